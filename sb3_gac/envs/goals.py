"""Goal environments: their goals as entries of their own, for hindsight, or as part of ``partial``."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_gac.envs.spaces import PARTIAL, box_entry, concatenate_boxes, take_from_box
from sb3_gac.envs.wrappers import Observation, reset_with

ACHIEVED_GOAL, DESIRED_GOAL = GOALS = ("achieved_goal", "desired_goal")


class AppendDesiredGoal(gym.Wrapper):
    """
    Append ``desired_goal`` to other entries, and drop both goals' own entries: the goal is a command that a policy reads with
    what it measures.  SB3's ``HerReplayBuffer`` needs those entries as they are: leave this wrapper out for it.

    :param env: environment with a Dict observation that has ``desired_goal``, see ``keep`` of
        :class:`~sb3_gac.envs.wrappers.SplitDictObservation`
    :param to: keys of the entries that get the goal, one-dimensional float32
    :raises ValueError: if ``to`` is no list of keys, or there is no such entry
    """

    def __init__(self, env: gym.Env, to: Sequence[str] = (PARTIAL,)):
        super().__init__(env)
        if isinstance(to, str):
            raise ValueError(f"to must be a list of keys, got {to!r}.")
        space = env.observation_space
        goal = take_from_box(box_entry(space, DESIRED_GOAL), slice(None))
        self._to = tuple(to)
        kept = {key: entry for key, entry in space.spaces.items() if key not in GOALS}  # type: ignore[attr-defined]
        joined = {key: concatenate_boxes([box_entry(space, key), goal]) for key in self._to}
        self.observation_space = spaces.Dict({**kept, **joined})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """
        :param seed: of the environment
        :param options: of the environment
        :return: observation, info
        """
        observation, info = reset_with(self.env, seed, options)
        return self._with_goal(observation), info

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """
        :param action: of the environment
        :return: observation, reward, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._with_goal(observation), reward, terminated, truncated, info

    def _with_goal(self, observation: Observation) -> Observation:
        kept = {key: value for key, value in observation.items() if key not in GOALS}
        goal = np.ravel(observation[DESIRED_GOAL])
        return {**kept, **{key: np.concatenate([observation[key], goal], dtype=np.float32) for key in self._to}}
