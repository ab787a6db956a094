"""A suite: which algorithms, on which tasks, at which noise levels, with which seeds. Read from YAML, checked by name."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import yaml

from sb3_gac.presets import read_preset

HERE = Path(__file__).parent
RUNS = HERE / "runs"
HYPERPARAMS = HERE / "hyperparams"
_SUITE_KEYS = {"steps", "envs", "preset", "eval_every", "eval_episodes", "overrides", "cells"}
_CELL_KEYS = {"task", "noises", "algorithms", "seeds"}


@dataclass(frozen=True)
class RunSpec:
    """
    One training run.

    :param algorithm: a name in ``hyperparams/algorithms.yml``
    :param task: as in ``sb3_gac/<task>-v<version>``
    :param noise: standard deviation of the sensor noise
    :param seed: of everything random
    :param steps: environment steps
    :param envs: environments side by side
    :param preset: a name in ``sb3_gac/presets``, the arguments to start from
    :param eval_every: environment steps between evaluations
    :param eval_episodes: of each evaluation
    :param overrides: arguments of the algorithm that replace those of the preset
    """

    algorithm: str
    task: str
    noise: float
    seed: int
    steps: int
    envs: int
    preset: str
    eval_every: int
    eval_episodes: int
    overrides: dict[str, Any] = field(default_factory=dict)

    def directory(self, root: Path) -> Path:
        """Where this run's files go."""
        return root / f"{self.preset}-{self.steps}" / f"{self.task}-noise{self.noise:g}" / self.algorithm / f"seed{self.seed}"

    def is_finished(self, root: Path) -> bool:
        """
        :param root: directory of all runs
        :return: whether this run is there, from its start to its end
        :raises ValueError: if what is there is a run with other settings
        """
        directory = self.directory(root)
        if not (directory / "evaluations.csv").exists():
            return False
        there = yaml.safe_load((directory / "config.yaml").read_text())["run"]
        changed = sorted(key for key, value in asdict(self).items() if there.get(key) != value)
        if changed:
            raise ValueError(f"{directory} holds a run with other settings under {changed}: remove it, or use another --runs.")
        return True


def made_with(configuration: Mapping[str, Any]) -> list[dict[str, Any]]:
    """
    :param configuration: a run's ``config.yaml``
    :return: commit and versions of the processes that made it, more than one if they differ
    """
    return [*configuration.get("earlier", []), {key: configuration[key] for key in ("commit", "versions")}]


def read_suite(path: Path) -> list[RunSpec]:
    """
    :param path: YAML file
    :return: its runs; all seeds of a cell before the next cell
    :raises ValueError: if a key is unknown or missing
    """
    return [spec for cell in read_cells(path) for spec in cell]


def read_cells(path: Path) -> list[list[RunSpec]]:
    """
    :param path: YAML file
    :return: its runs, by entry of its ``cells`` and noise
    :raises ValueError: if a key is unknown or missing, or a run is listed twice
    """
    suite = yaml.safe_load(path.read_text())
    check_is(path.name, suite, "a mapping", Mapping)
    if "preset" in suite:
        suite = {**read_preset(suite["preset"]).run, **suite}
    check_keys(path.name, suite, _SUITE_KEYS, _SUITE_KEYS - {"overrides"})
    for key in ("steps", "envs", "eval_every", "eval_episodes"):
        check_is(f"{path.name}, {key}", suite[key], "a whole number above 0", int, lambda number: number > 0)
    if not suite["envs"] <= suite["eval_every"] <= suite["steps"]:
        numbers = ", ".join(f"{key} {suite[key]}" for key in ("envs", "eval_every", "steps"))
        raise ValueError(f"{path.name}: eval_every must be from envs to steps, or no evaluation is made; there are {numbers}.")
    check_is(f"{path.name}, overrides", suite.get("overrides", {}), "a mapping", Mapping)
    check_is(f"{path.name}, cells", suite["cells"], "a list of at least one cell", list, len)
    cells = [runs for cell in suite["cells"] for runs in _cells_by_noise(path.name, suite, cell)]
    count = Counter(str(spec.directory(Path())) for cell in cells for spec in cell)
    if twice := sorted(directory for directory, times in count.items() if times > 1):
        raise ValueError(f"{path.name} lists these runs more than once: {twice}.")
    return cells


def _cells_by_noise(name: str, suite: dict[str, Any], cell: dict[str, Any]) -> Iterator[list[RunSpec]]:
    where = f"{name}, a cell"
    check_is(where, cell, "a mapping", Mapping)
    check_keys(where, cell, _CELL_KEYS, _CELL_KEYS)
    for key, kinds, what in (
        ("noises", (int, float), "numbers"),
        ("seeds", int, "whole numbers"),
        ("algorithms", str, "names"),
    ):
        check_is(f"{where}, {key}", cell[key], f"a list of at least one of {what}", list, len)
        for value in cell[key]:
            check_is(f"{where}, {key}", value, f"{what}, each", kinds, lambda value: isinstance(value, str) or value >= 0)
    common = {key: suite[key] for key in ("steps", "envs", "preset", "eval_every", "eval_episodes")}
    common["overrides"] = suite.get("overrides", {})
    for noise in cell["noises"]:
        runs = ((algorithm, seed) for seed in cell["seeds"] for algorithm in cell["algorithms"])
        yield [RunSpec(algorithm, cell["task"], float(noise), seed, **common) for algorithm, seed in runs]


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
        hint = f" YAML reads {value!r} as text: a number has a decimal point before its e." if is_number_as_text(value) else ""
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
