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

#: The memory of each policy's network, shape (B, S), or ``None`` for a network without one; ``None`` before the first step
BehaviourState: TypeAlias = tuple[np.ndarray | None, ...] | None


class ActingPolicy(BoundedPolicy):
    """A policy made of an algorithm's policies by role, which acts as the deployed one; a subclass builds the networks."""

    roles: ClassVar[Roles]
    role_keys: dict[str, tuple[str, ...]]
    reader: ObservationReader
    _acting_reader: ObservationReader

    @property
    def deployed(self) -> DeployedPolicy:
        """The policy that acts at evaluation."""
        return getattr(self, self.roles.deployed)

    @property
    def deployed_entries(self) -> tuple[str, ...]:
        """Observation entries that the deployed policy reads."""
        return self.role_keys[self.roles.deployed]

    def check_seen_by(self, role: str, observation: Any, where: str) -> None:
        """
        Check that an observation has all entries that a policy needs to act.

        :param role: role of the policy that is about to act
        :param observation: observation that the policy was handed
        :param where: name of the method that was called, for the message
        :raises ValueError: if an entry is missing that the role's policy reads, or the deployed one, which runs beside it
        """
        reads = list(dict.fromkeys([*self.role_keys[role], *self.deployed_entries]))
        if not isinstance(observation, Mapping):
            raise ValueError(f"The {role} reads {reads}: pass {where} a dict with these entries, not an array.")
        missing = [key for key in reads if key not in observation]
        if missing:
            raise ValueError(
                f"The observation passed to {where} lacks {missing}, which the {role} reads; it has {list(observation)}. "
                f"predict() is for observations of {list(self.deployed_entries)} alone."
            )

    def acting_distributions(self, outputs: Mapping[str, Any]) -> Mapping[str, Any]:
        """
        The distributions of all policies' actions. A subclass whose policies act relative to each other overrides this method.

        :param outputs: role -> output of its network, for each policy
        :return: role -> distribution of its actions
        """
        return outputs

    def behaviour_distribution(self, obs: PyTorchObs) -> Distribution:
        r"""
        :param obs: full observation, each entry of shape (\*E, ...), where ``*E`` are any leading dimensions
        :return: distribution of the actions of the policy that collects the data, its tensors of shape (\*E, A)
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
        Actions of the policies that collect the data.

        :param observation: full observation, each entry of shape (B, ...)
        :param state: state that the last call returned; ``None`` at the start
        :param episode_start: booleans, true where an episode starts, shape (B,)
        :param deterministic: whether to take the distribution's mode instead of a sample
        :param acting: role of the policy that acts in each of the B environments; ``None`` for ``roles.behaviour`` in all
        :return: actions in [-1, 1] or numbers of discrete actions, shape (B, \*action shape), and the memories of all
            policies, acting or not, to which :meth:`with_actions` has yet to add the action that is taken
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
        Add the actions that were taken to the policies' memories.

        :param state: state that :meth:`behaviour_action` returned
        :param actions: actions that were then taken, in [-1, 1] or numbers of discrete actions, shape (B, \*action shape)
        :return: state for the next call of :meth:`behaviour_action`
        """
        if state is None:
            return None
        return tuple(
            getattr(self, role).with_action(own, actions) for role, own in zip(self.roles.policies, state, strict=True)
        )

    @th.no_grad()
    def frozen_action(self, policy: nn.Module, observation: dict[str, np.ndarray]) -> np.ndarray:
        r"""
        Actions of a policy that is none of the algorithm's networks.

        :param policy: policy to ask, see :class:`sb3_gac.base.frozen.FrozenPolicy`
        :param observation: full observation, each entry of shape (B, ...)
        :return: sampled actions, in [-1, 1] or numbers of discrete actions, shape (B, \*action shape)
        """
        obs, _ = self.reader.read(observation, self.device)
        return self._chosen(policy(obs), deterministic=False)

    def _chosen(self, actions: Distribution, deterministic: bool) -> np.ndarray:
        r"""
        :param actions: distribution of actions, its tensors of shape (B, A)
        :param deterministic: whether to take the distribution's mode instead of a sample
        :return: chosen actions, shape (B, \*action shape)
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

        :param observation: one observation or a batch: a full dict, ``{"partial": ...}``, or the partial entry's array alone
        :param state: state that the last call returned, for a recurrent policy; ``None`` at the start
        :param episode_start: booleans, true where an episode starts, shape (B,)
        :param deterministic: whether to take the distribution's mode instead of a sample
        :return: action in the environment's range, and the state for the next call
        """
        return self.deployed.predict(observation, state, episode_start, deterministic)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """The deployed policy's actions: in [-1, 1], shape (B, A), or numbers of discrete actions, shape (B,)."""
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.deployed._predict(observation, deterministic)

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """
        Convert an observation to tensors on the policy's device.

        :param observation: one observation or a batch: a dict, of which unknown entries are dropped, or the array of the one
            entry that the deployed policy reads
        :return: tensor of each entry, shape (B, ...), and whether the observation was a batch
        :raises ValueError: naming the entry that does not fit its space, or whose batch size differs from the others'
        """
        if not isinstance(observation, Mapping):
            return self.deployed.obs_to_tensor(observation)
        return self.reader.read(observation, self.device)
