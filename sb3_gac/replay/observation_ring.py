"""A ring of observations by step, which puts stacks of frames together from single frames."""

from typing import Any

import numpy as np

from sb3_gac.replay.frame_stack import FrameStack
from sb3_gac.replay.observation_store import ObservationLayout, Rows


class ObservationRing:
    """
    Packed observations by step; the newest row replaces the oldest one.

    :param layout: layout of the observations
    :param n_rows: number of rows
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
        """Number of bytes allocated."""
        return sum(rows.nbytes for rows in self.rows.values()) + sum(stack.nbytes() for stack in self._stacks.values())

    def rows_by_name(self) -> dict[str, np.ndarray]:
        """The arrays that have rows, by name, shape (rows, n_envs, \\*) each, not copied."""
        return self.rows | {f"ages of {group}": stack.ages for group, stack in self._stacks.items()}

    def state(self) -> dict[str, Any]:
        """The state apart from :meth:`rows_by_name`, copied."""
        return {group: stack.apart.state() for group, stack in self._stacks.items()}

    def restore(self, state: dict[str, Any]) -> None:
        """
        Restore the state of another ring.

        :param state: state from :meth:`state`
        """
        for group, stack in self._stacks.items():
            stack.apart.restore(state[group])

    def reset(self) -> None:
        """Forget the frames that are kept apart."""
        for stack in self._stacks.values():
            stack.reset()

    # --- writing -----------------------------------------------------------------------------------------------------

    def check_follows(self, rows: Rows, next_rows: Rows) -> None:
        """
        Check that each next stack of frames continues the stack before it.

        :param rows: packed observations before the step, group -> shape (n_envs, width)
        :param next_rows: packed observations after the step, group -> shape (n_envs, width)
        :raises ValueError: if an entry is no stack of frames; the message names the entry
        """
        for group, stack in self._stacks.items():
            stack.check_follows(rows[group], next_rows[group])

    def goes_on(self, step: int, rows: Rows) -> np.ndarray:
        """
        Whether observations continue the last step.

        :param step: step whose row :meth:`write_next` wrote last
        :param rows: packed observations of the step, group -> shape (n_envs, width)
        :return: whether each environment's observation equals the row, shape (n_envs,)
        """
        written = self.gather(np.full(self._n_envs, step), np.arange(self._n_envs))
        return np.all([np.all(values == written[group], axis=1) for group, values in rows.items()], axis=0)

    def write(self, step: int, rows: Rows, goes_on: np.ndarray) -> None:
        """
        Write the observations of a step.

        :param step: step of the observations
        :param rows: packed observations, group -> shape (n_envs, width)
        :param goes_on: true where :meth:`write_next` wrote the same observation before, shape (n_envs,)
        """
        for group, stack in self._stacks.items():
            stack.begin(step, goes_on, rows[group])
        self._put(step, self._layout.stored(rows))

    def write_next(self, step: int, next_rows: Rows) -> None:
        """
        Write the observations that follow the last step.

        :param step: step after the one that :meth:`write` wrote last
        :param next_rows: packed observations, group -> shape (n_envs, width)
        """
        self._put(step, self._layout.stored(next_rows))
        for stack in self._stacks.values():
            stack.follow(step)

    def _put(self, step: int, stored: Rows) -> None:
        for group, values in stored.items():
            self.rows[group][step % self._n_rows] = values

    def forget_before(self, step: int) -> None:
        """
        Forget frames that are kept apart and no longer needed.

        :param step: oldest step whose observations are still needed
        """
        for stack in self._stacks.values():
            stack.apart.forget_before((step - stack.length + 1) * self._n_envs)

    # --- reading -----------------------------------------------------------------------------------------------------

    def stored(self, steps: np.ndarray, envs: np.ndarray) -> Rows:
        """
        The rows as they are stored.

        :param steps: steps of the observations, shape (B,)
        :param envs: environments of the observations, shape (B,)
        :return: stored rows, group -> shape (B, stored width)
        """
        flat = steps % self._n_rows * self._n_envs + envs
        return {group: rows.reshape(-1, rows.shape[-1]).take(flat, axis=0) for group, rows in self.rows.items()}

    def gather(self, steps: np.ndarray, envs: np.ndarray) -> Rows:
        """
        The observations, with stacks of frames put together.

        :param steps: steps of the observations, shape (B,)
        :param envs: environments of the observations, shape (B,)
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
        Complete stored next observations by the older frames of their stacks.

        :param following: stored rows of the observations after some steps, group -> shape (B, stored width)
        :param steps: these steps, shape (B,)
        :param envs: environments of these steps, shape (B,)
        :param before: packed observations at these steps, group -> shape (B, width); ``None`` if they were not gathered
        :return: packed next observations, group -> shape (B, width)
        """
        for group, stack in self._stacks.items():
            stacks = stack.gather(self.rows[group], steps, envs) if before is None else before[group]
            following[group] = np.concatenate([stacks[:, stack.width :], following[group]], axis=1)
        return following
