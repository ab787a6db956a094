"""The two policies: a learner on its own entries, and a guider relative to it or independent of it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gac.common.distributions import TanhGaussian, project_to_kl_ball
from sb3_gac.common.networks import RoleModel

DELTA_INIT_SCALE = 0.01
LOG_STD_BOUNDS = (-5.0, 1.0)


class RolePolicy(RoleModel, BasePolicy):
    """
    A policy network on the entries of its role: encoder and hidden layers; subclasses add the heads.

    :param observation_space: the entries that this role reads
    :param action_space: Box
    :param net_arch: hidden layer sizes
    :param features_extractor: encoder of the entries
    :param features_dim: its output size
    :param activation_fn: between layers
    :param normalize_images: divide images by 255
    :param rest_extractor: encoder of the entries that the learner does not read, if ``features_extractor`` is the
        learner's and this is another role
    :param log_std_bounds: smallest and largest log standard deviation before tanh
    """

    features_extractor: BaseFeaturesExtractor

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.SiLU,
        normalize_images: bool = True,
        rest_extractor: BaseFeaturesExtractor | None = None,
        log_std_bounds: tuple[float, float] = LOG_STD_BOUNDS,
    ):
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        self.rest_extractor = rest_extractor
        self.net_arch = net_arch
        self.features_dim = features_dim
        self.activation_fn = activation_fn
        self.log_std_bounds = log_std_bounds
        self.latent_net = nn.Sequential(*create_mlp(features_dim, -1, net_arch, activation_fn))
        latent_dim = net_arch[-1] if net_arch else features_dim
        action_dim = get_action_dim(action_space)
        self.mean = nn.Linear(latent_dim, action_dim)
        self.log_std = nn.Linear(latent_dim, action_dim)

    def latent(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: observation with at least the entries of this role, B of each
        :return: last hidden layer, shape (B, H)
        """
        return self.latent_net(self.extract_features(obs, self.features_extractor))

    def bounded_log_std(self, latent: th.Tensor) -> th.Tensor:
        """
        :param latent: shape (B, H)
        :return: log standard deviation before tanh, shape (B, A)
        """
        return self.log_std(latent).clamp(*self.log_std_bounds)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "net_arch": self.net_arch,
            "features_extractor": self.features_extractor,
            "features_dim": self.features_dim,
            "activation_fn": self.activation_fn,
            "rest_extractor": self.rest_extractor,
            "log_std_bounds": self.log_std_bounds,
        }


class Learner(RolePolicy):
    """
    The deployed policy: a mean on the learner's entries.

    In training it borrows the guider's std. Its own log-std head, fitted to the guider's, serves
    ``predict(deterministic=False)`` where there is no guider.
    """

    def forward(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """
        :param obs: observation with at least the learner's entries, B of each
        :return: mean before tanh, and the deployment log std, whose gradient stops at its head; both (B, A)
        """
        latent = self.latent(obs)
        return self.mean(latent), self.bounded_log_std(latent.detach())

    def mean_parameters(self) -> list[nn.Parameter]:
        """All parameters but those of the deployment log-std head, whose loss is another."""
        return [parameter for name, parameter in self.named_parameters() if not name.startswith("log_std.")]

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """
        :param observation: single or batched; a dict with at least the learner's entries, or, where the learner reads
            one entry, that entry alone
        :return: tensors of the learner's entries, and whether they were batched
        :raises ValueError: if one of the learner's entries is missing
        """
        return super().obs_to_tensor(self._own_entries(observation))

    def _own_entries(self, observation: np.ndarray | dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        assert isinstance(self.observation_space, spaces.Dict)
        keys = list(self.observation_space.spaces)
        if not isinstance(observation, Mapping):
            if len(keys) > 1:
                raise ValueError(f"The learner reads {keys}: pass predict() a dict with these entries, not an array.")
            return {keys[0]: observation}
        missing = [key for key in keys if key not in observation]
        if missing:
            raise ValueError(f"The observation passed to predict() lacks {missing}, which the learner reads.")
        return {key: observation[key] for key in keys}

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        action = TanhGaussian(*self(observation))
        return action.mode if deterministic else action.sample()


class Guider(RolePolicy):
    """
    The privileged policy in the paper's form: mean and std from its own network, nothing shared with the learner.

    :param max_kl: hard bound on KL(guider || learner), or ``None``: the mean is projected onto that ball
    :param kl_reduction: how the bounded KL is reduced over action dimensions
    """

    def __init__(self, *args: Any, max_kl: float | None = None, kl_reduction: str = "mean", **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.max_kl = max_kl
        self.kl_reduction = kl_reduction

    def forward(self, obs: PyTorchObs, learner_mean: th.Tensor) -> TanhGaussian:
        """
        :param obs: observation with at least the guider's entries, B of each
        :param learner_mean: the learner's mean for the same observations; treated as a constant, shape (B, A)
        :return: action distribution, shapes (B, A)
        """
        latent = self.latent(obs)
        log_std = self.bounded_log_std(latent)
        mean = self._guided_mean(self.mean(latent), learner_mean.detach(), log_std.detach().exp())
        return TanhGaussian(mean, log_std)

    def _guided_mean(self, output: th.Tensor, learner_mean: th.Tensor, std: th.Tensor) -> th.Tensor:
        if self.max_kl is None:
            return output
        offset = project_to_kl_ball((output - learner_mean) / std, self.max_kl, self.kl_reduction)
        return learner_mean + std * offset

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        raise TypeError("The guider is defined relative to the learner: use GAC.predict_guider().")

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {"max_kl": self.max_kl, "kl_reduction": self.kl_reduction}


class ResidualGuider(Guider):
    """
    The guider as the learner plus a privileged correction delta in units of the std: KL = 1/2 ||delta||^2 exactly.

    Neither the learner's drift nor a shrinking std moves the KL; delta = 0 is the learner itself.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        with th.no_grad():
            self.mean.weight.mul_(DELTA_INIT_SCALE)
            self.mean.bias.mul_(DELTA_INIT_SCALE)

    def _guided_mean(self, output: th.Tensor, learner_mean: th.Tensor, std: th.Tensor) -> th.Tensor:
        delta = output if self.max_kl is None else project_to_kl_ball(output, self.max_kl, self.kl_reduction)
        return learner_mean + std * delta


GUIDERS: dict[str, type[Guider]] = {"residual": ResidualGuider, "independent": Guider}
