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
        raise ValueError(f'The entry "{key}" must be a Box, but is {entry}: make it one in the environment.')
    return entry


def has_channels_last(box: spaces.Box) -> bool:
    """
    :param box: Box of any shape
    :return: whether the Box is of images in bytes whose last axis, the smallest, has the channels
    """
    return box.dtype == np.uint8 and len(box.shape) == 3 and box.shape[2] < min(box.shape[:2])


def take_from_box(box: spaces.Box, index: Any) -> spaces.Box:
    """
    Select components of a Box.

    :param box: Box of any shape
    :param index: indices into the flattened Box, or a slice
    :return: Box of these components, one-dimensional and float32
    """
    low, high = box.low.ravel()[index].astype(np.float32), box.high.ravel()[index].astype(np.float32)
    return spaces.Box(low, high, dtype=np.float32)


def concatenate_boxes(boxes: Sequence[spaces.Box], axis: int = 0) -> spaces.Box:
    """
    Join Boxes along an axis.

    :param boxes: Boxes that are equal in all other axes
    :param axis: axis along which they are joined
    :return: Box that joins them
    """
    low, high = (np.concatenate(bounds, axis) for bounds in zip(*((box.low, box.high) for box in boxes), strict=True))
    return spaces.Box(low, high, dtype=boxes[0].dtype)
