"""State-value networks on the entries of one role."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gac.networks.role_model import RoleModel


class StateValue(RoleModel):
    """
    The state value V(s), a network on the entries of one role.

    :param observation_space: space of the entries that this role reads
    :param action_space: action space of the environment
    :param net_arch: hidden layer sizes
    :param features_extractor: encoder of the entries
    :param features_dim: number of features that go into the hidden layers
    :param activation_fn: activation after each hidden layer
    :param normalize_images: whether images are divided by 255
    :param rest_extractor: encoder of the entries that the deployed policy does not read, if ``features_extractor`` is the
        deployed policy's; else ``None``
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
    ):
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.rest_extractor = rest_extractor
        self.memory = None
        self.net_arch = net_arch
        self.features_dim = features_dim
        self.activation_fn = activation_fn
        self.value_net = nn.Sequential(*create_mlp(features_dim, 1, net_arch, activation_fn))

    def forward(self, obs: PyTorchObs) -> th.Tensor:
        r"""
        :param obs: observation with at least the entries of this role, (\*E, ...) of each
        :return: value of each state, shape (\*E)
        """
        return self.value_net(self.extract_features(obs, self.features_extractor)).squeeze(-1)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "net_arch": self.net_arch,
            "features_extractor": self.features_extractor,
            "features_dim": self.features_dim,
            "activation_fn": self.activation_fn,
            "rest_extractor": self.rest_extractor,
        }
