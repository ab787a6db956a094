"""Layers of networks: last ones in float32, and those of an ensemble in one product."""

import math
from collections.abc import Callable

import torch as th
from torch import nn

INITIALIZATIONS = ("torch", "lecun_uniform")


def in_float32(layer: Callable[[th.Tensor], th.Tensor], x: th.Tensor) -> th.Tensor:
    """
    :param layer: one that stays in float32 where the layers before it are in mixed precision
    :param x: its input
    :return: its output
    """
    if not th.is_autocast_enabled(x.device.type):
        return layer(x)
    with th.autocast(x.device.type, enabled=False):
        return layer(x.float())


class Head(nn.Linear):
    """A last layer, in float32."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: shape (B, F)
        :return: shape (B, H)
        """
        return in_float32(super().forward, x)


class EnsembleLinear(nn.Module):
    """
    ``n_members`` linear layers in one batched product, each initialised like ``torch.nn.Linear``.

    :param n_members: size of the ensemble, N
    :param in_features: F
    :param out_features: H
    """

    def __init__(self, n_members: int, in_features: int, out_features: int):
        super().__init__()
        bound = in_features**-0.5
        self.weight = nn.Parameter(th.empty(n_members, in_features, out_features).uniform_(-bound, bound))
        self.bias = nn.Parameter(th.empty(n_members, 1, out_features).uniform_(-bound, bound))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: shape (N, B, F)
        :return: shape (N, B, H)
        """
        return th.bmm(x, self.weight) + self.bias


class EnsembleHead(EnsembleLinear):
    """Last layers of an ensemble, in float32."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: shape (N, B, F)
        :return: shape (N, B, H)
        """
        return in_float32(super().forward, x)


class EnsembleInput(nn.Module):
    """
    First layer of an ensemble, with separate weights for features and actions: where only the actions have a gradient,
    as in a policy's loss, only theirs is computed.

    :param n_members: size of the ensemble, N
    :param features_dim: F
    :param action_dim: A
    :param out_features: H
    """

    def __init__(self, n_members: int, features_dim: int, action_dim: int, out_features: int):
        super().__init__()
        layer = EnsembleLinear(n_members, features_dim + action_dim, out_features)
        self.features_weight = nn.Parameter(layer.weight.detach()[:, :features_dim].clone())
        self.actions_weight = nn.Parameter(layer.weight.detach()[:, features_dim:].clone())
        self.bias = layer.bias

    def forward(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param features: shape (N, B, F)
        :param actions: shape (B, A), or (K, B, A) for K actions to each row of features, whose product is computed once
        :return: shape (N, B, H), or (N, K B, H)
        """
        x = th.bmm(features, self.features_weight)
        if actions.dim() == 2:
            return th.baddbmm(x, actions.expand(len(features), *actions.shape), self.actions_weight) + self.bias
        rows = actions.flatten(0, 1)
        of_actions = th.bmm(rows.expand(len(features), *rows.shape), self.actions_weight).unflatten(1, actions.shape[:2])
        return (of_actions + (x + self.bias)[:, None]).flatten(1, 2)


class EnsembleOutput(nn.Module):
    """
    Last layer of an ensemble, one value each: a product and a sum, several times faster than so thin a matrix product.

    :param n_members: size of the ensemble, N
    :param in_features: H
    """

    def __init__(self, n_members: int, in_features: int):
        super().__init__()
        layer = EnsembleLinear(n_members, in_features, 1)
        self.weight = nn.Parameter(layer.weight.detach().transpose(1, 2).clone())
        self.bias = nn.Parameter(layer.bias.detach()[:, 0].clone())

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: shape (N, B, H)
        :return: shape (N, B)
        """
        return (x * self.weight).sum(dim=-1) + self.bias


@th.no_grad()
def lecun_uniform_(module: nn.Module) -> None:
    """
    Weights from U(-sqrt(3 / F), sqrt(3 / F)) of F inputs, whose variance is 1 / F, and biases of zero: the initialisation of
    LeCun et al. (1998, Efficient BackProp), which Brax's networks have. It is torch's, drawn before, times sqrt(3), so that a
    last layer that was made small stays so. What a network remembers with has torch's own.

    :param module: whose linear layers and convolutions have torch's initialisation
    """
    for layer in module.modules():
        if isinstance(layer, (nn.Linear, nn.Conv1d, nn.Conv2d, EnsembleLinear, EnsembleInput, EnsembleOutput)):
            for name, parameter in layer.named_parameters(recurse=False):
                parameter.mul_(0.0 if name == "bias" else math.sqrt(3))
