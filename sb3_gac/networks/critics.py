"""Q-networks on the entries of one role: an ensemble that is evaluated at once, for given actions or for all actions."""

import itertools
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gac.networks.layers import EnsembleHead, EnsembleInput, EnsembleLinear, EnsembleOutput
from sb3_gac.networks.recurrent import Memory
from sb3_gac.networks.role_model import RoleModel


class CriticEnsemble(RoleModel):
    """
    An ensemble of Q-networks on the entries of one role, which value given actions and are evaluated together.

    :param observation_space: space of the entries that this role reads
    :param action_space: Box of A dimensions
    :param net_arch: hidden layer sizes
    :param features_extractor: encoder of the entries
    :param features_dim: number of features that go into the hidden layers, F
    :param activation_fn: activation after each hidden layer
    :param normalize_images: whether images are divided by 255
    :param rest_extractor: encoder of the entries that the deployed policy does not read, if ``features_extractor`` is the
        deployed policy's; else ``None``
    :param n_critics: size of the ensemble, N
    :param memory: memory between the encoder and the layers that actions go into; ``features_dim`` is then its output size.
        ``None`` for none
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
        memory: Memory | None = None,
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
        """Build the first and the last layer."""
        action_dim = get_action_dim(self.action_space)
        self.input: nn.Module | None = None
        if self.net_arch:
            self.input = EnsembleInput(self.n_critics, features_dim, action_dim, self.net_arch[0])
        self.output: nn.Module = EnsembleOutput(self.n_critics, [features_dim + action_dim, *self.net_arch][-1])

    def forward(self, obs: PyTorchObs, actions: th.Tensor | None) -> th.Tensor:
        r"""
        :param obs: observation with at least the entries of this role, (\*E, ...) of each
        :param actions: actions in [-1, 1], shape (\*E, A), or (K, \*E, A) for K actions to each observation
        :return: values of the actions by each critic, shape (N, \*E), or (N, K, \*E)
        """
        return self.values(self.encode(obs), actions)

    def encode(self, obs: PyTorchObs) -> th.Tensor:
        r"""
        The features of observations, which serve for any actions.

        :param obs: observation with at least the entries of this role, (\*E, ...) of each
        :return: features, shape (\*E, F), or with a memory (N, T, B, F)
        """
        features = self.extract_features(obs, self.features_extractor)
        return features if self.memory is None else self.memory(features)[0]

    def values(self, features: th.Tensor, actions: th.Tensor | None) -> th.Tensor:
        """
        The values of actions at encoded observations.

        :param features: features from :meth:`encode`
        :param actions: actions in the form that :meth:`forward` describes
        :return: values in the form that :meth:`forward` describes
        """
        members = features if self.memory is not None else features.expand(self.n_critics, *features.shape)
        if members.dim() == 3:
            return self._values(members, actions)
        # Of sequences, T steps of B episodes are T * B rows; K actions to each observation have an axis before those two
        flat_actions = None if actions is None else actions.flatten(-3, -2)
        several = actions is not None and actions.dim() == members.dim()
        return self._values(members.flatten(1, 2), flat_actions).unflatten(2 if several else 1, members.shape[1:3])

    def _values(self, features: th.Tensor, actions: th.Tensor | None) -> th.Tensor:
        """
        :param features: features for each critic, shape (N, B, F)
        :param actions: actions in [-1, 1], shape (B, A), or (K, B, A)
        :return: values by each critic, shape (N, B), or (N, K, B)
        """
        assert actions is not None
        if self.input is None:
            rows = actions.flatten(0, -2)
            x = th.cat([features.repeat(1, len(rows) // features.shape[1], 1), rows.expand(self.n_critics, -1, -1)], dim=-1)
        else:
            x = self.hidden(self.input(features, actions))
        q = self.output(x)
        return q if actions.dim() == 2 else q.unflatten(1, actions.shape[:2])

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
    An ensemble of Q-networks that value every action at once.

    Arguments are those of :class:`CriticEnsemble`, except that ``action_space`` is a Discrete space of A actions.
    """

    def _make_ends(self, features_dim: int) -> None:
        n_actions = int(self.action_space.n)  # type: ignore[attr-defined]
        widths = [features_dim, *self.net_arch]
        self.input = EnsembleLinear(self.n_critics, features_dim, widths[1]) if self.net_arch else None
        self.output = EnsembleHead(self.n_critics, widths[-1], n_actions)

    def forward(self, obs: PyTorchObs, actions: th.Tensor | None = None) -> th.Tensor:
        r"""
        :param obs: observation with at least the entries of this role, (\*E, ...) of each
        :param actions: numbers of actions, shape (\*E, 1); ``None`` for all actions
        :return: values by each critic, shape (N, \*E), or (N, \*E, A) for all actions
        """
        return super().forward(obs, actions)

    def _values(self, features: th.Tensor, actions: th.Tensor | None) -> th.Tensor:
        x = features if self.input is None else self.hidden(self.input(features))
        q = self.output(x)
        return q if actions is None else q.gather(-1, actions.long().expand(self.n_critics, *actions.shape)).squeeze(-1)
