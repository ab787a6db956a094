"""Policy networks on the entries of one role: the base of all policies, and that of deployed policies."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gac.checks.entries import ObservationReader, check_is_observation
from sb3_gac.math.distributions import Distribution
from sb3_gac.networks.heads import LOG_STD_BOUNDS, make_head
from sb3_gac.networks.role_model import RoleModel


class BoundedPolicy(BasePolicy):
    """A policy whose actions never leave the environment's range."""

    def unscale_action(self, scaled_action: np.ndarray) -> np.ndarray:
        """
        Scale actions to the environment's range, as SB3's ``unscale_action`` does, but without exceeding the upper bound by
        rounding.

        :param scaled_action: actions in [-1, 1], shape (..., \\*action shape)
        :return: actions in the environment's range, of the same shape
        """
        return np.minimum(super().unscale_action(scaled_action), self.action_space.high)  # type: ignore[attr-defined]


class RolePolicy(RoleModel, BoundedPolicy):
    """
    A policy network on the entries of its role: encoder, hidden layers, and the head that fits the actions.

    Further arguments are those of :class:`RoleModel`, where ``action_space`` is a Box or Discrete.

    :param log_std_bounds: smallest and largest log standard deviation before tanh
    :param softplus_min_std: smallest standard deviation of a head with softplus, see :func:`sb3_gac.networks.heads.make_head`;
        ``None`` for a head with exp
    """

    head: Any  # GaussianHead or CategoricalHead, which nn.Module hides from type checkers

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        net_arch: list[int],
        *args: Any,
        log_std_bounds: tuple[float, float] = LOG_STD_BOUNDS,
        softplus_min_std: float | None = None,
        **kwargs: Any,
    ):
        squashes = isinstance(action_space, spaces.Box)
        super().__init__(observation_space, action_space, net_arch, *args, squash_output=squashes, **kwargs)
        self.reader = ObservationReader(observation_space)
        self.log_std_bounds = log_std_bounds
        self.softplus_min_std = softplus_min_std
        self.latent_net = nn.Sequential(*create_mlp(self.features_dim, -1, net_arch, self.activation_fn))
        latent_dim = net_arch[-1] if net_arch else self.features_dim
        self.head = make_head(latent_dim, action_space, log_std_bounds, softplus_min_std)

    def forward(self, obs: PyTorchObs) -> Distribution:
        """The output of the network, see :meth:`distribution`."""
        return self.distribution(obs)

    def distribution(self, obs: PyTorchObs) -> Distribution:
        r"""
        The output of the network; with a memory, the observations are sequences from an episode's start on.

        :param obs: observation with at least the entries of this role, (\*E, ...) of each
        :return: distribution of actions, or, for a residual guider, of corrections, shapes (\*E, A)
        """
        return self.output(self.latent(obs))

    def latent(self, obs: PyTorchObs) -> th.Tensor:
        r"""
        The last hidden layer of the network.

        :param obs: observation with at least the entries of this role, (\*E, ...) of each
        :return: activations of the last hidden layer, shape (\*E, H)
        """
        features = self.extract_features(obs, self.features_extractor)
        return self.latent_net(features if self.memory is None else self.memory(features)[0][0])

    def output(self, latent: th.Tensor) -> Distribution:
        r"""
        The output of the head.

        :param latent: activations of the last hidden layer, shape (\*E, H)
        :return: distribution that :meth:`distribution` describes, shapes (\*E, A)
        """
        return self.head(latent)

    def remember(
        self, obs: PyTorchObs, state: np.ndarray | None, episode_start: np.ndarray | None
    ) -> tuple[Distribution, np.ndarray | None]:
        """
        One step of acting, with the memory's state carried along.

        :param obs: observation with at least the entries of this role, (B, ...) of each
        :param state: state of the memory before the step, shape (B, S); ``None`` at an episode's start or without a memory
        :param episode_start: true where an episode starts, shape (B,); ``None`` if no episode starts
        :return: output of :meth:`distribution`, shapes (B, A), and state of the memory after the step, which
            :meth:`with_action` completes, shape (B, S); ``None`` without a memory
        """
        if self.memory is None:
            return self.distribution(obs), None
        assert isinstance(obs, dict)
        one_step = {key: value[None] for key, value in obs.items()}
        features = self.extract_features(one_step, self.features_extractor)
        before = self.memory.state_before(state, episode_start, features.shape[1])
        outputs, after = self.memory(features, before)
        return self.output(self.latent_net(outputs[0, 0])), after[0].detach().cpu().numpy()

    def with_action(self, state: np.ndarray | None, actions: np.ndarray) -> np.ndarray | None:
        r"""
        Add the actions of a step to the memory's state.

        :param state: state that :meth:`remember` returned, shape (B, S), or ``None``
        :param actions: actions taken in that step, in [-1, 1], shape (B, \*action shape), or numbers of discrete actions,
            shape (B,)
        :return: state for the next step, shape (B, S); ``None`` without a memory
        """
        if self.memory is None or state is None:
            return state
        return self.memory.with_action(th.as_tensor(state), th.as_tensor(actions)).numpy()

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "log_std_bounds": self.log_std_bounds,
            "softplus_min_std": self.softplus_min_std,
        }


class DeployedPolicy(RolePolicy):
    """A policy that can be deployed: ``predict`` needs the entries of its role alone, and ignores all others."""

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """
        Tensors of the entries that the policy reads.

        :param observation: one observation or a batch: a dict with at least the policy's entries, or, if the policy reads one
            entry, an array of that entry
        :return: tensors of the policy's entries, (B, ...) of each, and whether the observation was a batch
        :raises ValueError: if an entry is missing, does not fit its space, or has another batch size than the others; the
            message names the entry
        """
        return self.reader.read(self._own_entries(observation), self.device)

    def _own_entries(self, observation: np.ndarray | dict[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        assert isinstance(self.observation_space, spaces.Dict)
        keys = list(self.observation_space.spaces)
        check_is_observation(observation)
        if not isinstance(observation, Mapping):
            if len(keys) > 1:
                raise ValueError(f"The policy reads {keys}: pass predict() a dict with these entries, not an array.")
            return {keys[0]: observation}
        missing = [key for key in keys if key not in observation]
        if missing:
            raise ValueError(f"The observation passed to predict() lacks {missing}, which the policy reads.")
        return observation

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The policy's actions.

        :param observation: one observation or a batch, see :meth:`obs_to_tensor`
        :param state: state that the last call returned; ``None`` at the start
        :param episode_start: true where an episode starts, shape (B,)
        :param deterministic: whether the action is the distribution's mode instead of a sample
        :return: actions in the environment's range, and the state for the next call, ``None`` without a memory
        """
        if self.memory is None:
            return super().predict(observation, state, episode_start, deterministic)
        self.set_training_mode(False)
        obs, vectorized = self.obs_to_tensor(observation)
        with th.no_grad():
            actions, after = self.remember(obs, None if state is None else state[0], episode_start)
        chosen = actions.mode if deterministic else actions.sample()
        action = chosen.cpu().numpy().reshape(-1, *self.action_space.shape)  # type: ignore[misc]
        after = self.with_action(after, action)
        if isinstance(self.action_space, spaces.Box):
            action = self.unscale_action(action)
        assert after is not None
        return (action if vectorized else action.squeeze(axis=0)), (after,)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        actions, _ = self.remember(observation, None, None)
        return actions.mode if deterministic else actions.sample()


class Actor(DeployedPolicy):
    """A deployed policy that returns actions when it is called, as the actor of SB3's SAC does."""

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:  # type: ignore[override]
        """
        The policy's actions, on the network's scale; samples of continuous actions are differentiable.

        :param obs: observation with at least the policy's entries, (B, ...) of each; for a policy with a memory, observations
            of episodes' first steps
        :param deterministic: whether the action is the distribution's mode instead of a sample
        :return: actions in [-1, 1], shape (B, A), or numbers of discrete actions, shape (B,)
        """
        return self._predict(obs, deterministic)
