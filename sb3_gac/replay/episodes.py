"""Replay of whole episodes, or of sequences within episodes, for policies with a memory."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_gac.checks.values import check_integer
from sb3_gac.replay.buffer import CompactDictReplayBuffer
from sb3_gac.replay.samples import SequenceSamples
from sb3_gac.replay.shown import DONE, TIME_LIMIT


class EpisodeIndex:
    """
    An index of the episodes that a ring holds, first in, first out, in an array that grows.

    Each episode has a row: environment, first step, number of steps. Steps count from the first step ever added.
    """

    def __init__(self) -> None:
        self._rows = np.empty((16, 3), dtype=np.int64)
        self._first, self._end = 0, 0

    def append(self, env: int, first_step: int, length: int) -> None:
        """
        Add an episode.

        :param env: number of its environment
        :param first_step: its first step
        :param length: number of its steps
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
        The episodes that begin at a step or later; earlier ones may be forgotten.

        :param step: oldest step that is still stored
        :return: rows of the episodes that are whole, shape (number of episodes, 3)
        """
        while self._first < self._end and self._rows[self._first, 1] < step:
            self._first += 1
        rows = self._rows[self._first : self._end]
        return rows[rows[:, 1] >= step]


class EpisodeReplayBuffer(CompactDictReplayBuffer):
    """
    A :class:`CompactDictReplayBuffer` that samples whole episodes, or sequences within episodes.

    An episode can be sampled after it has ended, for any reason, as long as all of its steps are stored.

    :param args: positional arguments of :class:`CompactDictReplayBuffer`
    :param sequence_length: largest number of transitions in a sample that losses count, less at an episode's start and end, so
        that all steps are in equally many samples; ``None`` for whole episodes, drawn uniformly over episodes
    :param burn_in: largest number of transitions before these that only bring memories up to date
    :param kwargs: keyword arguments of :class:`CompactDictReplayBuffer`; ``n_steps`` must be 1
    """

    def __init__(self, *args: Any, sequence_length: int | None = None, burn_in: int = 0, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if self.n_steps != 1:
            raise ValueError(f"n_steps must be 1 for sequences, got {self.n_steps}.")
        if sequence_length is not None:
            check_integer("sequence_length", sequence_length, 1, remedy="or None for whole episodes")
        check_integer("burn_in", burn_in, 0)
        if burn_in and sequence_length is None:
            raise ValueError(f"burn_in goes with a sequence_length, but that is None for whole episodes, got {burn_in}.")
        self.sequence_length = sequence_length
        self.burn_in = burn_in
        self._forget_episodes()

    def _forget_episodes(self) -> None:
        self._episodes = EpisodeIndex()
        self._episode_starts = np.zeros(self.n_envs, dtype=np.int64)

    def reset(self) -> None:
        """Forget all transitions and episodes."""
        super().reset()
        self._forget_episodes()

    def bookkeeping(self) -> dict[str, Any]:
        """The buffer's state apart from its rows, see :meth:`CompactDictReplayBuffer.bookkeeping`."""
        return super().bookkeeping() | {"episodes": self._episodes.since(0), "starts": self._episode_starts.copy()}

    def restore_bookkeeping(self, state: dict[str, Any]) -> None:
        """Restore the state of another buffer, see :meth:`CompactDictReplayBuffer.restore_bookkeeping`."""
        super().restore_bookkeeping(state)
        self._episodes = EpisodeIndex()
        for episode in state["episodes"].tolist():
            self._episodes.append(*episode)
        self._episode_starts = state["starts"].copy()

    def add(  # type: ignore[override]
        self,
        obs: Mapping[str, np.ndarray],
        next_obs: Mapping[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Add one transition of each environment, see :meth:`CompactDictReplayBuffer.add`."""
        super().add(obs, next_obs, action, reward, done, infos)
        self._index_ended(self._n_added - 2)  # super().add() may have cut this step
        self._index_ended(self._n_added - 1)

    def mark_reset(self) -> None:
        """Cut the episodes under way, after a reset from outside, see :meth:`CompactDictReplayBuffer.mark_reset`."""
        super().mark_reset()
        self._index_ended(self._n_added - 1)

    def _index_ended(self, step: int) -> None:
        """
        Add the episodes that end with a step to the index.

        :param step: one of the last two steps; -1 if there is none
        """
        if step < 0:
            return
        ended = (self.endings[step % self.n_rows] != 0) & (self._episode_starts <= step)
        for env in np.flatnonzero(ended).tolist():
            self._episodes.append(env, self._episode_starts[env], step + 1 - self._episode_starts[env])
            self._episode_starts[env] = step + 1

    @property
    def n_episodes(self) -> int:
        """Number of whole episodes that can be sampled."""
        return len(self._whole_episodes())

    def _whole_episodes(self) -> np.ndarray:
        return self._episodes.since(self._first_sampled)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> SequenceSamples:  # type: ignore[override]
        """
        Sequences from whole episodes, drawn with replacement.

        :param batch_size: number of sequences, B
        :param env: ``VecNormalize`` that normalises observations and rewards; ``None`` for no normalisation
        :return: padded sequences, as tensors on the buffer's device
        :raises ValueError: if the buffer holds no whole episode
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
        :return: environments, first steps, numbers of steps, and how many of these only bring memories up to date, shape (B,)
            each
        """
        if self.sequence_length is None:
            envs, starts, lengths = episodes[np.random.randint(len(episodes), size=batch_size)].T
            return envs, starts, lengths, np.zeros_like(lengths)
        # A window of sequence_length steps may begin before an episode and end after it, so that every step is in as many
        ends = np.cumsum(episodes[:, 2] + self.sequence_length - 1)
        chosen = np.random.randint(ends[-1], size=batch_size)
        index = np.searchsorted(ends, chosen, side="right")
        envs, starts, lengths = episodes[index].T
        window_ends = chosen - (ends[index] - lengths - self.sequence_length)  # from 1 to lengths + sequence_length - 1
        offsets = np.maximum(window_ends - self.sequence_length, 0)
        burn_in = np.minimum(offsets, self.burn_in)
        counted = np.minimum(window_ends, lengths) - offsets
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
        :param entry: observations' entry at every step, shape (T * B, ...)
        :param final: the entry after each sequence's last step, shape (B, ...)
        :param lengths: number of steps of each sequence, shape (B,)
        :param shape: number of steps and of sequences, (T, B)
        :return: the entry of each sequence with its final value, zeros after it, shape (T + 1, B, ...)
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
    Check that an algorithm with a recurrent policy gets sequences.

    :param replay_buffer_class: class of the algorithm's replay buffer, ``None`` for the default
    :param n_steps: number of rewards summed up in a critic's target
    :raises ValueError: if one of the two does not go with a recurrent policy; the message names it
    """
    if replay_buffer_class is not None and not issubclass(replay_buffer_class, EpisodeReplayBuffer):
        raise ValueError(
            f"A recurrent policy learns from sequences, but replay_buffer_class={replay_buffer_class.__name__} "
            "has none: leave it out, or give EpisodeReplayBuffer or a subclass."
        )
    if n_steps != 1:
        raise ValueError(f"n_steps must be 1 for a recurrent policy, got {n_steps}.")


def holds_a_batch(buffer: ReplayBuffer | None) -> bool:
    """
    Whether there is data to draw a batch from: a step, or a whole episode where sequences or goals are sampled.

    :param buffer: replay buffer of any class; ``None`` for none
    :return: whether its ``sample`` can return a batch
    """
    if isinstance(buffer, EpisodeReplayBuffer):
        return buffer.n_episodes > 0
    if isinstance(buffer, HerReplayBuffer):
        return bool((buffer.ep_length > 0).any())
    return buffer is not None and buffer.size() > 0
