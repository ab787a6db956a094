"""
Named sets of arguments: ``GAC("MultiInputPolicy", env, **preset("small"))``.

Each preset is a YAML file beside this module. :func:`preset`, the main job, the zoo and the benchmarks read it::

    extends: other                  # preset whose settings this one overrides, if any
    run: {envs: 4}                  # number of environments that the preset is meant for; see :class:`Preset` for other keys
    arguments:
      all: {gamma: 0.99}            # for every algorithm
      off_policy: {batch_size: 128} # for the algorithms of a family; override those for every algorithm
      gac: {target_kl: 0.01}        # for one algorithm and its subclasses; override the above
    tasks:                          # the same for a task, and for the task at a noise level; override the above
      Ant: {arguments: {gac: {target_kl: 0.005}}, noises: {0.3: {gac: {target_kl: 0.001}}}}
    normalize:                      # by family or algorithm: arguments of SB3's VecNormalize around the environments
      gac: {norm_reward: false}

An algorithm is named as in :mod:`sb3_gac.algorithms`, or as ``module:Class``.  Activation functions and optimisers have
torch's names.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from torch import nn, optim

from sb3_gac.algorithms import ALGORITHMS, FAMILIES, algorithm_class, name_of
from sb3_gac.envs.suites import shows_whole_state, task_named
from sb3_gac.names import meant
from sb3_gac.presets.noises import at_noise, defaults_of, merge

DIRECTORY = Path(__file__).parent
_BRAX = "brax-"  # prefix of the paper's tasks in Brax, which take the arguments of the tasks without it
_PARTS = ("run", "arguments", "tasks", "normalize")
_OF_RUN = {"envs", "steps", "eval_episodes", "eval_deterministic"}
_LIBRARIES = {"activation_fn": nn, "optimizer_class": optim}


@dataclass(frozen=True)
class Preset:
    """
    The content of a preset's file.

    :param name: name of the file, without its ending
    :param run: ``envs``, the number of environments that ``gradient_steps`` is meant for, and defaults of a benchmark's suite:
        ``steps``, ``eval_episodes`` and ``eval_deterministic``
    :param arguments: "all", or name of a family or algorithm -> arguments of the algorithm
    :param tasks: task -> sections "arguments", as above, and "noises", noise -> arguments as above
    :param normalize: "all", or name of a family or algorithm -> arguments of ``VecNormalize``
    """

    name: str
    run: dict[str, Any]
    arguments: dict[str, dict[str, Any]]
    tasks: dict[str, dict[str, Any]] = field(default_factory=dict)
    normalize: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def envs(self) -> int:
        """Number of environments that ``gradient_steps`` is meant for."""
        number: int = self.run["envs"]
        return number

    def normalization(self, algorithm: str | type = "gac") -> dict[str, Any] | None:
        """
        The normalisation of an algorithm's environments.

        :param algorithm: class of the algorithm, or its name in :mod:`sb3_gac.algorithms`
        :return: arguments of the ``VecNormalize`` around the environments; ``None`` for no normalisation
        """
        found = [self.normalize[family] for family in _families(_kind(algorithm)) if family in self.normalize]
        return dict(found[-1]) if found else None

    def layers(self, algorithm: type, task: str | None, noise: float) -> Iterator[Mapping[str, Any]]:
        """
        The arguments for an algorithm, a task and a noise level, in layers of which later ones override earlier ones.

        Each part of the file has a layer for all algorithms, for the algorithm's ancestors and for itself. Where the
        privileged entry is not the whole state of the task, a last layer removes ``role_keys``, which would leave the critics
        that entry alone.

        :param algorithm: class of the algorithm
        :param task: task of an environment that is registered as ``sb3_gac/<task>-v5``, or its id; ``None`` for any other
            environment. A task ``brax-<task>`` that the file lacks has the arguments of the task without the prefix
        :param noise: standard deviation of the task's sensor noise. Between two noise levels of the file, numbers are
            interpolated; above the last level, the last level's arguments count. Both cause a warning
        :return: iterator over the layers
        :raises ValueError: if the task is unknown (the message names similar tasks), or the noise is negative
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
    Read the file of a preset.

    :param name: name of the preset
    :return: content of the file, over the preset that it extends
    :raises ValueError: if there is no such preset, or its file has unknown or missing keys
    """
    path = DIRECTORY / f"{name}.yml"
    if not path.exists():
        raise ValueError(f"preset must be one of {sorted(PRESETS)}, got {name!r}.{meant(str(name), PRESETS)}")
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
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
    """A part of a preset over the same part of another preset; sections that both have are merged."""
    both = below.keys() & above.keys()
    sections = {name: merge(below[name], above[name]) for name in both if isinstance(below[name], Mapping)}
    return {**below, **above, **sections}


def _families(algorithm: type) -> list[str]:
    """Names of the sections that hold arguments for an algorithm; later ones override earlier ones."""
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
    """A mapping from names to presets, which reads a file at each access."""

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
    name: str,
    *,
    algorithm: str | type = "gac",
    task: str | None = None,
    noise: float = 0.0,
    privileged: str | None = None,
    **overrides: Any,
) -> dict[str, Any]:
    """
    The arguments of a preset for an algorithm.

    The arguments are meant for ``PRESETS[name].envs`` environments, in a ``VecNormalize`` with the arguments
    ``PRESETS[name].normalization(algorithm)`` unless these are ``None``.

    :param name: name of the preset, a key of ``PRESETS`` such as "small" or "paper"
    :param algorithm: class of the algorithm, or its name in :mod:`sb3_gac.algorithms`
    :param task: task of an environment that is registered as ``sb3_gac/<task>-v5`` or ``sb3_gac/brax-<task>-v0``, or its id,
        whose arguments in the preset count as well; ``None`` for any other environment
    :param noise: standard deviation of the task's sensor noise; see :meth:`Preset.layers` for levels that the preset lacks
    :param privileged: value of the environment's argument ``privileged``, ``None`` for its default. For any but "state",
        such as "velocity", ``role_keys`` are left out, since critics then need all entries
    :param overrides: arguments that replace those of the preset; ``policy_kwargs`` are merged. Activation functions and
        optimisers are classes, or names of torch's
    :return: keyword arguments of the algorithm, ``policy`` included where the preset has it
    :raises ValueError: if there is no such preset, algorithm, task or class of torch's, or the noise is negative
    """
    found = read_preset(name)
    kind = _kind(algorithm)
    resolved: dict[str, Any] = {"policy_kwargs": {}}
    for layer in found.layers(kind, task, noise):
        resolved = merge(resolved, layer)
    if "role_keys" in resolved and privileged not in (None, "state"):
        resolved = merge(resolved, {"role_keys": None})
    return instantiate(merge(resolved, overrides | {"policy_kwargs": overrides.get("policy_kwargs") or {}}))


def _class_of(algorithm: str) -> type:
    try:
        return algorithm_class(algorithm)
    except ValueError as error:
        raise ValueError(f"algorithm {error}") from None


def instantiate(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """
    Turn the names of torch's activation functions and optimisers into classes.

    :param arguments: arguments of an algorithm, as read from YAML; what is a class or a function already stays as it is
    :return: the arguments as the algorithm's class takes them
    :raises ValueError: if torch has no class of a name, or ``policy_kwargs`` is no mapping
    """
    policy_kwargs = arguments.get("policy_kwargs") or {}
    if not isinstance(policy_kwargs, Mapping):
        raise ValueError(f"policy_kwargs: must be a mapping, got {policy_kwargs!r}.")
    named = {key: name for key, name in policy_kwargs.items() if key in _LIBRARIES and not callable(name)}
    return {**arguments, "policy_kwargs": {**policy_kwargs, **{key: _class_named(key, name) for key, name in named.items()}}}


def _class_named(key: str, name: Any) -> type:
    found = getattr(_LIBRARIES[key], str(name), None)
    if not isinstance(found, type):
        raise ValueError(f"policy_kwargs: {key} must name a class of {_LIBRARIES[key].__name__}, got {name!r}.")
    return found
