"""Hooks that algorithms override, called after each step and episode, and the state of episodes that they are told."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_gac.base.policy import AsymmetricPolicy


class EpisodeHooks(BaseAlgorithm):
    """Calls :meth:`on_step` and :meth:`on_episode_end`, which do nothing until an algorithm overrides them."""

    policy: AsymmetricPolicy
    #: For each environment: role of the policy that acts, return of the episode so far, whether some actions were no policy's
    acting: Sequence[str] = ()
    _returns_so_far: Any = None
    _has_warmed_up: Any = None

    def on_step(self) -> None:
        """Called after each step of the environments, once the step is stored."""

    def on_episode_end(self, env: int, episode_return: float, role: str | None) -> None:
        """
        Called after an episode's last step, once the step is stored and before :meth:`on_step`.

        :param env: index of the environment
        :param episode_return: sum of the episode's rewards before normalisation
        :param role: role of the policy that acted in the episode; ``None`` if some actions were the warm-up's, a recording's
            or those of a former phase of training
        """

    def begin_episodes(self, n_envs: int) -> None:
        """
        Begin an episode in every environment.

        :param n_envs: number of environments
        """
        self.acting = [self.policy.roles.behaviour] * n_envs
        self._returns_so_far, self._has_warmed_up = np.zeros(n_envs), np.zeros(n_envs, dtype=bool)

    def call_hooks(self, dones: np.ndarray) -> None:
        """
        Call the hooks after a step was stored.

        :param dones: booleans, true where that step ended an episode, shape (n_envs,)
        """
        for index in np.flatnonzero(dones).tolist():
            role = None if self._has_warmed_up[index] else self.acting[index]
            self.on_episode_end(index, float(self._returns_so_far[index]), role)
        self._returns_so_far[dones], self._has_warmed_up[dones] = 0.0, False
        self.on_step()
