"""What YAML has read, against what was meant: errors that name the file's key."""

from collections.abc import Callable, Mapping
from typing import Any


def check_list(where: str, values: Any, what: str, kinds: type | tuple[type, ...]) -> None:
    """
    :param where: for the message
    :param values: read from YAML
    :param what: each of them must be, for the message
    :param kinds: types that each may have
    :raises ValueError: if there are none, or one is something else
    """
    check_is(where, values, f"a list of at least one of {what}", list, len)
    for value in values:
        check_is(where, value, f"{what}, each", kinds, lambda value: isinstance(value, str) or value >= 0)


def check_numbers(where: str, value: Any, is_meant: Callable[[Any], Any] | None = None) -> None:
    """
    :param where: for the message
    :param value: arguments, or what they hold
    :param is_meant: whether a value must have been meant as a number, :func:`is_number_as_text` by default
    :raises ValueError: naming a number that YAML reads as text
    """
    if (is_meant or is_number_as_text)(value):
        raise ValueError(f"{where}: YAML reads {value!r} as text: write a number out, or as 1.0e-3 and 1.0e+5.")
    pairs = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in pairs:
        check_numbers(f"{where}, {key}", inner, is_meant)


def check_is(
    where: str, value: Any, what: str, kinds: type | tuple[type, ...], holds: Callable[[Any], Any] = lambda value: True
) -> None:
    """
    :param where: for the message
    :param value: read from YAML
    :param what: it must be, for the message
    :param kinds: types that it may have
    :param holds: what else must be so
    :raises ValueError: if it is something else
    """
    if isinstance(value, bool) or not isinstance(value, kinds) or not holds(value):
        hint = f" YAML reads {value!r} as text: write a number out, or as 1.0e-3." if is_number_as_text(value) else ""
        raise ValueError(f"{where}: must be {what}, got {value!r}.{hint}")


def is_number_as_text(value: Any) -> bool:
    """
    :param value: read from YAML, in whose version 1.1 1e-3 is no number and 1.0e-3 is one
    """
    if not isinstance(value, str):
        return False
    try:
        float(value)
    except ValueError:
        return False
    return True


def check_keys(where: str, mapping: Mapping[str, Any], known: set[str], required: set[str]) -> None:
    """
    :param where: for the message
    :param mapping: read from YAML
    :param known: keys that it may have
    :param required: keys that it must have
    :raises ValueError: if a key is unknown or missing
    """
    unknown, missing = sorted(set(mapping) - known), sorted(required - set(mapping))
    if unknown or missing:
        raise ValueError(f"{where}: unknown keys {unknown}, missing keys {missing}; the keys are {sorted(known)}.")
