"""Storage of a replay buffer for dict observations: each observation once, the entries of a row side by side."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import psutil
from gymnasium import spaces

from sb3_gac.checks.entries import stored_shape

Rows = dict[str, np.ndarray]


class ObservationLayout:
    """
    The layout of dict observations in rows, one row for each group of entries, so that one call gathers a batch of a group.

    A group holds all entries that are stored in the same type, or a single entry that is a stack of frames. A stored row of a
    stack holds its newest frame alone.

    :param space: Dict space of observations
    :param float_dtype: type that floating-point entries are stored in, or its name; ``None`` for their own type
    :param frame_stacks: entry -> number of its frames, see :func:`sb3_gac.replay.frame_stack.resolve_frame_stacks`
    :raises ValueError: if ``float_dtype`` is no floating-point type
    """

    def __init__(self, space: spaces.Dict, float_dtype: Any = None, frame_stacks: Mapping[str, int] | None = None):
        float_dtype = None if float_dtype is None else _floating_point(float_dtype)
        self.shapes = {key: stored_shape(entry) for key, entry in space.spaces.items()}
        self._given_shapes = {key: entry.shape or () for key, entry in space.spaces.items()}
        self.dtypes = {key: np.dtype(entry.dtype) for key, entry in space.spaces.items()}
        self.columns: dict[str, tuple[str, slice]] = {}
        self.widths: dict[str, int] = {}
        self.group_dtypes: dict[str, np.dtype] = {}
        #: Group -> number of frames of its entry, for groups of which a row stores one frame
        self.lengths: dict[str, int] = {}
        for key, shape in self.shapes.items():
            is_float = np.issubdtype(self.dtypes[key], np.floating)
            dtype = np.dtype(float_dtype if is_float and float_dtype is not None else self.dtypes[key])
            group = dtype.name
            if key in (frame_stacks or {}):
                group = f"frames of {key}"
                self.lengths[group] = (frame_stacks or {})[key]
            start = self.widths.get(group, 0)
            self.widths[group] = start + int(np.prod(shape))
            self.group_dtypes[group] = dtype
            self.columns[key] = (group, slice(start, self.widths[group]))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickled layout; layouts of earlier versions lack the given shapes and have no stacks of frames."""
        given = {key: () if shape == (1,) else shape for key, shape in state["shapes"].items()}
        dtypes = {group: np.dtype(group) for group in state["widths"]} if "group_dtypes" not in state else {}
        vars(self).update({"_given_shapes": given, "group_dtypes": dtypes, "lengths": {}, **state})

    def stored_width(self, group: str) -> int:
        """
        :param group: name of a group
        :return: number of columns that a row of the ring stores: all, or for a stack those of its newest frame, which are the
            last
        """
        return self.widths[group] // self.lengths.get(group, 1)

    def row_bytes(self) -> int:
        """Number of bytes stored for one observation, the ages of stacks included."""
        return sum(self.stored_width(group) * dtype.itemsize for group, dtype in self.group_dtypes.items()) + len(self.lengths)

    def empty(self, *leading: int) -> Rows:
        """
        Rows of zeros.

        :param leading: dimensions before the columns
        :return: stored rows, group -> zeros of shape (\\*leading, stored width)
        """
        return {group: np.zeros((*leading, self.stored_width(group)), dtype) for group, dtype in self.group_dtypes.items()}

    def stored(self, rows: Rows) -> Rows:
        """
        The part of packed observations that is stored.

        :param rows: packed observations, group -> shape (n, width)
        :return: stored rows, group -> shape (n, stored width)
        """
        return {group: values[:, self.widths[group] - self.stored_width(group) :] for group, values in rows.items()}

    def pack(self, observation: Mapping[str, np.ndarray], n_rows: int) -> Rows:
        """
        Pack observations.

        :param observation: observations, (n_rows, ...) of each entry
        :param n_rows: number of environments
        :return: packed observations, group -> shape (n_rows, width)
        :raises ValueError: if an entry is missing, unknown or of another shape, or holds a number that is too large for the
            type it is stored in; the message names the entry
        """
        if observation.keys() != self.columns.keys():
            raise ValueError(
                f"The replay buffer stores the entries {sorted(self.columns)}, but got an observation with "
                f"{sorted(observation)}: pass it observations of its observation_space."
            )
        rows = {group: np.empty((n_rows, width), dtype=self.group_dtypes[group]) for group, width in self.widths.items()}
        for key, (group, columns) in self.columns.items():
            values = np.asarray(observation[key])
            if values.shape not in ((n_rows, *self.shapes[key]), (n_rows, *self._given_shapes[key])):
                raise ValueError(
                    f'The replay buffer stores entry "{key}" in the shape {(n_rows, *self.shapes[key])}, environments first, '
                    f"but got {values.shape}: pass it observations of its observation_space."
                )
            if self.group_dtypes[group] != values.dtype:
                _check_range(key, values, self.group_dtypes[group])
            rows[group][:, columns] = values.reshape(n_rows, -1)
        return rows

    def unpack(self, rows: Rows) -> dict[str, np.ndarray]:
        """
        Unpack observations.

        :param rows: packed observations, group -> shape (\\*leading, width)
        :return: observations, entry -> shape (\\*leading, \\*entry shape), in the entry's own type; a view if it is stored in
            that type
        """
        observation = {}
        for key, (group, columns) in self.columns.items():
            values = rows[group][..., columns].astype(self.dtypes[key], copy=False)
            observation[key] = values.reshape(*values.shape[:-1], *self.shapes[key])
        return observation


def _floating_point(given: Any) -> np.dtype:
    try:
        dtype = np.dtype(given)
    except TypeError:  # no type at all
        dtype = np.dtype(object)
    if not np.issubdtype(dtype, np.floating):
        raise ValueError(f'storage_dtype must be a floating-point type such as "float16", or None, got "{given}".')
    return dtype


def _check_range(key: str, values: np.ndarray, stored: np.dtype) -> None:
    """
    Check that an entry's values are finite in the type that they are stored in.

    :param key: name of the entry
    :param values: values of the entry
    :param stored: type that they are stored in
    :raises ValueError: if a value is beyond the largest number of that type
    """
    if stored.kind != "f" or np.can_cast(values.dtype, stored):
        return
    largest = np.finfo(stored).max
    too_large = np.abs(values) > largest
    if too_large.any():
        raise ValueError(
            f'Entry "{key}" holds {values[too_large][0]:g}, but with replay_buffer_kwargs={{"storage_dtype": "{stored}"}} the '
            f"replay buffer holds numbers up to {largest:g}: leave storage_dtype out, or scale the entry in the environment. "
            "The step was not stored."
        )


def check_fits_in_memory(n_transitions: int, n_rows: int, row_bytes: int) -> None:
    """
    Check that a buffer fits into the available memory.

    :param n_transitions: number of transitions that the buffer is to hold
    :param n_rows: number of rows that the buffer needs, over all environments
    :param row_bytes: size of a row, in bytes
    :raises MemoryError: if less memory is available than the buffer needs; the message has the numbers
    """
    needed, available = row_bytes * n_rows, psutil.virtual_memory().available
    if needed > available:
        raise MemoryError(
            f"A replay buffer of {n_transitions:,} transitions needs {needed / 1e9:.2f} GB, but {available / 1e9:.2f} GB are "
            f"available: lower buffer_size to at most {int(available // row_bytes):,}, or set "
            "replay_buffer_kwargs={'storage_dtype': 'float16'}, or of stacked images {'frame_stacks': {entry: frames}}."
        )


class RowLayout(Protocol):
    """The layout of rows by group."""

    def empty(self, *leading: int) -> Rows:
        """Rows of zeros, see :meth:`ObservationLayout.empty`."""


class RowsApart:
    """
    Rows that are kept apart from a ring, each with a time. They are forgotten first in, first out, as the ring overwrites the
    steps that they belong to.

    :param layout: layout of the rows
    """

    def __init__(self, layout: RowLayout):
        self._layout = layout
        self._times = np.empty(0, dtype=np.int64)
        self._rows = layout.empty(0)
        self._first, self._end = 0, 0

    def __len__(self) -> int:
        return self._end - self._first

    def nbytes(self) -> int:
        """Number of bytes allocated."""
        return self._times.nbytes + sum(rows.nbytes for rows in self._rows.values())

    def state(self) -> dict[str, Any]:
        """The times and rows that are kept, copied."""
        kept = slice(self._first, self._end)
        return {"times": self._times[kept].copy(), "rows": {group: rows[kept].copy() for group, rows in self._rows.items()}}

    def restore(self, state: dict[str, Any]) -> None:
        """
        Restore the state of another store.

        :param state: state from :meth:`state`
        """
        self._times, self._rows = state["times"], state["rows"]
        self._first, self._end = 0, len(self._times)

    def append(self, times: np.ndarray, rows: Rows) -> None:
        """
        Add rows.

        :param times: times of the rows, in increasing order, none before the latest step that was appended, shape (n,)
        :param rows: rows to add, group -> shape (n, width)
        """
        count = len(times)
        if self._end + count > len(self._times):
            self._make_room(count)
        self._times[self._end : self._end + count] = times
        for group, values in rows.items():
            self._rows[group][self._end : self._end + count] = values
        in_order = self._end == self._first or self._times[self._end - 1] < times[0]
        self._end += count
        if not in_order:
            self._sort()

    def forget_before(self, time: int) -> None:
        """
        Forget the oldest rows.

        :param time: time before which rows are no longer needed
        """
        self._first += int(np.searchsorted(self._times[self._first : self._end], time))

    def forget_from(self, time: int) -> None:
        """
        Forget the newest rows, which are left from a step whose storing was interrupted.

        :param time: time from which on rows are forgotten
        """
        self._end = self._first + int(np.searchsorted(self._times[self._first : self._end], time))

    @property
    def rows(self) -> Rows:
        """All allocated rows, group -> shape (allocated, width), at the places that :meth:`find` returns."""
        return self._rows

    def find(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Find rows by their times.

        :param times: times of the rows, shape (B,)
        :return: places of the rows in :attr:`rows`, and whether there is a row of that time, shape (B,) each
        """
        kept = self._times[self._first : self._end]
        index = np.searchsorted(kept, times)
        found = index < len(kept)
        found[found] = kept[index[found]] == times[found]
        return self._first + index, found

    def replace_in(self, rows: Rows, positions: np.ndarray, times: np.ndarray) -> None:
        """
        Replace some of B rows by rows that are kept here.

        :param rows: rows, group -> shape (B, width), changed in place
        :param positions: positions of the rows that are replaced, shape (n,)
        :param times: times of their replacements, shape (n,)
        """
        index = self._first + np.searchsorted(self._times[self._first : self._end], times)
        for group, values in rows.items():
            values[positions] = self._rows[group][index]

    def _sort(self) -> None:
        kept = slice(self._first, self._end)
        order = np.argsort(self._times[kept])
        self._times[kept] = self._times[kept][order]
        for values in self._rows.values():
            values[kept] = values[kept][order]

    def _make_room(self, count: int) -> None:
        """Move the kept rows into new arrays with twice the room needed, so that appending takes amortised constant time."""
        kept = slice(self._first, self._end)
        size = max(2 * (len(self) + count), 16)
        times, rows = np.empty(size, dtype=np.int64), self._layout.empty(size)
        times[: len(self)] = self._times[kept]
        for group, values in rows.items():
            values[: len(self)] = self._rows[group][kept]
        self._times, self._rows, self._first, self._end = times, rows, 0, len(self)


class FinalObservations(RowsApart):
    """The final observations of episodes, which no row of the ring holds."""
