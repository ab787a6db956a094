"""Who acts in each environment, what the episode under way has returned so far, and what an algorithm does about it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_gac.base.policy import AsymmetricPolicy


class EpisodeHooks(BaseAlgorithm):
    """:meth:`on_step` and :meth:`on_episode_end`, for algorithms to fill in."""

    policy: AsymmetricPolicy
    #: Of each environment: role of the policy that acts, return of the episode so far, whether actions in it were uniform
    acting: Sequence[str] = ()
    _returns_so_far: Any = None
    _has_warmed_up: Any = None

    def on_step(self) -> None:
        """After each step of the environments, once it is stored."""

    def on_episode_end(self, env: int, episode_return: float, role: str | None) -> None:
        """
        After an episode's last step, once it is stored and before :meth:`on_step`.

        :param env: number of the environment
        :param episode_return: sum of the rewards as they are stored, that is, before normalisation
        :param role: of the policy that has acted; ``None`` if actions of the warm-up were among its own
        """

    def begin_episodes(self, n_envs: int) -> None:
        """
        :param n_envs: number of environments, in each of which an episode begins
        """
        self.acting = [self.policy.roles.behaviour] * n_envs
        self._returns_so_far, self._has_warmed_up = np.zeros(n_envs), np.zeros(n_envs, dtype=bool)

    def call_hooks(self, dones: np.ndarray) -> None:
        """
        :param dones: where an episode has ended with the step that was just stored, shape (n_envs,)
        """
        for index in np.flatnonzero(dones).tolist():
            role = None if self._has_warmed_up[index] else self.acting[index]
            self.on_episode_end(index, float(self._returns_so_far[index]), role)
        self._returns_so_far[dones], self._has_warmed_up[dones] = 0.0, False
        self.on_step()
