"""What replay buffers give, where SB3 has no type for it."""

from typing import NamedTuple

import torch as th


class WeightedSamples(NamedTuple):
    """
    SB3's ``DictReplayBufferSamples``, and how much critics learn from each.

    :param critic_weights: 0 for what ended by a time limit, else 1, shape (B,)
    """

    observations: dict[str, th.Tensor]
    actions: th.Tensor
    next_observations: dict[str, th.Tensor]
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    critic_weights: th.Tensor


class SequenceSamples(NamedTuple):
    """
    B sequences of up to T transitions, padded with zeros at their ends.

    :param observations: dict of entries, (T + 1, B, ...) of each: the last valid one is the last next observation
    :param actions: shape (T, B, A)
    :param rewards: shape (T, B)
    :param dones: 1 where the episode terminated, shape (T, B)
    :param mask: 1 for what counts, 0 for padding and for the steps before it that only bring memories up, shape (T, B)
    :param critic_weights: 0 for what ended by a time limit, else 1, shape (T, B), if ``mask_truncations`` asks for it
    """

    observations: dict[str, th.Tensor]
    actions: th.Tensor
    rewards: th.Tensor
    dones: th.Tensor
    mask: th.Tensor
    critic_weights: th.Tensor | None = None
