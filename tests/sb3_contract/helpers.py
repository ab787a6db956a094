"""SB3's test environments with Dict observations."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.envs import IdentityEnvBox
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gac.envs import PARTIAL, PRIVILEGED, SplitObservation


class AsDict(gym.Wrapper):
    """
    Turn an observation into Dict entries.

    :param env: any environment
    :param entries: those that hold its observation; the other of ``partial`` and ``privileged`` holds a random vector
    """

    def __init__(self, env: gym.Env, entries: tuple[str, ...] = (PARTIAL, PRIVILEGED)):
        super().__init__(env)
        vector = spaces.Box(-1, 1, (2,), np.float32)
        self._entries = entries
        self.observation_space = spaces.Dict(
            {key: env.observation_space if key in entries else vector for key in (PARTIAL, PRIVILEGED)}
        )

    def _dict(self, observation: Any) -> dict[str, Any]:
        fill = self.observation_space.spaces
        return {key: observation if key in self._entries else fill[key].sample() for key in (PARTIAL, PRIVILEGED)}

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        return self._dict(observation), info

    def step(self, action):
        observation, *rest = self.env.step(action)
        return self._dict(observation), *rest


class Renamed(gym.ObservationWrapper):
    """
    Rename the entries of a Dict observation.

    :param env: with Dict observations
    :param names: old name -> new name
    """

    def __init__(self, env: gym.Env, names: dict[str, str]):
        super().__init__(env)
        self._names = names
        self.observation_space = spaces.Dict(self.observation(env.observation_space.spaces))

    def observation(self, observation):
        return {self._names.get(key, key): value for key, value in observation.items()}


class RandomEnv(gym.Env):
    """
    Random observations and no reward.

    :param observation_space: of any kind
    :param action_space: of any kind
    :param max_episode_steps: time limit
    """

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space, max_episode_steps: int = 20):
        self.observation_space = observation_space
        self.action_space = action_space
        self.max_episode_steps = max_episode_steps

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.n_steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.n_steps += 1
        return self.observation_space.sample(), 0.0, False, self.n_steps >= self.max_episode_steps, {}


ACTIONS = spaces.Box(-1, 1, (2,), np.float32)


def pendulum(max_episode_steps: int = 200) -> gym.Env:
    """Pendulum whose velocity is privileged."""
    env = gym.make("Pendulum-v1", max_episode_steps=max_episode_steps)
    return SplitObservation(env, partial=[0, 1], privileged=[2])


def identity(low: float = -10, high: float = 10, eps: float = 0.05) -> gym.Env:
    """SB3's IdentityEnvBox, whose observation is both partial and privileged."""
    return AsDict(IdentityEnvBox(low, high, eps))


def vectorized(make_env=identity, n_envs: int = 1) -> VecEnv:
    """``n_envs`` environments in this process."""
    return DummyVecEnv([make_env] * n_envs)


def sample_observations(env: VecEnv, n_steps: int = 10) -> dict[str, np.ndarray]:
    """A batch of observations under random actions."""
    env.reset()
    steps = [env.step(np.stack([env.action_space.sample() for _ in range(env.num_envs)]))[0] for _ in range(n_steps)]
    return {key: np.concatenate([step[key] for step in steps]) for key in steps[0]}
