"""Goals of goal environments: entries of their own, for hindsight, or parts of ``partial``."""

from collections.abc import Collection, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_gac.envs.entries import RECEIVED
from sb3_gac.envs.spaces import PARTIAL, box_entry, concatenate_boxes, take_from_box
from sb3_gac.envs.wrappers import Observation, reset_with

ACHIEVED_GOAL, DESIRED_GOAL = GOALS = ("achieved_goal", "desired_goal")


class AppendDesiredGoal(gym.Wrapper):
    """
    Append ``desired_goal`` to other entries, and drop the entries of both goals.

    The desired goal is a command, which a policy reads beside its measurements.  SB3's ``HerReplayBuffer`` needs both goals as
    entries of their own: leave this wrapper out for it.

    :param env: environment with a Dict observation that has ``desired_goal``, which ``keep`` of
        :class:`~sb3_gac.envs.wrappers.SplitDictObservation` leaves there
    :param to: keys of the entries that get the goal; these entries are vectors of floats
    :raises ValueError: if ``to`` is no list of keys, or the observation lacks one of the entries, or has one of another kind
    """

    _place = RECEIVED

    def __init__(self, env: gym.Env, to: Sequence[str] = (PARTIAL,)):
        super().__init__(env)
        if not isinstance(to, Collection) or isinstance(to, str):
            raise ValueError(f"to must be a list of keys, got {to!r}.")
        self._to = tuple(to)
        space = env.observation_space
        goal = take_from_box(box_entry(space, DESIRED_GOAL), slice(None))
        kept = {key: entry for key, entry in space.spaces.items() if key not in GOALS}  # type: ignore[attr-defined]
        entries = {key: box_entry(space, key) for key in self._to}
        for key, entry in entries.items():
            if len(entry.shape) != 1 or not np.issubdtype(entry.dtype, np.floating):
                raise ValueError(f'AppendDesiredGoal needs a one-dimensional, floating-point entry "{key}", not {entry}.')
        joined = {key: concatenate_boxes([entry, goal]) for key, entry in entries.items()}
        self._types = {key: entry.dtype for key, entry in entries.items()}
        self.observation_space = spaces.Dict({**kept, **joined})

    @property
    def changed_entries(self) -> Sequence[str]:
        """Keys of the entries that get the goal, see :func:`sb3_gac.envs.entries.entries_changed_by`."""
        return self._to

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """
        :param seed: seed of the environment, ``None`` to go on with its random numbers
        :param options: options of the environment's reset
        :return: observation, info
        """
        observation, info = reset_with(self.env, seed, options)
        return self._with_goal(observation), info

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """
        :param action: action for the environment
        :return: observation, reward, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._with_goal(observation), reward, terminated, truncated, info

    def _with_goal(self, observation: Observation) -> Observation:
        kept = {key: value for key, value in observation.items() if key not in GOALS}
        goal = np.ravel(observation[DESIRED_GOAL])
        joined = {key: np.concatenate([observation[key], goal], dtype=dtype) for key, dtype in self._types.items()}
        return {**kept, **joined}
