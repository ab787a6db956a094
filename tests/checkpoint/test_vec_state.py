"""The state of vectorised environments: taken once, put back, and not that of the environments that went on."""

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_gac.checkpoint.vec_env import restore_vec_env_state, vec_env_state
from sb3_gac.envs import SensorNoise
from tests.helpers import TwoViewBandit


def _env():
    return VecNormalize(VecMonitor(DummyVecEnv([lambda: TwoViewBandit(length=7)] * 2)))


def _steps(env, n):
    return [env.step(np.full((2, 1), 0.3, np.float32)) for _ in range(n)]


def test_what_follows_is_what_followed():
    """Observations, normalised rewards, ends of episodes and their returns."""
    env, other = _env(), _env()
    env.seed(0)
    for one in (env, other):
        one.reset()
    _steps(env, 10)
    state = vec_env_state(env)
    followed = _steps(env, 20)
    assert restore_vec_env_state(other, state) == ""
    for expected, actual in zip(followed, _steps(other, 20), strict=True):
        for before, after in zip(expected[:3], actual[:3], strict=True):
            np.testing.assert_equal(after, before)
        assert [info.get("episode", {}).get("r") for info in actual[3]] == [
            info.get("episode", {}).get("r") for info in expected[3]
        ]
    assert other.venv.episode_count == env.venv.episode_count


class _Unknown(gym.Wrapper):
    """A wrapper whose state nobody knows."""


def test_settings_are_kept_where_episodes_cannot_be():
    env, other = (DummyVecEnv([lambda: _Unknown(SensorNoise(TwoViewBandit(), 0.1))] * 2) for _ in range(2))
    env.envs[1].env.noise_std = 0.3
    assert "_Unknown" in restore_vec_env_state(other, vec_env_state(env))
    assert [float(one.env.noise_std) for one in other.envs] == [np.float32(0.1), np.float32(0.3)]
