"""What a gradient step works on and with: batches of data, what policies make of them, losses."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_gac.math.losses import soft_target
from sb3_gac.networks.actors import RolePolicy
from sb3_gac.replay.histories import Histories
from sb3_gac.replay.samples import SequenceSamples

#: Name -> detached scalar, left on the device
Metrics = dict[str, th.Tensor]


class Batch(NamedTuple):
    r"""
    A batch of transitions, ``*E`` = (B,), or of sequences of them from episodes' starts on, ``*E`` = (T, B).

    :param observations: dict of entries, (\*E, ...) of each
    :param actions: in [-1, 1], shape (\*E, A), or numbers of actions, shape (\*E, 1)
    :param rewards: shape (\*E)
    :param next_observations: dict of entries, (\*E, ...) of each
    :param dones: 1 where the episode terminated, 0 where it went on or ran into its time limit, shape (\*E)
    :param discounts: gamma to the number of steps that the reward sums up, scalar or shape (\*E)
    :param sequence: of sequences, observations and the last next one together, (T + 1, B, ...) of each entry
    :param mask: of sequences, 1 for what counts, 0 for padding and for what only brings memories up, shape (T, B)
    :param histories: of transitions, what came before each, if the algorithm's ``history_length`` asks for it
    :param critic_weights: 1 for what critics learn from, 0 for what they leave, shape (\*E); ``None`` if they learn from all
    """

    observations: PyTorchObs
    actions: th.Tensor
    rewards: th.Tensor
    next_observations: PyTorchObs
    dones: th.Tensor
    discounts: th.Tensor
    sequence: PyTorchObs | None = None
    mask: th.Tensor | None = None
    histories: Histories | None = None
    critic_weights: th.Tensor | None = None

    @classmethod
    def of(cls, samples: Any, gamma: float, histories: Histories | None = None) -> "Batch":
        """
        :param samples: of a replay buffer
        :param gamma: discount factor, where they have none of their own
        :param histories: see :class:`Batch`
        """
        discounts = getattr(samples, "discounts", None)
        if discounts is None:
            discounts = th.full((), gamma, device=samples.rewards.device)
        if isinstance(samples, SequenceSamples):
            now = {key: entry[:-1] for key, entry in samples.observations.items()}
            later = {key: entry[1:] for key, entry in samples.observations.items()}
            what_happened = (samples.actions, samples.rewards, later, samples.dones)
            weights = samples.critic_weights
            return cls(now, *what_happened, discounts, samples.observations, samples.mask, critic_weights=weights)
        weights = getattr(samples, "critic_weights", None)
        return cls(
            samples.observations,
            samples.actions,
            samples.rewards.flatten(),
            samples.next_observations,
            samples.dones.flatten(),
            discounts.flatten() if discounts.dim() else discounts,
            histories=histories,
            critic_weights=None if weights is None else weights.flatten(),
        )

    def outputs(self, policy: RolePolicy) -> "Outputs":
        """
        :param policy: a policy's network
        :return: its distributions for the observations and, as constants, for the next ones; with a memory in one pass
        """
        if policy.memory is None:
            now = policy.distribution(self.observations)
            with th.no_grad():
                return Outputs(now, policy.distribution(self.next_observations))
        both: Any = policy.distribution(self.sequence)  # type: ignore[arg-type]
        return Outputs(type(both)(*(part[:-1] for part in both)), type(both)(*(part[1:].detach() for part in both)))

    def soft_target(self, next_q: th.Tensor, reward: th.Tensor | None = None, **terms: th.Tensor | float) -> th.Tensor:
        r"""
        The Bellman target of these transitions.

        :param next_q: target critics at the next observations, shape (N, \*E)
        :param reward: in place of the batch's, shape (\*E)
        :param terms: of :func:`sb3_gac.math.losses.soft_target`: entropy and KL at the next observations, and their weights
        :return: shape (\*E)
        """
        reward = self.rewards if reward is None else reward
        return soft_target(reward=reward, done=self.dones, next_q=next_q, discount=self.discounts, **terms)

    @th.no_grad()
    def q_at_obs(self, critic: Any) -> Callable[[Any], th.Tensor]:
        """
        :param critic: an ensemble, frozen
        :return: actions at the observations -> values, differentiable by the actions
        """
        return partial(critic.values, critic.encode(self.observations))

    @th.no_grad()
    def q_at_next_obs(self, critic: Any) -> Callable[[Any], th.Tensor]:
        """
        :param critic: an ensemble, frozen
        :return: actions at the next observations -> values
        """
        if critic.memory is None:
            return partial(critic.values, critic.encode(self.next_observations))
        return partial(critic.values, critic.encode(self.sequence)[:, 1:])


class Outputs(NamedTuple):
    """
    What a policy's network computes for a batch.

    :param now: for the observations, with its gradient
    :param later: for the next observations, constant
    """

    now: Any
    later: Any


class Loss(NamedTuple):
    """
    :param value: what a network minimises, scalar
    :param metrics: what else is to be logged, or is needed for the coefficients, scalars
    """

    value: th.Tensor
    metrics: Metrics
