"""A ring of observations by step, in which stacks of frames are put together from the frames that the rows hold."""

from typing import Any

import numpy as np

from sb3_gac.replay.frame_stack import FrameStack
from sb3_gac.replay.observation_store import ObservationLayout, Rows


class ObservationRing:
    """
    Packed observations by step, of which the newest row takes the place of the oldest one.

    :param layout: of the observations
    :param n_rows: that it holds
    :param n_envs: number of environments
    """

    def __init__(self, layout: ObservationLayout, n_rows: int, n_envs: int):
        self._layout, self._n_rows, self._n_envs = layout, n_rows, n_envs
        self.rows = layout.empty(n_rows, n_envs)
        entries = {group: key for key, (group, _) in layout.columns.items()}
        self._stacks = {
            group: FrameStack(entries[group], length, rows.shape[-1], rows.dtype, n_rows, n_envs)
            for group, length in layout.lengths.items()
            for rows in [self.rows[group]]
        }

    def nbytes(self) -> int:
        """Bytes allocated."""
        return sum(rows.nbytes for rows in self.rows.values()) + sum(stack.nbytes() for stack in self._stacks.values())

    def rows_by_name(self) -> dict[str, np.ndarray]:
        """All that it holds by row, (rows, n_envs, \\*) each, not copied."""
        return self.rows | {f"ages of {group}": stack.ages for group, stack in self._stacks.items()}

    def state(self) -> dict[str, Any]:
        """What else there is, copied."""
        return {group: stack.apart.state() for group, stack in self._stacks.items()}

    def restore(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state`
        """
        for group, stack in self._stacks.items():
            stack.apart.restore(state[group])

    def reset(self) -> None:
        """Forget everything."""
        for stack in self._stacks.values():
            stack.reset()

    # --- writing -----------------------------------------------------------------------------------------------------

    def check_follows(self, rows: Rows, next_rows: Rows) -> None:
        """
        :param rows: packed observations, shape (n_envs, width) of each group
        :param next_rows: those after the step
        :raises ValueError: naming the entry that is no stack of frames
        """
        for group, stack in self._stacks.items():
            stack.check_follows(rows[group], next_rows[group])

    def goes_on(self, step: int, rows: Rows) -> np.ndarray:
        """
        :param step: for which a row was written as the one after the last
        :param rows: packed observations
        :return: whether they are what was written, shape (n_envs,)
        """
        written = self.gather(np.full(self._n_envs, step), np.arange(self._n_envs))
        return np.all([np.all(values == written[group], axis=1) for group, values in rows.items()], axis=0)

    def write(self, step: int, rows: Rows, goes_on: np.ndarray) -> None:
        """
        :param step: of the observations
        :param rows: packed
        :param goes_on: where they were written before, as those after the last step
        """
        for group, stack in self._stacks.items():
            stack.begin(step, goes_on, rows[group])
        self._put(step, self._layout.stored(rows))

    def write_next(self, step: int, next_rows: Rows) -> None:
        """
        :param step: after the one that was written last
        :param next_rows: packed
        """
        self._put(step, self._layout.stored(next_rows))
        for stack in self._stacks.values():
            stack.follow(step)

    def _put(self, step: int, stored: Rows) -> None:
        for group, values in stored.items():
            self.rows[group][step % self._n_rows] = values

    def forget_before(self, step: int) -> None:
        """
        :param step: no earlier one is asked for any more
        """
        for stack in self._stacks.values():
            stack.apart.forget_before((step - stack.length + 1) * self._n_envs)

    # --- reading -----------------------------------------------------------------------------------------------------

    def stored(self, steps: np.ndarray, envs: np.ndarray) -> Rows:
        """
        :param steps: shape (B,)
        :param envs: shape (B,)
        :return: group -> shape (B, stored width)
        """
        flat = steps % self._n_rows * self._n_envs + envs
        return {group: rows.reshape(-1, rows.shape[-1]).take(flat, axis=0) for group, rows in self.rows.items()}

    def gather(self, steps: np.ndarray, envs: np.ndarray) -> Rows:
        """
        :param steps: shape (B,)
        :param envs: shape (B,)
        :return: packed observations, group -> shape (B, width)
        """
        stacked = {group: stack.gather(self.rows[group], steps, envs) for group, stack in self._stacks.items()}
        flat = steps % self._n_rows * self._n_envs + envs
        return {
            group: stacked[group] if group in stacked else rows.reshape(-1, rows.shape[-1]).take(flat, axis=0)
            for group, rows in self.rows.items()
        }

    def with_older_frames(self, following: Rows, steps: np.ndarray, envs: np.ndarray, before: Rows | None) -> Rows:
        """
        :param following: what is stored of the observations after some steps, group -> shape (B, stored width)
        :param steps: those steps, shape (B,)
        :param envs: shape (B,)
        :param before: packed observations at those steps, if they were gathered
        :return: packed, group -> shape (B, width)
        """
        for group, stack in self._stacks.items():
            stacks = stack.gather(self.rows[group], steps, envs) if before is None else before[group]
            following[group] = np.concatenate([stacks[:, stack.width :], following[group]], axis=1)
        return following
