"""
Values as JSON and arrays, and back, without ever executing the content of a file.

Objects and classes are written by name, and only names in the libraries of :data:`TRUSTED` are looked up again.
"""

import importlib
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

#: Packages whose classes a file may name
TRUSTED = ("sb3_gac", "stable_baselines3", "torch", "gymnasium", "numpy", "collections")


class UntrustedNameError(ValueError):
    """A value or a file names a class of a library that is not trusted."""


def encode(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """
    Convert a value to a form that JSON can hold, with arrays apart.

    :param value: value made of numbers, strings, lists, tuples, deques, dicts with strings as keys, arrays, numpy generators,
        trusted classes and their objects
    :param arrays: dict that gets the arrays of the value, by number
    :return: value in a form that JSON can hold
    :raises UntrustedNameError: naming the class of a part that is none of these
    """
    if isinstance(value, np.generic):
        return encode(np.asarray(value), arrays) | {"scalar": True}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.ndarray) and value.dtype != object:
        arrays[str(len(arrays))] = value
        return {"array": str(len(arrays) - 1)}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {"dict": {key: encode(part, arrays) for key, part in value.items()}}
    if isinstance(value, (list, tuple, deque)) and type(value) in (list, tuple, deque):
        parts = [encode(part, arrays) for part in value]
        extra = {"maxlen": value.maxlen} if isinstance(value, deque) else {}
        return {type(value).__name__: parts} | extra
    if isinstance(value, np.random.Generator):
        return {"generator": type(value.bit_generator).__name__, "state": encode(value.bit_generator.state, arrays)}
    if isinstance(value, type):
        return {"class": reference(value)}
    return {"object": reference(type(value)), "state": encode(vars(value), arrays)}


def decode(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """
    Convert an encoded value back.

    :param value: value that :func:`encode` returned
    :param arrays: arrays by number, which :func:`encode` has filled
    :return: value that was encoded
    :raises UntrustedNameError: if it names a class of a library that is not trusted
    """
    if not isinstance(value, dict):
        return value
    if "array" in value:
        array = np.array(arrays[value["array"]])
        return array[()] if value.get("scalar") else array
    if "dict" in value:
        return {key: decode(part, arrays) for key, part in value["dict"].items()}
    if "deque" in value:
        return deque((decode(part, arrays) for part in value["deque"]), maxlen=value["maxlen"])
    if "generator" in value:
        bit_generator = getattr(np.random, value["generator"])()
        bit_generator.state = decode(value["state"], arrays)
        return np.random.Generator(bit_generator)
    if "class" in value:
        return dereference(value["class"])
    if "object" in value:
        kind = dereference(value["object"])
        instance = kind.__new__(kind)
        vars(instance).update(decode(value["state"], arrays))
        return instance
    (kind, parts), *_ = value.items()
    return {"list": list, "tuple": tuple}[kind](decode(part, arrays) for part in parts)


def reference(kind: type) -> str:
    """
    The name under which a class is written.

    :param kind: class of a trusted library
    :return: module and qualified name, with a colon between them
    :raises UntrustedNameError: if the library is not trusted, or the class is not found by that name
    """
    name = f"{kind.__module__}:{kind.__qualname__}"
    if dereference(name) is not kind:
        raise UntrustedNameError(f"{name} is not what is found under that name")
    return name


def dereference(name: str) -> Any:
    """
    Find a class by name.

    :param name: module and qualified name, from :func:`reference`
    :return: class of that name
    :raises UntrustedNameError: if the library is not trusted, or there is no class of that name
    """
    module, _, path = name.partition(":")
    if module.partition(".")[0] not in TRUSTED:
        raise UntrustedNameError(f"{name} is not of one of the libraries {TRUSTED}")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part, None)
    if not isinstance(found, type):
        raise UntrustedNameError(f"{name} is no class")
    return found
