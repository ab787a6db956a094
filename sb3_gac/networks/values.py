"""State-value networks on the entries of one role."""

from typing import Any

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gac.networks.layers import Head
from sb3_gac.networks.role_model import RoleModel


class StateValue(RoleModel):
    """The state value V(s), a network on the entries of one role. Arguments are those of :class:`RoleModel`."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        hidden = create_mlp(self.features_dim, -1, self.net_arch, self.activation_fn)
        latent_dim = self.net_arch[-1] if self.net_arch else self.features_dim
        self.value_net = nn.Sequential(*hidden, Head(latent_dim, 1))

    def forward(self, obs: PyTorchObs) -> th.Tensor:
        r"""
        :param obs: observation with at least the entries of this role, (\*E, ...) of each
        :return: value of each state, shape (\*E)
        """
        return self.value_net(self.extract_features(obs, self.features_extractor)).squeeze(-1)
