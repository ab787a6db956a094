"""
Output layers of policy networks, by action space: a tanh-Gaussian for Box, a categorical distribution for Discrete.

This module, :mod:`sb3_gac.math.distributions` and the two critic ensembles are the only places that depend on the kind of
action.
"""

import math
from typing import Any

import numpy as np
import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from torch import nn

from sb3_gac.checks.spaces import UnsupportedActionSpaceError, check_box_actions
from sb3_gac.checks.values import check_positive, check_range
from sb3_gac.math.distributions import Categorical, TanhGaussian
from sb3_gac.math.losses import log_std_loss
from sb3_gac.networks.layers import Head

LOG_STD_BOUNDS = (-5.0, 1.0)


class GaussianHead(nn.Module):
    """
    Output layers for the mean and log standard deviation of actions before tanh.

    :param latent_dim: size of the last hidden layer, H
    :param action_space: Box of A dimensions
    :param log_std_bounds: smallest and largest log standard deviation before tanh
    :param softplus_min_std: smallest standard deviation of a head with softplus, see :func:`make_head`; ``None`` for a head
        with exp
    """

    def __init__(
        self,
        latent_dim: int,
        action_space: spaces.Box,
        log_std_bounds: tuple[float, float] = LOG_STD_BOUNDS,
        softplus_min_std: float | None = None,
    ):
        super().__init__()
        action_dim = spaces.flatdim(action_space)
        self.mean = Head(latent_dim, action_dim)
        self.log_std = Head(latent_dim, action_dim)
        self.log_std_bounds = log_std_bounds
        self.softplus_min_std = softplus_min_std

    def forward(self, latent: th.Tensor, detach_std: bool = False) -> TanhGaussian:
        """
        :param latent: activations of the last hidden layer, shape (\\*E, H)
        :param detach_std: whether the standard deviation's gradient stops at its output layer
        :return: distribution of actions, shapes (\\*E, A)
        """
        output = self.log_std(latent.detach() if detach_std else latent)
        if self.softplus_min_std is None:
            return TanhGaussian(self.mean(latent), output.clamp(*self.log_std_bounds))
        return TanhGaussian(self.mean(latent), (F.softplus(output) + self.softplus_min_std).log())

    def deployment_parameters(self) -> list[nn.Parameter]:
        """The parameters that serve at deployment only, if the standard deviation of training is the guider's."""
        return list(self.log_std.parameters())

    @staticmethod
    def deployment_losses(
        deployed: TanhGaussian, borrowing: TanhGaussian, mask: th.Tensor | None = None
    ) -> dict[str, th.Tensor]:
        """
        The losses that fit :meth:`deployment_parameters`.

        :param deployed: the learner's distribution with its own standard deviation, shapes (\\*E, A)
        :param borrowing: the learner's distribution with the guider's standard deviation, as a constant, shapes (\\*E, A)
        :param mask: 1 for valid steps and 0 for padding, shape (\\*E); ``None`` if all are valid
        :return: name of a loss -> scalar
        """
        return {"log_std_loss": log_std_loss(deployed.log_std, borrowing.log_std, mask)}

    @th.no_grad()
    def shrink(self, factor: float) -> None:
        """
        Make the initial means smaller.

        :param factor: factor that multiplies the weights and biases of the mean's layer
        """
        self.mean.weight.mul_(factor)
        self.mean.bias.mul_(factor)


class CategoricalHead(nn.Module):
    """
    Output layer for the unnormalised log-probabilities of discrete actions.

    :param latent_dim: size of the last hidden layer, H
    :param action_space: Discrete space of A actions
    """

    def __init__(self, latent_dim: int, action_space: spaces.Discrete):
        super().__init__()
        self.logits = Head(latent_dim, int(action_space.n))

    def forward(self, latent: th.Tensor, detach_std: bool = False) -> Categorical:
        """
        :param latent: activations of the last hidden layer, shape (\\*E, H)
        :param detach_std: without effect, since there is no standard deviation
        :return: distribution of actions, shape (\\*E, A)
        """
        return Categorical(self.logits(latent))

    def deployment_parameters(self) -> list[nn.Parameter]:
        """No parameters: the learner's distribution is the same in training and at deployment."""
        return []

    @staticmethod
    def deployment_losses(
        deployed: Categorical, borrowing: Categorical, mask: th.Tensor | None = None
    ) -> dict[str, th.Tensor]:
        """No losses, since no parameters serve at deployment only."""
        return {}

    @th.no_grad()
    def shrink(self, factor: float) -> None:
        """
        Make the initial logits smaller.

        :param factor: factor that multiplies the weights and biases of the layer
        """
        self.logits.weight.mul_(factor)
        self.logits.bias.mul_(factor)


def make_head(
    latent_dim: int,
    action_space: spaces.Space,
    log_std_bounds: tuple[float, float],
    softplus_min_std: float | None = None,
) -> nn.Module:
    """
    The head that fits an action space.

    :param latent_dim: size of the last hidden layer, H
    :param action_space: Box or Discrete space of actions
    :param log_std_bounds: smallest and largest log standard deviation before tanh, for Box
    :param softplus_min_std: smallest standard deviation, for Box: the standard deviation is ``softplus_min_std`` +
        softplus(output), as in Brax, where the smallest one is 0.001 (``NormalTanhDistribution``). ``None`` for exp(output),
        the output within ``log_std_bounds``
    :return: Gaussian head for Box, categorical head for Discrete
    :raises ValueError: if ``log_std_bounds`` is no range, ``softplus_min_std`` is no number above 0, or both are given
    """
    if isinstance(action_space, spaces.Discrete):
        return CategoricalHead(latent_dim, action_space)
    assert isinstance(action_space, spaces.Box)
    check_range("log_std_bounds", log_std_bounds)
    if softplus_min_std is not None:
        check_positive("softplus_min_std", softplus_min_std)
        if tuple(log_std_bounds) != LOG_STD_BOUNDS:
            raise ValueError(
                f"softplus_min_std={softplus_min_std} takes the place of log_std_bounds, which are {log_std_bounds!r}: leave "
                "one of the two out."
            )
    return GaussianHead(latent_dim, action_space, log_std_bounds, softplus_min_std)


def check_action_space(algorithm: str, action_space: spaces.Space) -> None:
    """
    Check whether there is a head for the environment's actions.

    :param algorithm: name of the algorithm, for the message
    :param action_space: action space of the environment
    :raises UnsupportedActionSpaceError: if there is no head for the space
    """
    if isinstance(action_space, spaces.Box):
        check_box_actions(action_space)
        return
    if isinstance(action_space, spaces.Discrete) and action_space.start == 0:
        return
    remedy = {
        spaces.MultiDiscrete: "Wrap the environment in sb3_gac.envs.FlattenMultiDiscrete, which numbers the combinations.",
        spaces.MultiBinary: "Wrap the environment so that its actions are MultiDiscrete, and that in "
        "sb3_gac.envs.FlattenMultiDiscrete.",
        spaces.Discrete: "Wrap the environment so that its actions count from 0.",
    }.get(type(action_space), "Wrap the environment so that its actions are continuous, or one of a number of choices.")
    raise UnsupportedActionSpaceError(
        f"{algorithm} supports Box and Discrete action spaces, but the environment has {action_space}. {remedy}"
    )


def resolve_target_entropy(target_entropy: Any, action_space: spaces.Space) -> float:
    """
    The target entropy in numbers.

    :param target_entropy: a number; "auto", the paper's: -0.5 for each action dimension, or 0.9 times the entropy of a uniform
        choice among discrete actions; "sac", SAC's: -1 for each action dimension, or 0.98 times the entropy of a uniform
        choice (arXiv 1910.07207)
    :param action_space: Box or Discrete space of actions
    :return: target entropy, in nats
    :raises ValueError: if ``target_entropy`` has another form
    """
    if isinstance(action_space, spaces.Discrete):
        named = {name: share * math.log(action_space.n) for name, share in (("auto", 0.9), ("sac", 0.98))}
    else:
        assert action_space.shape is not None
        named = {name: share * float(np.prod(action_space.shape)) for name, share in (("auto", -0.5), ("sac", -1.0))}
    if isinstance(target_entropy, str) and target_entropy in named:
        return named[target_entropy]
    try:
        number = float(target_entropy)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f'target_entropy must be "auto", "sac" or a number, got {target_entropy!r}.')
    return number


def resolve_target_divergence(target_divergence: str | float, action_space: spaces.Space) -> float:
    """
    The target divergence in numbers.

    :param target_divergence: a number; "auto": 0.5 for each action dimension, which is the KL of a mean that is off by one
        standard deviation, or half of the entropy of a uniform choice among discrete actions
    :param action_space: Box or Discrete space of actions
    :return: KL divergence, in nats, summed over action dimensions
    """
    if target_divergence != "auto":
        return float(target_divergence)
    if isinstance(action_space, spaces.Discrete):
        return 0.5 * math.log(action_space.n)
    return 0.5 * spaces.flatdim(action_space)
