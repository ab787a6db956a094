"""Arguments of a preset at a noise level, of which its file has only some."""

import inspect
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

_ROUNDING = {"rel_tol": 1e-6, "abs_tol": 1e-9}  # of float32, and of sums such as 0.1 + 0.2


def at_noise(
    where: str, by_noise: Mapping[float, Sequence[Mapping[str, Any]]], noise: float, below: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]]:
    """
    :param where: what has these arguments, for messages
    :param by_noise: noise -> arguments there, the later over the earlier
    :param noise: standard deviation that arguments are wanted for
    :param below: arguments that hold where ``by_noise`` has none
    :return: those of the same noise, but for rounding; none below the first noise, where ``below`` holds. Between two noises
        numbers are interpolated, and all else is that of the nearer one; beyond the last it is the last one's. Either of
        these is said in a warning
    :raises ValueError: if the noise is negative, or no number
    """
    if not (_is_number(noise) and noise >= 0):
        raise ValueError(f"noise must be a number of at least 0, got {noise!r}.")
    for level, layers in by_noise.items():
        if math.isclose(noise, level, **_ROUNDING):
            return list(layers)
    lower = max((level for level in by_noise if level < noise), default=None)
    if lower is None:
        return []
    upper = min((level for level in by_noise if level > noise), default=None)
    ends = [lower] if upper is None else [lower, upper]
    names = {name for level in ends for layer in by_noise[level] for name in layer}
    if not names:
        return []
    low, *rest = (merged([*below, *by_noise[level]]) for level in ends)
    if rest:
        share = (noise - ends[0]) / (ends[1] - ends[0])
        found = {name: _between(low.get(name), rest[0].get(name), share) for name in sorted(names)}
        how = f"interpolated between those at {ends[0]:g} and {ends[1]:g}"
    else:
        found, how = {name: low[name] for name in sorted(names)}, f"those at {ends[0]:g}, the nearest"
    values = ", ".join(f"{name} {value!r}" for name, value in found.items())
    warnings.warn(f"{where} has no arguments at noise {noise:g}: they are {how}: {values}.", UserWarning, stacklevel=4)
    return [found]


def _between(low: Any, high: Any, share: float) -> Any:
    if _is_number(low) and _is_number(high):
        return float(f"{low + share * (high - low):.6g}")
    return low if share < 0.5 else high


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def defaults_of(algorithm: type) -> dict[str, Any]:
    """
    :param algorithm: a class
    :return: default values of its constructor's arguments, of those that have one
    """
    parameters = inspect.signature(algorithm).parameters.values()
    return {parameter.name: parameter.default for parameter in parameters if parameter.default is not parameter.empty}


def merged(layers: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """
    :param layers: arguments, the later over the earlier
    """
    result: dict[str, Any] = {}
    for layer in layers:
        result = merge(result, layer)
    return result


def merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param below: arguments
    :param above: what replaces them, key by key; ``policy_kwargs`` are merged
    """
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge(merged[key], value) if both and key == "policy_kwargs" else value
    return merged
