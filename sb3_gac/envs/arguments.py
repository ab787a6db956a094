"""Checks of arguments that several environments and wrappers have; none imports torch."""

from typing import Any

import numpy as np


def check_count(name: str, value: Any, low: int = 1, of_what: str = "") -> int:
    """
    Check a number of steps, frames, environments or the like.

    :param name: name of the argument, for the message
    :param value: value to check
    :param low: smallest allowed number
    :param of_what: what the number is of, for the message
    :return: the number as Python's own
    :raises ValueError: unless ``value`` is an integer of at least ``low``
    """
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < low:
        raise ValueError(f"{name} must be an integer of at least {low}{of_what and f', {of_what}'}, got {value!r}.")
    return int(value)
