"""Q-networks on the entries of one role: an ensemble that is evaluated at once, for given actions or for all actions."""

import itertools
from typing import Any

import torch as th
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gac.networks.layers import EnsembleHead, EnsembleInput, EnsembleLinear, EnsembleOutput
from sb3_gac.networks.role_model import RoleModel


class CriticEnsemble(RoleModel):
    """
    An ensemble of Q-networks on the entries of one role, which value given actions and are evaluated together.

    Further arguments are those of :class:`RoleModel`, where ``action_space`` is a Box of A dimensions.

    :param n_critics: size of the ensemble, N
    """

    def __init__(self, *args: Any, n_critics: int = 2, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.n_critics = n_critics
        layers = [self.activation_fn()] if self.net_arch else []
        for in_features, out_features in itertools.pairwise(self.net_arch):
            layers += [EnsembleLinear(n_critics, in_features, out_features), self.activation_fn()]
        self.hidden = nn.Sequential(*layers)
        self._make_ends()

    def _make_ends(self) -> None:
        """Build the first and the last layer."""
        action_dim = get_action_dim(self.action_space)
        self.input: nn.Module | None = None
        if self.net_arch:
            self.input = EnsembleInput(self.n_critics, self.features_dim, action_dim, self.net_arch[0])
        self.output: nn.Module = EnsembleOutput(self.n_critics, [self.features_dim + action_dim, *self.net_arch][-1])

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
        return super()._get_constructor_parameters() | {"n_critics": self.n_critics}


class DiscreteCriticEnsemble(CriticEnsemble):
    """
    An ensemble of Q-networks that value every action at once.

    Arguments are those of :class:`CriticEnsemble`, except that ``action_space`` is a Discrete space of A actions.
    """

    def _make_ends(self) -> None:
        n_actions = int(self.action_space.n)  # type: ignore[attr-defined]
        widths = [self.features_dim, *self.net_arch]
        self.input = EnsembleLinear(self.n_critics, *widths[:2]) if self.net_arch else None
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
