"""Collecting data: every step that was taken is stored and none is invented, whoever stops, interrupts or interferes."""

import warnings
from collections.abc import Sequence
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
from typing_extensions import Self

from sb3_gac.checks.environments import EnvironmentGuard, guard_environments, guard_of
from sb3_gac.checks.requirements import check_environment
from sb3_gac.replay.buffer import CompactDictReplayBuffer
from sb3_gac.replay.source import ReplaySource


class DataCollection(OffPolicyAlgorithm):
    """
    SB3's loop in another order: a step is stored before callbacks see it, so that one which ends ``learn``, raises, or
    evaluates on the training environments takes nothing away and adds nothing.

    A rollout that was ended by a callback is gone on with by the next ``learn(..., reset_num_timesteps=False)``: together
    they do what one would have done.
    """

    #: Steps of each environment, and episodes, of the rollout under way
    _rollout_steps = 0
    _rollout_episodes = 0
    #: Guard of the environments that were last used from here, and what it had counted by then
    _last_use: tuple[EnvironmentGuard | None, int] = (None, 0)
    _replay_source: ReplaySource | None = None
    _used_elsewhere_said = False
    #: Of each environment: role of the policy that acts, return of the episode so far, whether actions in it were uniform
    acting: Sequence[str] = ()
    _returns_so_far: Any = None
    _has_warmed_up: Any = None

    # --- hooks, for algorithms -----------------------------------------------------------------------------------------

    def on_step(self) -> None:
        """After each step of the environments, once it is stored."""

    def on_episode_end(self, env: int, episode_return: float, role: str | None) -> None:
        """
        After an episode's last step, once it is stored and before :meth:`on_step`.

        :param env: number of the environment
        :param episode_return: sum of the rewards as they are stored, that is, before normalisation
        :param role: of the policy that has acted; ``None`` if actions of the warm-up were among its own
        """

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        """
        Whatever environment the model is given comes through here.

        :raises ValueError: see :func:`check_environment`
        """
        check_environment(env)
        wrapped = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        guard_environments(wrapped)
        return wrapped

    @property
    def replay_source(self) -> ReplaySource:
        """What the replay buffer gets of the environments."""
        assert self.env is not None
        if self._replay_source is None or self._replay_source.env is not self.env:
            self._replay_source = ReplaySource(self.env)
            self._check_replay_source(self._replay_source)
        return self._replay_source

    @property
    def sampling_env(self) -> Any:
        """What is to be passed to ``ReplayBuffer.sample``."""
        return None if self.env is None else self.replay_source.sampling_env

    def _check_replay_source(self, source: ReplaySource) -> None:
        if self.replay_buffer is not None:
            self._check_what_is_held(self.replay_buffer, source)
        if source.in_the_way is None:
            return
        names = f"{type(source.in_the_way).__name__} stands outside VecNormalize"
        remedy = f"make it VecNormalize({type(source.in_the_way).__name__}(env))"
        if self.replay_buffer_class is not None and issubclass(self.replay_buffer_class, HerReplayBuffer):
            raise ValueError(
                f"{names}: goals would be stored normalised, and HerReplayBuffer computes rewards from raw ones: {remedy}."
            )
        warnings.warn(
            f"{names}: the replay buffer holds observations as they were normalised when they were seen. To have them "
            f"normalised with the newest statistics whenever they are sampled, {remedy}.",
            stacklevel=4,
        )

    def _check_what_is_held(self, buffer: ReplayBuffer, source: ReplaySource) -> None:
        """
        :raises ValueError: if what is stored was normalised when it was seen, and what is to be stored is not, or the reverse
        """
        normalised = source.in_the_way is not None
        held = getattr(buffer, "holds_normalised", normalised) if buffer.size() else normalised
        if held != normalised:
            ways = ("raw", "normalised as they were seen")
            wrapper = f"{'no' if held else 'a'} wrapper outside VecNormalize changes them"
            raise ValueError(
                f"The replay buffer holds observations {ways[held]}, but of these environments it would get them "
                f"{ways[normalised]}, because {wrapper}: wrap the environments as before, or leave the buffer out."
            )
        buffer.holds_normalised = normalised  # type: ignore[attr-defined]

    # --- episodes ---------------------------------------------------------------------------------------------------

    def learn(self, *args: Any, **kwargs: Any) -> Self:
        """See SB3's ``learn``. After an interrupt, as by Ctrl-C, the next one starts with a reset of the environments."""
        try:
            return super().learn(*args, **kwargs)
        except BaseException as error:
            if not isinstance(error, Exception):
                self._last_obs = None
            raise

    def _setup_learn(
        self, total_timesteps: int, callback: Any = None, reset_num_timesteps: bool = True, *args: Any, **kwargs: Any
    ) -> Any:
        resets = reset_num_timesteps or self._last_obs is None
        if resets:
            self._cut_episodes()
        if reset_num_timesteps:
            self._rollout_steps, self._rollout_episodes = 0, 0
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
        if resets:
            self._note_reset()
        return result

    def _cut_episodes(self) -> None:
        """The environments are about to be reset: what was stored last is not continued by what comes next."""
        if isinstance(self.replay_buffer, CompactDictReplayBuffer):
            self.replay_buffer.mark_reset()
        elif isinstance(self.replay_buffer, HerReplayBuffer):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self.replay_buffer.truncate_last_trajectory()

    def _note_reset(self) -> None:
        """The environments were just reset: ``_last_obs`` is their first observation."""
        assert self.env is not None
        assert isinstance(self._last_obs, dict)
        self._last_original_obs = self.replay_source.observation(self._last_obs)
        self._last_episode_starts = np.ones(self.env.num_envs, dtype=bool)
        self._begin_episodes(self.env.num_envs)
        self._note_use()

    def _begin_episodes(self, n_envs: int) -> None:
        self.acting = [str(self.policy.roles.behaviour)] * n_envs  # type: ignore[union-attr]
        self._returns_so_far, self._has_warmed_up = np.zeros(n_envs), np.zeros(n_envs, dtype=bool)

    def _note_use(self) -> None:
        """Whatever was done to the environments so far was done from here."""
        assert self.env is not None
        guard = guard_of(self.env)
        self._last_use = (guard, guard.uses)

    def _reset_if_used_elsewhere(self, env: VecEnv) -> None:
        """Episodes under way end where somebody else has stepped or reset the environments, or they are others than before."""
        guard = guard_of(env)
        if self._last_obs is not None and self._last_use == (guard, guard.uses):
            return
        if self._last_obs is not None and not self._used_elsewhere_said:
            warnings.warn(
                "The training environments were stepped or reset from outside the training, as by an evaluation on them, or "
                "force_reset=False was given with others than before: the episodes under way end there, and new ones start. "
                "Give evaluations an environment of their own.",
                stacklevel=4,
            )
            self._used_elsewhere_said = True
        self._cut_episodes()
        self._last_obs = env.reset()  # type: ignore[assignment]
        self._note_reset()

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
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        continue_training = True
        while continue_training and should_collect_more_steps(train_freq, self._rollout_steps, self._rollout_episodes):
            if env is not self.env:  # a callback has set others
                env, replay_buffer, action_noise = self.env, self.replay_buffer, self.action_noise  # type: ignore[assignment]
            self._reset_if_used_elsewhere(env)
            actions, buffer_actions = self._sample_action(learning_starts, action_noise, env.num_envs)
            new_obs, rewards, dones, infos = env.step(actions)
            self._note_use()
            self._store_transition(replay_buffer, buffer_actions, new_obs, rewards, dones, infos)  # type: ignore[arg-type]
            self.num_timesteps += env.num_envs
            self._rollout_steps += 1
            self._update_info_buffer(infos, dones)
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self._call_hooks(dones)
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

    def _call_hooks(self, dones: np.ndarray) -> None:
        for index in np.flatnonzero(dones).tolist():
            role = None if self._has_warmed_up[index] else self.acting[index]
            self.on_episode_end(index, float(self._returns_so_far[index]), role)
        self._returns_so_far[dones], self._has_warmed_up[dones] = 0.0, False
        self.on_step()

    def _count_episodes(self, dones: np.ndarray, action_noise: ActionNoise | None, log_interval: int | None) -> bool:
        """
        :param dones: whether an episode has ended, shape (n_envs,)
        :param action_noise: starts anew there
        :param log_interval: episodes between two logs
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
        following = source.observation(new_obs)  # of the next episode where one has ended
        next_obs = {key: values.copy() for key, values in following.items()} if np.any(dones) else following
        for index in np.flatnonzero(dones):
            final = source.final(infos[index])
            for key, values in next_obs.items():
                values[index] = final[key]
        rewards = source.reward(reward)
        replay_buffer.add(self._last_original_obs, next_obs, buffer_action, rewards, dones, infos)  # type: ignore[arg-type]
        self._returns_so_far += rewards
        self._last_obs, self._last_original_obs, self._last_episode_starts = new_obs, following, np.array(dones)

    def _excluded_save_params(self) -> list[str]:
        of_the_data = ["_rollout_steps", "_rollout_episodes"]  # steps that a file of the model leaves behind
        return [*super()._excluded_save_params(), "_replay_source", "_last_use", *of_the_data]
