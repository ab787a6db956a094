"""Arguments of a preset at any noise level, from those at the noise levels of its file."""

import inspect
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Any

_ROUNDING = {"rel_tol": 1e-6, "abs_tol": 1e-9}  # rounding of float32, and of sums such as 0.1 + 0.2


def at_noise(
    where: str, by_noise: Mapping[float, Sequence[Mapping[str, Any]]], noise: float, below: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]]:
    """
    The arguments at a noise level.

    Between two noise levels, numbers are interpolated, and other arguments are those of the nearer level; above the last level
    the last level's arguments count. Both cause a warning.

    :param where: name of the preset and task, for messages
    :param by_noise: noise level -> layers of arguments, later ones over earlier ones
    :param noise: standard deviation of the sensor noise
    :param below: layers of arguments that hold where ``by_noise`` has none
    :return: layers of arguments on top of ``below``; none if the noise is below all levels
    :raises ValueError: if the noise is negative, infinite or no number
    """
    if not (_is_number(noise) and 0 <= noise < math.inf):
        raise ValueError(f"noise must be a finite number of at least 0, got {noise!r}.")
    noise = float(noise)
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
    return isinstance(value, Real) and not isinstance(value, bool)  # numpy's numbers are Real as well


def defaults_of(algorithm: type) -> dict[str, Any]:
    """
    :param algorithm: class of an algorithm
    :return: name -> default value, for the constructor's arguments that have one
    """
    parameters = inspect.signature(algorithm).parameters.values()
    return {parameter.name: parameter.default for parameter in parameters if parameter.default is not parameter.empty}


def merged(layers: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """
    Merge layers of arguments.

    :param layers: arguments, later ones over earlier ones
    :return: merged arguments
    """
    result: dict[str, Any] = {}
    for layer in layers:
        result = merge(result, layer)
    return result


def merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """
    Merge two layers of arguments.

    :param below: arguments
    :param above: arguments that replace those of the same name; ``policy_kwargs`` are merged
    :return: merged arguments
    """
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge(merged[key], value) if both and key == "policy_kwargs" else value
    return merged
