"""SB3's contract: the constructor, and ``learn()`` with every argument of SAC."""

import inspect

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise

from sb3_gac import GAC, GACShare, GACWithoutQ
from tests.helpers import optimizers_of
from tests.sb3_contract.helpers import make_gac, pendulum


def _is_finite(model):
    return all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


def test_constructor_has_sacs_arguments_in_sacs_order_with_sacs_defaults():
    sac = [p for p in inspect.signature(SAC.__init__).parameters.values() if "sde" not in p.name]
    gac = inspect.signature(GAC.__init__).parameters
    names = [parameter.name for parameter in sac]
    assert [name for name in gac if name in names] == names
    assert {name: gac[name].default for name in names} == {parameter.name: parameter.default for parameter in sac}
    own = [name for name in gac if name not in names]
    assert list(gac)[: names.index("target_entropy") + 1] == names[: names.index("target_entropy") + 1]
    assert own
    assert all(gac[name].default is not inspect.Parameter.empty for name in own)


def test_gsde_is_refused():
    with pytest.raises(TypeError, match="use_sde"):
        make_gac(use_sde=True)


@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy"])
def test_policies_for_other_observations_are_refused(policy):
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        GAC(policy, pendulum())


@pytest.mark.parametrize("ent_coef", ["auto", 0.01, "auto_0.1"])
def test_entropy_coefficient_is_learned_or_fixed(ent_coef):
    noise = NormalActionNoise(np.zeros(1), np.zeros(1))
    model = make_gac(ent_coef=ent_coef, action_noise=noise, verbose=0).learn(40)
    start = 0.1 if isinstance(ent_coef, str) else ent_coef
    assert (model.ent_coef_tensor.item() != pytest.approx(start)) == isinstance(ent_coef, str)
    assert _is_finite(model)


@pytest.mark.parametrize("n_critics", [1, 2, 3])
def test_number_of_critics(n_critics):
    model = make_gac(policy_kwargs={"n_critics": n_critics}).learn(30)
    obs, _ = model.policy.obs_to_tensor(model.get_env().reset())
    for critic, target in model.policy.pairs.values():
        assert critic(obs, th.zeros(1, 1)).shape == target(obs, th.zeros(1, 1)).shape == (n_critics, 1)


@pytest.mark.parametrize("model_class", [GAC, GACShare, GACWithoutQ])
def test_every_variant_learns(model_class):
    model = make_gac(model_class=model_class)
    before = [parameter.clone() for parameter in model.actor.parameters()]
    model.learn(40)
    assert _is_finite(model)
    assert not any(th.equal(old, new) for old, new in zip(before, model.actor.parameters(), strict=True))


@pytest.mark.parametrize("noise", [NormalActionNoise, OrnsteinUhlenbeckActionNoise])
def test_action_noise_is_added_and_clipped(noise):
    model = make_gac(action_noise=noise(np.zeros(1), 100 * np.ones(1)), learning_starts=0, gradient_steps=0).learn(30)
    assert np.isin(model.replay_buffer.actions[: model.replay_buffer.pos], [-1, 1]).mean() > 0.5


@pytest.mark.parametrize(("train_freq", "n_updates"), [(4, 10), ((4, "step"), 10), ((1, "episode"), 2), (1, 40)])
def test_train_freq_survives_save_and_load(tmp_path, train_freq, n_updates):
    model = make_gac(pendulum(max_episode_steps=20), learning_starts=0, train_freq=train_freq, gradient_steps=1).learn(40)
    assert model._n_updates == n_updates
    model.save(tmp_path / "model.zip")
    env = model.get_env()
    for kwargs in ({}, {"train_freq": train_freq}):
        loaded = GAC.load(tmp_path / "model.zip", env=env, **kwargs)
        assert loaded.train_freq == model.train_freq
        loaded.learn(40)
        assert loaded._n_updates > model._n_updates


@pytest.mark.parametrize("train_freq", ["4", ("1", "episode"), "non_sense", (1, "close")])
def test_bad_train_freq_is_refused(train_freq):
    with pytest.raises(ValueError, match="train_freq"):
        make_gac(train_freq=train_freq)


@pytest.mark.parametrize(("gradient_steps", "per_round"), [(3, 3), (0, 0), (-1, 6)])
def test_gradient_steps_with_several_environments(gradient_steps, per_round):
    env = make_vec_env(lambda: gym.wrappers.TimeLimit(pendulum(), 50), n_envs=2)
    train_freq = 3
    model = make_gac(env, learning_starts=0, train_freq=train_freq, gradient_steps=gradient_steps)
    model.learn(total_timesteps=train_freq)
    if gradient_steps == 0:
        assert model._n_updates == 0
    else:
        assert model.logger.name_to_value["train/n_updates"] == per_round


def test_action_noise_is_vectorized_for_several_environments():
    env = make_vec_env(lambda: gym.wrappers.TimeLimit(pendulum(), 20), n_envs=2)
    noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    model = make_gac(env, train_freq=5, action_noise=noise).learn(100)
    assert isinstance(model.action_noise, VectorizedActionNoise)
    assert model.action_noise.n_envs == 2
    assert model.num_timesteps == 100


@pytest.mark.parametrize("interval", [1, 5])
def test_target_update_interval(interval):
    model = make_gac(target_update_interval=interval, tau=1.0).learn(30)
    pairs = list(zip(model.critic.parameters(), model.critic_target.parameters(), strict=True))
    if model._n_updates % interval:
        model.train(interval - model._n_updates % interval)
    assert all(th.equal(param, target) for param, target in pairs)
    model.train(1)
    assert all(th.equal(param, target) for param, target in pairs) == (interval == 1)


def test_learning_rate_schedule_reaches_the_optimizers():
    model = make_gac(learning_rate=lambda progress: 1e-4 * (1 + progress)).learn(40)
    lr = model.logger.name_to_value["train/learning_rate"]
    assert lr == pytest.approx(1e-4)
    for optimizer in (*optimizers_of(model.policy), model.ent_coef_optimizer):
        assert optimizer.param_groups[0]["lr"] == pytest.approx(lr)


def test_training_continues_without_resetting_the_timesteps():
    model = make_gac().learn(40)
    model.learn(40, reset_num_timesteps=False)
    assert model.num_timesteps == 80
    assert model.replay_buffer.pos == 80
    model.learn(40)
    assert model.num_timesteps == 40
    assert model.replay_buffer.pos == 120


def test_model_learns_on_a_new_environment():
    model = make_gac().learn(30)
    with pytest.raises(AssertionError, match="filled by 1 environments, but the model has 2"):
        model.set_env(make_vec_env(pendulum, n_envs=2))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.set_env(gym.make("Pendulum-v1"))
    model.set_env(pendulum(), force_reset=True)
    assert model._last_obs is None
    assert model.learn(30, reset_num_timesteps=False).num_timesteps == 60
