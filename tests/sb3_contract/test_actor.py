"""SB3's contract: the actor is called with observations and returns actions, as SAC's does; policies say what was built."""

import inspect

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_gac.algorithms import algorithm_class
from tests.helpers import Recall, TwoViewBandit, TwoViewChoice, small_model
from tests.registry import LINES, algorithms, make, on_policy
from tests.sb3_contract.helpers import AsDict


class InfiniteHorizon(gym.Env):
    """A reward of 1 in every step, for ever: the value of every state is 1 / (1 - gamma), here 5."""

    def __init__(self, n_states: int = 3):
        self.observation_space = spaces.Discrete(n_states)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._state = 0
        return self._state, {}

    def step(self, action):
        self._state = (self._state + 1) % int(self.observation_space.n)
        return self._state, 1.0, False, False, {}


def _value_of_the_first_state(algorithm, **arguments):
    """Of rewards alone, in episodes of 2 steps: without entropy, divergences and teachers."""
    taken = inspect.signature(algorithm_class(algorithm)).parameters
    weights = {name: 0.0 for name in ("ent_coef", "kl_coef", "teacher_coef") if name in taken}
    if "temperature" in LINES[algorithm].lacks:
        del weights["ent_coef"]
    off_policy = {"learning_starts": 0, "tau": 1.0, "train_freq": 1, "policy_kwargs": {"n_critics": 1}}
    of_family = {"vf_coef": 1.0, "n_epochs": 8} if on_policy(algorithm) else off_policy
    env = AsDict(gym.wrappers.TimeLimit(InfiniteHorizon(), 2))
    model = make(algorithm, env, gamma=0.8, seed=1, learning_rate=0.1, **weights, **of_family, **arguments).learn(70)
    obs = model.policy.obs_to_tensor(model.get_env().reset())[0]
    with th.no_grad():
        return (model.critic(obs) if on_policy(algorithm) else model.critic(obs, model.actor(obs))[0]).item()


@algorithms()
def test_infinite_horizon(algorithm):
    """A time limit bootstraps: without that the value is at most that of 2 steps, 1.8."""
    assert _value_of_the_first_state(algorithm) > 2.3


def test_without_time_limits_the_horizon_is_finite():
    assert _value_of_the_first_state("gac", replay_buffer_kwargs={"handle_timeout_termination": False}) < 2.3


@pytest.mark.parametrize(
    ("kind", "algorithm"),
    [
        *(("Box", name) for name in LINES),
        *(("Discrete", name) for name in LINES),
        *(("recurrent", name) for name, line in LINES.items() if "memory" not in line.lacks),
    ],
)
def test_the_actor_returns_the_actions_that_predict_scales(kind, algorithm):
    env = {"Box": TwoViewBandit, "Discrete": TwoViewChoice, "recurrent": lambda: Recall(continuous=True)}[kind]()
    model = make(algorithm, env, policy="MultiInputGruPolicy" if kind == "recurrent" else "MultiInputPolicy")
    observation = {key: np.stack([space.sample() for _ in range(5)]) for key, space in env.observation_space.items()}
    obs, _ = model.policy.obs_to_tensor(observation)
    actions = model.actor(obs, deterministic=True)
    assert actions.shape == ((5,) if kind == "Discrete" else (5, 1))
    expected, _ = model.predict(observation, deterministic=True)
    np.testing.assert_allclose(actions.detach().numpy(), expected, rtol=1e-4, atol=1e-6)
    for alone in (model.policy, model.policy.actor):
        th.testing.assert_close(alone(obs, deterministic=True), actions)
    assert any(not th.equal(model.actor(obs), actions) for _ in range(20)), "samples, if not told otherwise"


@algorithms("critics")
def test_a_gaussian_actors_samples_are_differentiable(algorithm):
    model = make(algorithm, TwoViewBandit())
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


@algorithms()
def test_the_policy_says_what_was_built_where_no_net_arch_is_given(algorithm, tmp_path):
    model = make(algorithm, TwoViewBandit(), policy_kwargs={"net_arch": None})
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    loaded = algorithm_class(algorithm).load(tmp_path / "model", device="cpu")
    for policy in (model.policy, loaded.policy, type(model.policy).load(tmp_path / "policy", device="cpu")):
        assert policy.net_arch == [256, 256]
        assert policy.deployed.latent_net[0].out_features == 256


def test_the_policy_says_what_was_built_where_policy_kwargs_are_empty():
    assert small_model(policy_kwargs={}).policy.net_arch == [256, 256]
