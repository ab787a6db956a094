"""Observers of environments in this process: of who uses them, and of each episode's last observation."""

import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gac.checks.spaces import entries_of

FINAL = "terminal_observation"  # SB3's name of an episode's last observation in an info
USE = "_sb3_gac_use"
SUSPICIOUS_ENDS = 5


class EnvironmentUse:
    """
    Counts steps and resets of an environment, whoever calls them.

    An evaluation, for example, may step the same environment from vectorised environments of its own.

    :param env: environment without wrappers
    """

    def __init__(self, env: Any):
        self.count = 0
        self._step, self._reset = env.step, env.reset
        vars(env).update({"step": self.step, "reset": self.reset, USE: self})

    @classmethod
    def of(cls, env: Any) -> "EnvironmentUse":
        """
        The counter of an environment, made at the first call.

        :param env: environment with or without wrappers
        :return: counter of the environment
        """
        inner = env.unwrapped
        return vars(inner)[USE] if USE in vars(inner) else cls(inner)

    def step(self, *args: Any, **kwargs: Any) -> Any:
        """Count a step and take it; this method replaces the environment's ``step``."""
        self.count += 1
        return self._step(*args, **kwargs)

    def reset(self, *args: Any, **kwargs: Any) -> Any:
        """Count a reset and make it; this method replaces the environment's ``reset``."""
        self.count += 1
        return self._reset(*args, **kwargs)


class KeepingFinal:
    """
    Copies an episode's last observation before the environment's ``reset``, which it replaces.

    DummyVecEnv holds the last observation by reference, and the environment may write the next episode's first observation
    into the same arrays.

    :param reset: the environment's own ``reset``
    """

    def __init__(self, reset: Callable[..., Any]):
        self._reset = reset
        self._places: list[tuple[weakref.ref[DummyVecEnv], int]] = []

    @classmethod
    def of(cls, env: Any) -> "KeepingFinal":
        """
        Replace an environment's ``reset``, unless that is done already.

        :param env: environment with the wrappers that it has in DummyVecEnv
        :return: object that replaces the environment's ``reset``
        """
        if not isinstance(vars(env).get("reset"), cls):
            vars(env)["reset"] = cls(env.reset)
        return vars(env)["reset"]

    def __getstate__(self) -> dict[str, Any]:
        """State for a copy of the environment, without places: where the copy will be held is not known."""
        return {"_reset": self._reset, "_places": []}

    def add(self, vec_env: DummyVecEnv, index: int) -> None:
        """
        Add a place where the environment is held.

        :param vec_env: vectorised environments that hold the environment
        :param index: index of the environment among them
        """
        self._places = [place for place in self._places if place[0]() is not None] + [(weakref.ref(vec_env), index)]

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        for place, index in self._places:
            vec_env = place()
            info = {} if vec_env is None else vec_env.buf_infos[index]
            if FINAL in info:
                info[FINAL] = deepcopy(info[FINAL])
        return self._reset(*args, **kwargs)


class SuspiciousEnds:
    """
    Warns once if the last observation of each of several episodes equals the first observation of the next.

    The two are equal if an environment in another process writes into arrays that it returned before, or if the last
    observation is taken after the reset.
    """

    def __init__(self) -> None:
        self._in_a_row = 0
        self._before: Mapping[str, Any] | None = None

    def look_at(self, observation: Any, dones: np.ndarray, infos: Sequence[dict[str, Any]]) -> None:
        """
        Look at a step of all environments.

        :param observation: observations of all environments after the step
        :param dones: booleans, true where the step ended an episode, shape (n_envs,)
        :param infos: info dict of each environment, which holds the last observation of an episode that has ended
        """
        if self._in_a_row < SUSPICIOUS_ENDS:
            now, before = entries_of(observation), self._before
            for index in [] if before is None else np.flatnonzero(dones).tolist():
                final = entries_of(infos[index][FINAL])
                if not _are_equal(final, now, index):
                    self._in_a_row = 0
                elif before is not None and not _are_equal(final, before, index):
                    self._in_a_row += 1
            self._before = now
            if self._in_a_row >= SUSPICIOUS_ENDS:
                warnings.warn(
                    f"The last observation of each of the last {self._in_a_row} episodes is the first one of the next. "
                    "Does the environment write into the arrays that it returned before, or is the last observation taken "
                    "after the reset? Then what is learned of ends of episodes is wrong: return new arrays, taken before it.",
                    stacklevel=2,
                )


def _are_equal(final: Mapping[str, Any], observation: Mapping[str, Any], index: int) -> bool:
    """Whether an episode's last observation equals that of environment ``index`` in the observations of all."""
    return all(np.array_equal(final[key], values[index]) for key, values in observation.items())
