"""Reads YAML whose keys differ, and checks its values, with errors that name the key in the file."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml


class _DistinctKeys(yaml.SafeLoader):
    """A loader for which a key that comes twice in a mapping is an error; YAML's own keeps the last one in silence."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping of a node; a key that comes after ``<<`` may replace one that was merged."""
        keys = [(key.tag, key.value) for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for index, (key, _) in enumerate(node.value):
            if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in keys[:index]:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key.value!r} comes twice in a mapping: remove or rename one", key.start_mark
                )
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """
    :param path: YAML file
    :return: content of the file
    :raises ValueError: naming the line, if the file is not YAML, or if a key comes twice in a mapping
    """
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _DistinctKeys)
    except yaml.YAMLError as error:
        raise ValueError(f"{path.name} is not YAML: {error}") from None


def check_list(where: str, values: Any, what: str, kinds: type | tuple[type, ...]) -> None:
    """
    :param where: file and key, with which an error message begins
    :param values: value that was read from YAML
    :param what: description of the elements, for an error message, such as "whole numbers"
    :param kinds: types that an element may have
    :raises ValueError: if the value is no list or an empty one, or if an element has another type, is infinite or below 0
    """
    check_is(where, values, f"a list of at least one of {what}", list, len)
    for value in values:
        check_is(where, value, f"{what}, each", kinds, lambda value: isinstance(value, str) or 0 <= value < math.inf)


def check_numbers(where: str, value: Any, is_meant: Callable[[Any], Any] | None = None) -> None:
    """
    :param where: file and key, with which an error message begins
    :param value: arguments, or any value in them; mappings and lists are searched
    :param is_meant: function that says whether a value must have been meant as a number; by default
        :func:`is_number_as_text`
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
    :param where: file and key, with which an error message begins
    :param value: value that was read from YAML
    :param what: description of an allowed value, for an error message
    :param kinds: types that the value may have; a boolean is never allowed
    :param holds: function of the value that must be true as well
    :raises ValueError: if the value is not allowed
    """
    if isinstance(value, bool) or not isinstance(value, kinds) or not holds(value):
        hint = f" YAML reads {value!r} as text: write a number out, or as 1.0e-3." if is_number_as_text(value) else ""
        raise ValueError(f"{where}: must be {what}, got {value!r}.{hint}")


def is_number_as_text(value: Any) -> bool:
    """
    :param value: value that was read from YAML
    :return: whether the value is a text that Python reads as a number: in YAML 1.1, ``1e-3`` is text and ``1.0e-3`` a number
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
    :param where: file and key, with which an error message begins
    :param mapping: mapping that was read from YAML
    :param known: keys that the mapping may have
    :param required: keys that the mapping must have
    :raises ValueError: if a key is unknown or missing
    """
    unknown, missing = sorted(map(str, set(mapping) - known)), sorted(required - set(mapping))
    if unknown or missing:
        raise ValueError(f"{where}: unknown keys {unknown}, missing keys {missing}; the keys are {sorted(known)}.")
