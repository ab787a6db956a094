"""Who takes the actions of an off-policy algorithm: chance, the behaviour policy, a frozen one, or a recording."""

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
    Actions for the environments, in [-1, 1] for the buffer; each environment's policy stays to the episode's end.

    The attributes without a value are those of :class:`sb3_gac.base.algorithm.AsymmetricAlgorithm`, which stands beside it.
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
        Uniform during warm-up, then the behaviour policy, which sees everything.

        :param learning_starts: steps of warm-up
        :param action_noise: added to the scaled action, which is then clipped
        :param n_envs: number of environments
        :return: action for the environments, and the same scaled to [-1, 1] for the buffer
        """
        action, scaled_action = self._next_action(learning_starts, action_noise, n_envs)
        self._behaviour_state = self.policy.with_actions(self._behaviour_state, scaled_action)
        return action, scaled_action

    def _next_action(
        self, learning_starts: int, action_noise: ActionNoise | None, n_envs: int
    ) -> tuple[np.ndarray, np.ndarray]:
        if self._recorded is not None:
            scaled = self._recorded.actions(self.num_timesteps // n_envs).reshape(n_envs, *self.action_space.shape)  # type: ignore
            return self._in_environments_range(scaled), scaled
        warms_up = self.num_timesteps < learning_starts
        episode_starts = np.ones(n_envs, dtype=bool) if self._last_episode_starts is None else self._last_episode_starts
        if len(self.acting) != n_envs:
            self.begin_episodes(n_envs)
        self.acting = self.choose_acting(episode_starts)
        self._has_warmed_up |= warms_up
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
        if warms_up:  # the memory was brought up
            return super()._sample_action(learning_starts, action_noise, n_envs)
        if action_noise is not None:
            scaled_action = np.clip(scaled_action + action_noise(), -1, 1)
        return self._in_environments_range(scaled_action), scaled_action

    def _make_behaviour(self) -> Behaviour:
        return Behaviour(self.policy_class.roles, self.behaviour, self.behaviour_per, self.frozen_arguments)

    def choose_acting(self, episode_start: np.ndarray) -> list[str]:
        """
        Which policy acts in each environment, see ``behaviour``; to be overridden by algorithms with a rule of their own.

        :param episode_start: true where an episode starts, shape (n_envs,)
        :return: role of the policy, or name of a frozen one, of each environment; who has acted stays to the episode's end
        """
        return self.chooses_behaviour.choose(self.acting, episode_start, self._current_progress_remaining)

    def _in_environments_range(self, action: np.ndarray) -> np.ndarray:
        """
        :param action: in [-1, 1], or one of a number
        """
        return self.policy.unscale_action(action) if isinstance(self.action_space, spaces.Box) else action

    def call_hooks(self, dones: np.ndarray) -> None:
        """See :meth:`EpisodeHooks.call_hooks`; first, a recorded step must be what it was."""
        if self._recorded is not None:
            assert isinstance(self.replay_buffer, CompactDictReplayBuffer)
            self._recorded.check(self.num_timesteps // self.n_envs - 1, self.replay_buffer.newest_rewards())
        super().call_hooks(dones)

    def _fit_action_noise(self) -> None:
        """Noise that SB3 has made for another number of environments becomes noise for as many as there are."""
        noise = self.action_noise
        if isinstance(noise, VectorizedActionNoise) and noise.n_envs != self.n_envs:
            base = deepcopy(noise.base_noise)
            base.reset()
            self.action_noise = VectorizedActionNoise(base, self.n_envs) if self.n_envs > 1 else base

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "chooses_behaviour", "_recorded"]
