"""Names of the entries ``partial`` and ``privileged``, and operations on Box spaces."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

PARTIAL = "partial"
PRIVILEGED = "privileged"


def box_entry(space: spaces.Space, key: str) -> spaces.Box:
    """
    Look up an entry of a Dict space, which must be a Box.

    :param space: Dict space of an observation
    :param key: key of one of its entries
    :return: space of that entry
    :raises ValueError: if there is no such entry, or the entry is not a Box
    """
    if not isinstance(space, spaces.Dict) or key not in space.spaces:
        raise ValueError(f'The observation has no entry "{key}"; its space is {space}.')
    entry = space[key]
    if not isinstance(entry, spaces.Box):
        raise ValueError(f'The entry "{key}" must be a Box, but is {entry}.')
    return entry


def take_from_box(box: spaces.Box, index: Any) -> spaces.Box:
    """
    Select components of a Box.

    :param box: Box of any shape
    :param index: indices into the flattened Box, or a slice
    :return: Box of these components, one-dimensional and float32
    """
    low, high = box.low.ravel()[index].astype(np.float32), box.high.ravel()[index].astype(np.float32)
    return spaces.Box(low, high, dtype=np.float32)


def concatenate_boxes(boxes: Sequence[spaces.Box]) -> spaces.Box:
    """
    Join Boxes along their first axis.

    :param boxes: Boxes that are equal in all axes but the first
    :return: Box that joins them along the first axis
    """
    low, high = np.concatenate([box.low for box in boxes]), np.concatenate([box.high for box in boxes])
    return spaces.Box(low, high, dtype=boxes[0].dtype)
