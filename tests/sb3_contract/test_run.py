"""SB3's contract: the constructor, and ``learn()`` with every argument of SAC."""

import inspect

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise

from sb3_gac.algorithms import algorithm_class
from tests.helpers import optimizers_of
from tests.registry import LINES, algorithms, load, make, on_policy
from tests.sb3_contract.helpers import pendulum


def _is_finite(model):
    return all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


#: Of PPO's arguments, those whose defaults are the method's own, and those that methods with two views have no use for
OWN_DEFAULTS, WITHOUT = {"clip_range", "vf_coef", "max_grad_norm"}, {"clip_range_vf", "rollout_buffer_class"}
WITHOUT |= {"rollout_buffer_kwargs"}


@algorithms()
def test_constructor_has_sb3s_arguments_in_sb3s_order_with_sb3s_defaults(algorithm):
    """SAC's, and on-policy PPO's."""
    theirs = inspect.signature((PPO if on_policy(algorithm) else SAC).__init__).parameters
    ours = inspect.signature(algorithm_class(algorithm).__init__).parameters
    names = [name for name in theirs if "sde" not in name and name not in WITHOUT - set(ours)]
    if on_policy(algorithm):
        names.remove("target_kl")  # means another thing here
        last = "vf_coef"
        names.remove("max_grad_norm")  # by name, as off-policy
    else:
        last = "target_entropy"
    assert [name for name in ours if name in names] == names
    assert list(ours)[: names.index(last) + 1] == names[: names.index(last) + 1]
    same = [name for name in names if not (on_policy(algorithm) and name in OWN_DEFAULTS)]
    assert {name: ours[name].default for name in same} == {name: theirs[name].default for name in same}
    assert all(ours[name].default is not inspect.Parameter.empty for name in ours if name not in names)


@algorithms()
def test_gsde_is_refused(algorithm):
    with pytest.raises(TypeError, match="use_sde"):
        make(algorithm, pendulum(), use_sde=True)


@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy"])
@algorithms()
def test_policies_for_other_observations_are_refused(algorithm, policy):
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        algorithm_class(algorithm)(policy, pendulum())


@pytest.mark.parametrize("ent_coef", ["auto_0.1", 0.01])
@algorithms("temperature")
def test_entropy_coefficient_is_learned_or_fixed(algorithm, ent_coef):
    noise = NormalActionNoise(np.zeros(1), np.zeros(1))
    model = make(algorithm, pendulum(), ent_coef=ent_coef, action_noise=noise, **LINES[algorithm].one_phase).learn(20)
    start = 0.1 if isinstance(ent_coef, str) else ent_coef
    assert (model.ent_coef_tensor.item() != pytest.approx(start)) == isinstance(ent_coef, str)
    assert _is_finite(model)


@pytest.mark.parametrize("n_critics", [1, 3])
@algorithms("critics")
def test_number_of_critics(algorithm, n_critics):
    model = make(algorithm, pendulum(), policy_kwargs={"n_critics": n_critics}).learn(20)
    obs, _ = model.policy.obs_to_tensor(model.get_env().reset())
    pairs = [model.policy.pairs[role] for role in model.policy.roles.critics if role in model.policy.pairs]
    assert pairs
    for critic, target in pairs:
        assert critic(obs, th.zeros(1, 1)).shape == target(obs, th.zeros(1, 1)).shape == (n_critics, 1)


@algorithms()
def test_every_algorithm_learns(algorithm):
    model = make(algorithm, pendulum())
    before = [parameter.clone() for parameter in model.actor.parameters()]
    model.learn(40)
    assert _is_finite(model)
    assert not any(th.equal(old, new) for old, new in zip(before, model.actor.parameters(), strict=True))


@pytest.mark.parametrize("noise", [NormalActionNoise, OrnsteinUhlenbeckActionNoise])
@algorithms("replay")
def test_action_noise_is_added_and_clipped(algorithm, noise):
    strong = noise(np.zeros(1), 100 * np.ones(1))
    model = make(algorithm, pendulum(), action_noise=strong, learning_starts=0, gradient_steps=0).learn(30)
    assert np.isin(model.replay_buffer.actions[: model.replay_buffer.pos], [-1, 1]).mean() > 0.5


@pytest.mark.parametrize(("train_freq", "n_updates"), [(4, 5), ((10, "step"), 2), ((1, "episode"), 2)])
@algorithms("replay")
def test_train_freq_survives_save_and_load(algorithm, tmp_path, train_freq, n_updates):
    env = pendulum(max_episode_steps=10)
    model = make(algorithm, env, learning_starts=0, train_freq=train_freq, gradient_steps=1).learn(20)
    assert model._n_updates == n_updates
    model.save(tmp_path / "model.zip")
    env = model.get_env()
    for kwargs in ({}, {"train_freq": train_freq}):
        loaded = load(algorithm, tmp_path / "model.zip", env, **kwargs)
        assert loaded.train_freq == model.train_freq
        loaded.learn(20)
        assert loaded._n_updates > model._n_updates


@pytest.mark.parametrize("train_freq", ["4", ("1", "episode"), "non_sense", (1, "close")])
@algorithms("replay")
def test_bad_train_freq_is_refused(algorithm, train_freq):
    with pytest.raises(ValueError, match="train_freq"):
        make(algorithm, pendulum(), train_freq=train_freq)


@pytest.mark.parametrize(("gradient_steps", "per_round"), [(3, 3), (0, 0), (-1, 6)])
@algorithms("replay")
def test_gradient_steps_with_several_environments(algorithm, gradient_steps, per_round):
    env = make_vec_env(lambda: gym.wrappers.TimeLimit(pendulum(), 50), n_envs=2)
    train_freq = 3
    model = make(algorithm, env, learning_starts=0, train_freq=train_freq, gradient_steps=gradient_steps)
    model.learn(total_timesteps=train_freq)
    if gradient_steps == 0:
        assert model._n_updates == 0
    else:
        assert model.logger.name_to_value["train/n_updates"] == per_round


@algorithms("replay")
def test_action_noise_is_vectorized_for_several_environments(algorithm):
    env = make_vec_env(lambda: gym.wrappers.TimeLimit(pendulum(), 20), n_envs=2)
    noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    model = make(algorithm, env, action_noise=noise).learn(30)
    assert isinstance(model.action_noise, VectorizedActionNoise)
    assert model.action_noise.n_envs == 2
    assert model.num_timesteps == 30


@pytest.mark.parametrize("interval", [1, 5])
@algorithms("critics")
def test_target_update_interval(algorithm, interval):
    options = {"target_update_interval": interval, "tau": 1.0, **LINES[algorithm].one_phase}
    model = make(algorithm, pendulum(), **options).learn(20)
    pairs = list(zip(model.critic.parameters(), model.critic_target.parameters(), strict=True))
    if model._n_updates % interval:
        model.train(interval - model._n_updates % interval)
    assert all(th.equal(param, target) for param, target in pairs)
    model.train(1)
    assert all(th.equal(param, target) for param, target in pairs) == (interval == 1)


@algorithms()
def test_learning_rate_schedule_reaches_the_optimizers(algorithm):
    model = make(algorithm, pendulum(), learning_rate=lambda progress: 1e-4 * (1 + progress)).learn(20)
    lr = model.logger.name_to_value["train/learning_rate"]
    assert lr == pytest.approx(1e-4)
    if "temperature" not in LINES[algorithm].lacks:
        assert model.ent_coef_optimizer.param_groups[0]["lr"] == pytest.approx(lr)
    for optimizer in optimizers_of(model.policy):
        assert optimizer.param_groups[0]["lr"] == pytest.approx(lr)


@algorithms()
def test_training_continues_without_resetting_the_timesteps(algorithm):
    model = make(algorithm, pendulum())
    for reset_num_timesteps, now, collected in ((True, 20, 20), (False, 40, 40), (True, 20, 60)):
        model.learn(20, reset_num_timesteps=reset_num_timesteps)
        assert model.num_timesteps == now
        assert on_policy(algorithm) or model.replay_buffer.pos == collected


@algorithms()
def test_model_learns_on_a_new_environment(algorithm):
    model = make(algorithm, pendulum()).learn(20)
    if not on_policy(algorithm):
        with pytest.raises(AssertionError, match="filled by 1 environments, but the model has 2"):
            model.set_env(make_vec_env(pendulum, n_envs=2))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.set_env(gym.make("Pendulum-v1"))
    model.set_env(pendulum(), force_reset=True)
    assert model._last_obs is None
    assert model.learn(20, reset_num_timesteps=False).num_timesteps == 40
