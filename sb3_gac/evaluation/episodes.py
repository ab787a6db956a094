"""Episodes of a policy, each from a seed of its own and independent of the others."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from sb3_gac.evaluation.policies import EvaluatedPolicy

_MANY = 10_000  # steps after which an episode may be one that never ends


class Episode(NamedTuple):
    """
    The result of an episode.

    :param total: sum of the episode's rewards
    :param length: number of steps
    :param success: ``is_success`` in the last step's info, ``None`` where the environment does not report it
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
    Run episodes side by side.

    Each episode begins with a reset by its seed, so its result does not depend on the order in which episodes end.

    :param policy: policy that acts, deterministically
    :param envs: environments that run side by side, no more than there are episodes; an environment without an episode left
        waits for the others
    :param seeds: seeds, one for each episode
    :param on_end: function that is called whenever an episode has ended
    :return: results, one for each seed, in the order of the seeds
    """
    results: dict[int, Episode] = {}
    waiting = iter(range(len(seeds)))
    slots = [_Slot(env, waiting, seeds) for env in envs]
    policy.start(len(slots))
    steps = 0
    while any(slot.episode is not None for slot in slots):
        batch = {key: np.stack([slot.observation[key] for slot in slots]) for key in slots[0].observation}
        steps += 1
        if steps == _MANY and not results:
            warnings.warn(
                f"No episode has ended in {steps:,} steps. If the environment's episodes never end, stop, and give it a time "
                "limit: register it with max_episode_steps, or wrap it in gymnasium.wrappers.TimeLimit.",
                stacklevel=2,
            )
        actions = policy.act(batch, np.array([slot.starts for slot in slots]))
        for slot, action in zip(slots, actions, strict=True):
            ended = slot.step(action)
            if ended is not None:
                results[ended[0]] = ended[1]
                on_end()
    return [results[number] for number in range(len(seeds))]


class _Slot:
    """An environment and the number of its current episode, which is ``None`` if no episode is left for it."""

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
        Take a step, and begin the next episode if the step has ended one.

        :param action: action in the environment's range
        :return: number and result of the episode, if this step has ended it, otherwise ``None``
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
