"""A suite: which algorithms, on which tasks, at which noise levels, with which seeds. Read from YAML, checked by name."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

HERE = Path(__file__).parent
HYPERPARAMS = HERE / "hyperparams"
_SUITE_KEYS = {"steps", "envs", "preset", "eval_every", "eval_episodes", "overrides", "cells"}
_CELL_KEYS = {"task", "noises", "algorithms", "seeds"}


@dataclass(frozen=True)
class RunSpec:
    """
    One training run.

    :param algorithm: a name in ``hyperparams/algorithms.yml``
    :param task: as in ``sb3_gac/<task>-v5``
    :param noise: standard deviation of the sensor noise
    :param seed: of everything random
    :param steps: environment steps
    :param envs: environments side by side
    :param preset: a name in ``hyperparams/presets``, the arguments to start from
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
        return root / f"{self.task}-noise{self.noise:g}" / self.algorithm / f"seed{self.seed}"


def read_suite(path: Path) -> list[RunSpec]:
    """
    :param path: YAML file
    :return: its runs; all seeds of a cell before the next cell
    :raises ValueError: if a key is unknown or missing
    """
    suite = yaml.safe_load(path.read_text())
    if "preset" in suite:
        suite = {**read_preset(suite["preset"])["run"], **suite}
    check_keys(path.name, suite, _SUITE_KEYS, _SUITE_KEYS - {"overrides"})
    return [spec for cell in suite["cells"] for spec in _cell_runs(path.name, suite, cell)]


def _cell_runs(name: str, suite: dict[str, Any], cell: dict[str, Any]) -> Iterator[RunSpec]:
    check_keys(f"{name}, a cell", cell, _CELL_KEYS, _CELL_KEYS)
    common = {key: suite[key] for key in ("steps", "envs", "preset", "eval_every", "eval_episodes")}
    for noise in cell["noises"]:
        for seed in cell["seeds"]:
            for algorithm in cell["algorithms"]:
                overrides = suite.get("overrides", {})
                yield RunSpec(algorithm, cell["task"], float(noise), seed, overrides=overrides, **common)


def read_preset(name: str) -> dict[str, Any]:
    """
    :param name: of a file in ``hyperparams/presets``
    :return: its ``run`` settings, ``arguments`` and ``tasks``
    :raises ValueError: if there is no such preset, or it has unknown keys
    """
    path = HYPERPARAMS / "presets" / f"{name}.yml"
    if not path.exists():
        raise ValueError(f"preset must be one of {sorted(p.stem for p in path.parent.glob('*.yml'))}, got {name!r}.")
    preset = yaml.safe_load(path.read_text())
    check_keys(path.name, preset, {"run", "arguments", "tasks"}, {"run", "arguments"})
    check_keys(f"{path.name}, run", preset["run"], {"envs", "steps"}, set())
    for task, settings in preset.get("tasks", {}).items():
        check_keys(f"{path.name}, {task}", settings, {"arguments", "noises"}, set())
    return preset


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
