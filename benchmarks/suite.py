"""Suites: a YAML file names algorithms, tasks, noise levels and seeds; it is read into training runs, every key checked."""

import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.yaml_checks import check_is, check_keys, check_list, check_numbers, read_yaml
from sb3_gac.presets import read_preset

HERE = Path(__file__).parent
RUNS = HERE / "runs"
HYPERPARAMS = HERE / "hyperparams"
_COMMON = ("steps", "envs", "preset", "eval_every", "eval_episodes")
_SUITE_KEYS = {*_COMMON, "eval_deterministic", "overrides", "algorithms", "cells"}
_SHARED_KEYS = {"algorithms", "seeds", "needs"}
_TASK_KEYS = {"task", "noises", "history", *_SHARED_KEYS}
_ENV_KEYS = {"env", "env_kwargs", "wrappers", "name", *_SHARED_KEYS}
NAME = re.compile(r"\w[\w.+-]*")
#: Settings that runs of earlier versions had without recording them
UNSAID = {"eval_deterministic": True}
_WITH_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")  # other numbers may be in quotes on purpose


@dataclass(frozen=True)
class RunSpec:
    """
    The settings of one training run.

    :param algorithm: name of the algorithm in ``hyperparams/algorithms.yml``, or in the suite's own ``algorithms``
    :param task: task name, as in ``sb3_gac/<task>-v<version>``, or the name of any other environment
    :param noise: standard deviation of the sensor noise, ``None`` for an environment that takes no such argument
    :param seed: seed of everything random
    :param steps: environment steps of training
    :param envs: number of environments side by side
    :param preset: name of the preset in ``sb3_gac/presets`` whose arguments are the first layer
    :param eval_every: environment steps between two evaluations
    :param eval_episodes: number of episodes of each evaluation
    :param overrides: arguments of the algorithm that replace those of the preset
    :param environment: ``id``, ``kwargs`` and ``wrappers`` of the environment, ``None`` for a registered task
    :param definition: definition of the algorithm, ``None`` for the one in ``hyperparams/algorithms.yml``
    :param needs: argument of the algorithm -> ``algorithm``, ``steps``, ``definition`` and ``needs`` of the run whose model
        that argument is; ``None`` if the run needs no other
    :param history: number of observations that ``partial`` holds, with the actions between them; ``None`` for the newest alone
    :param eval_deterministic: whether evaluations use the deterministic policy instead of sampled actions; an algorithm that
        is a program of its own decides by itself
    """

    algorithm: str
    task: str
    noise: float | None
    seed: int
    steps: int
    envs: int
    preset: str
    eval_every: int
    eval_episodes: int
    overrides: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, Any] | None = None
    definition: dict[str, Any] | None = None
    needs: dict[str, dict[str, Any]] | None = None
    history: int | None = None
    eval_deterministic: bool = True

    @property
    def title(self) -> str:
        """The task's name in figures, tables and files; it names the history too."""
        return self.task if self.history is None else f"{self.task}-history{self.history}"

    @property
    def cell(self) -> str:
        """The name of the cell, task and noise, which the runs of all its algorithms and seeds share."""
        return self.title if self.noise is None else f"{self.title}-noise{self.noise:g}"

    def directory(self, root: Path) -> Path:
        """
        :param root: directory of all runs
        :return: directory of this run's files
        """
        return root / f"{self.preset}-{self.steps}" / self.cell / self.algorithm / f"seed{self.seed}"


def needed_runs(spec: RunSpec) -> dict[str, RunSpec]:
    """
    :param spec: settings of a run
    :return: argument of its algorithm -> settings of the run whose model that argument is: the same task, seed and other
        settings, but for the algorithm and the steps
    """
    needs = spec.needs or {}
    return {argument: replace(spec, **{"definition": None, "needs": None} | need) for argument, need in needs.items()}


def with_needed(specs: Iterable[RunSpec]) -> Iterator[RunSpec]:
    """
    :param specs: settings of runs
    :return: settings of these runs and of all that they need, each after those that it needs
    """
    for spec in specs:
        yield from with_needed(needed_runs(spec).values())
        yield spec


def needed_steps(spec: RunSpec) -> int:
    """
    :param spec: settings of a run
    :return: environment steps of all runs that must come before this one, each run counted once
    """
    before = {needed.directory(Path()): needed.steps for needed in with_needed(needed_runs(spec).values())}
    return sum(before.values())


def made_with(configuration: Mapping[str, Any]) -> list[dict[str, Any]]:
    """
    :param configuration: content of a run's ``config.yaml``
    :return: commit and versions of the processes that made the run, one entry for each distinct combination
    """
    return [*configuration.get("earlier", []), {key: configuration[key] for key in ("commit", "versions")}]


def read_suite(path: Path) -> list[RunSpec]:
    """
    :param path: YAML file of a suite
    :return: settings of its runs, all seeds of a cell before the next cell
    :raises ValueError: if a key is unknown or missing, or a run is listed twice
    """
    return [spec for cell in read_cells(path) for spec in cell]


def read_cells(path: Path) -> list[list[RunSpec]]:
    """
    Read a suite, and put its folder on Python's path, so that modules beside the suite can be imported.

    :param path: YAML file of a suite
    :return: settings of its runs: one list for each noise of each entry of ``cells``
    :raises ValueError: if a key is unknown or missing, or a run is listed twice
    """
    cells = cells_of(path.name, read_yaml(path))
    if str(path.parent.resolve()) not in sys.path:
        sys.path.append(str(path.parent.resolve()))
    return cells


def cells_of(name: str, suite: Any) -> list[list[RunSpec]]:
    """
    :param name: name of the suite's file, with which an error message begins
    :param suite: content of the file
    :return: settings of its runs: one list for each noise of each entry of ``cells``
    :raises ValueError: if a key is unknown or missing, or a run is listed twice
    """
    check_is(name, suite, "a mapping", Mapping)
    if "preset" in suite:
        suite = {**read_preset(suite["preset"]).run, **suite}
    check_keys(name, suite, _SUITE_KEYS, {*_COMMON, "cells"})
    for key in ("steps", "envs", "eval_every", "eval_episodes"):
        check_is(f"{name}, {key}", suite[key], "a whole number above 0", int, lambda number: number > 0)
    if not suite["envs"] <= suite["eval_every"] <= suite["steps"]:
        numbers = ", ".join(f"{key} {suite[key]}" for key in ("envs", "eval_every", "steps"))
        raise ValueError(f"{name}: eval_every must be from envs to steps, or no evaluation is made; there are {numbers}.")
    if not isinstance(deterministic := suite.get("eval_deterministic", True), bool):
        raise ValueError(f"{name}, eval_deterministic: must be true or false, got {deterministic!r}.")
    check_is(f"{name}, overrides", suite.get("overrides", {}), "a mapping", Mapping)
    check_is(f"{name}, cells", suite["cells"], "a list of at least one cell", list, len)
    cells = _Reader(name, suite).cells()
    _check_distinct(name, [spec for cell in cells for spec in cell])
    return cells


def _check_distinct(name: str, specs: list[RunSpec]) -> None:
    count = Counter(str(spec.directory(Path())) for spec in specs)
    if twice := sorted(directory for directory, times in count.items() if times > 1):
        raise ValueError(f"{name} lists these runs more than once: {twice}.")
    runs: dict[Path, RunSpec] = {}
    for spec in with_needed(specs):
        directory = spec.directory(Path())
        if runs.setdefault(directory, spec) != spec:
            raise ValueError(f"{name}: {directory} is needed in two ways, that differ in what it needs itself.")
    environments: dict[str, dict[str, Any] | None] = {}
    for spec in specs:
        if environments.setdefault(spec.cell, spec.environment) != spec.environment:
            raise ValueError(f"{name} has two environments with the name {spec.cell!r}: give one of them another name.")


def read_definitions() -> dict[str, Any]:
    """The content of ``hyperparams/algorithms.yml``: algorithm's name -> its class, arguments, and the runs that it needs."""
    definitions: dict[str, Any] = read_yaml(HYPERPARAMS / "algorithms.yml")
    return definitions


class _Reader:
    """
    A suite's content, turned into runs.

    :param name: name of the suite's file, for messages
    :param suite: content of the file, whose numbers have been checked
    """

    def __init__(self, name: str, suite: dict[str, Any]):
        self._name, self._suite = name, suite
        self._own = suite.get("algorithms", {})
        where = f"{name}, algorithms"
        check_is(where, self._own, "a mapping from names to definitions", Mapping)
        everybodys = read_definitions()
        self._definitions = {**everybodys, **self._own}
        if again := sorted(set(self._own) & set(everybodys)):
            raise ValueError(f"{where}: hyperparams/algorithms.yml has {again} already, give yours another name.")
        for algorithm, definition in self._own.items():
            check_is(where, algorithm, "names of letters, digits and . + -", str, NAME.fullmatch)
            check_is(f"{where}, {algorithm}", definition, "a mapping", Mapping)

    def cells(self) -> list[list[RunSpec]]:
        """The settings of all runs: one list for each noise of each entry of ``cells``."""
        return [runs for number, cell in enumerate(self._suite["cells"], 1) for runs in self._by_noise(number, cell)]

    def _by_noise(self, number: int, cell: Any) -> Iterator[list[RunSpec]]:
        where = f"{self._name}, cell {number}"
        check_is(where, cell, "a mapping", Mapping)
        environment, task, noises = self._environment(where, cell)
        check_list(f"{where}, seeds", cell["seeds"], "whole numbers", int)
        check_list(f"{where}, algorithms", cell["algorithms"], "names", str)
        common = {key: self._suite[key] for key in _COMMON} | {"overrides": self._suite.get("overrides", {})}
        common["eval_deterministic"] = self._suite.get("eval_deterministic", True)
        particulars = self._particulars(where, cell)
        for noise in noises:
            yield [
                RunSpec(
                    name,
                    task,
                    noise,
                    seed,
                    **common,
                    environment=environment,
                    history=cell.get("history"),
                    **particulars[name],
                )
                for seed in cell["seeds"]
                for name in cell["algorithms"]
            ]

    def _environment(self, where: str, cell: Any) -> tuple[dict[str, Any] | None, str, list[float | None]]:
        """The cell's environment, ``None`` for a registered task; its name; and its noises."""
        if "env" in cell:
            check_keys(where, cell, _ENV_KEYS, {"env", "algorithms", "seeds"})
            environment, name = read_environment(where, cell), cell.get("name", default_name(cell["env"]))
            check_is(f"{where}, name", name, "a name of letters, digits and . + -", str, NAME.fullmatch)
            return environment, name, [None]
        check_keys(where, cell, _TASK_KEYS, _TASK_KEYS - {"needs", "history"})
        if "history" in cell:
            check_is(f"{where}, history", cell["history"], "a whole number above 1", int, lambda number: number > 1)
        check_is(f"{where}, task", cell["task"], "the name of a task, as in Hopper", str, len)
        check_list(f"{where}, noises", cell["noises"], "numbers", (int, float))
        return None, cell["task"], [float(noise) for noise in cell["noises"]]

    def _particulars(self, where: str, cell: Any) -> dict[str, dict[str, Any]]:
        """For each algorithm, the definition that the suite has of it, and the runs that it needs."""
        changes = cell.get("needs", {})
        check_is(f"{where}, needs", changes, "a mapping", Mapping)
        if unknown := sorted(map(str, set(changes) - set(cell["algorithms"]))):
            raise ValueError(f"{where}, needs: the cell has no algorithms {unknown}; it has {cell['algorithms']}.")
        return {
            name: {
                "definition": self._own.get(name),
                "needs": self._needs(f"{where}, {name}", name, self._suite["steps"], changes.get(name, {})),
            }
            for name in cell["algorithms"]
        }

    def _needs(
        self, where: str, name: str, steps: int, changes: Mapping[str, Any], above: tuple[str, ...] = ()
    ) -> dict[str, dict[str, Any]] | None:
        """The runs that an algorithm needs, with the cell's changes, each with the runs that it needs in turn."""
        if name in above:
            raise ValueError(f"{where}: {' needs '.join([*above, name])}, and so on for ever.")
        defined = (self._definitions.get(name) or {}).get("needs", {})
        for needs in (defined, changes):
            check_is(f"{where}, needs", needs, "a mapping from arguments to runs", Mapping)
        found = {}
        for argument in {**defined, **changes}:
            need = {"steps": steps, **_checked(where, argument, defined), **_checked(where, argument, changes)}
            part = f"{where}, needs, {argument}"
            check_keys(part, need, {"algorithm", "steps"}, {"algorithm"})
            check_is(
                f"{part}, algorithm", need["algorithm"], f"one of {sorted(self._definitions)}", str, self._definitions.get
            )
            least = self._suite["eval_every"]
            check_is(f"{part}, steps", need["steps"], f"a whole number from eval_every, {least}, on", int, least.__le__)
            inner = self._needs(where, need["algorithm"], need["steps"], {}, (*above, name))
            own = {"definition": self._own.get(need["algorithm"]), "needs": inner}
            found[argument] = need | {key: value for key, value in own.items() if value is not None}
        return found or None


def _checked(where: str, argument: str, needs: Mapping[str, Any]) -> Mapping[str, Any]:
    need: Mapping[str, Any] = needs.get(argument, {})
    check_is(f"{where}, needs, {argument}", need, "a mapping, with algorithm and steps", Mapping)
    return need


def read_environment(where: str, cell: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param where: place in the file, with which an error message begins
    :param cell: mapping with ``env``, and perhaps ``env_kwargs`` and ``wrappers``
    :return: ``id``, ``kwargs`` and ``wrappers`` of the environment; a wrapper is a mapping from its ``module:Class`` to its
        keyword arguments
    :raises ValueError: if one of the three has another type or form
    """
    check_is(f"{where}, env", cell["env"], "an id, as in CartPole-v1 or my_module:MyEnv-v0", str, len)
    kwargs, wrappers = cell.get("env_kwargs", {}), cell.get("wrappers", [])
    _check_kwargs(f"{where}, env_kwargs", kwargs)
    check_is(f"{where}, wrappers", wrappers, "a list", list)
    found = []
    for wrapper in wrappers:
        named = {wrapper: {}} if isinstance(wrapper, str) else wrapper
        what = "module:Class, alone or with keyword arguments, each"
        check_is(f"{where}, wrappers", named, what, Mapping, lambda named: len(named) == 1 and all(map(_is_path, named)))
        ((path, arguments),) = named.items()
        _check_kwargs(f"{where}, wrappers, {path}", arguments)
        found.append({path: dict(arguments)})
    return {"id": cell["env"], "kwargs": dict(kwargs), "wrappers": found}


def default_name(env_id: Any) -> str:
    """
    :param env_id: id of an environment
    :return: name of an environment to which the suite gives none: its id without the module
    """
    return str(env_id).rpartition(":")[2].replace("/", "-")


def _is_path(text: Any) -> bool:
    return isinstance(text, str) and all(text.partition(":"))


def _check_kwargs(where: str, kwargs: Any) -> None:
    check_is(
        where, kwargs, "a mapping of keyword arguments", Mapping, lambda kwargs: all(isinstance(key, str) for key in kwargs)
    )
    check_numbers(where, kwargs, lambda value: isinstance(value, str) and _WITH_EXPONENT.fullmatch(value))
