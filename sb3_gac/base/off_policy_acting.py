"""The source of an off-policy algorithm's actions: the uniform warm-up, a policy, a frozen policy, or a recording."""

from copy import deepcopy
from typing import ClassVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise

from sb3_gac.base.behaviour import Behaviour, BehaviourSpec
from sb3_gac.base.collecting import DataCollection
from sb3_gac.base.frozen import FrozenPolicy
from sb3_gac.base.hooks import EpisodeHooks
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.recording import Recording
from sb3_gac.replay.buffer import CompactDictReplayBuffer


class OffPolicyActing(EpisodeHooks, DataCollection):
    """
    Chooses the actions for the environments. In each environment one policy acts until the episode's end.

    The attributes without a value are those of :class:`sb3_gac.base.algorithm.AsymmetricAlgorithm`, the other base of
    off-policy algorithms.
    """

    policy_class: type[AsymmetricPolicy]
    frozen: dict[str, FrozenPolicy]
    frozen_arguments: ClassVar[tuple[str, ...]]
    is_recurrent: bool
    behaviour: BehaviourSpec
    behaviour_per: str
    chooses_behaviour: Behaviour
    _recorded: Recording | None = None

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Actions for the next step: uniform ones during the warm-up, then those of the policies that act.

        :param learning_starts: number of environment steps of the warm-up
        :param action_noise: noise added to actions in [-1, 1], which are then clipped; ``None`` for none
        :param n_envs: number of environments
        :return: actions for the environments, and the same actions scaled to [-1, 1] for the replay buffer
        """
        action, scaled_action = self._next_action(learning_starts, action_noise, n_envs)
        self._behaviour_state = self.policy.with_actions(self._behaviour_state, scaled_action)
        return action, scaled_action

    def _next_action(
        self, learning_starts: int, action_noise: ActionNoise | None, n_envs: int
    ) -> tuple[np.ndarray, np.ndarray]:
        warms_up = self.num_timesteps < learning_starts
        episode_starts = np.ones(n_envs, dtype=bool) if self._last_episode_starts is None else self._last_episode_starts
        if len(self.acting) != n_envs:
            self.begin_episodes(n_envs)
        self.acting = self.choose_acting(episode_starts)
        self._has_warmed_up |= warms_up or self._recorded is not None  # no policy of this run acts on a recording
        if self._recorded is not None:
            scaled = self._recorded.actions(self.num_timesteps // n_envs).reshape(n_envs, *self.action_space.shape)  # type: ignore
            return self._in_environments_range(scaled), scaled
        if warms_up and not (self.is_recurrent or self.policy.remembers):
            return super()._sample_action(learning_starts, action_noise, n_envs)
        assert isinstance(self._last_obs, dict)
        trained = [self.policy.roles.behaviour if role in self.frozen else role for role in self.acting]
        scaled_action, self._behaviour_state = self.policy.behaviour_action(
            self._last_obs, self._behaviour_state, episode_starts, acting=trained
        )
        for name in self.frozen.keys() & set(self.acting):
            rows = np.array([role == name for role in self.acting])
            scaled_action[rows] = self.policy.frozen_action(self.frozen[name], self._last_obs)[rows]
        if warms_up:  # by now the policies' memories are up to date
            return super()._sample_action(learning_starts, action_noise, n_envs)
        if action_noise is not None:
            scaled_action = np.clip(scaled_action + np.reshape(action_noise(), scaled_action.shape), -1, 1)
        return self._in_environments_range(scaled_action), scaled_action

    def _make_behaviour(self, n_envs: int | None = None) -> Behaviour:
        roles = self.policy_class.roles
        return Behaviour(roles, self.behaviour, self.behaviour_per, self.frozen_arguments, n_envs or self.n_envs)

    def choose_acting(self, episode_start: np.ndarray) -> list[str]:
        """
        The policy that acts in each environment, see ``behaviour``; an algorithm with a rule of its own overrides this method.

        A policy that has begun an episode acts until its end.

        :param episode_start: booleans, true where an episode starts, shape (n_envs,)
        :return: role of the policy that acts in each environment, or name of a frozen policy
        """
        return self.chooses_behaviour.choose(self.acting, episode_start, self._current_progress_remaining)

    def _in_environments_range(self, action: np.ndarray) -> np.ndarray:
        """
        :param action: actions in [-1, 1], or numbers of discrete actions, shape (n_envs, ...)
        :return: actions in the environment's range
        """
        return self.policy.unscale_action(action) if isinstance(self.action_space, spaces.Box) else action

    def call_hooks(self, dones: np.ndarray) -> None:
        """See :meth:`EpisodeHooks.call_hooks`; with a recording, the step's rewards are compared with the recorded ones."""
        if self._recorded is not None:
            assert isinstance(self.replay_buffer, CompactDictReplayBuffer)
            self._recorded.check(self.num_timesteps // self.n_envs - 1, self.replay_buffer.newest_rewards())
        super().call_hooks(dones)

    def _fit_action_noise(self) -> None:
        """Make action noise fit the present number of environments, as SB3 does when ``learn`` begins, and not later."""
        noise = self.action_noise
        is_vectorized = isinstance(noise, VectorizedActionNoise)
        if noise is None or (noise.n_envs if is_vectorized else 1) == self.n_envs:  # type: ignore[attr-defined]
            return
        base = deepcopy(noise.base_noise if is_vectorized else noise)  # type: ignore[attr-defined]
        base.reset()
        self.action_noise = VectorizedActionNoise(base, self.n_envs) if self.n_envs > 1 else base

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "chooses_behaviour", "_recorded"]
