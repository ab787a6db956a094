"""Names of the two entries, and operations on Box spaces."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

PARTIAL = "partial"
PRIVILEGED = "privileged"


def box_entry(space: spaces.Space, key: str) -> spaces.Box:
    """
    :param space: Dict
    :param key: of one of its entries
    :return: that entry's space
    :raises ValueError: if there is no such entry, or it is not a Box
    """
    if not isinstance(space, spaces.Dict) or key not in space.spaces:
        raise ValueError(f'The observation has no entry "{key}"; its space is {space}.')
    entry = space[key]
    if not isinstance(entry, spaces.Box):
        raise ValueError(f'The entry "{key}" must be a Box, but is {entry}.')
    return entry


def take_from_box(box: spaces.Box, index: Any) -> spaces.Box:
    """
    :param box: any shape
    :param index: into the flattened box
    :return: one-dimensional, float32
    """
    low, high = box.low.ravel()[index].astype(np.float32), box.high.ravel()[index].astype(np.float32)
    return spaces.Box(low, high, dtype=np.float32)


def concatenate_boxes(boxes: Sequence[spaces.Box]) -> spaces.Box:
    """
    :param boxes: equal in all axes but the first
    :return: joined along the first axis
    """
    low, high = np.concatenate([box.low for box in boxes]), np.concatenate([box.high for box in boxes])
    return spaces.Box(low, high, dtype=boxes[0].dtype)
