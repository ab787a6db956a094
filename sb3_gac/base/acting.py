"""How the policies of an algorithm act: the deployed one for ``predict``, all of them together to collect the data."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeAlias

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gac.base.roles import Roles
from sb3_gac.checks.entries import ObservationReader
from sb3_gac.math.distributions import Distribution
from sb3_gac.networks.actors import BoundedPolicy, DeployedPolicy

#: What each policy's network remembers, shapes (B, S), ``None`` without a memory; ``None`` before the first step
BehaviourState: TypeAlias = tuple[np.ndarray | None, ...] | None


class ActingPolicy(BoundedPolicy):
    """Policies by role, of which the deployed one is what this one is outside of training; a subclass builds them."""

    roles: ClassVar[Roles]
    role_keys: dict[str, tuple[str, ...]]
    reader: ObservationReader
    _acting_reader: ObservationReader

    @property
    def deployed(self) -> DeployedPolicy:
        """The policy that acts at evaluation."""
        return getattr(self, self.roles.deployed)

    def check_seen_by(self, role: str, observation: Any, where: str) -> None:
        """
        :param role: that is about to act
        :param observation: that it was handed
        :param where: the method that was called, for the message
        :raises ValueError: if an entry is missing that the role or, because it acts beside it, the deployed policy reads
        """
        reads = list(dict.fromkeys([*self.role_keys[role], *self.role_keys[self.roles.deployed]]))
        if not isinstance(observation, Mapping):
            raise ValueError(f"The {role} reads {reads}: pass {where} a dict with these entries, not an array.")
        missing = [key for key in reads if key not in observation]
        if missing:
            raise ValueError(
                f"The observation passed to {where} lacks {missing}, which the {role} reads; it has {list(observation)}. "
                f"predict() is for observations of {list(self.role_keys[self.roles.deployed])} alone."
            )

    def acting_distributions(self, outputs: Mapping[str, Any]) -> Mapping[str, Any]:
        """
        :param outputs: role -> what its network computed, for each policy
        :return: role -> distribution of its actions
        """
        return outputs

    def behaviour_distribution(self, obs: PyTorchObs) -> Distribution:
        r"""
        :param obs: full observation, (\*E, ...) of each entry
        :return: distribution of the actions of the policy that collects the data, shapes (\*E, A)
        """
        outputs = {role: getattr(self, role).distribution(obs) for role in self.roles.policies}
        return self.acting_distributions(outputs)[self.roles.behaviour]

    @th.no_grad()
    def behaviour_action(
        self,
        observation: dict[str, np.ndarray],
        state: BehaviourState = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        acting: Sequence[str] | None = None,
    ) -> tuple[np.ndarray, BehaviourState]:
        r"""
        Action of the policies that collect the data, in [-1, 1] or one of a number.

        :param observation: full observation, B of each entry
        :param state: what the last call returned, ``None`` at the start
        :param episode_start: true where an episode starts, shape (B,)
        :param deterministic: mode instead of a sample
        :param acting: role that acts in each environment; by default ``roles.behaviour``
        :return: shape (B, \*action shape), and what policies remember, those that do not act as well; but for the action that
            is then taken, see :meth:`with_actions`
        """
        obs, _ = self._acting_reader.read(observation, self.device)
        names = self.roles.policies
        before = state or (None,) * len(names)
        steps = [getattr(self, name).remember(obs, own, episode_start) for name, own in zip(names, before, strict=True)]
        policies = self.acting_distributions(dict(zip(names, (output for output, _ in steps), strict=True)))
        after = tuple(remembered for _, remembered in steps)
        roles = list(dict.fromkeys(acting if acting is not None else [self.roles.behaviour]))
        actions = self._chosen(policies[roles[0]], deterministic)
        for role in roles[1:]:
            rows = np.array([name == role for name in acting or ()])
            actions[rows] = self._chosen(policies[role], deterministic)[rows]
        return actions, None if all(remembered is None for remembered in after) else after

    def with_actions(self, state: BehaviourState, actions: np.ndarray) -> BehaviourState:
        r"""
        :param state: what :meth:`behaviour_action` returned
        :param actions: that were then taken, in [-1, 1] or one of a number, shape (B, \*action shape)
        :return: what each policy remembers of both, for the next call
        """
        if state is None:
            return None
        return tuple(
            getattr(self, role).with_action(own, actions) for role, own in zip(self.roles.policies, state, strict=True)
        )

    @th.no_grad()
    def frozen_action(self, policy: nn.Module, observation: dict[str, np.ndarray]) -> np.ndarray:
        r"""
        :param policy: that is no network of this one's, see :class:`sb3_gac.base.frozen.FrozenPolicy`
        :param observation: full observation, B of each entry
        :return: a sample of its actions, in [-1, 1] or of a number, shape (B, \*action shape)
        """
        obs, _ = self.reader.read(observation, self.device)
        return self._chosen(policy(obs), deterministic=False)

    def _chosen(self, actions: Distribution, deterministic: bool) -> np.ndarray:
        r"""
        :param actions: shapes (B, A)
        :param deterministic: mode instead of a sample
        :return: shape (B, \*action shape)
        """
        chosen = actions.mode if deterministic else actions.sample()
        return chosen.cpu().numpy().reshape(-1, *self.action_space.shape)  # type: ignore[misc]

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The deployed policy's action; entries that it does not read are ignored.

        :param observation: single or batched; ``{"partial": ...}``, a full dict, or the partial entry alone
        :param state: what a recurrent policy's last call returned, ``None`` at the start
        :param episode_start: true where an episode starts, shape (B,)
        :param deterministic: mode instead of a sample
        :return: action in the environment's range, and the state for the next call
        """
        return self.deployed.predict(observation, state, episode_start, deterministic)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """The deployed policy's action, in [-1, 1] of shape (B, A), or one of a number of shape (B,)."""
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.deployed._predict(observation, deterministic)

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """
        :param observation: dict of observation entries, single or batched; unknown entries are dropped
        :return: tensors, and whether they were batched
        :raises ValueError: naming the entry that does not fit its space, or is not as many as the others
        """
        if not isinstance(observation, Mapping):
            return self.deployed.obs_to_tensor(observation)
        return self.reader.read(observation, self.device)
