"""Which components of an observation make an entry: indices of a flat one, keys of a Dict."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_gac.envs.spaces import box_entry, concatenate_boxes, take_from_box

Indices = Sequence[int] | slice
KeySelection = Sequence[str] | Mapping[str, Indices | None]


class BatchSelection:
    """
    An entry made of the observations of many environments at once.

    :param name: of the entry, for messages
    :param selection: of a Box observation, indices into the flattened array, or a slice; of a Dict, keys, or a mapping from
        keys to such indices, or ``None`` for all of an entry
    :param space: of one environment's observation: a Box, or a Dict of Boxes
    :raises ValueError: if the space is of another kind, or a key or an index is unknown
    """

    def __init__(self, name: str, selection: Indices | KeySelection, space: spaces.Space):
        if isinstance(space, spaces.Box):
            self._parts: dict[str | None, Any] = {None: as_slice(check_indices(name, selection, space))}  # type: ignore[arg-type]
            self.space = take_from_box(space, self._parts[None])
            return
        if not isinstance(space, spaces.Dict):
            raise ValueError(f"{name} is selected from a Box or a Dict of Boxes, but the observation is {space}.")
        keys = check_keys(name, selection, space)  # type: ignore[arg-type]
        self._parts = {key: as_slice(index) for key, index in keys.items()}
        self.space = concatenate_boxes([take_from_box(box_entry(space, key), index) for key, index in keys.items()])

    def of(self, observation: Any) -> np.ndarray:
        """
        :param observation: of N environments, an array, or arrays by key, each of shape (N, ...)
        :return: shape (N, size of the entry), float32, a new array
        """
        rows = [_rows(observation if key is None else observation[key])[:, index] for key, index in self._parts.items()]
        if len(rows) == 1:
            return rows[0].astype(np.float32)
        return np.concatenate(rows, axis=1, dtype=np.float32, casting="unsafe")


def _rows(values: np.ndarray) -> np.ndarray:
    return values if values.ndim == 2 else values.reshape(len(values), -1)


def as_slice(index: np.ndarray | slice) -> np.ndarray | slice:
    """
    :param index: into an array
    :return: the same selection, faster where it is a range
    """
    if isinstance(index, slice):
        return index
    first, last = int(index[0]), int(index[-1])
    return slice(first, last + 1) if np.array_equal(index, np.arange(first, last + 1)) else index


def check_indices(name: str, indices: Indices, space: spaces.Box) -> np.ndarray:
    """
    :param name: of the argument
    :param indices: into the flattened space
    :param space: that they are into
    :return: the indices
    :raises ValueError: if one is outside the space, or there is none
    """
    size = int(np.prod(space.shape))
    array = np.arange(size)[indices] if isinstance(indices, slice) else np.asarray(list(indices))
    is_list = array.ndim == 1 and array.size > 0 and np.issubdtype(array.dtype, np.integer)
    if not is_list or array.min() < 0 or array.max() >= size:
        given = indices if isinstance(indices, slice) else list(indices)
        raise ValueError(f"{name} must be a non-empty list of indices in 0..{size - 1}, got {given}.")
    return array


def check_keys(name: str, selection: KeySelection, space: spaces.Dict) -> dict[str, Any]:
    """
    :param name: of the argument
    :param selection: keys, or a mapping from keys to indices
    :param space: that they are of
    :return: key -> index array, or a slice for the whole entry
    :raises ValueError: if a key or an index is unknown, or there is none
    """
    if isinstance(selection, (str, slice)) or not selection:
        raise ValueError(f"{name} must be a non-empty list of keys, or a mapping from keys to indices, got {selection!r}.")
    by_key: Mapping[str, Indices | None] = selection if isinstance(selection, Mapping) else dict.fromkeys(selection)
    resolved: dict[str, Any] = {}
    for key, indices in by_key.items():
        entry = box_entry(space, key)
        resolved[key] = slice(None) if indices is None else check_indices(f'{name}["{key}"]', indices, entry)
    return resolved
