"""Building blocks of the policies: an ensemble of Q-networks evaluated at once."""

import itertools
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gac.checks.entries import encode, encoded_size

SMALLEST_IMAGE = 36  # pixels of each side that SB3's NatureCNN leaves something of


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


class EntryExtractor(CombinedExtractor):
    """
    SB3's ``CombinedExtractor`` for entries of any name and kind; its parameters have the names that they have there.

    :param observation_space: of the entries
    :param cnn_output_dim: features of each image
    :param normalized_image: whether all three-dimensional Boxes are images, of whatever type and bounds
    """

    def __init__(self, observation_space: spaces.Dict, cnn_output_dim: int = 256, normalized_image: bool = False):
        BaseFeaturesExtractor.__init__(self, observation_space, features_dim=1)  # not known yet
        self._names = module_names(observation_space.spaces)
        extractors: dict[str, nn.Module] = {}
        features_dim = 0
        for key, space in observation_space.spaces.items():
            if is_image_space(space, normalized_image=normalized_image):
                _check_image_size(key, space)
                extractors[self._names[key]] = NatureCNN(space, cnn_output_dim, normalized_image)
                features_dim += cnn_output_dim
            else:
                extractors[self._names[key]] = nn.Flatten()
                features_dim += encoded_size(space)
        self.extractors = nn.ModuleDict(extractors)
        self._features_dim = features_dim

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """
        :param observations: these entries, (B, ...) each
        :return: shape (B, F)
        """
        return th.cat([self.extractors[name](observations[key]) for key, name in self._names.items()], dim=1)


def module_names(keys: Iterable[str]) -> dict[str, str]:
    """
    :param keys: names of entries
    :return: key -> a name that torch's ``ModuleDict`` takes: the key itself, unless it has a dot or is one of its attributes
    """
    keys, attributes = list(keys), nn.ModuleDict()
    names: dict[str, str] = {}
    for key in keys:
        name = key.replace(".", "_")
        while hasattr(attributes, name) or (name != key and name in (*keys, *names.values())):
            name += "_"
        names[key] = name
    return names


def _check_image_size(key: str, space: spaces.Space) -> None:
    sides = (space.shape or ())[1:]
    if min(sides) < SMALLEST_IMAGE:
        raise ValueError(
            f'The observation\'s entry "{key}" is an image of {sides[0]} x {sides[1]} pixels, but the default encoder '
            f"(NatureCNN) needs {SMALLEST_IMAGE} x {SMALLEST_IMAGE} at least. Give a larger image, or an encoder of your own, "
            'policy_kwargs={"features_extractor_class": ...}; make it one-dimensional in the environment if it is no image.'
        )


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

    With a ``memory`` (:class:`sb3_gac.networks.recurrent.Memory`) it takes sequences from an episode's start on, (T, B, ...)
    of each entry instead of (B, ...).

    Where the learner's encoder is shared, ``features_extractor`` is the learner's, which the learner's loss alone
    trains, and ``rest_extractor`` encodes the entries that the learner does not read.
    """

    rest_extractor: BaseFeaturesExtractor | None
    memory: nn.Module | None

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
        leading: list[int] = []
        if self.memory is not None:  # encoders know one leading dimension, sequences have two
            leading = list(next(iter(entries.values())).shape[:2])
            entries = {key: value.flatten(0, 1) for key, value in entries.items()}
        features = extractor({key: encode(value, space[key], self.normalize_images) for key, value in entries.items()})
        # not unflatten, which ONNX would do for the example's batch alone
        return features.reshape(*leading, -1) if leading else features


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
        :param actions: shape (B, A)
        :return: shape (N, B, H)
        """
        x = th.bmm(features, self.features_weight)
        return th.baddbmm(x, actions.expand(len(features), *actions.shape), self.actions_weight) + self.bias


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
    :param memory: of the entries, for sequences; ``features_dim`` is then its output size. Actions join after it
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
        memory: nn.Module | None = None,
    ):
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.rest_extractor = rest_extractor
        self.memory = memory
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

    def forward(self, obs: PyTorchObs, actions: th.Tensor | None) -> th.Tensor:
        r"""
        :param obs: observation with at least the entries of this role, (\*E, ...) of each
        :param actions: in [-1, 1], shape (\*E, A)
        :return: shape (N, \*E)
        """
        return self.values(self.encode(obs), actions)

    def encode(self, obs: PyTorchObs) -> th.Tensor:
        r"""
        What is needed of the observations, whatever the actions.

        :param obs: observation with at least the entries of this role, (\*E, ...) of each
        :return: shape (B, F), or with a memory (N, T, B, F)
        """
        features = self.extract_features(obs, self.features_extractor)
        return features if self.memory is None else self.memory(features)[0]

    def values(self, features: th.Tensor, actions: th.Tensor | None) -> th.Tensor:
        """
        :param features: of :meth:`encode`
        :param actions: see :meth:`forward`
        :return: see :meth:`forward`
        """
        if self.memory is None:
            return self._values(features.expand(self.n_critics, *features.shape), actions)
        assert actions is None or actions.dim() == 3
        flat_actions = None if actions is None else actions.flatten(0, 1)
        return self._values(features.flatten(1, 2), flat_actions).unflatten(1, features.shape[1:3])

    def _values(self, features: th.Tensor, actions: th.Tensor | None) -> th.Tensor:
        """
        :param features: shape (N, B, F)
        :param actions: shape (B, A)
        :return: shape (N, B)
        """
        assert actions is not None
        if self.input is None:
            return self.output(th.cat([features, actions.expand(self.n_critics, *actions.shape)], dim=-1))
        return self.output(self.hidden(self.input(features, actions)))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "net_arch": self.net_arch,
            "features_extractor": self.features_extractor,
            "features_dim": self.features_dim,
            "activation_fn": self.activation_fn,
            "rest_extractor": self.rest_extractor,
            "n_critics": self.n_critics,
            "memory": self.memory,
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
        self.output = EnsembleHead(self.n_critics, widths[-1], n_actions)

    def forward(self, obs: PyTorchObs, actions: th.Tensor | None = None) -> th.Tensor:
        r"""
        :param obs: observation with at least the entries of this role, (\*E, ...) of each
        :param actions: numbers of actions, shape (\*E, 1); ``None`` for all
        :return: shape (N, \*E), or (N, \*E, A) of all actions
        """
        return super().forward(obs, actions)

    def _values(self, features: th.Tensor, actions: th.Tensor | None) -> th.Tensor:
        x = features if self.input is None else self.hidden(self.input(features))
        q = self.output(x)
        return q if actions is None else q.gather(-1, actions.long().expand(self.n_critics, *actions.shape)).squeeze(-1)
