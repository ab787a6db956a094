"""An environment whose episodes have lengths of their own, report successes and can be drawn; and policies for it."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import FilterObservation

from sb3_gac.envs import History, SensorNoise
from sb3_gac.evaluation.policies import EvaluatedPolicy

ENV = "tests.evaluation.helpers:Walk"


class Walk(gym.Env):
    """
    A position with a random drift, seen in ``partial``, and the drift in ``privileged``; the action is added to it, the reward
    is what it is near 0. An episode ends at random, or after 30 steps, and is a success if it ends within 1 of 0.

    :param render_mode: "rgb_array" or none
    """

    def __init__(self, render_mode=None):
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 25}
        self.render_mode = render_mode
        self.observation_space = spaces.Dict(
            partial=spaces.Box(-np.inf, np.inf, (2,), np.float32), privileged=spaces.Box(-np.inf, np.inf, (1,), np.float32)
        )
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.drift, self.steps = self.np_random.normal(), self.np_random.normal() / 3, 0
        return self._observe(), {}

    def step(self, action):
        self.position += self.drift + float(action[0])
        self.steps += 1
        is_over = bool(self.np_random.random() < 0.1)
        info = {"is_success": abs(self.position) < 1}
        return self._observe(), 1 - abs(self.position), is_over, self.steps == 30, info

    def render(self):
        if self.render_mode is None:
            return None
        return np.full((51, 60, 3), 100 + self.steps, np.uint8)

    def _observe(self):
        partial = np.array([self.position, self.steps], np.float32)
        return {"partial": partial, "privileged": np.array([self.drift], np.float32)}


def noisy_walk(noise_std=0.2, history=1, **kwargs):
    """With noise as an argument of its own, and a history."""
    env = SensorNoise(Walk(**kwargs), noise_std)
    return env if history == 1 else History(env, history, actions=True)


def blind_walk():
    """That nobody can draw."""
    return Walk()


def walk_without_privileged():
    """As on the robot."""
    return FilterObservation(Walk(), ["partial"])


class Remembering(EvaluatedPolicy):
    """Moves against the mean of the positions that it has seen in the episode."""

    def __init__(self):
        super().__init__({"partial": (2,)})

    def start(self, n_envs):
        self.sums, self.counts = np.zeros(n_envs), np.zeros(n_envs)

    def act(self, observations, starts):
        self.sums[starts], self.counts[starts] = 0, 0
        self.sums += observations["partial"][:, 0]
        self.counts += 1
        return -np.clip(self.sums / self.counts, -1, 1)[:, None].astype(np.float32)
