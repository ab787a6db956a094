"""Checks of what users and environments hand in; each error names the culprit and the remedy."""

import math
from collections.abc import Callable, Mapping
from decimal import Decimal
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_gac.schedules import read_schedule


class UnsupportedActionSpaceError(AssertionError, ValueError):
    """The algorithm does not support the action space. SB3 raises AssertionError here, so this is one as well."""


# --- texts of errors ----------------------------------------------------------------------------------------------------


def as_sentence(said: object) -> str:
    """
    The text of an error as a sentence, which further sentences may follow.

    :param said: error, or anything else whose text comes from elsewhere
    :return: text, which ends with a full stop whether it came with one or not
    """
    text = str(said).strip()
    return text if text.endswith((".", "!", "?")) else f"{text}."


def described(error: Exception) -> str:
    """
    The description of an error as a sentence.

    :param error: error of any type
    :return: type of the error and its text, if it has one
    """
    name = type(error).__name__
    return as_sentence(f"{name}: {error}" if str(error).strip() else name)


# --- arguments ----------------------------------------------------------------------------------------------------------


def plain(value: Any, arrays: bool = False) -> Any:
    """
    Python's own numbers in place of numpy's, torch's and other libraries', also inside of dicts, lists and tuples.

    A file that holds numbers of other libraries can't be read without executing its content.

    :param value: value of any type
    :param arrays: whether arrays with dimensions are converted too: to a number if they hold a single one, else to lists
    :return: value with Python's numbers
    """
    if getattr(value, "ndim", None) == 0 and hasattr(value, "item"):
        number = value.item()
        return float(number) if isinstance(number, np.floating) else number  # a long double's item is a long double
    if arrays and isinstance(value, (np.ndarray, th.Tensor)):
        numbers = value.tolist()
        return value.item() if np.size(numbers) == 1 else numbers
    if isinstance(value, (Real, Decimal)) and type(value) not in (bool, int, float):  # fractions, members of an IntEnum
        return int(value) if isinstance(value, Integral) else float(value)
    if isinstance(value, Mapping):
        return {plain(key): plain(part, arrays) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        parts = [plain(part, arrays) for part in value]
        if isinstance(value, list):
            return parts
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def check_positive(name: str, value: Any, remedy: str = "") -> None:
    """
    Check that a value is a finite number above 0.

    :param name: name of the value, for the message
    :param value: value to check
    :param remedy: advice that the message adds to what is allowed
    :raises ValueError: unless ``value`` is a finite number > 0
    """
    _check_number(name, value, 0 < _number(value) < math.inf, "> 0", remedy)


def check_not_negative(name: str, value: Any, remedy: str = "") -> None:
    """
    Check that a value is a finite number of 0 or more.

    :param name: name of the value, for the message
    :param value: value to check
    :param remedy: advice that the message adds to what is allowed
    :raises ValueError: unless ``value`` is a finite number >= 0
    """
    _check_number(name, value, 0 <= _number(value) < math.inf, ">= 0", remedy)


def check_fraction(name: str, value: Any) -> None:
    """
    Check that a value is a number from 0 to 1, both allowed.

    :param name: name of the value, for the message
    :param value: value to check
    :raises ValueError: unless ``value`` is a number in [0, 1]
    """
    _check_number(name, value, 0 <= _number(value) <= 1, "from 0 to 1")


def check_inner_fraction(name: str, value: Any) -> None:
    """
    Check that a value is a number between 0 and 1, neither allowed.

    :param name: name of the value, for the message
    :param value: value to check
    :raises ValueError: unless ``value`` is a number in (0, 1)
    """
    if not 0 < _number(value) < 1:
        raise ValueError(f"{name} must be a number between 0 and 1, got {value!r}.")


def _number(value: Any) -> float:
    try:
        return math.nan if isinstance(value, str) else float(value)
    except (TypeError, ValueError):
        return math.nan


def _check_number(name: str, value: Any, allowed: bool, bound: str, remedy: str = "") -> None:
    if not allowed:
        raise ValueError(f"{name} must be a number {bound}{', ' + remedy if remedy else ''}, got {value!r}.")


def check_integer(name: str, value: Any, low: int, high: float = math.inf, remedy: str = "") -> None:
    """
    Check that a value is an integer in a range.

    :param name: name of the value, for the message
    :param value: value to check
    :param low: smallest allowed value
    :param high: largest allowed value
    :param remedy: advice that the message adds to what is allowed
    :raises ValueError: unless ``value`` is an integer from ``low`` to ``high``
    """
    if not (isinstance(value, Integral) and low <= int(value) <= high):
        bound = f">= {low}" if high == math.inf else f"from {low} to {high}"
        raise ValueError(f"{name} must be an integer {bound}{', ' + remedy if remedy else ''}, got {value!r}.")


def check_range(name: str, value: Any, above: float = -math.inf) -> tuple[float, float]:
    """
    Check that a value is a pair of bounds.

    :param name: name of the value, for the message
    :param value: value to check
    :param above: number below both bounds
    :return: lower and upper bound
    :raises ValueError: unless ``value`` is a pair of numbers with ``above`` < low < high
    """
    try:
        low, high = (_number(bound) for bound in value)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not above < low < high < math.inf:
        bound = "low < high" if above == -math.inf else f"{above:g} < low < high"
        raise ValueError(f"{name} must be a pair (low, high) with {bound}, got {value!r}.")
    return low, high


def check_choice(name: str, value: Any, choices: Any) -> None:
    """
    Check that a value is one of several.

    :param name: name of the value, for the message
    :param value: value to check
    :param choices: allowed values
    :raises ValueError: unless ``value`` is one of ``choices``
    """
    if value not in tuple(choices):
        raise ValueError(f"{name} must be one of {sorted(choices)}, got {value!r}.")


def check_type(name: str, value: Any, types: type | tuple[type, ...], expected: str) -> None:
    """
    Check the type of a value.

    :param name: name of the value, for the message
    :param value: value to check
    :param types: allowed type, or types
    :param expected: description of what is allowed, for the message
    :raises ValueError: unless ``value`` is an instance of ``types``
    """
    if not isinstance(value, types):
        raise ValueError(f"{name} must be {expected}, got {value!r}.")


def check_schedule(name: str, value: Any, remedy: str = "or a schedule", may_be_zero: bool = False) -> None:
    """
    Check that a value is a positive number or a schedule of such; a schedule may begin or end at 0.

    :param name: name of the value, for the message
    :param value: number, function of the fraction of training that remains, or text of a schedule
    :param remedy: advice that the message adds to what is allowed
    :param may_be_zero: whether the number 0 is allowed as well
    :raises ValueError: unless ``value`` is one of these
    """
    if isinstance(value, str):
        try:
            value = read_schedule(value)
        except ValueError as error:
            raise ValueError(f"{name} must be a number {'>=' if may_be_zero else '>'} 0, {remedy}; {error}") from None
    if not callable(value):
        (check_not_negative if may_be_zero else check_positive)(name, value, remedy)
        return
    for progress_remaining, when in ((1.0, "start"), (0.0, "end")):
        check_not_negative(f"{name} at the {when} of training", plain(value(progress_remaining), arrays=True))


# --- spaces and what environments return --------------------------------------------------------------------------------


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
