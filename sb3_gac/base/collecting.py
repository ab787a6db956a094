"""The loop that collects data: it stores each step that was taken, and no other, whoever stops or interrupts it."""

import warnings
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, RolloutReturn, TrainFreq
from stable_baselines3.common.utils import should_collect_more_steps
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_gac.base.behaviour import Behaviour
from sb3_gac.base.replay_data import check_number
from sb3_gac.checks.arguments import check_train_freq
from sb3_gac.checks.requirements import warn_of_other_rewards
from sb3_gac.replay.buffer import CompactDictReplayBuffer
from sb3_gac.replay.source import ReplaySource

#: Number of steps at the start of training whose rewards are compared with those of ``compute_reward``: rare ones may agree
COMPARED = 20


class DataCollection(OffPolicyAlgorithm):
    """
    SB3's loop in another order: a step is stored before callbacks see it.

    A callback may end ``learn``, raise an error, or evaluate on the training environments: no transition is lost, and no
    wrong one is stored. If a callback ends a rollout, the next ``learn(..., reset_num_timesteps=False)`` goes on with the
    rollout: the two calls together do what a single one would have done.
    """

    #: Attributes that collecting changes
    collected = ("_episode_num", "_rollout_steps", "_rollout_episodes", "_last_original_obs")
    #: Number of steps of each environment, and of episodes, in the rollout under way
    _rollout_steps = 0
    _rollout_episodes = 0
    _resumed_noise: Any = None
    _returns_so_far: Any
    _behaviour_state: Any
    #: Number of steps whose rewards are still to be compared with those of ``compute_reward``
    _rewards_to_compare: int = 0
    _fit_action_noise: Callable[[], None]
    _make_behaviour: Callable[[int], Behaviour]
    chooses_behaviour: Behaviour
    note_use: Callable[[], None]
    call_hooks: Callable[[np.ndarray], None]
    follow_arguments: Callable[[], None]
    replay_source: ReplaySource
    _check_what_is_held: Callable[[ReplayBuffer, ReplaySource], None]
    _make_replay_buffer: Callable[[], ReplayBuffer]
    reset_if_used_elsewhere: Callable[[VecEnv], None]

    # --- other environments -----------------------------------------------------------------------------------------

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        See SB3's ``set_env``; while the replay buffer is empty, the number of environments may change.

        :raises ValueError: if the replay buffer was filled by another number of environments
        """
        assert isinstance(env, VecEnv)
        buffer = self.replay_buffer
        if buffer is not None and buffer.n_envs != env.num_envs:
            if buffer.size() > 0:
                check_number(buffer, env.num_envs, f"{type(self).__name__}.load(path, env=...) takes any number")
            self.replay_buffer = None
        if env.num_envs != self.n_envs:
            check_train_freq("train_freq", self.train_freq, env.num_envs)
            self.chooses_behaviour = self._make_behaviour(env.num_envs)
            self.n_envs, self._last_obs, self._behaviour_state = env.num_envs, None, None
            self._fit_action_noise()
        super().set_env(env, force_reset)
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        if isinstance(self.replay_buffer, HerReplayBuffer):
            self.replay_buffer.env = self.env  # whose compute_reward rewards goals; SB3 would ask the environments before
        _ = self.replay_source  # a look at it, which may raise or warn

    # --- episodes ---------------------------------------------------------------------------------------------------

    def _setup_learn(self, total_timesteps: int, callback: Any = None, reset_num_timesteps: bool = True, *args: Any) -> Any:
        """See SB3's ``_setup_learn``; a resumed action noise goes on instead of starting anew."""
        if self.replay_buffer is None and self.env is not None:
            self.replay_buffer = self._make_replay_buffer()
        if self.replay_buffer is not None:
            check_number(self.replay_buffer, self.n_envs)
        self._rewards_to_compare = COMPARED if isinstance(self.replay_buffer, HerReplayBuffer) else 0
        if reset_num_timesteps:
            self._rollout_steps, self._rollout_episodes = 0, 0
        noise, self._resumed_noise = deepcopy(self._resumed_noise), None
        optimizes = self.optimize_memory_usage
        if isinstance(self.replay_buffer, CompactDictReplayBuffer):
            self.optimize_memory_usage = False  # or SB3 ends the last episode in its own arrays; cut_episodes() does it here
        try:
            result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args)
        finally:
            self.optimize_memory_usage = optimizes
        if noise is not None and not reset_num_timesteps:
            self.action_noise = noise
        return result

    def cut_episodes(self) -> None:
        """End the episodes under way in the replay buffer, because the environments are about to be reset."""
        if isinstance(self.replay_buffer, CompactDictReplayBuffer):
            self.replay_buffer.mark_reset()
        elif isinstance(self.replay_buffer, HerReplayBuffer):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self.replay_buffer.truncate_last_trajectory()

    def keep_first_observations(self) -> None:
        """Keep the first observations after a reset, ``_last_obs``, in the form in which they are to be stored."""
        assert isinstance(self._last_obs, dict)
        self._last_original_obs = self.replay_source.observation(self._last_obs)

    # --- steps ------------------------------------------------------------------------------------------------------

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        """See SB3's ``collect_rollouts``; callbacks find the same names in ``locals``."""
        self.follow_arguments()
        if not isinstance(train_freq, TrainFreq):  # somebody has set a number
            train_freq = self.train_freq
        if action_noise is not None:  # which may have been set since SB3 looked
            action_noise = self.action_noise
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        continue_training = True
        while continue_training and should_collect_more_steps(train_freq, self._rollout_steps, self._rollout_episodes):
            if env is not self.env:  # a callback has set other environments
                env, replay_buffer, action_noise = self.env, self.replay_buffer, self.action_noise  # type: ignore[assignment]
            self.reset_if_used_elsewhere(env)
            actions, buffer_actions = self._sample_action(learning_starts, action_noise, env.num_envs)
            new_obs, rewards, dones, infos = env.step(actions)
            self.note_use()
            self._store_transition(replay_buffer, buffer_actions, new_obs, rewards, dones, infos)  # type: ignore[arg-type]
            self.num_timesteps += env.num_envs
            self._rollout_steps += 1
            self._update_info_buffer(infos, dones)
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self.call_hooks(dones)
            self._on_step()
            logs_are_due = self._count_episodes(dones, action_noise, log_interval)
            num_collected_steps, num_collected_episodes = self._rollout_steps, self._rollout_episodes
            callback.update_locals(locals())
            continue_training = callback.on_step()
            if logs_are_due:
                self.dump_logs()
        result = RolloutReturn(self._rollout_steps * env.num_envs, self._rollout_episodes, continue_training)
        if continue_training:
            callback.on_rollout_end()
            self._rollout_steps, self._rollout_episodes = 0, 0
        return result

    def _count_episodes(self, dones: np.ndarray, action_noise: ActionNoise | None, log_interval: int | None) -> bool:
        """
        :param dones: booleans, true where an episode has ended, shape (n_envs,)
        :param action_noise: noise that starts anew where an episode has ended; ``None`` for none
        :param log_interval: number of episodes between two logs; ``None`` for no logs
        :return: whether a log is due
        """
        due = False
        for index in np.flatnonzero(dones).tolist():
            self._rollout_episodes += 1
            self._episode_num += 1
            if action_noise is not None:
                action_noise.reset(**({"indices": [index]} if len(dones) > 1 else {}))
            due |= log_interval is not None and self._episode_num % log_interval == 0
        return due

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        assert isinstance(new_obs, dict)
        source = self.replay_source
        self._check_what_is_held(replay_buffer, source)
        following = source.observation(new_obs)  # the next episode's first observation, where an episode has ended
        next_obs = {key: values.copy() for key, values in following.items()} if np.any(dones) else following
        for index in np.flatnonzero(dones):
            final = source.final(infos[index])
            for key, values in next_obs.items():
                values[index] = final[key]
        rewards = source.reward(reward)
        replay_buffer.add(self._last_original_obs, next_obs, buffer_action, rewards, dones, infos)  # type: ignore[arg-type]
        if self._rewards_to_compare > 0:
            assert self.env is not None
            said = warn_of_other_rewards(self.replay_buffer_kwargs, self.env, next_obs, rewards, infos)
            self._rewards_to_compare = 0 if said else self._rewards_to_compare - 1
        self._returns_so_far += rewards
        self._last_obs, self._last_original_obs, self._last_episode_starts = new_obs, following, np.array(dones)

    def _excluded_save_params(self) -> list[str]:
        of_the_data = [
            "_rollout_steps",
            "_rollout_episodes",
            "_rewards_to_compare",
        ]  # of the rollout under way, which a model's file does not hold
        return [*super()._excluded_save_params(), "_resumed_noise", *of_the_data]
