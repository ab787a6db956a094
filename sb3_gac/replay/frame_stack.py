"""Observation entries that are stacks of frames; a ring of rows stores each frame once."""

from collections.abc import Mapping
from types import NoneType

import numpy as np
from gymnasium import spaces

from sb3_gac.checks.values import check_integer
from sb3_gac.replay.observation_store import Rows, RowsApart

#: Value in place of an age for rows whose older frames are kept apart
APART = 128
OLDER = "older"
LONGEST = APART - 1


def resolve_frame_stacks(space: spaces.Dict, frame_stacks: Mapping[str, int] | None) -> dict[str, int]:
    """
    Check which entries are stacks of frames.

    :param space: Dict space of observations
    :param frame_stacks: entry -> number of its frames, joined along its first axis, the oldest first; ``None`` for none
    :return: entry -> number of its frames, for entries of more than one frame
    :raises ValueError: if an entry does not exist, or can't consist of so many frames; the message names the entry
    """
    if not isinstance(frame_stacks, (Mapping, NoneType)):
        raise ValueError(f"frame_stacks must be a mapping from entries to their numbers of frames, got {frame_stacks!r}.")
    for key, length in (frame_stacks or {}).items():
        name = f'frame_stacks["{key}"]'
        if key not in space.spaces:
            raise ValueError(f"{name} names no entry of the observation, which has {list(space.spaces)}.")
        check_integer(name, length, 1, LONGEST)
        entry = space.spaces[key]
        if not isinstance(entry, spaces.Box) or not entry.shape or entry.shape[0] % length:
            raise ValueError(f"{name} is {length} frames, joined along the first axis, but the entry is {entry}.")
    return {key: length for key, length in (frame_stacks or {}).items() if length > 1}


class OlderFrames:
    """
    The layout of the older frames of a stack, which are kept apart.

    :param width: size of all frames of a stack but the newest, in numbers
    :param dtype: type of the frames
    """

    def __init__(self, width: int, dtype: np.dtype):
        self.width, self.dtype = width, dtype

    def empty(self, *leading: int) -> Rows:
        """Rows of zeros, see :meth:`ObservationLayout.empty`."""
        return {OLDER: np.zeros((*leading, self.width), dtype=self.dtype)}


class FrameStack:
    """
    The stacks of frames of one entry, put together from a ring whose rows hold the newest frame of each stack.

    The older frames of a row are the newest frames of the rows before it; the row's ``ages`` say of how many rows. Frames
    older than these repeat the first of them, as :class:`sb3_gac.envs.History` does at an episode's start. Stacks that begin
    otherwise have their older frames kept apart.

    :param key: name of the entry, for messages
    :param length: number of frames of a stack, L
    :param width: size of a frame in numbers, W
    :param dtype: type of the frames
    :param n_rows: number of rows of the ring
    :param n_envs: number of environments
    """

    def __init__(self, key: str, length: int, width: int, dtype: np.dtype, n_rows: int, n_envs: int):
        self.key, self.length, self.width = key, length, width
        self.ages = np.zeros((n_rows, n_envs), dtype=np.uint8)
        self._layout = OlderFrames((length - 1) * width, dtype)
        self.apart = RowsApart(self._layout)

    def nbytes(self) -> int:
        """Number of bytes allocated."""
        return self.ages.nbytes + self.apart.nbytes()

    def reset(self) -> None:
        """Forget the frames that are kept apart."""
        self.apart = RowsApart(self._layout)

    # --- adding ------------------------------------------------------------------------------------------------------

    def check_follows(self, stacks: np.ndarray, next_stacks: np.ndarray) -> None:
        """
        Check that each next stack continues the stack before it.

        :param stacks: stacks before the step, shape (n_envs, L * W)
        :param next_stacks: stacks after the step, shape (n_envs, L * W)
        :raises ValueError: if the older frames of a next stack are not the newer frames of the stack before it
        """
        if not np.array_equal(stacks[:, self.width :], next_stacks[:, : -self.width]):
            raise ValueError(
                f'replay_buffer_kwargs={{"frame_stacks": {{"{self.key}": {self.length}}}}} says that the entry "{self.key}" '
                "is the last frames of something, joined along its first axis, the oldest first, but after a step "
                "its older frames are not the newer ones from before: leave it out of frame_stacks. The step was not stored."
            )

    def begin(self, step: int, goes_on: np.ndarray, stacks: np.ndarray) -> None:
        """
        Write the older frames of rows that do not continue the rows before them.

        :param step: step at which the stacks are observed
        :param goes_on: true where a stack continues the row before, shape (n_envs,)
        :param stacks: stacks of the step, shape (n_envs, L * W)
        """
        n_rows, n_envs = self.ages.shape
        self.apart.forget_from(step * n_envs)  # left from a step whose storing was interrupted
        envs = np.flatnonzero(~goes_on | (self.ages[step % n_rows] >= APART))
        frames = stacks[envs].reshape(-1, self.length, self.width)
        repeated = (frames[:, :-1] == frames[:, -1:]).all(axis=(1, 2))
        if not repeated.all():
            self.apart.append(step * n_envs + envs[~repeated], {OLDER: frames[~repeated, :-1].reshape(-1, self._layout.width)})
        self.ages[step % n_rows, envs] = np.where(repeated, 0, APART)

    def follow(self, step: int) -> None:
        """
        Write the ages of rows that continue the rows before them.

        :param step: step of these rows
        """
        n_rows = len(self.ages)
        before = self.ages[(step - 1) % n_rows] % APART
        self.ages[step % n_rows] = np.minimum(before + 1, self.length - 1)

    # --- reading -----------------------------------------------------------------------------------------------------

    def gather(self, frames: np.ndarray, steps: np.ndarray, envs: np.ndarray) -> np.ndarray:
        """
        Put stacks together.

        :param frames: newest frames by row, shape (rows, n_envs, W)
        :param steps: steps of the stacks, shape (B,)
        :param envs: environments of the stacks, shape (B,)
        :return: stacks, shape (B, L * W)
        """
        n_rows, n_envs = self.ages.shape
        ages = self.ages[steps % n_rows, envs] % APART
        back = np.minimum(np.arange(self.length - 1, -1, -1), ages[:, None])
        rows = (steps[:, None] - back) % n_rows
        stacks = frames.reshape(-1, self.width).take(rows * n_envs + envs[:, None], axis=0)
        self._put_in_what_is_apart(stacks, steps - ages, envs, ages)
        return stacks.reshape(len(steps), self.length * self.width)

    def _put_in_what_is_apart(self, stacks: np.ndarray, starts: np.ndarray, envs: np.ndarray, ages: np.ndarray) -> None:
        """
        :param stacks: stacks, shape (B, L, W), changed in place
        :param starts: steps of the oldest rows that the stacks come from, shape (B,)
        :param envs: environments of the stacks, shape (B,)
        :param ages: ages of the stacks' rows, shape (B,)
        """
        n_rows, n_envs = self.ages.shape
        is_apart = (self.ages[starts % n_rows, envs] >= APART) & (ages < self.length - 1)
        for age in np.unique(ages[is_apart]).tolist():
            chosen = np.flatnonzero(is_apart & (ages == age))
            index, found = self.apart.find(starts[chosen] * n_envs + envs[chosen])
            older = self.apart.rows[OLDER][index[found]].reshape(-1, self.length - 1, self.width)
            stacks[chosen[found], : self.length - 1 - age] = older[:, age:]
