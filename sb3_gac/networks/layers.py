"""Layers of networks: output layers in float32, and the layers of an ensemble in one matrix product."""

import math
from collections.abc import Callable
from typing import TypeVar

import torch as th
from torch import nn

Output = TypeVar("Output")

INITIALIZATIONS = ("torch", "lecun_uniform")


def in_float32(layer: Callable[[th.Tensor], Output], x: th.Tensor) -> Output:
    """
    Apply a layer in float32, also where the layers before it run in mixed precision.

    :param layer: function of the input
    :param x: input of the layer
    :return: output of the layer
    """
    if not th.is_autocast_enabled(x.device.type):
        return layer(x)
    with th.autocast(x.device.type, enabled=False):
        return layer(x.float())


class Head(nn.Linear):
    """A linear output layer that computes in float32."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: input, shape (B, F)
        :return: output, shape (B, H)
        """
        return in_float32(super().forward, x)


class EnsembleLinear(nn.Module):
    """
    The linear layers of an ensemble in one batched matrix product, each initialised like ``torch.nn.Linear``.

    :param n_members: size of the ensemble, N
    :param in_features: size of the input, F
    :param out_features: size of the output, H
    """

    def __init__(self, n_members: int, in_features: int, out_features: int):
        super().__init__()
        bound = in_features**-0.5
        self.weight = nn.Parameter(th.empty(n_members, in_features, out_features).uniform_(-bound, bound))
        self.bias = nn.Parameter(th.empty(n_members, 1, out_features).uniform_(-bound, bound))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: input of each member, shape (N, B, F)
        :return: output of each member, shape (N, B, H)
        """
        return th.bmm(x, self.weight) + self.bias


class EnsembleHead(EnsembleLinear):
    """The linear output layers of an ensemble, computed in float32."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: input of each member, shape (N, B, F)
        :return: output of each member, shape (N, B, H)
        """
        return in_float32(super().forward, x)


class EnsembleInput(nn.Module):
    """
    The first layers of an ensemble, with separate weights for features and actions: where only the actions have a gradient, as
    in a policy's loss, no gradient of the features is computed.

    :param n_members: size of the ensemble, N
    :param features_dim: number of features, F
    :param action_dim: number of action dimensions, A
    :param out_features: size of the output, H
    """

    def __init__(self, n_members: int, features_dim: int, action_dim: int, out_features: int):
        super().__init__()
        layer = EnsembleLinear(n_members, features_dim + action_dim, out_features)
        self.features_weight = nn.Parameter(layer.weight.detach()[:, :features_dim].clone())
        self.actions_weight = nn.Parameter(layer.weight.detach()[:, features_dim:].clone())
        self.bias = layer.bias

    def forward(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param features: features for each member, shape (N, B, F)
        :param actions: actions, shape (B, A), or (K, B, A) for K actions to each row of features; the features' product is
            then computed once for all K
        :return: output of each member, shape (N, B, H), or (N, K B, H)
        """
        x = th.bmm(features, self.features_weight)
        if actions.dim() == 2:
            return th.baddbmm(x, actions.expand(len(features), *actions.shape), self.actions_weight) + self.bias
        rows = actions.flatten(0, 1)
        of_actions = th.bmm(rows.expand(len(features), *rows.shape), self.actions_weight).unflatten(1, actions.shape[:2])
        return (of_actions + (x + self.bias)[:, None]).flatten(1, 2)


class EnsembleOutput(nn.Module):
    """
    The output layers of an ensemble, of one value for each member, as a product and a sum: several times faster than a matrix
    product with one column.

    :param n_members: size of the ensemble, N
    :param in_features: size of the input, H
    """

    def __init__(self, n_members: int, in_features: int):
        super().__init__()
        layer = EnsembleLinear(n_members, in_features, 1)
        self.weight = nn.Parameter(layer.weight.detach().transpose(1, 2).clone())
        self.bias = nn.Parameter(layer.bias.detach()[:, 0].clone())

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: input of each member, shape (N, B, H)
        :return: value of each member, shape (N, B)
        """
        return (x * self.weight).sum(dim=-1) + self.bias


@th.no_grad()
def lecun_uniform_(module: nn.Module) -> None:
    """
    Turn torch's initialisation into that of LeCun et al. (1998, Efficient BackProp), which Brax's networks have.

    Weights of a layer with F inputs are then from U(-sqrt(3 / F), sqrt(3 / F)), with the variance 1 / F, and biases are zero.
    The weights are those that torch has drawn, times sqrt(3), so that an output layer that was made small stays small.
    Recurrent layers keep torch's initialisation.

    :param module: network whose linear layers and convolutions have torch's initialisation
    """
    for layer in module.modules():
        if isinstance(layer, (nn.Linear, nn.Conv1d, nn.Conv2d, EnsembleLinear, EnsembleInput, EnsembleOutput)):
            for name, parameter in layer.named_parameters(recurse=False):
                parameter.mul_(0.0 if name == "bias" else math.sqrt(3))
