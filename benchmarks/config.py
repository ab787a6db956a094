"""
What a run trains with: layers of YAML, the later over the earlier, checked against the algorithm's own signature.

In order: the preset's arguments, those of the task, those of the task at that noise (each first for ``all`` algorithms, then
for the classes from which the algorithm descends), the suite's overrides, the algorithm's own.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import gymnasium as gym
import torch as th
import yaml
from stable_baselines3 import SAC

import sb3_gac
from benchmarks.suite import HYPERPARAMS, RunSpec, check_keys, is_number_as_text, read_preset
from sb3_gac.checks.arguments import constructor_parameters

_OTHERS_CLASSES = {"stable_baselines3.SAC": SAC}
POLICY = "MultiInputPolicy"
_GIVEN_TO_POLICIES = {"observation_space", "action_space", "lr_schedule"}
_LIBRARIES = {"activation_fn": th.nn, "optimizer_class": th.optim}


def read_algorithm(name: str) -> tuple[type, dict[str, Any]]:
    """
    :param name: of an algorithm in ``hyperparams/algorithms.yml``
    :return: its class, and its arguments
    :raises ValueError: if there is no such algorithm or class
    """
    algorithms = yaml.safe_load((HYPERPARAMS / "algorithms.yml").read_text())
    if name not in algorithms:
        raise ValueError(f"algorithm must be one of {sorted(algorithms)}, got {name!r}.")
    arguments = dict(algorithms[name])
    class_name = arguments.pop("class")
    if class_name in _OTHERS_CLASSES:
        return _OTHERS_CLASSES[class_name], arguments
    if class_name not in sb3_gac.__all__:
        raise ValueError(f"Algorithm {name} names the class {class_name!r}, which neither sb3_gac nor {_OTHERS_CLASSES} has.")
    return getattr(sb3_gac, class_name), arguments


def check_runs(where: str, specs: Iterable[RunSpec]) -> None:
    """
    Whether runs can be made, as far as can be told without making one.

    :param where: the suite, for the message
    :param specs: of its runs
    :raises ValueError: naming an algorithm, a task or an argument that there is not, or a number that YAML reads as text
    """
    for spec in {(spec.algorithm, spec.task, spec.noise): spec for spec in specs}.values():
        try:
            environment(spec)
            resolve(spec)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None


def environment(spec: RunSpec) -> tuple[str, dict[str, Any]]:
    """
    :param spec: of a run
    :return: id and keyword arguments of its environment; without sensor noise there need be no argument for it
    :raises ValueError: if there is no such task
    """
    ids = {name.removeprefix("sb3_gac/").rpartition("-v")[0]: name for name in gym.registry if name.startswith("sb3_gac/")}
    if spec.task not in ids:
        raise ValueError(f"task must be one of the registered sb3_gac/<task>-v<version>, {sorted(ids)}, got {spec.task!r}.")
    takes_noise = not spec.task.startswith("popgym-")
    if spec.noise and not takes_noise:
        raise ValueError(f"{spec.task} has no sensor noise: give noises: [0].")
    return ids[spec.task], {"noise_std": spec.noise} if takes_noise else {}


def resolve(spec: RunSpec) -> tuple[type, dict[str, Any]]:
    """
    :param spec: of a run
    :return: class of the algorithm, and its arguments, as YAML has them
    :raises ValueError: if an argument is unknown to the class or its policy, or is a number that YAML reads as text
    """
    algorithm_class, own = read_algorithm(spec.algorithm)
    resolved: dict[str, Any] = {"buffer_size": min(1_000_000, max(spec.steps, 1_000))}
    for layer in (*_preset_layers(spec, algorithm_class), spec.overrides, own):
        resolved = merge(resolved, layer)
    _check_known(spec.algorithm, resolved, algorithm_class, {"env"})
    policies, policy = algorithm_class.policy_aliases, resolved.get("policy", POLICY)  # type: ignore[attr-defined]
    if policy not in policies:
        raise ValueError(f"{spec.algorithm}: policy must be one of {sorted(policies)}, got {policy!r}.")
    of_policy = resolved.get("policy_kwargs") or {}
    _check_known(f"{spec.algorithm}, policy_kwargs", of_policy, policies[policy], _GIVEN_TO_POLICIES)
    _check_numbers(spec.algorithm, resolved)
    return algorithm_class, resolved


def _check_known(where: str, arguments: Mapping[str, Any], taker: type, given: set[str]) -> None:
    known = sorted(set(constructor_parameters(taker)) - given)
    unknown = sorted(set(arguments) - set(known))
    if unknown:
        raise ValueError(f"{where}: {taker.__name__} has no arguments {unknown}; it has {known}.")


def _check_numbers(where: str, value: Any) -> None:
    """In arguments, and in whatever they hold."""
    if is_number_as_text(value):
        raise ValueError(f"{where}: YAML reads {value!r} as text: a number has a decimal point before its e, as in 1.0e-3.")
    pairs = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in pairs:
        _check_numbers(f"{where}, {key}", inner)


def _preset_layers(spec: RunSpec, algorithm_class: type) -> Iterator[Mapping[str, Any]]:
    preset = read_preset(spec.preset)
    task = preset.get("tasks", {}).get(spec.task, {})
    noises = {float(noise): layer for noise, layer in task.get("noises", {}).items()}
    families = ["all", *(ancestor.__name__ for ancestor in reversed(algorithm_class.__mro__))]
    for arguments in (preset["arguments"], task.get("arguments", {}), noises.get(spec.noise, {})):
        check_keys(f"preset {spec.preset}, arguments", arguments, {"all", *sb3_gac.__all__}, set())
        yield from (arguments[family] for family in families if family in arguments)


def merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param below: a layer
    :param above: what replaces it, key by key; mappings are merged
    """
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge(merged[key], value) if both and key == "policy_kwargs" else value
    return merged


def instantiate(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param arguments: as YAML has them
    :return: as the class takes them: names of activations and optimisers become classes
    :raises ValueError: if torch has none of that name
    """
    policy_kwargs = dict(arguments.get("policy_kwargs") or {})
    for key, library in _LIBRARIES.items():
        if key in policy_kwargs:
            found = getattr(library, str(policy_kwargs[key]), None)
            if not isinstance(found, type):
                raise ValueError(f"policy_kwargs: {key} must name a class of {library.__name__}, got {policy_kwargs[key]!r}.")
            policy_kwargs[key] = found
    return {**arguments, "policy_kwargs": policy_kwargs}
