"""Histories: the steps before a transition in its episode."""

from typing import NamedTuple

import numpy as np
import torch as th


class Histories(NamedTuple):
    """
    The K steps before each of B transitions, the oldest first; zeros before the episode's start.

    :param observations: observations of these steps, (K, B, ...) of each entry
    :param actions: actions of these steps, in [-1, 1], shape (K, B, A), or numbers of discrete actions, shape (K, B, 1)
    :param mask: 1 for steps of the transition's own episode, 0 before its start, shape (K, B)
    """

    observations: dict[str, th.Tensor]
    actions: th.Tensor
    mask: th.Tensor

    @classmethod
    def of(cls, entries: dict[str, th.Tensor], actions: th.Tensor, mask: th.Tensor) -> "Histories":
        """
        Histories whose observations are set to zero before an episode's start.

        :param entries: observations, (K * B, ...) of each entry, with any values before an episode's start
        :param actions: actions, shape (K, B, A), zero before an episode's start
        :param mask: 1 for steps of the transition's own episode, 0 before its start, shape (K, B)
        :return: histories of B transitions
        """
        observations = {key: entry.unflatten(0, mask.shape) for key, entry in entries.items()}
        ones = {key: mask.view(*mask.shape, *[1] * (entry.dim() - 2)) for key, entry in observations.items()}
        return cls({key: entry * ones[key].to(entry.dtype) for key, entry in observations.items()}, actions, mask)


def check_samples_histories(replay_buffer_class: type | None) -> None:
    """
    Check that an algorithm whose batches have histories gets them.

    :param replay_buffer_class: class of the algorithm's replay buffer, ``None`` for the default
    :raises ValueError: if the class can't sample histories
    """
    if replay_buffer_class is not None and not hasattr(replay_buffer_class, "sample_with_histories"):
        raise ValueError(
            f"replay_buffer_class={replay_buffer_class.__name__} can't sample what came before a transition: leave it out, or "
            "give CompactDictReplayBuffer or a subclass."
        )


def steps_before(steps: np.ndarray, length: int) -> np.ndarray:
    """
    :param steps: steps of transitions, shape (B,)
    :param length: number of steps before each transition, K
    :return: steps before each transition, the oldest first, shape (K, B)
    """
    return steps - np.arange(length, 0, -1)[:, None]


def unbroken(goes_on: np.ndarray) -> np.ndarray:
    """
    :param goes_on: whether the episode goes on after each step, the oldest step first, shape (K, B)
    :return: whether the episode goes on after a step and after all later steps, shape (K, B)
    """
    return np.logical_and.accumulate(goes_on[::-1], axis=0)[::-1]
