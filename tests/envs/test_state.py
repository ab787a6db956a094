"""The state of an environment in the middle of an episode, taken down and put back."""

from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor

from sb3_gac.envs import History, PreviousAction, SensorNoise, SplitObservation
from sb3_gac.envs.state import NotRestorableError, env_state, restore_env_state
from tests.helpers import TwoViewBandit

TASKS = ["HalfCheetah", "Ant", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum", "Hopper", "Walker2d", "Swimmer"]


def _cheetah_with_history():
    env = SplitObservation(gym.make("HalfCheetah-v5"), partial=range(8), privileged=range(17))
    return PreviousAction(History(SensorNoise(SensorNoise(env, 0.1), 0.2), length=3, actions=True), reward=True)


def _pendulum():
    return SensorNoise(SplitObservation(gym.make("Pendulum-v1"), partial=[0, 1], privileged=[0, 1, 2]), 0.1)


MAKERS = {task: lambda task=task: gym.make(f"sb3_gac/{task}-v5", noise_std=0.1) for task in TASKS} | {
    "history": _cheetah_with_history,
    "pendulum": _pendulum,
    "own methods": lambda: gym.wrappers.TimeLimit(TwoViewBandit(noise_std=0.3, length=9), 7),
}


def _go_on(env, actions):
    """All that the environment returns, episode after episode."""
    seen = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append((deepcopy(observation), reward, terminated, truncated))
        if terminated or truncated:
            seen.append(deepcopy(env.reset()[0]))
    return seen


@pytest.mark.parametrize("name", MAKERS)
def test_another_environment_goes_on_to_the_bit(name):
    env, other = Monitor(MAKERS[name]()), Monitor(MAKERS[name]())
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(120)]
    env.reset(seed=3)
    _go_on(env, actions[:55])
    state = env_state(env)
    expected = _go_on(env, actions[55:])
    other.reset(seed=99)
    _go_on(other, actions[:3])
    restore_env_state(other, state)
    np.testing.assert_equal(_go_on(other, actions[55:]), expected)
    assert other.episode_returns == env.episode_returns


@pytest.mark.parametrize("name", MAKERS)
def test_an_environment_that_was_never_reset_takes_a_state_from_before_the_first_step(name):
    env, other = MAKERS[name](), MAKERS[name]()
    env.reset(seed=0)
    state = env_state(env)
    restore_env_state(other, state)
    actions = [env.action_space.sample() for _ in range(5)]
    np.testing.assert_equal(_go_on(other, actions), _go_on(env, actions))


def test_a_state_from_before_the_first_reset():
    env, other = _pendulum(), _pendulum()
    restore_env_state(other, env_state(env))
    np.testing.assert_equal(other.reset(seed=0)[0], env.reset(seed=0)[0])


class _Unknown(gym.Wrapper):
    pass


def test_an_unknown_layer_is_named():
    with pytest.raises(NotRestorableError, match=r"test_state\._Unknown.*checkpoint_state\(\)"):
        env_state(_Unknown(TwoViewBandit()))


def test_other_layers_are_named():
    env = gym.wrappers.TimeLimit(TwoViewBandit(), 7)
    env.reset(seed=0)
    with pytest.raises(NotRestorableError, match=r"made of \['tests.*, but the checkpoint's was made of \['.*TimeLimit"):
        restore_env_state(TwoViewBandit(), env_state(env))
