"""
Named sets of arguments: ``GAC("MultiInputPolicy", env, **preset("small"))``.

Each is a YAML file beside this one, and read by everybody: by :func:`preset`, the main job, the zoo and the benchmarks::

    extends: other                  # preset that this one is over, if any
    run: {envs: 4}                  # environments side by side that it is meant for; see :class:`Preset` for what else
    arguments:
      all: {gamma: 0.99}            # of every algorithm
      off_policy: {batch_size: 128} # of those of a family, over those of all
      gac: {target_kl: 0.01}        # of that one and its subclasses alone, over the above
    tasks:                          # the same again, over the above: for a task, and for that task at a noise level
      Ant: {arguments: {gac: {target_kl: 0.005}}, noises: {0.3: {gac: {target_kl: 0.001}}}}
    normalize:                      # of a family or algorithm: arguments of SB3's VecNormalize around its environments
      gac: {norm_reward: false}

An algorithm has its name in :mod:`sb3_gac.algorithms`, or is ``module:Class``.  Activation functions and optimisers are
torch's, by name.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from torch import nn, optim

from sb3_gac.algorithms import ALGORITHMS, FAMILIES, algorithm_class, name_of
from sb3_gac.envs.suites import shows_whole_state, task_named
from sb3_gac.presets.noises import at_noise, defaults_of, merge

DIRECTORY = Path(__file__).parent
_BRAX = "brax-"  # the paper's tasks in its own simulator: what is meant for the paper's task is meant for them
_PARTS = ("run", "arguments", "tasks", "normalize")
_OF_RUN = {"envs", "steps", "eval_episodes", "eval_deterministic"}
_LIBRARIES = {"activation_fn": nn, "optimizer_class": optim}


@dataclass(frozen=True)
class Preset:
    """
    A file of arguments, as it is.

    :param name: name of the preset's file
    :param run: environments side by side that ``gradient_steps`` is meant for, ``envs``; and what a benchmark's suite has if
        it says nothing else: ``steps``, ``eval_episodes`` and ``eval_deterministic``
    :param arguments: "all" or the name of an algorithm -> arguments
    :param tasks: task -> ``arguments``, and ``noises``: noise -> arguments
    :param normalize: "all" or the name of an algorithm -> arguments of ``VecNormalize``
    """

    name: str
    run: dict[str, Any]
    arguments: dict[str, dict[str, Any]]
    tasks: dict[str, dict[str, Any]] = field(default_factory=dict)
    normalize: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def envs(self) -> int:
        """Environments side by side, for which ``gradient_steps`` is meant."""
        number: int = self.run["envs"]
        return number

    def normalization(self, algorithm: str | type = "gac") -> dict[str, Any] | None:
        """
        :param algorithm: its class, or its name in :mod:`sb3_gac.algorithms`
        :return: arguments of the ``VecNormalize`` around its environments, ``None`` where they show observations as they are
        """
        found = [self.normalize[family] for family in _families(_kind(algorithm)) if family in self.normalize]
        return dict(found[-1]) if found else None

    def layers(self, algorithm: type, task: str | None, noise: float) -> Iterator[Mapping[str, Any]]:
        """
        :param algorithm: class that the arguments are for
        :param task: of an environment that is registered as ``sb3_gac/<task>-v5``, by its name or that id; ``None`` for any
            other environment. Brax's ``brax-<task>`` are those of the paper
        :param noise: standard deviation of the task's sensor noise; between two for which the file has arguments, numbers are
            interpolated, and beyond the last one it is that one's that count, both with a warning
        :return: arguments, the later over the earlier: in each part of the file those of all, of ancestors, and its own.
            ``role_keys`` that leave critics the privileged entry alone are not for tasks where that is not the whole state
        :raises ValueError: if there is no such task, naming the nearest ones, or the noise is negative
        """
        families = _families(algorithm)
        if task is not None and task not in self.tasks:
            task = task_named(task)
        of_task = self.tasks.get(task or "", self.tasks.get((task or "").removeprefix(_BRAX), {}))
        parts = (self.arguments, of_task.get("arguments", {}))
        found = [sections[family] for sections in parts for family in families if family in sections]
        by_noise = {
            float(level): [sections[family] for family in families if family in sections]
            for level, sections in of_task.get("noises", {}).items()
        }
        found += at_noise(f"The preset {self.name} for {task}", by_noise, noise, [defaults_of(algorithm), *found])
        yield from found
        if any("role_keys" in layer for layer in found) and task is not None and not shows_whole_state(task):
            yield {"role_keys": None}


def read_preset(name: str) -> Preset:
    """
    :param name: of a preset
    :return: what its file has
    :raises ValueError: if there is no such preset, or its file has keys that mean nothing
    """
    path = DIRECTORY / f"{name}.yml"
    if not path.exists():
        raise ValueError(f"preset must be one of {sorted(PRESETS)}, got {name!r}.")
    content = yaml.safe_load(path.read_text())
    extends = isinstance(content, Mapping) and "extends" in content
    _check(path.name, content, {"extends", *_PARTS}, set() if extends else {"run", "arguments"})
    _check(f"{path.name}, run", content.get("run", {}), _OF_RUN, set() if extends else {"envs"})
    for part in ("arguments", "normalize"):
        _check_sections(f"{path.name}, {part}", content.get(part, {}))
    for task, settings in content.get("tasks", {}).items():
        where = f"{path.name}, {task}"
        _check(where, settings, {"arguments", "noises"})
        _check_sections(f"{where}, arguments", settings.get("arguments", {}))
        for noise, sections in settings.get("noises", {}).items():
            if not isinstance(noise, int | float):
                raise ValueError(f"{where}, noises: must be numbers, each, got {noise!r}.")
            _check_sections(f"{where}, noise {noise}", sections)
    if extends:
        below = read_preset(content["extends"])
        content = {part: _over(getattr(below, part), content.get(part, {})) for part in _PARTS}
    return Preset(path.stem, **content)


def _over(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """A part of a preset, the sections in it one over the other where both have one."""
    both = below.keys() & above.keys()
    sections = {name: merge(below[name], above[name]) for name in both if isinstance(below[name], Mapping)}
    return {**below, **above, **sections}


def _families(algorithm: type) -> list[str]:
    """What sections for it may be called, the later ones over the earlier ones."""
    return ["all", *map(name_of, reversed(algorithm.__mro__))]


def _kind(algorithm: str | type) -> type:
    return algorithm if isinstance(algorithm, type) else _class_of(algorithm)


def _check_sections(where: str, sections: Any) -> None:
    foreign = {name for name in sections if ":" in str(name)} if isinstance(sections, Mapping) else set()
    _check(where, sections, {"all", *FAMILIES, *ALGORITHMS, *foreign})
    for name, arguments in sections.items():
        _check(f"{where}, {name}", arguments, set(arguments) if isinstance(arguments, Mapping) else set())


def _check(where: str, content: Any, known: set[str], required: set[str] = frozenset()) -> None:  # type: ignore[assignment]
    if not isinstance(content, Mapping):
        raise ValueError(f"{where}: must be a mapping, got {content!r}.")
    unknown, missing = sorted(set(map(str, content)) - known), sorted(required - set(content))
    if unknown or missing:
        raise ValueError(f"{where}: unknown keys {unknown}, missing keys {missing}; the keys are {sorted(known)}.")


class _Presets(Mapping[str, Preset]):
    """All presets by name. A file is read when it is asked for."""

    def __getitem__(self, name: str) -> Preset:
        if name not in set(self):
            raise KeyError(name)
        return read_preset(name)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(path.stem for path in DIRECTORY.glob("*.yml")))

    def __len__(self) -> int:
        return len(list(iter(self)))


PRESETS: Mapping[str, Preset] = _Presets()


def preset(
    name: str, *, algorithm: str | type = "gac", task: str | None = None, noise: float = 0.0, **overrides: Any
) -> dict[str, Any]:
    """
    :param name: one of ``PRESETS``, such as "small" or "paper"
    :param algorithm: that the arguments are for: its class, or its name in :mod:`sb3_gac.algorithms`
    :param task: as in ``sb3_gac/<task>-v5`` or ``sb3_gac/brax-<task>-v0``, or that id: with what the preset has for it, if
        anything; ``None`` for an environment that is not registered so
    :param noise: standard deviation of that task's sensor noise; see :meth:`Preset.layers` for one between the file's
    :param overrides: arguments that replace those of the preset; ``policy_kwargs`` are merged
    :return: keyword arguments of the algorithm, with its ``policy`` where the preset names one; ``PRESETS[name].envs``
        environments go with them, in a ``VecNormalize`` where ``PRESETS[name].normalization(algorithm)`` is not ``None``
    :raises ValueError: if there is no such preset, algorithm or task, or the noise is negative
    """
    found = read_preset(name)
    kind = _kind(algorithm)
    resolved: dict[str, Any] = {"policy_kwargs": {}}
    for layer in found.layers(kind, task, noise):
        resolved = merge(resolved, layer)
    return merge(instantiate(resolved), overrides | {"policy_kwargs": overrides.get("policy_kwargs") or {}})


def _class_of(algorithm: str) -> type:
    try:
        return algorithm_class(algorithm)
    except ValueError as error:
        raise ValueError(f"algorithm {error}") from None


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
