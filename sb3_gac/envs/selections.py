"""Selections of an observation's components for an entry: indices of a flat observation, keys of a Dict."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_gac.envs.spaces import box_entry, concatenate_boxes, take_from_box

Indices = Sequence[int] | slice
KeySelection = Sequence[str] | Mapping[str, Indices | None]


class BatchSelection:
    """
    An entry that is selected from the observations of many environments at once.

    :param name: name of the entry, for messages
    :param selection: selected components: for a Box, indices into the flattened observation, or a slice; for a Dict, keys, or
        a mapping from keys to such indices, with ``None`` for a whole entry
    :param space: space of one environment's observation: a Box, or a Dict of Boxes
    :raises ValueError: if the space is of another kind, or a key or an index is unknown
    """

    def __init__(self, name: str, selection: Indices | KeySelection, space: spaces.Space):
        if isinstance(space, spaces.Box):
            self._parts: dict[str | None, Any] = {None: as_slice(check_indices(name, selection, space))}  # type: ignore[arg-type]
            self._sizes: dict[str | None, int] = {None: spaces.flatdim(space)}
            self.space = take_from_box(space, self._parts[None])
            return
        if not isinstance(space, spaces.Dict):
            raise ValueError(f"{name} is selected from a Box or a Dict of Boxes, but the observation is {space}.")
        keys = check_keys(name, selection, space)  # type: ignore[arg-type]
        self._parts = {key: as_slice(index) for key, index in keys.items()}
        self._sizes = {key: spaces.flatdim(box_entry(space, key)) for key in keys}
        self.space = concatenate_boxes([take_from_box(box_entry(space, key), index) for key, index in keys.items()])

    def check_sizes(self, observation: Any) -> None:
        """
        Check that observations are as large as their space, for in others the indices are those of other components.

        :param observation: observations of N environments: an array, or arrays by key, each of shape (N, ...)
        :raises ValueError: if an array has another number of components; the message says how many there are
        """
        for key, expected in self._sizes.items():
            size = _rows(observation if key is None else observation[key]).shape[1]
            if size != expected:
                of = "observation" if key is None else f'"{key}"'
                raise ValueError(
                    f"The simulator's {of} has {size} components, but it is split by position as one of {expected}: leave out "
                    "the simulator's arguments that change it."
                )

    def of(self, observation: Any) -> np.ndarray:
        """
        Take the entry from a batch of observations.

        :param observation: observations of N environments: an array, or arrays by key, each of shape (N, ...)
        :return: the entry for all N environments, a new float32 array of shape (N, size of the entry)
        """
        rows = [_rows(observation if key is None else observation[key])[:, index] for key, index in self._parts.items()]
        if len(rows) == 1:
            return rows[0].astype(np.float32)
        return np.concatenate(rows, axis=1, dtype=np.float32, casting="unsafe")


def _rows(values: np.ndarray) -> np.ndarray:
    return values if values.ndim == 2 else values.reshape(len(values), -1)


def as_slice(index: np.ndarray | slice) -> np.ndarray | slice:
    """
    Turn indices into a slice where they are consecutive.

    :param index: indices into an array, or a slice
    :return: the same selection, as a slice where the indices are consecutive, since slices are faster
    """
    if isinstance(index, slice):
        return index
    first, last = int(index[0]), int(index[-1])
    return slice(first, last + 1) if np.array_equal(index, np.arange(first, last + 1)) else index


def check_indices(name: str, indices: Indices, space: spaces.Box) -> np.ndarray:
    """
    Check a selection from a flattened observation.

    :param name: name of the argument, for the message
    :param indices: indices into the flattened space, or a slice
    :param space: space of the observation, or of one of its entries
    :return: the indices as an array, shape (number of indices,)
    :raises ValueError: if an index is outside the space, or there is none
    """
    size = int(np.prod(space.shape))
    given = list(indices) if isinstance(indices, Iterable) else indices
    try:
        array = np.arange(size)[given] if isinstance(given, slice) else np.asarray(given)
    except ValueError:  # lists of different lengths
        array = np.empty(0)
    is_list = array.ndim == 1 and array.size > 0 and np.issubdtype(array.dtype, np.integer)
    if not is_list or array.min() < 0 or array.max() >= size:
        raise ValueError(f"{name} must be a non-empty list of indices in 0..{size - 1}, got {given}.")
    return array


def check_keys(name: str, selection: KeySelection, space: spaces.Dict) -> dict[str, Any]:
    """
    Check a selection from a Dict observation.

    :param name: name of the argument, for the message
    :param selection: keys, or a mapping from keys to indices, slices, or ``None`` for a whole entry
    :param space: space of the Dict observation
    :return: key -> array of indices, or a slice for the whole entry
    :raises ValueError: if a key or an index is unknown, or there is none
    """
    # A set has another order in each process, and with it an entry's components
    is_ordered = isinstance(selection, Collection) and not isinstance(selection, (str, set, frozenset))
    if not is_ordered or len(selection) == 0:
        raise ValueError(f"{name} must be a non-empty list of keys, or a mapping from keys to indices, got {selection!r}.")
    by_key: Mapping[str, Indices | None] = selection if isinstance(selection, Mapping) else dict.fromkeys(selection)
    resolved: dict[str, Any] = {}
    for key, indices in by_key.items():
        entry = box_entry(space, key)
        resolved[key] = slice(None) if indices is None else check_indices(f'{name}["{key}"]', indices, entry)
    return resolved
