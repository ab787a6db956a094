"""Checks of single values that users hand in; each error names the culprit and the remedy."""

import math
from collections.abc import Mapping
from decimal import Decimal
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch as th

from sb3_gac.schedules import read_schedule

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
