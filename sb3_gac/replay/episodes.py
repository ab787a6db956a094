"""Replay of whole episodes, or of parts of them, for policies that remember."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gac.replay.buffer import CompactDictReplayBuffer
from sb3_gac.replay.samples import SequenceSamples
from sb3_gac.replay.shown import DONE, TIME_LIMIT


class EpisodeIndex:
    """
    Which episodes a ring holds: first in, first out, in arrays that grow.

    One row per episode: environment, first step, number of steps; steps count from the buffer's start.
    """

    def __init__(self) -> None:
        self._rows = np.empty((16, 3), dtype=np.int64)
        self._first, self._end = 0, 0

    def append(self, env: int, first_step: int, length: int) -> None:
        """
        :param env: its number
        :param first_step: of the episode
        :param length: in steps
        """
        if self._end == len(self._rows):
            kept = self._rows[self._first : self._end]
            self._rows = np.empty((max(2 * len(kept), 16), 3), dtype=np.int64)
            self._rows[: len(kept)] = kept
            self._first, self._end = 0, len(kept)
        self._rows[self._end] = env, first_step, length
        self._end += 1

    def since(self, step: int) -> np.ndarray:
        """
        :param step: earlier ones are gone
        :return: the episodes that are whole, shape (E, 3)
        """
        while self._first < self._end and self._rows[self._first, 1] < step:
            self._first += 1
        rows = self._rows[self._first : self._end]
        return rows[rows[:, 1] >= step]


class EpisodeReplayBuffer(CompactDictReplayBuffer):
    """
    :class:`CompactDictReplayBuffer`, sampled by episode, or by sequence within episodes.

    Episodes count once they have ended, for whatever reason, and as long as all of their steps are there.

    :param args: of :class:`CompactDictReplayBuffer`
    :param sequence_length: transitions that count in a sample, drawn uniformly over steps; ``None`` for whole episodes,
        drawn uniformly over episodes
    :param burn_in: up to so many transitions before those only bring memories up
    :param kwargs: of :class:`CompactDictReplayBuffer`; ``n_steps`` must be 1
    """

    def __init__(self, *args: Any, sequence_length: int | None = None, burn_in: int = 0, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if self.n_steps != 1:
            raise ValueError(f"n_steps must be 1 for sequences, got {self.n_steps}.")
        if sequence_length is not None and sequence_length < 1:
            raise ValueError(f"sequence_length must be at least 1, or None for whole episodes, got {sequence_length}.")
        if burn_in < 0 or (burn_in and sequence_length is None):
            raise ValueError(f"burn_in must be at least 0, and goes with a sequence_length, got {burn_in}.")
        self.sequence_length = sequence_length
        self.burn_in = burn_in
        self._forget_episodes()

    def _forget_episodes(self) -> None:
        self._episodes = EpisodeIndex()
        self._episode_starts = np.zeros(self.n_envs, dtype=np.int64)

    def reset(self) -> None:
        """Forget everything."""
        super().reset()
        self._forget_episodes()

    def bookkeeping(self) -> dict[str, Any]:
        """See :meth:`CompactDictReplayBuffer.bookkeeping`."""
        return super().bookkeeping() | {"episodes": self._episodes.since(0), "starts": self._episode_starts.copy()}

    def restore_bookkeeping(self, state: dict[str, Any]) -> None:
        """See :meth:`CompactDictReplayBuffer.restore_bookkeeping`."""
        super().restore_bookkeeping(state)
        self._episodes = EpisodeIndex()
        for episode in state["episodes"].tolist():
            self._episodes.append(*episode)
        self._episode_starts = state["starts"]

    def add(  # type: ignore[override]
        self,
        obs: Mapping[str, np.ndarray],
        next_obs: Mapping[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """See :meth:`CompactDictReplayBuffer.add`."""
        super().add(obs, next_obs, action, reward, done, infos)
        self._index_ended(self._n_added - 2)  # may have been cut
        self._index_ended(self._n_added - 1)

    def mark_reset(self) -> None:
        """See :meth:`CompactDictReplayBuffer.mark_reset`."""
        super().mark_reset()
        self._index_ended(self._n_added - 1)

    def _index_ended(self, step: int) -> None:
        """
        :param step: one of the last two, or -1: episodes that end with it count from now on
        """
        if step < 0:
            return
        ended = (self.endings[step % self.n_rows] != 0) & (self._episode_starts <= step)
        for env in np.flatnonzero(ended).tolist():
            self._episodes.append(env, self._episode_starts[env], step + 1 - self._episode_starts[env])
            self._episode_starts[env] = step + 1

    @property
    def n_episodes(self) -> int:
        """Whole episodes that can be sampled."""
        return len(self._whole_episodes())

    def _whole_episodes(self) -> np.ndarray:
        return self._episodes.since(self._first_sampled)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> SequenceSamples:  # type: ignore[override]
        """
        :param batch_size: sequences, B
        :param env: normalises observations and rewards
        :return: tensors on the buffer's device
        :raises ValueError: if no episode is whole
        """
        episodes = self._whole_episodes()
        if not len(episodes):
            raise ValueError(
                f"The replay buffer holds no whole episode among its last {self.size() * self.n_envs} transitions: raise "
                "learning_starts above the length of an episode, and buffer_size far above it."
            )
        return self._sequences(*self._choose(episodes, batch_size), env)

    def _choose(self, episodes: np.ndarray, batch_size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """
        :return: environments, first steps, numbers of steps and, of these, steps that only bring memories up; (B,) each
        """
        if self.sequence_length is None:
            envs, starts, lengths = episodes[np.random.randint(len(episodes), size=batch_size)].T
            return envs, starts, lengths, np.zeros_like(lengths)
        ends = np.cumsum(episodes[:, 2])
        chosen = np.random.randint(ends[-1], size=batch_size)
        index = np.searchsorted(ends, chosen, side="right")
        envs, starts, lengths = episodes[index].T
        offsets = chosen - (ends[index] - lengths)
        burn_in = np.minimum(offsets, self.burn_in)
        counted = np.minimum(lengths - offsets, self.sequence_length)
        return envs, starts + offsets - burn_in, burn_in + counted, burn_in

    def _sequences(
        self, envs: np.ndarray, starts: np.ndarray, lengths: np.ndarray, burn_in: np.ndarray, env: VecNormalize | None
    ) -> SequenceSamples:
        time = np.arange(lengths.max())[:, None]
        valid = time < lengths
        rows = np.where(valid, starts + time, starts) % self.n_rows
        flat_rows, flat_envs = rows.ravel(), np.broadcast_to(envs, rows.shape).ravel()
        last = (starts + lengths - 1) % self.n_rows
        shape = rows.shape
        observations = self._to_tensors(self._gather(flat_rows, flat_envs), env)
        finals = self._to_tensors(self._next_rows(last, envs), env)
        rewards = self._normalize_reward(self.rewards[rows, envs], env) * valid
        terminated = ((self.endings[rows, envs] & (DONE | TIME_LIMIT)) == DONE) & valid
        actions = self.actions[rows, envs] * valid[..., None].astype(self.actions.dtype)
        return SequenceSamples(
            {key: self._with_final(value, finals[key], lengths, shape) for key, value in observations.items()},
            self.to_torch(actions, copy=False),
            self.to_torch(rewards.astype(np.float32), copy=False),
            self.to_torch(terminated.astype(np.float32), copy=False),
            self.to_torch((valid & (time >= burn_in)).astype(np.float32), copy=False),
            self._critic_weights(self.endings[rows, envs]),
        )

    def _with_final(self, entry: th.Tensor, final: th.Tensor, lengths: np.ndarray, shape: tuple[int, ...]) -> th.Tensor:
        """
        :param entry: at every step, shape (T * B, ...)
        :param final: after each sequence's last step, shape (B, ...)
        :param lengths: shape (B,)
        :param shape: (T, B)
        :return: shape (T + 1, B, ...), zeros after the final one
        """
        steps, batch = shape
        result = entry.new_zeros((steps + 1, batch, *entry.shape[1:]))
        index = th.as_tensor(lengths, device=entry.device)
        valid = th.arange(steps, device=entry.device)[:, None] < index
        result[:-1] = entry.unflatten(0, shape) * valid.reshape(*shape, *[1] * (entry.dim() - 1)).to(entry.dtype)
        result[index, th.arange(batch, device=entry.device)] = final
        return result


def check_learns_from_sequences(replay_buffer_class: type | None, n_steps: int) -> None:
    """
    :param replay_buffer_class: of an algorithm with a recurrent policy, ``None`` for the default
    :param n_steps: argument of the algorithm
    :raises ValueError: naming what does not go with a recurrent policy
    """
    if replay_buffer_class is not None and not issubclass(replay_buffer_class, EpisodeReplayBuffer):
        raise ValueError(
            f"A recurrent policy learns from sequences, but replay_buffer_class={replay_buffer_class.__name__} "
            "has none: leave it out, or give EpisodeReplayBuffer or a subclass."
        )
    if n_steps != 1:
        raise ValueError(f"n_steps must be 1 for a recurrent policy, got {n_steps}.")
