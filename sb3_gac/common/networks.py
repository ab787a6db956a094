"""Building blocks of the policies: an ensemble of Q-networks evaluated at once."""

import itertools
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn


def trainable(parameters: Iterable[nn.Parameter], but: Iterable[nn.Parameter] = ()) -> list[nn.Parameter]:
    """
    :param parameters: of a network; parts of an encoder may be frozen
    :param but: those that belong to another network
    :return: those that the network's optimiser may change
    """
    others = {id(parameter) for parameter in but}
    return [parameter for parameter in parameters if parameter.requires_grad and id(parameter) not in others]


class VectorExtractor(BaseFeaturesExtractor):
    """
    What SB3's ``CombinedExtractor`` does to vectors, at a tenth of the cost: joins them, in the space's order.

    :param observation_space: entries that are all one-dimensional Boxes of float32, which no preprocessing changes
    """

    def __init__(self, observation_space: spaces.Dict):
        super().__init__(observation_space, sum(spaces.flatdim(box) for box in observation_space.values()))
        self._keys = list(observation_space.spaces)

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """
        :param observations: at least these entries, (B, ...) each
        :return: shape (B, F)
        """
        return th.cat([observations[key].float() for key in self._keys], dim=-1)

    @staticmethod
    def fits(space: spaces.Dict) -> bool:
        """Whether all entries are such vectors."""
        return all(isinstance(box, spaces.Box) and len(box.shape) == 1 and box.dtype == np.float32 for box in space.values())


def polyak_average(parameters: list[th.Tensor], targets: list[th.Tensor], tau: float) -> None:
    """
    target <- tau parameter + (1 - tau) target, in place, one call for all.

    :param parameters: of the network
    :param targets: of its target, in the same order
    :param tau: in [0, 1]
    """
    with th.no_grad():
        th._foreach_lerp_(targets, parameters, tau)


class RoleModel(BaseModel):
    """
    A network that reads only the observation entries of its role, whatever else the observation holds.

    Where the learner's encoder is shared, ``features_extractor`` is the learner's, which the learner's loss alone
    trains, and ``rest_extractor`` encodes the entries that the learner does not read.
    """

    rest_extractor: BaseFeaturesExtractor | None

    def extract_features(self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor) -> th.Tensor:
        """
        :param obs: observation with at least the entries of this role
        :param features_extractor: the role's extractor, or the learner's
        :return: shape (B, F)
        """
        if self.rest_extractor is None:
            return self._encode(obs, self.observation_space, features_extractor)
        with th.no_grad():
            shared = self._encode(obs, features_extractor._observation_space, features_extractor)
        return th.cat([shared, self._encode(obs, self.rest_extractor._observation_space, self.rest_extractor)], dim=-1)

    def _encode(self, obs: PyTorchObs, space: spaces.Space, extractor: BaseFeaturesExtractor) -> th.Tensor:
        assert isinstance(space, spaces.Dict)
        if isinstance(extractor, VectorExtractor):
            return extractor(obs)
        entries = {key: obs[key] for key in space.spaces}  # type: ignore[index]
        return extractor(preprocess_obs(entries, space, normalize_images=self.normalize_images))


class Head(nn.Linear):
    """A last layer, which stays in float32 where the layers before it are in mixed precision."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: shape (B, F)
        :return: shape (B, H)
        """
        if not th.is_autocast_enabled(x.device.type):
            return super().forward(x)
        with th.autocast(x.device.type, enabled=False):
            return super().forward(x.float())


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
        :param features: shape (B, F)
        :param actions: shape (B, A)
        :return: shape (N, B, H)
        """
        n_members = len(self.bias)
        x = th.bmm(features.expand(n_members, *features.shape), self.features_weight)
        return th.baddbmm(x, actions.expand(n_members, *actions.shape), self.actions_weight) + self.bias


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


class CriticEnsemble(RoleModel):
    """
    Q-networks on the entries of one role, evaluated together: of actions that they are given.

    :param observation_space: the entries that this role reads
    :param action_space: Box
    :param net_arch: hidden layer sizes
    :param features_extractor: encoder of the entries
    :param features_dim: its output size, F
    :param activation_fn: between layers
    :param normalize_images: divide images by 255
    :param rest_extractor: encoder of the entries that the learner does not read, if ``features_extractor`` is the
        learner's
    :param n_critics: size of the ensemble, N
    """

    features_extractor: BaseFeaturesExtractor

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.SiLU,
        normalize_images: bool = True,
        rest_extractor: BaseFeaturesExtractor | None = None,
        n_critics: int = 2,
    ):
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.rest_extractor = rest_extractor
        self.net_arch = net_arch
        self.features_dim = features_dim
        self.activation_fn = activation_fn
        self.n_critics = n_critics
        layers = [activation_fn()] if net_arch else []
        for in_features, out_features in itertools.pairwise(net_arch):
            layers += [EnsembleLinear(n_critics, in_features, out_features), activation_fn()]
        self.hidden = nn.Sequential(*layers)
        self._make_ends(features_dim)

    def _make_ends(self, features_dim: int) -> None:
        """First and last layer."""
        action_dim = get_action_dim(self.action_space)
        self.input: nn.Module | None = None
        if self.net_arch:
            self.input = EnsembleInput(self.n_critics, features_dim, action_dim, self.net_arch[0])
        self.output: nn.Module = EnsembleOutput(self.n_critics, [features_dim + action_dim, *self.net_arch][-1])

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        :param obs: observation with at least the entries of this role, B of each
        :param actions: in [-1, 1], shape (B, A)
        :return: shape (N, B)
        """
        features = self.extract_features(obs, self.features_extractor)
        if self.input is None:
            x = th.cat([features, actions], dim=-1)
            return self.output(x.expand(self.n_critics, *x.shape))
        return self.output(self.hidden(self.input(features, actions)))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "net_arch": self.net_arch,
            "features_extractor": self.features_extractor,
            "features_dim": self.features_dim,
            "activation_fn": self.activation_fn,
            "rest_extractor": self.rest_extractor,
            "n_critics": self.n_critics,
        }


class DiscreteCriticEnsemble(CriticEnsemble):
    """
    Q-networks with a value for every action.

    Arguments are those of :class:`CriticEnsemble`, but for ``action_space``: Discrete, of A actions.
    """

    def _make_ends(self, features_dim: int) -> None:
        n_actions = int(self.action_space.n)  # type: ignore[attr-defined]
        widths = [features_dim, *self.net_arch]
        self.input = EnsembleLinear(self.n_critics, features_dim, widths[1]) if self.net_arch else None
        self.output = EnsembleLinear(self.n_critics, widths[-1], n_actions)

    def forward(self, obs: PyTorchObs, actions: th.Tensor | None = None) -> th.Tensor:
        """
        :param obs: observation with at least the entries of this role, B of each
        :param actions: numbers of actions, shape (B, 1); ``None`` for all
        :return: shape (N, B), or (N, B, A) of all actions
        """
        x = self.extract_features(obs, self.features_extractor)
        x = x.expand(self.n_critics, *x.shape)
        if self.input is not None:
            x = self.hidden(self.input(x))
        q = self.output(x)
        return q if actions is None else q.gather(-1, actions.long().expand(self.n_critics, *actions.shape)).squeeze(-1)
