"""
What a run trains with: layers of YAML, the later over the earlier, checked against the algorithm's own signature.

In order: the preset's arguments, those of the task, those of the task at that noise (each first for ``all`` algorithms, then
for the classes from which the algorithm descends), the suite's overrides, the algorithm's own.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import gymnasium as gym
import yaml

from benchmarks.suite import HYPERPARAMS, RunSpec, is_number_as_text
from sb3_gac.algorithms import algorithm_class
from sb3_gac.checks.arguments import constructor_parameters
from sb3_gac.envs.suites import SUITES, suite_of, task_of
from sb3_gac.presets import merge, read_preset

POLICY = "MultiInputPolicy"
_GIVEN_TO_POLICIES = {"observation_space", "action_space", "lr_schedule"}


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
    try:
        return algorithm_class(arguments.pop("class")), arguments
    except ValueError as error:
        raise ValueError(f"algorithms.yml, {name}, class {error}") from None


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
    ids = {task_of(name): name for name in gym.registry if name.startswith("sb3_gac/")}
    if spec.task not in ids:
        raise ValueError(f"task must be one of the registered sb3_gac/<task>-v<version>, {sorted(ids)}, got {spec.task!r}.")
    suite = suite_of(ids[spec.task])
    takes_noise = suite is None or SUITES[suite].sensor_noise
    if spec.noise and not takes_noise:
        raise ValueError(f"{spec.task} has no sensor noise: give noises: [0].")
    return ids[spec.task], {"noise_std": spec.noise} if takes_noise else {}


def resolve(spec: RunSpec) -> tuple[type, dict[str, Any]]:
    """
    :param spec: of a run
    :return: class of the algorithm, and its arguments, as YAML has them
    :raises ValueError: if an argument is unknown to the class or its policy, or is a number that YAML reads as text
    """
    kind, own = read_algorithm(spec.algorithm)
    preset = read_preset(spec.preset)
    resolved: dict[str, Any] = {"buffer_size": min(1_000_000, max(spec.steps, 1_000))}
    for layer in (*preset.layers(kind, spec.task, spec.noise), spec.overrides, own):
        resolved = merge(resolved, layer)
    _check_known(spec.algorithm, resolved, kind, {"env"})
    policies, policy = kind.policy_aliases, resolved.get("policy", POLICY)  # type: ignore[attr-defined]
    if policy not in policies:
        raise ValueError(f"{spec.algorithm}: policy must be one of {sorted(policies)}, got {policy!r}.")
    of_policy = resolved.get("policy_kwargs") or {}
    _check_known(f"{spec.algorithm}, policy_kwargs", of_policy, policies[policy], _GIVEN_TO_POLICIES)
    _check_numbers(spec.algorithm, resolved)
    return kind, resolved


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
