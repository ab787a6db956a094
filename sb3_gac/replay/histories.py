"""What came before a transition, in its episode."""

from typing import NamedTuple

import numpy as np
import torch as th


class Histories(NamedTuple):
    """
    The K steps before each of B transitions, the oldest first; zeros before the episode's start.

    :param observations: dict of entries, (K, B, ...) of each
    :param actions: that followed them, in [-1, 1], shape (K, B, A), or numbers of actions, shape (K, B, 1)
    :param mask: 1 for steps of the transition's own episode, 0 before its start, shape (K, B)
    """

    observations: dict[str, th.Tensor]
    actions: th.Tensor
    mask: th.Tensor

    @classmethod
    def of(cls, entries: dict[str, th.Tensor], actions: th.Tensor, mask: th.Tensor) -> "Histories":
        """
        :param entries: dict of entries, (K * B, ...) of each, whatever they are before an episode's start
        :param actions: shape (K, B, A)
        :param mask: shape (K, B)
        """
        observations = {key: entry.unflatten(0, mask.shape) for key, entry in entries.items()}
        ones = {key: mask.view(*mask.shape, *[1] * (entry.dim() - 2)) for key, entry in observations.items()}
        return cls({key: entry * ones[key].to(entry.dtype) for key, entry in observations.items()}, actions, mask)


def check_samples_histories(replay_buffer_class: type | None) -> None:
    """
    :param replay_buffer_class: of an algorithm whose batches have histories, ``None`` for the default
    :raises ValueError: if it can't sample them
    """
    if replay_buffer_class is not None and not hasattr(replay_buffer_class, "sample_with_histories"):
        raise ValueError(
            f"replay_buffer_class={replay_buffer_class.__name__} can't sample what came before a transition: leave it out, or "
            "give CompactDictReplayBuffer or a subclass."
        )


def steps_before(steps: np.ndarray, length: int) -> np.ndarray:
    """
    :param steps: of transitions, shape (B,)
    :param length: K
    :return: the steps before each, the oldest first, shape (K, B)
    """
    return steps - np.arange(length, 0, -1)[:, None]


def unbroken(goes_on: np.ndarray) -> np.ndarray:
    """
    :param goes_on: whether the episode goes on after each of the steps, the oldest first, shape (K, B)
    :return: whether it does after that and all later ones, shape (K, B)
    """
    return np.logical_and.accumulate(goes_on[::-1], axis=0)[::-1]
