"""The loop that collects rollouts: it stores each step that was taken, and no other, whoever stops or interrupts it."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecEnv
from typing_extensions import Self

#: Arrays of a rollout buffer that are filled step by step, besides observations
_FILLED = ("actions", "rewards", "episode_starts", "values", "log_probs")


class UnrolledBuffer(DictRolloutBuffer):
    """
    SB3's buffer of rollouts, whose advantages may look ahead no further than the end of an unroll.

    :param unroll_length: number of steps in an unroll, at whose end advantages bootstrap; ``None`` for the whole rollout
    :param args: positional arguments of ``DictRolloutBuffer``
    :param kwargs: keyword arguments of ``DictRolloutBuffer``
    """

    def __init__(self, *args: Any, unroll_length: int | None = None, **kwargs: Any):
        self.unroll_length = unroll_length
        super().__init__(*args, **kwargs)

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: np.ndarray) -> None:
        """
        Generalised advantage estimation, which is cut where an episode ends and where an unroll ends.

        :param last_values: values of the observations after the last step, shape (n_envs,)
        :param dones: booleans, true where the last step ended an episode, shape (n_envs,)
        """
        next_values = np.concatenate([self.values[1:], last_values.detach().cpu().numpy().reshape(1, -1)])
        goes_on = 1.0 - np.concatenate([self.episode_starts[1:], np.asarray(dones, dtype=np.float32).reshape(1, -1)])
        deltas = self.rewards + self.gamma * next_values * goes_on - self.values
        traces = self.gamma * self.gae_lambda * goes_on
        if self.unroll_length is not None:
            traces[self.unroll_length - 1 :: self.unroll_length] = 0.0
        advantage = np.zeros_like(deltas[0])
        for step in reversed(range(self.buffer_size)):
            advantage = self.advantages[step] = deltas[step] + traces[step] * advantage
        self.returns = self.advantages + self.values


class RolloutCollection(OnPolicyAlgorithm):
    """
    SB3's loop in another order: a step is stored before callbacks see it.

    If a callback ends a rollout, the next ``learn(..., reset_num_timesteps=False)`` goes on with the rollout: the two calls
    together do what a single one would have done.
    """

    #: Attributes that collecting changes
    collected = ("_obs_after_last_step",)
    #: Observations after the last stored step, from which its episodes may still bootstrap; ``None`` if there are none
    _obs_after_last_step: dict[str, np.ndarray] | None = None
    reward_scale: float
    unroll_length: int | None
    rollout_buffer: UnrolledBuffer
    _returns_so_far: Any
    note_use: Callable[[], None]
    reset_if_used_elsewhere: Callable[[VecEnv], None]
    check_minibatches: Callable[[int], None]
    call_hooks: Callable[[np.ndarray], None]
    follow_arguments: Callable[[], None]
    _precision: Callable[[], AbstractContextManager]

    def _setup_model(self) -> None:
        """See SB3's ``_setup_model``; the policy is made without SB3's argument ``use_sde``."""
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self._make_rollout_buffer()
        self.policy = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs)  # type: ignore
        self.policy = self.policy.to(self.device)

    # --- data ---------------------------------------------------------------------------------------------------------

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """See SB3's ``set_env``; between two rollouts, the number of environments may change."""
        assert isinstance(env, VecEnv)
        if env.num_envs != self.n_envs:
            self.check_minibatches(env.num_envs)
            self.n_envs, self._last_obs, self._obs_after_last_step = env.num_envs, None, None
            self._make_rollout_buffer()
        super().set_env(env, force_reset)

    def cut_episodes(self) -> None:
        """End the episodes under way before a reset: the last step of the rollout bootstraps, as at a time limit."""
        buffer = self.rollout_buffer
        if self._obs_after_last_step is not None and buffer.pos > 0 and not buffer.generator_ready:
            going_on = ~np.asarray(self._last_episode_starts)
            buffer.rewards[buffer.pos - 1] += going_on * self.gamma * self._values_of(self._obs_after_last_step)
        self._obs_after_last_step = None

    def keep_first_observations(self) -> None:
        """Called after a reset of the environments; a rollout buffer needs nothing then."""

    def check_data_can_be_saved(self) -> None:
        """Do nothing: a checkpoint can hold every rollout buffer."""

    def save_data(self, root: Path) -> tuple[dict[str, Any], list[str]]:
        """
        The rollout under way, for a checkpoint.

        :param root: folder of all checkpoints of a run
        :return: filled part of each array of the rollout buffer by name (empty if the rollout was trained on already), and no
            names of blocks
        """
        buffer = self.rollout_buffer
        if buffer.generator_ready:
            return {}, []
        filled = {name: getattr(buffer, name)[: buffer.pos] for name in _FILLED}
        return {**filled, "observations": {key: entry[: buffer.pos] for key, entry in buffer.observations.items()}}, []

    def restore_data(self, root: Path, saved: dict[str, Any]) -> None:
        """
        Restore the rollout under way.

        :param root: folder of all checkpoints of a run
        :param saved: first value that :meth:`save_data` returned
        """
        if not saved:
            return
        buffer = self.rollout_buffer
        buffer.pos = len(saved["rewards"])
        buffer.full = buffer.pos == buffer.buffer_size
        for name in _FILLED:
            getattr(buffer, name)[: buffer.pos] = saved[name]
        for key, entry in saved["observations"].items():
            buffer.observations[key][: buffer.pos] = entry

    def example_of_data(self) -> dict[str, th.Tensor]:
        """Observation entries and rewards of the rollout, as the networks see them, for the diagnosis of a divergence."""
        buffer = self.rollout_buffer
        entries = {**buffer.observations, "reward": buffer.rewards}
        return {name: th.as_tensor(values[: buffer.buffer_size]) for name, values in entries.items()}

    def _make_rollout_buffer(self) -> None:
        self.rollout_buffer = UnrolledBuffer(
            self.n_steps,
            self.observation_space,
            self.action_space,
            device=self.device,
            gamma=self.gamma,
            gae_lambda=self.gae_lambda,
            n_envs=self.n_envs,
            unroll_length=self.unroll_length,
        )

    # --- steps --------------------------------------------------------------------------------------------------------

    def _setup_learn(self, total_timesteps: int, callback: Any = None, reset_num_timesteps: bool = True, *args: Any) -> Any:
        if reset_num_timesteps:
            self.rollout_buffer.reset()
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """See SB3's ``collect_rollouts``; callbacks find the same names in ``locals``."""
        self.follow_arguments()
        self.policy.set_training_mode(False)
        if self.rollout_buffer.generator_ready:  # gradient steps have been taken on the rollout
            self.rollout_buffer.reset()
        callback.on_rollout_start()
        dones = np.asarray(self._last_episode_starts)
        while self.rollout_buffer.pos < n_rollout_steps:
            env, rollout_buffer = self.env, self.rollout_buffer  # type: ignore[assignment]  # a callback may set other environments
            self.reset_if_used_elsewhere(env)
            drawn, actions, values, log_probs = self._act()
            new_obs, rewards, dones, infos = env.step(actions)
            self.note_use()
            self._returns_so_far += self._vec_normalize_env.get_original_reward() if self._vec_normalize_env else rewards
            rewards = self._with_value_of_what_was_cut(rewards * self.reward_scale, dones, infos)
            rollout_buffer.add(self._last_obs, drawn, rewards, self._last_episode_starts, values, log_probs)  # type: ignore
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
            self._obs_after_last_step = new_obs  # type: ignore[assignment]
            self.num_timesteps += env.num_envs
            self._update_info_buffer(infos, dones)
            self.call_hooks(dones)
            callback.update_locals(locals())
            if not callback.on_step():
                return False
        last_values = th.as_tensor(self._values_of(self._last_obs))  # type: ignore[arg-type]
        self.rollout_buffer.compute_returns_and_advantage(last_values, dones)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    @th.no_grad()
    def _act(self) -> tuple[np.ndarray, np.ndarray, th.Tensor, th.Tensor]:
        """
        Let the behaviour policy act.

        :return: draws from its distribution, for the rollout buffer; actions for the environments; values of the
            observations; log-probabilities of the draws
        """
        obs, _ = self.policy.obs_to_tensor(self._last_obs)  # type: ignore[arg-type]
        with self._precision():  # that of the losses, or rounding alone would move their ratios away from 1
            distribution = self.policy.behaviour_distribution(obs)  # type: ignore[operator]
        drawn = distribution.draw()
        actions = distribution.action(drawn).cpu().numpy()
        if isinstance(self.action_space, spaces.Box):
            actions = self.policy.unscale_action(actions.reshape(-1, *self.action_space.shape))
        return drawn.cpu().numpy(), actions, self.policy.critic(obs), distribution.log_prob(drawn)  # type: ignore[operator]

    def _with_value_of_what_was_cut(self, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> np.ndarray:
        """
        Bootstrap where a time limit has ended an episode.

        :param rewards: rewards of the step, shape (n_envs,)
        :param dones: booleans, true where an episode has ended, shape (n_envs,)
        :param infos: info dict of each environment
        :return: rewards, plus the discounted value of the last observation where an episode was truncated, shape (n_envs,)
        """
        cut = [index for index in np.flatnonzero(dones).tolist() if infos[index].get("TimeLimit.truncated", False)]
        if cut:
            last = [infos[index]["terminal_observation"] for index in cut]
            rewards[cut] += self.gamma * self._values_of({key: np.stack([obs[key] for obs in last]) for key in last[0]})
        return rewards

    @th.no_grad()
    def _values_of(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """
        :param observation: observations, each entry of shape (B, ...)
        :return: values by the critic, shape (B,)
        """
        obs, _ = self.policy.obs_to_tensor(observation)
        return self.policy.critic(obs).cpu().numpy()  # type: ignore[operator]

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """See SB3's ``OnPolicyAlgorithm.learn``; by default TensorBoard's runs have the name of the class."""
        self.follow_arguments()  # before anything of the training has begun
        tb_log_name = tb_log_name or type(self).__name__
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
