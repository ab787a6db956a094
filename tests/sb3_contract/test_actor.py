"""SB3's contract: the actor is called with observations and returns actions, as SAC's does; policies say what was built."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_gac import GAC, AsymmetricSAC, GACShare, GACWithoutQ
from tests.helpers import Recall, TwoViewBandit, TwoViewChoice, small_model
from tests.sb3_contract.helpers import AsDict, make_gac

ALGORITHMS = [GAC, GACShare, GACWithoutQ, AsymmetricSAC]


class InfiniteHorizon(gym.Env):
    """A reward of 1 in every step, for ever: the value of every state is 1 / (1 - gamma)."""

    def __init__(self, n_states: int = 4):
        self.observation_space = spaces.Discrete(n_states)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._state = 0
        return self._state, {}

    def step(self, action):
        self._state = (self._state + 1) % int(self.observation_space.n)
        return self._state, 1.0, False, False, {}


@pytest.mark.parametrize("handle_timeout_termination", [False, True])
def test_infinite_horizon(handle_timeout_termination):
    """A time limit bootstraps: without that the value is that of 8 steps, 7.5."""
    gamma = 0.98
    model = make_gac(
        AsDict(gym.wrappers.TimeLimit(InfiniteHorizon(), 8)),
        gamma=gamma,
        seed=1,
        tau=0.5,
        learning_rate=0.01,
        learning_starts=0,
        policy_kwargs={"n_critics": 1},
        replay_buffer_kwargs={"handle_timeout_termination": handle_timeout_termination},
    ).learn(400)
    obs = model.policy.obs_to_tensor(model.get_env().reset())[0]
    value = model.critic(obs, model.actor(obs))[0].item()
    assert (abs(1 / (1 - gamma) - value) < 5.0) == handle_timeout_termination, value


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("kind", ["Box", "Discrete", "recurrent"])
def test_the_actor_returns_the_actions_that_predict_scales(cls, kind):
    env = {"Box": TwoViewBandit, "Discrete": TwoViewChoice, "recurrent": lambda: Recall(continuous=True)}[kind]()
    policy = "MultiInputGruPolicy" if kind == "recurrent" else "MultiInputPolicy"
    model = small_model(env, cls, policy=policy)
    observation = {key: np.stack([space.sample() for _ in range(5)]) for key, space in env.observation_space.items()}
    obs, _ = model.policy.obs_to_tensor(observation)
    actions = model.actor(obs, deterministic=True)
    assert actions.shape == ((5,) if kind == "Discrete" else (5, 1))
    expected, _ = model.predict(observation, deterministic=True)
    np.testing.assert_allclose(actions.detach().numpy(), expected, rtol=1e-4, atol=1e-6)
    for alone in (model.policy, model.policy.actor):
        th.testing.assert_close(alone(obs, deterministic=True), actions)
    assert any(not th.equal(model.actor(obs), actions) for _ in range(20)), "samples, if not told otherwise"


def test_a_gaussian_actors_samples_are_differentiable():
    model = small_model()
    obs, _ = model.policy.obs_to_tensor(model.get_env().reset())
    model.critic(obs, model.actor(obs)).sum().backward()
    assert model.actor.head.log_std.weight.grad.abs().sum() > 0


def test_the_learner_under_its_own_name_returns_its_distribution_and_is_the_actor():
    model = small_model()
    obs, _ = model.policy.obs_to_tensor(model.get_env().reset())
    assert th.equal(model.policy.learner(obs).mode, model.actor(obs, deterministic=True))
    assert [id(p) for p in model.actor.parameters()] == [id(p) for p in model.policy.learner.parameters()]
    model.actor.set_training_mode(True)
    assert model.policy.learner.training


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("policy_kwargs", [{}, {"net_arch": None}])
def test_the_policy_says_what_was_built_where_no_net_arch_is_given(cls, policy_kwargs, tmp_path):
    model = small_model(cls=cls, policy_kwargs=policy_kwargs)
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    for policy in (model.policy, cls.load(tmp_path / "model").policy, type(model.policy).load(tmp_path / "policy")):
        assert policy.net_arch == [256, 256]
        assert policy.deployed.latent_net[0].out_features == 256
