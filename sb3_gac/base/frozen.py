"""Frozen policies: teachers, which are asked for their actions and never trained."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gac.base.loading import class_of_model
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.random_state import random_numbers_kept
from sb3_gac.checks.entries import encode, leading_dimensions
from sb3_gac.checks.scale import entries_normalised_in_training, scales_in_training
from sb3_gac.math.distributions import TanhGaussian


class FrozenPolicy(nn.Module):
    """
    A copy of the policy with which a trained model collected its data. It reads full observations and is never trained.

    :param model: model of this package, or SB3's SAC on a Dict space
    :param name: name of the argument that the model was given as, for messages
    :raises TypeError: if the model is of another kind
    :raises ValueError: if its policy has a memory
    """

    def __init__(self, model: BaseAlgorithm, name: str = "teacher"):
        super().__init__()
        if not (isinstance(model, SAC) or isinstance(getattr(model, "policy", None), AsymmetricPolicy)):
            raise TypeError(f"{name} must be a model of sb3_gac, or SB3's SAC on a Dict space, got {type(model).__name__}.")
        if getattr(model, "use_sde", False):
            raise ValueError(f"{name} explores by gSDE, whose distribution is not one of the action alone: train it without.")
        self.policy = deepcopy(model.policy)  # because the model itself may go on training
        self.normalised, self.scales = entries_normalised_in_training(model), scales_in_training(model)
        if isinstance(self.policy, AsymmetricPolicy) and (self.policy.remembers or any(self.policy.rnn_types.values())):
            raise ValueError(f"{name} has a memory, but is given single transitions: train a {name} without a memory.")
        self.requires_grad_(False)
        self.train(False)

    @property
    def entries(self) -> list[str]:
        """Names of the observation entries that the policy's model was trained on."""
        return list(self.policy.observation_space.spaces)  # type: ignore[attr-defined]

    @th.no_grad()
    def forward(self, obs: PyTorchObs) -> Any:
        r"""
        The distribution of the policy's actions.

        :param obs: full observation, each entry of shape (\*E, ...), where ``*E`` are any leading dimensions
        :return: distribution of actions, its tensors of shape (\*E, A)
        """
        policy: Any = self.policy
        if isinstance(policy, AsymmetricPolicy):
            return policy.behaviour_distribution(obs)
        space = policy.observation_space
        key, *_ = space.spaces
        leading = obs[key].shape[: leading_dimensions(obs[key], space[key])]
        # SB3's encoder knows one leading dimension
        rows = {key: obs[key].flatten(0, len(leading) - 1) for key in space.spaces}
        entries = {key: encode(values, space[key], policy.normalize_images) for key, values in rows.items()}
        latent = policy.actor.latent_pi(policy.actor.features_extractor(entries))
        mean, log_std = policy.actor.mu(latent), policy.actor.log_std(latent).clamp(-20, 2)
        return TanhGaussian(mean.unflatten(0, leading), log_std.unflatten(0, leading))


def load_frozen_policy(
    source: str | Path | BaseAlgorithm,
    observation_space: spaces.Dict,
    action_space: spaces.Space,
    device: th.device,
    name: str = "teacher",
) -> FrozenPolicy:
    """
    Make a frozen policy of a trained model.

    :param source: trained model, or the path of a saved model of this package
    :param observation_space: observation space of the environment, which must have all entries of the teacher's space
    :param action_space: action space of the environment
    :param device: device on which the policy computes
    :param name: name of the argument that the model was given as, for messages
    :return: frozen policy
    :raises ValueError: if the teacher's entries or actions have other spaces than the environment's
    """
    model = _loaded(Path(source), device, name) if isinstance(source, (str, Path)) else source
    frozen = FrozenPolicy(model, name).to(device)
    assert isinstance(model.observation_space, spaces.Dict)
    for key, space in model.observation_space.items():
        if observation_space.spaces.get(key) != space:
            now = observation_space.spaces.get(key, "missing")
            raise ValueError(f'{name} was trained on an entry "{key}" that was {space}, and here it is {now}.')
    if model.action_space != action_space:
        raise ValueError(f"{name} was trained for actions in {model.action_space}, and here they are in {action_space}.")
    return frozen


def _loaded(path: Path, device: th.device, name: str) -> BaseAlgorithm:
    try:
        kind = class_of_model(path, device)
    except ValueError:
        raise ValueError(
            f"{name}={str(path)!r} is no model of a class that can be imported: pass the loaded model itself."
        ) from None
    with random_numbers_kept():  # because loading a model sets its seed
        return kind.load(path, device=device)
