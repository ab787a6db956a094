"""Finished runs: from their directories, or, without those, from results that they were aggregated to before."""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import yaml

from benchmarks.config import in_present_names, read_algorithm, resolve, settings_in_present_names
from benchmarks.suite import UNSAID, RunSpec, made_with
from benchmarks.tidy import NEEDED, NO_NOISE, read_tidy

#: What tells a suite's runs apart
NAMES = ["task", "noise", "algorithm", "seed"]
_PARTICULARS = ["environment", "definition", "needs", "history"]


class FinishedRun(NamedTuple):
    """
    What is left of a run, and what its results are made of.

    :param spec: of the run
    :param evaluations: one row per evaluation
    :param arguments: of the algorithm
    :param origins: commit and versions of the processes that made it
    :param seconds: that they took, ``None`` if that is not known
    :param cpus: of the machine
    """

    spec: RunSpec
    evaluations: pd.DataFrame
    arguments: dict[str, Any]
    origins: list[dict[str, Any]]
    seconds: float | None
    cpus: int

    @property
    def name(self) -> str:
        """Its directory, below that of all runs."""
        return name_of(self.spec)


def name_of(spec: RunSpec) -> str:
    """
    :param spec: of a run
    :return: its directory, below that of all runs
    """
    return str(spec.directory(Path()))


def kind_of(spec: RunSpec) -> str:
    """
    :param spec: of a run
    :return: what runs with the same arguments have in common
    """
    return f"{spec.algorithm}, {spec.title}" + ("" if spec.noise is None else f", noise {spec.noise:g}")


def names_of(spec: RunSpec) -> dict[str, Any]:
    """
    :param spec: of a run
    :return: ``NAMES`` -> what a table has there
    """
    shown = {"task": spec.title, "noise": NO_NOISE if spec.noise is None else spec.noise}
    return {name: getattr(spec, name) for name in NAMES} | shown


def particulars_of(spec: RunSpec) -> dict[str, Any]:
    """
    :param spec: of a run
    :return: what not all runs of its suite have: an environment that is no registered task, a definition, needs, a history
    """
    return {name: value for name, value in asdict(spec).items() if name in _PARTICULARS and value is not None}


def settings_of(spec: RunSpec) -> dict[str, Any]:
    """
    :param spec: of a run
    :return: what all runs of its suite have in common
    """
    return {name: value for name, value in asdict(spec).items() if name not in [*NAMES, *_PARTICULARS]}


def read_directory(spec: RunSpec, runs: Path) -> FinishedRun:
    """
    :param spec: of a finished run
    :param runs: directory of all runs
    """
    directory = spec.directory(runs)
    configuration = yaml.safe_load((directory / "config.yaml").read_text())
    return FinishedRun(
        spec,
        pd.read_csv(directory / "evaluations.csv"),
        _recorded_arguments(spec, configuration["arguments"]),
        made_with(configuration),
        json.loads((directory / "timing.json").read_text())["seconds"],
        configuration["cpus"],
    )


class _FormerName(argparse.Action):
    """Of an option, for one release: it does what the present one does, and says so."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, option_string: Any = None) -> None:
        present = "--" + self.dest.replace("_", "-")
        print(f"{parser.prog}: DeprecationWarning: {option_string} is {present} now.", file=sys.stderr)
        setattr(namespace, self.dest, values)


def add_reuse_options(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of a program that counts runs which were made elsewhere, see :func:`read_reused`
    """
    results: dict[str, Any] = {"dest": "reuse_results", "type": Path, "nargs": "+", "default": ()}
    rerun: dict[str, Any] = {"dest": "rerun", "nargs": "+", "default": (), "metavar": "ALGORITHM"}
    parser.add_argument("--reuse-results", **results, help="without a suffix: their runs count where --runs has none")
    parser.add_argument("--rerun", **rerun, help="whose runs in --reuse-results do not count")
    parser.add_argument("--earlier", **results, action=_FormerName, help=argparse.SUPPRESS)
    parser.add_argument("--renewed", **rerun, action=_FormerName, help=argparse.SUPPRESS)


def read_reused(results: Sequence[Path], specs: Sequence[RunSpec], rerun: Sequence[str]) -> dict[str, FinishedRun]:
    """
    :param results: of earlier runs, without a suffix; the later over the earlier ones
    :param specs: of runs that may be among them
    :param rerun: algorithms whose runs do not count
    :return: name -> those that are, see :func:`read_results`
    """
    wanted = [spec for spec in specs if spec.algorithm not in rerun]
    return {name: run for path in results for name, run in read_results(path, wanted).items()}


def read_results(path: Path, specs: Sequence[RunSpec]) -> dict[str, FinishedRun]:
    """
    :param path: of results, without a suffix
    :param specs: of runs that may be among them
    :return: name -> those that are, if they were made with the settings and arguments that the spec has now
    :raises ValueError: if the results do not tell their runs apart
    """
    results = json.loads(path.with_suffix(".json").read_text())
    if "runs" not in results:
        raise ValueError(f"{path}.json does not tell its runs apart: it was aggregated before they could be taken up again.")
    evaluations = dict(list(read_tidy(path.with_suffix(".csv")).drop(columns=NEEDED, errors="ignore").groupby(NAMES)))
    return {name_of(spec): _recorded(spec, results, evaluations) for spec in specs if _is_among(results, spec)}


def _is_among(results: Mapping[str, Any], spec: RunSpec) -> bool:
    if name_of(spec) not in results["runs"]:
        return False
    kind, arguments = resolve(spec)
    recorded = UNSAID | results["settings"], results.get("particulars", {}).get(kind_of(spec), {})
    now = settings_of(spec), particulars_of(spec)
    return in_present_names(kind, results["arguments"][kind_of(spec)]) == arguments and all(
        settings_in_present_names(kind, before) == settings_in_present_names(kind, after)
        for before, after in zip(recorded, now, strict=True)
    )


def _recorded_arguments(spec: RunSpec, recorded: Mapping[str, Any]) -> dict[str, Any]:
    return in_present_names(read_algorithm(spec.algorithm, spec.definition)[0], recorded)


def _recorded(spec: RunSpec, results: Mapping[str, Any], evaluations: Mapping[Any, pd.DataFrame]) -> FinishedRun:
    of_run = results["runs"][name_of(spec)]
    rows = evaluations[tuple(names_of(spec).values())].drop(columns=NAMES).dropna(axis=1, how="all")
    origins = [results["made_with"][index] for index in of_run["made_with"]]
    arguments = _recorded_arguments(spec, results["arguments"][kind_of(spec)])
    return FinishedRun(spec, rows, arguments, origins, of_run["seconds"], results["cpus"])
