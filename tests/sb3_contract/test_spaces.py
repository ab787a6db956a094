"""SB3's contract: observation entries of every kind, float64 and multi-dimensional actions; the others are refused."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan

from sb3_gac.envs import PARTIAL, PRIVILEGED
from tests.registry import algorithms, is_taught, make, on_policy
from tests.sb3_contract.helpers import ACTIONS, AsDict, RandomEnv, identity, pendulum

FLOAT32 = spaces.Box(-1, 1, (2,), np.float32)
FLOAT64 = spaces.Box(-1, 1, (2,), np.float64)
DISCRETE_ENTRIES = [
    spaces.MultiDiscrete([4, 3]),
    spaces.MultiBinary(8),
    spaces.MultiBinary((3, 2)),
    spaces.Discrete(4),
]


@pytest.mark.parametrize("entry", [FLOAT32, *DISCRETE_ENTRIES], ids=str)
def test_environments_of_these_tests_are_valid(entry):
    check_env(AsDict(RandomEnv(entry, ACTIONS)), skip_render_check=True)


@pytest.mark.parametrize("make_env", [pendulum, identity])
def test_named_environments_of_these_tests_are_valid(make_env):
    check_env(make_env(), warn=False, skip_render_check=True)


def _check_entry(algorithm, entry):
    env = AsDict(RandomEnv(entry, ACTIONS))
    model = make(algorithm, env, gamma=0.5, seed=1).learn(20)
    returns, lengths = evaluate_policy(model, env, n_eval_episodes=2, warn=False, return_episode_rewards=True)
    assert lengths == [20, 20]
    assert returns == [0, 0]
    for size in (1, 3):
        batch = np.stack([np.asarray(entry.sample()) for _ in range(size)])
        assert model.predict({PARTIAL: batch})[0].shape == (size, 2)
    assert model.predict({PARTIAL: entry.sample()})[0].shape == (2,)


@algorithms()
def test_a_discrete_observation_entry(algorithm):
    _check_entry(algorithm, spaces.MultiDiscrete([4, 3]))


@pytest.mark.parametrize("entry", DISCRETE_ENTRIES[1:], ids=str)
def test_other_discrete_observation_entries(entry):
    _check_entry("gac", entry)


def _untaught(algorithm, env):
    return make(algorithm, env, **({"teacher": None} if is_taught(algorithm) else {}))


@pytest.mark.parametrize(
    "space",
    [spaces.MultiDiscrete([4, 3]), spaces.MultiBinary(3)],
    ids=str,
)
@algorithms()
def test_other_actions_are_refused(algorithm, space):
    with pytest.raises(AssertionError, match="supports Box and Discrete action spaces"):
        _untaught(algorithm, AsDict(RandomEnv(FLOAT32, space)))


@algorithms()
def test_observations_that_are_not_a_dict_are_refused(algorithm):
    with pytest.raises(ValueError, match="must be a Dict"):
        _untaught(algorithm, gym.make("Pendulum-v1"))


@pytest.mark.parametrize(
    ("observation_space", "action_space"),
    [
        (FLOAT64, FLOAT64),
        (FLOAT32, spaces.Box(-1, 1, (2, 2), np.float32)),
        (FLOAT64, spaces.Box(np.array([-2, 0], np.float64), np.array([1, 5], np.float64), dtype=np.float64)),
    ],
    ids=str,
)
@algorithms()
def test_float64_and_multi_dimensional_spaces(algorithm, observation_space, action_space):
    env = AsDict(RandomEnv(observation_space, action_space), entries=(PARTIAL,))
    model = make(algorithm, env).learn(20)
    assert model._n_updates > 0
    if not on_policy(algorithm):  # SB3's rollouts have the space's
        assert model.replay_buffer.actions.dtype == np.float32
    obs, _ = env.reset()
    guiders = [model.predict_guider] if hasattr(model, "predict_guider") else []
    for act in (model.predict, *guiders):
        for deterministic in (False, True):
            action, _ = act(obs, deterministic=deterministic)
            assert action.dtype == action_space.dtype
            assert action_space.contains(action)


class _NanEnv(RandomEnv):
    """Observations turn into NaN at the third step."""

    def step(self, action):
        obs, *rest = super().step(action)
        return obs * (np.float32("nan") if self.n_steps == 3 else 1), *rest


@pytest.mark.parametrize("wrapper", [VecCheckNan, None])
@algorithms()
def test_nan_observations_stop_training(algorithm, wrapper):
    env = DummyVecEnv([lambda: AsDict(_NanEnv(FLOAT32, ACTIONS), entries=(PRIVILEGED,))])
    if wrapper is not None:
        env = wrapper(env, raise_exception=True)
    model = make(algorithm, env)
    with pytest.raises(ValueError, match=r"(?i)nan.*privileged|privileged.*nan"):
        model.learn(10)
    if not on_policy(algorithm):
        assert not np.isnan(model.replay_buffer.next_observations[PRIVILEGED]).any()
    assert (model.rollout_buffer if on_policy(algorithm) else model.replay_buffer).pos == 2
