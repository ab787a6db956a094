"""Checks of spaces, and of what environments return against them; each error names the culprit and the remedy."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces


class UnsupportedActionSpaceError(AssertionError, ValueError):
    """The algorithm does not support the action space. SB3 raises AssertionError here, so this is one as well."""


def check_box_actions(space: spaces.Box) -> None:
    """
    Check that actions can be scaled from [-1, 1], where policies make them, to a space's bounds, and back.

    :param space: space of the actions
    :raises UnsupportedActionSpaceError: naming the components whose bounds do not allow that, and the remedy
    """
    if space.dtype not in (np.float32, np.float64):
        raise UnsupportedActionSpaceError(
            f"Box actions must be of type float32 or float64, but the action space is {space}, of type {space.dtype}. Wrap "
            "the environment in gymnasium.wrappers.TransformAction with a Box of float32, and convert actions there: "
            f"lambda action: {'np.round(action)' if space.dtype.kind != 'f' else 'action'}.astype(np.{space.dtype})."
        )
    if 0 in space.shape:
        raise UnsupportedActionSpaceError(f"The action space {space} has no component: there is nothing to choose.")
    said = [
        f"component {_listed(np.argwhere(components))} {fault(*(bound[components][0] for bound in (space.low, space.high)))}"
        for components, fault in _box_faults(space)
        if components.any()
    ]
    if said:
        raise UnsupportedActionSpaceError(
            f"The action space must have a finite lower and upper bound in every component, low < high, but {'; '.join(said)}"
        )


def _box_faults(space: spaces.Box) -> list[tuple[np.ndarray, Callable[[Any, Any], str]]]:
    """For each kind of fault: mask of the components that have it, in the space's shape, and function that describes it."""
    low, high = np.asarray(space.low, dtype=np.float64), np.asarray(space.high, dtype=np.float64)
    largest = np.finfo(np.float32).max
    bounded = (np.abs(low) < largest) & (np.abs(high) < largest)
    with np.errstate(over="ignore", invalid="ignore"):
        too_wide = bounded & ~np.isfinite((high - low).astype(np.float32))
    rebound = (
        "the actuator's range, for example with gymnasium.wrappers.TransformAction(env, lambda action: action, "
        "gymnasium.spaces.Box(low, high))."
    )
    return [
        (~bounded, lambda low, high: f"is not bounded (low {low:g}, high {high:g}). Give it {rebound}"),
        (too_wide, lambda low, high: f"is wider than float32 can say (low {low:g}, high {high:g}). Give it {rebound}"),
        (low > high, lambda low, high: f"has low {low:g} above high {high:g}. Swap them."),
        (
            bounded & (low == high),
            lambda low, high: f"is locked (low == high == {low:g}). Leave it out of the action space, and put its value back "
            "where the environment is stepped, in a gymnasium.ActionWrapper.",
        ),
    ]


def _listed(indices: np.ndarray, most: int = 8) -> str:
    """
    :param indices: indices of components, shape (n, number of the space's dimensions)
    :param most: number of components that are named one by one, at most
    :return: list of the components, in words
    """
    names = [str(index[0]) if len(index) == 1 else str(tuple(index)) for index in indices[:most].tolist()]
    return ", ".join(names) + (f" and {len(indices) - most} more" if len(indices) > most else "")


def check_same_spaces(kind: str, known: spaces.Space, given: spaces.Space, whose: str) -> None:
    """
    Check that a space is the same as the model's.

    :param kind: kind of the spaces, for the message: "Observation" or "Action"
    :param known: space of the model
    :param given: space to compare with the model's
    :param whose: name of what the other space belongs to, for the message, such as "environment"
    :raises ValueError: naming each entry that differs
    """
    if known == given:
        return
    differences = [f"the {whose} has {given}, the model {known}"]
    if isinstance(known, spaces.Dict) and isinstance(given, spaces.Dict):
        names = dict.fromkeys([*known.spaces, *given.spaces])
        pairs = {name: (known.spaces.get(name), given.spaces.get(name)) for name in names}
        differences = [
            f'entry "{name}" is {theirs or "missing"} in the {whose}, {ours or "missing"} in the model'
            for name, (ours, theirs) in pairs.items()
            if ours != theirs
        ]
    raise ValueError(f"{kind} spaces do not match: {'; '.join(differences)}.")


def check_spaces_of(model: Any, other: Any, whose: str) -> None:
    """
    Check that two objects have the same observation space and the same action space.

    :param model: model, or another object with ``observation_space`` and ``action_space``
    :param other: object with ``observation_space`` and ``action_space`` to compare with the model's
    :param whose: name of what the other spaces belong to, for the message, such as "environment"
    :raises ValueError: naming the entries that differ
    """
    check_same_spaces("Observation", model.observation_space, other.observation_space, whose)
    check_same_spaces("Action", model.action_space, other.action_space, whose)


def index_bounds(space: spaces.Space) -> tuple[Any, Any] | None:
    """
    The smallest and the largest value in a discrete kind of space.

    :param space: space of an entry
    :return: smallest and largest value, for MultiDiscrete of each component; ``None`` for Box
    """
    if isinstance(space, spaces.Discrete):
        return space.start, space.start + space.n - 1
    if isinstance(space, spaces.MultiDiscrete):
        return space.start, space.start + space.nvec - 1
    return (0, 1) if isinstance(space, spaces.MultiBinary) else None


def fault_of(value: Any, space: spaces.Space) -> str | None:
    """
    The fault of a value that an environment returned.

    :param value: value that one environment returned for an entry
    :param space: space of the entry, which has a shape
    :return: fault of the value in words, as the rest of a sentence; ``None`` if there is none
    """
    try:
        array = np.asarray(value)
    except ValueError:  # nested lists of different lengths
        return f"is not an array: {value!r:.80}"
    if array.dtype.kind not in "biuf":
        return f"is of type {type(value).__name__}, expected numbers of type {space.dtype} and shape {space.shape}"
    if array.shape != space.shape:
        return f"has shape {array.shape}, expected {space.shape}"
    if not np.isfinite(array).all():
        return "holds NaN or infinite values"
    if not held_by(space.dtype, array):
        return f"has type {array.dtype} and values that the expected {space.dtype} can't hold"
    bounds = index_bounds(space)
    if bounds is not None and not ((array >= bounds[0]) & (array <= bounds[1])).all():
        return f"holds {array.tolist()}, which is not in {space}"
    return None


def is_finite(array: np.ndarray, dtype: Any) -> bool:
    """
    Whether all numbers are finite once they are stored.

    :param array: array of numbers
    :param dtype: type in which the numbers will be stored
    :return: whether all are finite in that type
    """
    if dtype.kind == "f" and array.dtype != dtype:
        with np.errstate(over="ignore"):
            array = array.astype(dtype)
    return bool(np.isfinite(array).all())


def held_by(dtype: Any, array: np.ndarray) -> bool:
    """
    Whether a type can hold numbers of another type.

    :param dtype: type of numbers
    :param array: array of another type
    :return: whether the conversion loses no more than precision
    """
    if dtype.kind == "f":
        return is_finite(array, dtype)
    with np.errstate(invalid="ignore"):
        return bool((array.astype(dtype) == array).all())


def entries_of(observation: Any) -> Mapping[str, Any]:
    """
    The entries of an observation.

    :param observation: observation of a Dict space or of any other
    :return: name -> entry; an observation that is no dict is the one entry "observation"
    """
    return observation if isinstance(observation, Mapping) else {"observation": observation}
