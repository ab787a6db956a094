"""Types of a gradient step's data: batches of transitions, outputs of policies for them, and losses."""

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
    A batch of B transitions, ``*E`` = (B,), or of B sequences of T transitions from episodes' starts on, ``*E`` = (T, B).

    :param observations: dict of entries, each of shape (\*E, ...)
    :param actions: actions in [-1, 1], shape (\*E, A), or numbers of discrete actions, shape (\*E, 1)
    :param rewards: rewards, shape (\*E)
    :param next_observations: dict of entries, each of shape (\*E, ...)
    :param dones: 1 where the episode terminated, 0 where it went on or was truncated by its time limit, shape (\*E)
    :param discounts: gamma to the power of the number of steps that the reward sums up, scalar or shape (\*E)
    :param sequence: observations of sequences together with the last next observation, each entry of shape (T + 1, B, ...);
        ``None`` for transitions
    :param mask: mask of sequences, 1 for steps that losses count, 0 for padding and for steps that only bring memories up to
        date, shape (T, B); ``None`` for transitions
    :param histories: the steps before each transition, if the algorithm's ``history_length`` is above 0, else ``None``
    :param critic_weights: 1 for transitions that critics learn from, 0 for the others, shape (\*E); ``None`` if critics learn
        from all
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
        Make a batch of a replay buffer's samples.

        :param samples: transitions or sequences that a replay buffer has sampled
        :param gamma: discount factor, for samples without discounts of their own
        :param histories: the steps before each transition, or ``None``
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
        Run a policy's network on the batch; a network with a memory takes one pass over each sequence.

        :param policy: network of a policy
        :return: distributions of its actions for the observations and, as constants, for the next observations
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

        :param next_q: values of the N target critics at the next observations, shape (N, \*E)
        :param reward: rewards in place of the batch's, shape (\*E); ``None`` for the batch's
        :param terms: further arguments of :func:`sb3_gac.math.losses.soft_target`: log-probability and KL at the next
            observations, each of shape (\*E), and their weights
        :return: target, shape (\*E)
        """
        reward = self.rewards if reward is None else reward
        return soft_target(reward=reward, done=self.dones, next_q=next_q, discount=self.discounts, **terms)

    @th.no_grad()
    def q_at_obs(self, critic: Any) -> Callable[[Any], th.Tensor]:
        """
        The critics as a function of actions at the batch's observations.

        :param critic: ensemble of critics, whose encoder and memory run here once, without gradients
        :return: function: actions -> values of the critics, differentiable with respect to the actions
        """
        return partial(critic.values, critic.encode(self.observations))

    @th.no_grad()
    def q_at_next_obs(self, critic: Any) -> Callable[[Any], th.Tensor]:
        """
        The critics as a function of actions at the batch's next observations.

        :param critic: ensemble of critics, whose encoder and memory run here once, without gradients
        :return: function: actions -> values of the critics
        """
        if critic.memory is None:
            return partial(critic.values, critic.encode(self.next_observations))
        return partial(critic.values, critic.encode(self.sequence)[:, 1:])


class Outputs(NamedTuple):
    """
    Outputs of a policy's network for a batch.

    :param now: output for the observations, with its gradient
    :param later: output for the next observations, a constant
    """

    now: Any
    later: Any


class Loss(NamedTuple):
    """
    A loss, with what is measured along with it.

    :param value: quantity that a network minimises, scalar
    :param metrics: name -> scalar, quantities to log or to update coefficients with
    """

    value: th.Tensor
    metrics: Metrics
