"""Episodes of a policy, each from a seed of its own, whatever happens in the others."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from sb3_gac.evaluation.policies import EvaluatedPolicy


class Episode(NamedTuple):
    """
    What came of one.

    :param total: sum of its rewards
    :param length: steps
    :param success: ``is_success`` of its last step's info, ``None`` where the environment does not report it
    """

    total: float
    length: int
    success: bool | None


def run_episodes(
    policy: EvaluatedPolicy,
    envs: Sequence[gym.Env],
    seeds: Sequence[int],
    on_end: Callable[[], None] = lambda: None,
) -> list[Episode]:
    """
    Run episodes side by side. Each begins with a reset by its seed, so that it is the same in whatever order they end.

    :param policy: to act, deterministically
    :param envs: as many as are to run side by side, no more than episodes; those without one left wait for the others
    :param seeds: one for each episode
    :param on_end: called whenever an episode has ended
    :return: one for each seed, in that order
    """
    results: dict[int, Episode] = {}
    waiting = iter(range(len(seeds)))
    slots = [_Slot(env, waiting, seeds) for env in envs]
    policy.start(len(slots))
    while any(slot.episode is not None for slot in slots):
        batch = {key: np.stack([slot.observation[key] for slot in slots]) for key in slots[0].observation}
        actions = policy.act(batch, np.array([slot.starts for slot in slots]))
        for slot, action in zip(slots, actions, strict=True):
            ended = slot.step(action)
            if ended is not None:
                results[ended[0]] = ended[1]
                on_end()
    return [results[number] for number in range(len(seeds))]


class _Slot:
    """An environment and the number of the episode that it is in, ``None`` if none is left for it."""

    episode: int | None

    def __init__(self, env: gym.Env, waiting: Any, seeds: Sequence[int]):
        self._env, self._waiting, self._seeds = env, waiting, seeds
        self.observation: Any = None
        self._next_episode()

    def _next_episode(self) -> None:
        self.episode, self._total, self._length, self.starts = next(self._waiting, None), 0.0, 0, True
        if self.episode is not None:
            self.observation, _ = self._env.reset(seed=self._seeds[self.episode])

    def step(self, action: Any) -> tuple[int, Episode] | None:
        """
        :param action: in the environment's range
        :return: number of the episode that has ended, and what came of it
        """
        if self.episode is None:
            return None
        self.observation, reward, terminated, truncated, info = self._env.step(action)
        self._total, self._length, self.starts = self._total + float(reward), self._length + 1, False
        if not (terminated or truncated):
            return None
        success = info.get("is_success")
        ended = self.episode, Episode(self._total, self._length, None if success is None else bool(success))
        self._next_episode()
        return ended
