"""The base of networks that read the observation entries of their role."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gac.checks.entries import encode, leading_dimensions
from sb3_gac.networks.encoders import EntryExtractor, VectorExtractor
from sb3_gac.networks.recurrent import Memory


class RoleModel(BaseModel):
    """
    A network that reads the observation entries of its role, and ignores all others.

    A network with a ``memory`` (:class:`sb3_gac.networks.recurrent.Memory`) needs sequences from an episode's start on,
    (T, B, ...) of each entry. A network without a memory takes sequences or (B, ...) of each entry.

    Where the deployed policy's encoder is shared, ``features_extractor`` is the deployed policy's, which only that policy's
    loss trains, and ``rest_extractor`` encodes the entries that the deployed policy does not read.

    :param observation_space: space of the entries that this role reads
    :param action_space: action space of the environment
    :param net_arch: hidden layer sizes
    :param features_extractor: encoder of the entries; ``None`` for a network that adds to another one's layers
    :param features_dim: number of features that go into the hidden layers, F
    :param activation_fn: activation after each hidden layer
    :param normalize_images: whether images are divided by 255
    :param rest_extractor: encoder of the entries that the deployed policy does not read, if ``features_extractor`` is the
        deployed policy's and this network is another role's; else ``None``
    :param memory: memory behind the encoder; ``features_dim`` is then its output size. ``None`` for none
    :param sb3: further keyword arguments of SB3's class that this one is mixed with
    """

    features_extractor: BaseFeaturesExtractor

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor | None,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.SiLU,
        normalize_images: bool = True,
        rest_extractor: BaseFeaturesExtractor | None = None,
        memory: Memory | None = None,
        **sb3: Any,
    ):
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images, **sb3
        )
        self.net_arch = net_arch
        self.features_dim = features_dim
        self.activation_fn = activation_fn
        self.rest_extractor = rest_extractor
        self.memory = memory

    @property
    def relation(self) -> tuple[Any, ...] | None:
        """
        What makes the output relative to the deployed policy, which is a part of what it means; ``None`` for an output that
        stands by itself.
        """
        return None

    def extract_features(self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor) -> th.Tensor:
        """
        The features of an observation.

        :param obs: observation with at least the entries of this role, (B, ...) or (T, B, ...) of each
        :param features_extractor: encoder of this role, or the deployed policy's if it is shared
        :return: features, shape (B, F) or (T, B, F)
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
        key, value = next(iter(entries.items()))
        leading = list(value.shape[: 2 if self.memory is not None else leading_dimensions(value, space[key])])
        if len(leading) > 1:  # encoders know one leading dimension, sequences have two
            entries = {key: value.flatten(0, 1) for key, value in entries.items()}
        if isinstance(extractor, EntryExtractor):
            entries = extractor.laid_out(entries)
        features = extractor({key: encode(value, space[key], self.normalize_images) for key, value in entries.items()})
        # Reshaped, not unflattened: ONNX would fix unflatten to the batch size of the example
        return features.reshape(*leading, -1) if len(leading) > 1 else features

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "net_arch": self.net_arch,
            "features_extractor": self.features_extractor,
            "features_dim": self.features_dim,
            "activation_fn": self.activation_fn,
            "rest_extractor": self.rest_extractor,
            "memory": self.memory,
        }
