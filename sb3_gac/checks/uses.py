"""What is to be known of environments in this process: who uses them, and what becomes of an episode's last observation."""

import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gac.checks.values import entries_of

FINAL = "terminal_observation"  # SB3's name of an episode's last observation in an info
USE = "_sb3_gac_use"
SUSPICIOUS_ENDS = 5


class EnvironmentUse:
    """
    Counts steps and resets of an environment, whoever calls them: an evaluation may have it in vectorised environments of
    its own.

    :param env: without wrappers
    """

    def __init__(self, env: Any):
        self.count = 0
        self._step, self._reset = env.step, env.reset
        vars(env).update({"step": self.step, "reset": self.reset, USE: self})

    @classmethod
    def of(cls, env: Any) -> "EnvironmentUse":
        """
        :param env: with or without wrappers
        :return: the one that counts for it
        """
        inner = env.unwrapped
        return vars(inner)[USE] if USE in vars(inner) else cls(inner)

    def step(self, *args: Any, **kwargs: Any) -> Any:
        """In the place of the environment's own."""
        self.count += 1
        return self._step(*args, **kwargs)

    def reset(self, *args: Any, **kwargs: Any) -> Any:
        """In the place of the environment's own."""
        self.count += 1
        return self._reset(*args, **kwargs)


class KeepingFinal:
    """
    In the place of an environment's ``reset``: DummyVecEnv holds an episode's last observation by reference, and the
    environment may write the next episode's first one into the same arrays.

    :param reset: the environment's own
    """

    def __init__(self, reset: Callable[..., Any]):
        self._reset = reset
        self._places: list[tuple[weakref.ref[DummyVecEnv], int]] = []

    @classmethod
    def of(cls, env: Any) -> "KeepingFinal":
        """
        :param env: as DummyVecEnv has it
        :return: what is in the place of its ``reset`` from now on
        """
        if not isinstance(vars(env).get("reset"), cls):
            vars(env)["reset"] = cls(env.reset)
        return vars(env)["reset"]

    def __getstate__(self) -> dict[str, Any]:
        """Of a copy of the environment it is not known where that will be held."""
        return {"_reset": self._reset, "_places": []}

    def add(self, vec_env: DummyVecEnv, index: int) -> None:
        """
        :param vec_env: that holds the environment
        :param index: under which it does
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
    Says once if the last observation of every episode is the first one of the next. An environment in another process that
    writes into the arrays it returned before looks like that, and so does one that is asked for it after its reset.
    """

    def __init__(self) -> None:
        self._in_a_row = 0
        self._before: Mapping[str, Any] | None = None

    def look_at(self, observation: Any, dones: np.ndarray, infos: Sequence[dict[str, Any]]) -> None:
        """
        :param observation: of all environments, after a step
        :param dones: whether an episode has ended, shape (n_envs,)
        :param infos: with the last observations
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
    """Whether an episode's last observation is what an environment has among those of all."""
    return all(np.array_equal(final[key], values[index]) for key, values in observation.items())
