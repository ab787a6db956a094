"""Discrete actions, for GAC and the SAC family: learning, routing of gradients, SB3's contract."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_gac import GAC, AsymmetricSAC
from sb3_gac.networks.critics import DiscreteCriticEnsemble
from sb3_gac.networks.encoders import VectorExtractor
from tests.gac.helpers import steps_of
from tests.helpers import TwoViewChoice, small_model

ALGORITHMS = [GAC, AsymmetricSAC]


@pytest.mark.parametrize("arguments", [{}, {"guider": "independent"}, {"cls": AsymmetricSAC}])
def test_the_deployed_policy_learns_to_choose(arguments):
    """Ten steps, three actions, both views tell which is right: near 10; by chance 3.3."""
    settings = {"learning_rate": 3e-3, "learning_starts": 100, "batch_size": 64, "gamma": 0.5, "ent_coef": 0.05}
    model = small_model(TwoViewChoice(length=10), **settings, policy_kwargs={"net_arch": [32]}, **arguments).learn(1500)
    env = make_vec_env(TwoViewChoice, 1, seed=1, env_kwargs={"length": 10})
    returns, _ = evaluate_policy(model, env, n_eval_episodes=40, warn=False)
    assert returns > 8


def test_kl_is_held_at_its_target_where_only_the_guider_knows():
    """
    Noise hides the target from the learner; the guider leans towards it, as far as the constraint lets it.

    So near each other, KL is nearly the same either way: its direction is the plain step's to tell (test_plain_step.py).
    """
    env = TwoViewChoice(noise_std=100.0, length=10)
    model = small_model(env, learning_starts=100, target_kl=0.02, gamma=0.5, learning_rate=3e-3, batch_size=64).learn(1500)
    observations = [env.reset(seed=seed)[0] for seed in range(300)]
    obs = {key: np.stack([observation[key] for observation in observations]) for key in observations[0]}
    with th.no_grad():
        guider, learner, _ = model.policy.distributions(model.policy.obs_to_tensor(obs)[0])
    mu, pi = (policy.logits.double().softmax(-1) for policy in (guider, learner))
    assert 0.01 < (mu * (mu / pi).log()).sum(dim=-1).mean() < 0.04
    right = th.as_tensor(np.digitize(obs["privileged"], [-0.8 / 3, 0.8 / 3]))
    of_guider, of_learner = (policy.logits.softmax(-1).gather(-1, right).mean() for policy in (guider, learner))
    assert of_guider > of_learner + 0.02


def test_each_loss_reaches_its_own_network():
    model = small_model(TwoViewChoice(length=5), learning_starts=1000, learner_kl_scale=1.0).learn(64)
    before = {name: p.clone() for name, p in model.policy.named_parameters()}
    for step in steps_of(model, model._sample_batch(16)):
        model.minimize(step.network, step.loss, *step.tensors)
        changed = {name.split(".")[0] for name, p in model.policy.named_parameters() if not th.equal(p, before[name])}
        assert changed == {step.network}
        before = {name: p.clone() for name, p in model.policy.named_parameters()}


@pytest.mark.parametrize("net_arch", [[], [8], [8, 8]])
def test_critics_value_every_action_and_the_one_taken(net_arch):
    space = spaces.Dict(partial=spaces.Box(-1, 1, (3,), np.float32))
    critic = DiscreteCriticEnsemble(space, spaces.Discrete(4), net_arch, VectorExtractor(space), 3, n_critics=3)
    obs, actions = {"partial": th.randn(5, 3)}, th.tensor([[0], [3], [1], [1], [2]])
    every, taken = critic(obs), critic(obs, actions)
    assert every.shape == (3, 5, 4)
    for row, action in enumerate(actions[:, 0]):
        assert th.equal(taken[:, row], every[:, row, action])


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_saved_and_loaded_it_acts_and_goes_on_as_before(cls, tmp_path):
    model = small_model(TwoViewChoice(length=5), cls=cls).learn(50)
    model.save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model", env=TwoViewChoice(length=5))
    partial = np.random.default_rng(0).normal(size=(64, 2)).astype(np.float32)
    expected, _ = model.predict({"partial": partial}, deterministic=True)
    assert np.array_equal(loaded.predict({"partial": partial}, deterministic=True)[0], expected)
    assert expected.shape == (64,)
    assert model.predict({"partial": partial[0]})[0].shape == ()
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 70


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_equal_seeds_give_equal_results_with_several_environments(cls):
    def trained():
        env = make_vec_env(TwoViewChoice, 3, env_kwargs={"length": 4}, seed=1)
        model = small_model(env, cls=cls, n_steps=2).learn(90)
        return th.cat([p.flatten() for p in model.policy.parameters()])

    assert th.equal(trained(), trained())


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_compiled_steps_are_plain_steps(cls):
    models = [small_model(TwoViewChoice(length=5), cls=cls, learning_starts=1000, compile=flag).learn(64) for flag in (0, 1)]
    for model in models:
        np.random.seed(0)
        model.train(3, 16)
    for p, q in zip(*(model.policy.parameters() for model in models), strict=True):
        th.testing.assert_close(p, q, rtol=1e-4, atol=1e-6)


def test_target_entropy_is_a_share_of_a_uniform_choices():
    for name, share in (("auto", 0.9), ("sac", 0.98)):
        assert small_model(TwoViewChoice(), target_entropy=name).target_entropy == pytest.approx(share * np.log(3))


def test_the_guider_acts_and_starts_next_to_its_learner():
    model = small_model(TwoViewChoice())
    obs = {"partial": np.zeros((7, 2), np.float32), "privileged": np.ones((7, 1), np.float32)}
    actions, _ = model.predict_guider(obs)
    assert actions.shape == (7,)
    assert set(actions) <= {0, 1, 2}
    guider, learner, _ = model.policy.distributions(model.policy.obs_to_tensor(obs)[0])
    assert guider.kl(learner).max() < 1e-3
