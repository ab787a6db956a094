"""Finished runs, read from their directories or from the results into which they were aggregated before."""

import argparse
import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import pandas as pd
import yaml

from benchmarks.config import normalization, read_algorithm, resolve
from benchmarks.recorded import in_present_names, settings_in_present_names, with_defaults
from benchmarks.suite import UNSAID, RunSpec, made_with
from benchmarks.tidy import NAMES, NEEDED, NO_NOISE, file_of, read_tidy

_PARTICULARS = ["environment", "definition", "needs", "history"]
#: Infinite number -> YAML's word for it, in JSON, which has no such numbers; and the reverse
_WORDS = {math.inf: ".inf", -math.inf: "-.inf"}
_INFINITE = {word: number for number, word in _WORDS.items()}


#: Keyword arguments of ``VecNormalize``, or ``False`` where nothing is normalised
Normalize: TypeAlias = dict[str, Any] | bool


class FinishedRun(NamedTuple):
    """
    The records of a finished run, from which results are made.

    :param spec: settings of the run
    :param evaluations: table with one row for each evaluation
    :param arguments: arguments of the algorithm
    :param origins: commit and versions of the processes that made the run, one entry for each distinct combination
    :param seconds: seconds that the run took, ``None`` if they were not recorded
    :param cpus: number of CPUs of the machine
    :param normalize: keyword arguments of the ``VecNormalize`` around the run's environments, ``False`` without one, ``None``
        if they were not recorded
    """

    spec: RunSpec
    evaluations: pd.DataFrame
    arguments: dict[str, Any]
    origins: list[dict[str, Any]]
    seconds: float | None
    cpus: int
    normalize: Normalize | None = None

    @property
    def name(self) -> str:
        """The run's directory, relative to that of all runs."""
        return name_of(self.spec)


def name_of(spec: RunSpec) -> str:
    """
    :param spec: settings of a run
    :return: the run's directory, relative to that of all runs
    """
    return str(spec.directory(Path()))


def kind_of(spec: RunSpec) -> str:
    """
    :param spec: settings of a run
    :return: name of the algorithm in the cell, which all seeds share: such as "gac, Hopper, noise 0.1"
    """
    return f"{spec.algorithm}, {spec.title}" + ("" if spec.noise is None else f", noise {spec.noise:g}")


def names_of(spec: RunSpec) -> dict[str, Any]:
    """
    :param spec: settings of a run
    :return: each of ``NAMES`` -> the run's value in that column of a table
    """
    shown = {"task": spec.title, "noise": NO_NOISE if spec.noise is None else spec.noise}
    return {name: getattr(spec, name) for name in NAMES} | shown


def particulars_of(spec: RunSpec) -> dict[str, Any]:
    """
    :param spec: settings of a run
    :return: settings that not all runs of its suite share, if the run has them: an environment that is no registered task, a
        definition, needs and a history
    """
    return {name: value for name, value in asdict(spec).items() if name in _PARTICULARS and value is not None}


def settings_of(spec: RunSpec) -> dict[str, Any]:
    """
    :param spec: settings of a run
    :return: settings that all runs of its suite share
    """
    return {name: value for name, value in asdict(spec).items() if name not in [*NAMES, *_PARTICULARS]}


def is_finished(spec: RunSpec, runs: Path) -> bool:
    """
    :param spec: settings of a run
    :param runs: directory of all runs
    :return: whether this run has been finished there
    :raises ValueError: if its directory holds a finished run with other settings, arguments or normalisation
    """
    directory = spec.directory(runs)
    if not (directory / "evaluations.csv").exists():
        return False
    if changed := _changed(spec, yaml.safe_load((directory / "config.yaml").read_text(encoding="utf-8"))):
        hint = "remove it, or use another directory (--runs, or --out of a comparison)"
        raise ValueError(f"{directory} holds a run with other settings under {changed}: {hint}.")
    return True


def _changed(spec: RunSpec, configuration: Mapping[str, Any]) -> list[str]:
    """The names of what a run's configuration has with another value than the suite, such as "arguments.tau"."""
    kind, arguments = resolve(spec)
    recorded, wanted = (settings_in_present_names(kind, one) for one in (UNSAID | configuration["run"], asdict(spec)))
    changed = sorted(name for name, value in wanted.items() if recorded.get(name) != value)
    if (made_of := configuration.get("arguments")) is not None:
        changed += conflicts("arguments", with_defaults(kind, in_present_names(kind, made_of), arguments), arguments)
    return changed + ["normalize"] * (_normalize_in(configuration) != normalize_of(spec))


def conflicts(name: str, recorded: Any, other: Any) -> list[str]:
    """
    Compare recorded arguments with others. One that was not recorded has no other value: see
    :func:`~benchmarks.recorded.with_defaults` for the value that it had.

    :param name: name of the arguments, with which the names that are returned begin
    :param recorded: arguments as they were recorded, or one of them
    :param other: arguments to compare with, or one of them
    :return: names of the recorded arguments that the others lack, or have with another value
    """
    if not (isinstance(recorded, Mapping) and isinstance(other, Mapping)):
        return [name] if recorded != other else []
    lacking = [f"{name}.{key}" for key in recorded if key not in other]
    return lacking + [
        found for key in recorded if key in other for found in conflicts(f"{name}.{key}", recorded[key], other[key])
    ]


def normalize_of(spec: RunSpec) -> Normalize:
    """
    :param spec: settings of a run
    :return: keyword arguments of the ``VecNormalize`` around its environments, ``False`` without one
    """
    options = normalization(spec)
    return False if options is None else dict(options)


def _normalize_in(configuration: Mapping[str, Any]) -> Normalize:
    normalize: Normalize = configuration.get("normalize", False)  # a run without normalisation has no such key
    return normalize


def read_directory(spec: RunSpec, runs: Path) -> FinishedRun:
    """
    :param spec: settings of a finished run
    :param runs: directory of all runs
    :return: records of the run
    """
    directory = spec.directory(runs)
    configuration = yaml.safe_load((directory / "config.yaml").read_text(encoding="utf-8"))
    return FinishedRun(
        spec,
        pd.read_csv(directory / "evaluations.csv"),
        _recorded_arguments(spec, configuration["arguments"]),
        made_with(configuration),
        json.loads((directory / "timing.json").read_text(encoding="utf-8"))["seconds"],
        configuration["cpus"],
        _normalize_in(configuration),
    )


class _FormerName(argparse.Action):
    """The former name of an option, kept for one release: it works as the present one, and prints a warning."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, option_string: Any = None) -> None:
        present = "--" + self.dest.replace("_", "-")
        print(f"{parser.prog}: DeprecationWarning: {option_string} is {present} now.", file=sys.stderr)
        setattr(namespace, self.dest, values)


def add_reuse_options(parser: argparse.ArgumentParser) -> None:
    """
    Add ``--reuse-results`` and ``--rerun``.

    :param parser: parser of a program that counts runs which were made elsewhere, see :func:`read_reused`
    """
    results: dict[str, Any] = {"dest": "reuse_results", "type": Path, "nargs": "+", "default": ()}
    rerun: dict[str, Any] = {"dest": "rerun", "nargs": "+", "default": (), "metavar": "ALGORITHM"}
    parser.add_argument("--reuse-results", **results, help="without a suffix: their runs count where --runs has none")
    parser.add_argument("--rerun", **rerun, help="whose runs in --reuse-results do not count")
    parser.add_argument("--earlier", **results, action=_FormerName, help=argparse.SUPPRESS)
    parser.add_argument("--renewed", **rerun, action=_FormerName, help=argparse.SUPPRESS)


def read_reused(results: Sequence[Path], specs: Sequence[RunSpec], rerun: Sequence[str]) -> dict[str, FinishedRun]:
    """
    :param results: paths of results, without a suffix; where two have the same run, the later path counts
    :param specs: settings of the runs to look for
    :param rerun: names of the algorithms whose runs do not count
    :return: run's name -> records of each run that was found, see :func:`read_results`
    :raises ValueError: if none of the runs is of an algorithm in ``rerun``
    """
    names = sorted({spec.algorithm for spec in specs})
    if unknown := sorted(set(rerun) - set(names)):
        raise ValueError(f"--rerun: the suite has no algorithms {unknown}; it has {names}.")
    wanted = [spec for spec in specs if spec.algorithm not in rerun]
    return {name: run for path in results for name, run in read_results(path, wanted).items()}


def as_json(value: Any) -> Any:
    """
    :param value: value of which a results' file is made
    :return: the same with YAML's words for infinite numbers, which JSON has not
    """
    return _each(lambda one: _WORDS.get(one, one) if isinstance(one, float) else one, value)


def from_json(value: Any) -> Any:
    """
    :param value: value from a results' file
    :return: value that :func:`as_json` was given
    """
    return _each(lambda one: _INFINITE.get(one, one) if isinstance(one, str) else one, value)


def _each(change: Callable[[Any], Any], value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _each(change, part) for key, part in value.items()}
    return [_each(change, part) for part in value] if isinstance(value, (list, tuple)) else change(value)


def read_results(path: Path, specs: Sequence[RunSpec]) -> dict[str, FinishedRun]:
    """
    :param path: path of results, without a suffix
    :param specs: settings of the runs to look for
    :return: run's name -> records of each run that was found, if it was made with the settings and arguments of today's suite
    :raises ValueError: if the results have no record of single runs
    """
    results = from_json(json.loads(file_of(path, "json").read_text(encoding="utf-8")))
    if "runs" not in results:
        raise ValueError(
            f"{file_of(path, 'json')} does not tell its runs apart: it was aggregated before they could be taken up again."
        )
    evaluations = dict(list(read_tidy(file_of(path, "csv")).drop(columns=NEEDED, errors="ignore").groupby(NAMES)))
    found = ((spec, _record_of(spec, results)) for spec in specs)
    return {
        name_of(spec): _recorded(spec, record, evaluations, results["cpus"])
        for spec, record in found
        if record is not None and _is_as_now(spec, results["settings"], record)
    }


def record_of(run: FinishedRun) -> dict[str, Any]:
    """
    :param run: records of a finished run that does not count in results
    :return: all that :func:`read_results` needs to count the run another time
    """
    rows = run.evaluations.astype(object)
    return {
        "seconds": run.seconds,
        "cpus": run.cpus,
        "origins": run.origins,
        "arguments": run.arguments,
        "particulars": particulars_of(run.spec),
        "normalize": run.normalize,
        "evaluations": rows.where(rows.notna(), None).to_dict(orient="list"),  # JSON has no NaN
    }


def _record_of(spec: RunSpec, results: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The records of a run in results, as :func:`record_of` writes them; a run that counts has its evaluations elsewhere."""
    name, kind = name_of(spec), kind_of(spec)
    if name not in results["runs"]:
        aside: Mapping[str, Any] | None = results.get("set_aside", {}).get(name)
        return aside
    of_run = results["runs"][name]
    return {
        "seconds": of_run["seconds"],
        **({"cpus": of_run["cpus"]} if "cpus" in of_run else {}),  # where the machines of the runs differ
        "origins": [results["made_with"][index] for index in of_run["made_with"]],
        "arguments": results["arguments"][kind],
        "particulars": results.get("particulars", {}).get(kind, {}),
        "normalize": results.get("normalize", {}).get(kind),  # earlier results have no record of it
    }


def _is_as_now(spec: RunSpec, settings: dict[str, Any], record: Mapping[str, Any]) -> bool:
    """Whether a run was made with the settings and arguments of today's suite."""
    kind, arguments = resolve(spec)
    recorded = UNSAID | settings, record["particulars"]
    now = settings_of(spec), particulars_of(spec)
    if record["normalize"] is not None and record["normalize"] != normalize_of(spec):
        return False
    return in_present_names(kind, record["arguments"]) == arguments and all(
        settings_in_present_names(kind, before) == settings_in_present_names(kind, after)
        for before, after in zip(recorded, now, strict=True)
    )


def _recorded_arguments(spec: RunSpec, recorded: Mapping[str, Any]) -> dict[str, Any]:
    return in_present_names(read_algorithm(spec.algorithm, spec.definition)[0], recorded)


def _recorded(spec: RunSpec, record: Mapping[str, Any], evaluations: Mapping[Any, pd.DataFrame], cpus: int) -> FinishedRun:
    if "evaluations" in record:
        rows = pd.DataFrame(record["evaluations"])
    else:
        rows = evaluations[tuple(names_of(spec).values())].drop(columns=NAMES).dropna(axis=1, how="all")
    arguments = _recorded_arguments(spec, record["arguments"])
    return FinishedRun(
        spec, rows, arguments, record["origins"], record["seconds"], record.get("cpus", cpus), record["normalize"]
    )
