"""Types of samples from replay buffers that SB3 does not have."""

from typing import NamedTuple

import torch as th


class WeightedSamples(NamedTuple):
    """
    SB3's ``DictReplayBufferSamples`` with weights for the critics' losses.

    :param critic_weights: 0 for transitions that a time limit truncated, else 1, shape (B,)
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

    :param observations: observations and the final next observation of each sequence, (T + 1, B, ...) of each entry
    :param actions: actions in [-1, 1], shape (T, B, A), or numbers of discrete actions, shape (T, B, 1)
    :param rewards: rewards, shape (T, B)
    :param dones: 1 where the episode terminated, else 0, shape (T, B)
    :param mask: 1 for transitions that losses count, 0 for padding and for transitions that only bring memories up to date,
        shape (T, B)
    :param critic_weights: 0 for transitions that a time limit truncated, else 1, shape (T, B); ``None`` without
        ``mask_truncations``
    """

    observations: dict[str, th.Tensor]
    actions: th.Tensor
    rewards: th.Tensor
    dones: th.Tensor
    mask: th.Tensor
    critic_weights: th.Tensor | None = None
