"""
Aggregates the finished runs of a suite into a tidy CSV file, and into scores as JSON::

    python -m benchmarks.aggregate benchmarks/suites/halfcheetah.yml --out benchmarks/results/halfcheetah

A missing run is an error, since an average over fewer runs would hide it.  ``--complete-cells`` leaves out all runs of the
suite's cells in which a run is missing.  The results name the missing runs, and keep the finished ones that were left out.
``--reuse-results`` takes runs whose directories are elsewhere, or gone, from the results into which they were aggregated.
Intervals are stratified bootstraps of 95% (rliable, arXiv 2108.13264).
"""

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from rliable import metrics

from benchmarks.bootstrap import Estimate, estimate, improvements, interval
from benchmarks.checkpoint import write_together
from benchmarks.finished import (
    FinishedRun,
    add_reuse_options,
    as_json,
    is_finished,
    kind_of,
    name_of,
    names_of,
    particulars_of,
    read_directory,
    read_reused,
    record_of,
    settings_of,
)
from benchmarks.run_checks import check_finite, check_same_settings, with_equal_returns
from benchmarks.suite import HERE, RUNS, needed_steps, read_cells
from benchmarks.tidy import (
    CELL,
    NAMES,
    NEEDED,
    NO_NOISE,
    as_csv,
    file_of,
    normalised_scores,
    read_tidy,
    run_scores,
    significant,
    steps_before,
)

REFERENCE = "sac-asym"
STEADY_FROM = 5_000


class Found(NamedTuple):
    """
    The runs of a suite.

    :param counted: records of the finished runs that count
    :param missing: names of the runs that are not finished
    :param set_aside: records of the finished runs that do not count, because another run of their cell is missing
    """

    counted: list[FinishedRun]
    missing: list[str]
    set_aside: list[FinishedRun]


def finished_runs(
    suite: Path, runs: Path, complete_cells: bool = False, reuse: Sequence[Path] = (), rerun: Sequence[str] = ()
) -> Found:
    """
    :param suite: YAML file of the suite
    :param runs: directory of all runs
    :param complete_cells: whether a cell in which a run is missing is left out; otherwise a missing run is an error
    :param reuse: paths of results, without a suffix, whose runs count where a run has no directory; where two have the same
        run, the later path counts
    :param rerun: names of the algorithms whose runs in ``reuse`` do not count
    :return: runs that count, those that are missing, and those that are set aside
    :raises FileNotFoundError: naming the runs that are not finished, if they may not be left out or no cell is complete
    :raises ValueError: if a run was made with other settings
    """
    cells = read_cells(suite)
    specs = [spec for cell in cells for spec in cell]
    found = read_reused(reuse, specs, rerun)
    found |= {name_of(spec): read_directory(spec, runs) for spec in specs if is_finished(spec, runs)}
    missing = [name for name in map(name_of, specs) if name not in found]
    names = [[name_of(spec) for spec in cell] for cell in cells]
    complete = [found[name] for cell in names if set(cell) <= set(found) for name in cell]
    if missing and not (complete_cells and complete):
        raise FileNotFoundError(f"{len(missing)} runs are not finished in {runs}: {missing}")
    counted = {run.name for run in complete}
    return Found(complete, missing, [run for name, run in found.items() if name not in counted])


def _about_set_aside(runs: Sequence[FinishedRun]) -> list[str]:
    names = [run.name for run in runs]
    return [f"{len(names)} finished runs are set aside, since other runs of their cells are missing: {names}"] if names else []


def collect(runs: list[FinishedRun]) -> pd.DataFrame:
    """
    :param runs: records of finished runs
    :return: table with one row for each evaluation: task, noise, algorithm, seed, timesteps, learner, and where they exist
        guider, kl and others; where a run needs other runs, ``needed_steps`` has their environment steps, which ``timesteps``
        does not contain
    """
    before = {run.name: needed_steps(run.spec) for run in runs}
    of_needed = {name: {NEEDED: steps} if any(before.values()) else {} for name, steps in before.items()}
    frames = [run.evaluations.assign(**names_of(run.spec), **of_needed[run.name]) for run in runs]
    tidy = pd.concat(frames, ignore_index=True)
    return tidy[[*NAMES, *(column for column in tidy.columns if column not in NAMES)]]


def choose_reference(algorithms: list[str], wanted: str | None = None) -> str:
    """
    :param algorithms: names of all algorithms
    :param wanted: name of the reference, ``None`` for ``REFERENCE`` if it is among the algorithms, and otherwise the first
    :return: name of the reference
    :raises ValueError: if the wanted reference is not among the algorithms
    """
    if wanted is None:
        return REFERENCE if REFERENCE in algorithms else algorithms[0]
    if wanted not in algorithms:
        raise ValueError(f"reference must be one of {algorithms}, got {wanted!r}.")
    return wanted


def summarise_cells(tidy: pd.DataFrame, reference: str) -> list[dict[str, Any]]:
    """
    :param tidy: evaluations, see :func:`collect`
    :param reference: name of the algorithm whose final mean return in a cell is the threshold of "steps_to_reference"
    :return: one row for each task, noise and algorithm: scores with intervals, and where there is a target for the KL, the KL
        as multiples of it
    """
    rows = []
    for cell_key, cell in tidy.groupby(CELL, sort=False):
        scores = run_scores(cell)
        of_reference = float(scores[scores.algorithm == reference].final.mean())
        for algorithm, group in cell.groupby("algorithm", sort=False):
            own = scores[scores.algorithm == algorithm].sort_values("seed")
            rows.append(
                {
                    **_named(cell_key),
                    "algorithm": algorithm,
                    **({NEEDED: steps_before(group)} if steps_before(group) else {}),
                    "seeds": own.seed.tolist(),
                    "final": list(map(significant, own.final)),
                    "final_mean": significant(own.final.mean()),
                    "final_iqm": list(map(significant, interval(own.final.to_numpy()))),
                    "area_iqm": list(map(significant, interval(own.area.to_numpy()))),
                    "steps_to_reference": steps_to(group, of_reference),
                    **guidance(group),
                }
            )
    return rows


def _named(cell_key: Any) -> dict[str, Any]:
    task, noise = cell_key
    return {"task": task, "noise": None if noise == NO_NOISE else noise}


def steps_to(group: pd.DataFrame, threshold: float) -> int | None:
    """
    :param group: evaluations of one algorithm in one cell
    :param threshold: return to reach
    :return: environment steps, those of needed runs included, at the first evaluation whose mean over seeds reaches the
        threshold; ``None`` if no evaluation reaches it
    """
    mean = group.groupby("timesteps").learner.mean()
    # The mean of the same returns may differ in its last digit, by the order in which they are summed up
    reached = mean.index[(mean >= threshold) | np.isclose(mean, threshold, rtol=1e-9, atol=0)]
    return int(reached[0]) + steps_before(group) if len(reached) else None


def guidance(group: pd.DataFrame) -> dict[str, float]:
    """
    :param group: evaluations of one algorithm in one cell
    :return: mean final return of the guider, and the least, mean and largest ratio of the KL to its target after
        ``STEADY_FROM`` steps, if there are any; empty without a guider. An evaluation's KL is the mean since the one before
    """
    if "guider" not in group or group.guider.isna().all():
        return {}
    final = group[group.timesteps == group.timesteps.max()]
    steady = group[group.timesteps > STEADY_FROM].reindex(
        columns=["kl", "target_kl"]
    )  # before the first gradient step no algorithm has these columns
    ratio = (steady.kl / steady.target_kl).dropna()
    kl = {f"kl_over_target_{name}": round(float(getattr(ratio, name)()), 3) for name in ("min", "mean", "max") if len(ratio)}
    return {"guider_mean": significant(final.guider.mean()), **kl}


def compare(tidy: pd.DataFrame) -> dict[str, Any]:
    """
    Compare over all cells together the algorithms that every cell has. All of them count with equally many runs in every cell:
    the smallest number of runs of any algorithm in any cell, those with the first seeds.

    :param tidy: evaluations, see :func:`collect`
    :return: "compared", the algorithms, cells and seeds that were compared; "normalised_iqm", interquartile means of the
        normalised final returns; and "probability_of_improvement" of each algorithm over each other. The last two have
        intervals
    """
    scores = normalised_scores(tidy)
    counts = scores.pivot_table("seed", CELL, "algorithm", aggfunc="count")
    names = [name for name in scores.algorithm.unique() if counts[name].notna().all()]
    runs = int(counts[names].min().min()) if names else 0
    compared = scores[scores.algorithm.isin(names)].sort_values("seed", kind="stable")
    compared = compared.groupby([*CELL, "algorithm"], sort=False).head(runs)
    matrices = {name: _runs_by_cell(compared[compared.algorithm == name]) for name in names}
    return {
        "compared": {
            "algorithms": names,
            "left_out": [name for name in scores.algorithm.unique() if name not in names],
            "cells": _compared_cells(compared),
        },
        "normalised_iqm": _rounded(estimate(matrices, metrics.aggregate_iqm)),
        "probability_of_improvement": _rounded(improvements(matrices)),
    }


def _runs_by_cell(of_algorithm: pd.DataFrame) -> np.ndarray:
    return np.stack([cell.normalised.to_numpy() for _, cell in of_algorithm.groupby(CELL)], axis=1)


def _compared_cells(compared: pd.DataFrame) -> list[dict[str, Any]]:
    """For each cell, the seeds of each algorithm, and the returns that are normalised to 0 and 1."""
    return [
        {
            **_named(key),
            "low": significant(cell.low.iloc[0]),
            "high": significant(cell.high.iloc[0]),
            "seeds": {str(name): group.seed.tolist() for name, group in cell.groupby("algorithm", sort=False)},
        }
        for key, cell in compared.groupby(CELL)
    ]


def _rounded(estimates: dict[str, Estimate]) -> dict[str, list[float]]:
    return {name: [round(value, 3) for value in (point, low, high)] for name, (point, (low, high)) in estimates.items()}


def command(options: argparse.Namespace) -> str:
    """
    :param options: command-line options of this program
    :return: shell command that makes the missing runs and then the same results, in the checkout
    """
    shared = [_from_checkout(options.suite), *_option("--runs", [options.runs] if options.runs != RUNS else [])]
    shared += [*_option("--reuse-results", options.reuse_results), *_option("--rerun", options.rerun)]
    own = [*_option("--reference", [options.reference] if options.reference else []), *_option("--out", [options.out])]
    own += ["--complete-cells"] * options.complete_cells
    made = [["benchmarks.launch", *shared], ["benchmarks.aggregate", *shared, *own]]
    return " && ".join(shlex.join(["python", "-m", *words]) for words in made)


def _option(name: str, values: Sequence[str | Path]) -> list[str]:
    texts = [_from_checkout(value) if isinstance(value, Path) else value for value in values]
    return [name, *texts] if texts else []


def _from_checkout(path: Path) -> str:
    path = path.resolve()
    return str(path.relative_to(HERE.parent) if path.is_relative_to(HERE.parent) else path)


def origins(runs: list[FinishedRun]) -> dict[str, Any]:
    """
    :param runs: records of finished runs
    :return: commits and versions of the runs, their settings, arguments and normalisation, and the hours that they took
    :raises ValueError: if seeds of one algorithm in one cell were made with other arguments
    """
    check_same_settings(runs)
    made_with = _distinct([origin for run in runs for origin in run.origins])
    seconds = [run.seconds for run in runs if run.seconds is not None]
    cpus = {run.cpus for run in runs}
    particulars = {kind_of(run.spec): found for run in runs if (found := particulars_of(run.spec))}
    return {
        "made_with": made_with,
        "mixed_runs": [run.name for run in runs if len(run.origins) > 1],
        "cpus": max(cpus),
        "hours": round(sum(seconds) / 3600, 2),
        "timed_runs": len(seconds),
        "seconds_per_run": {"median": round(float(np.median(seconds)), 1), "max": round(max(seconds), 1)} if seconds else {},
        "settings": settings_of(runs[0].spec),
        "arguments": {kind_of(run.spec): run.arguments for run in runs},
        "normalize": {kind_of(run.spec): run.normalize for run in runs if run.normalize is not None},
        **({"particulars": particulars} if particulars else {}),
        "runs": {
            run.name: {
                "seconds": run.seconds,
                "made_with": [made_with.index(origin) for origin in run.origins],
                **({"cpus": run.cpus} if len(cpus) > 1 else {}),
            }
            for run in runs
        },
    }


def _distinct(origins_of_runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [origin for index, origin in enumerate(origins_of_runs) if origin not in origins_of_runs[:index]]


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Entry point of the command line.

    :param arguments: command-line arguments, by default those of the process
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.aggregate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("suite", type=Path, help="YAML file of the suite")
    parser.add_argument("--runs", type=Path, default=RUNS, help="directory of all runs (default: benchmarks/runs)")
    parser.add_argument("--out", type=Path, required=True, help="path of the results, without a suffix")
    parser.add_argument("--reference", help=f"to whose final return steps are counted: {REFERENCE}, or the first, by default")
    parser.add_argument("--complete-cells", action="store_true", help="leave out cells of which a run is missing")
    add_reuse_options(parser)
    options = parser.parse_args(arguments)
    try:
        found = finished_runs(options.suite, options.runs, options.complete_cells, options.reuse_results, options.rerun)
        runs = found.counted
        check_finite(runs)
        reference = choose_reference(list(dict.fromkeys(run.spec.algorithm for run in runs)), options.reference)
        made = origins(runs)
    except (ValueError, OSError) as error:
        sys.exit(str(error))
    text = as_csv(collect(runs))
    tidy = read_tidy(StringIO(text))  # so that the scores can be computed from the file to the last digit
    equal = with_equal_returns(tidy)
    for sentence in [*equal, *_about_set_aside(found.set_aside)]:
        print(sentence, file=sys.stderr)
    results = {
        "command": command(options),
        **made,
        "still_to_run": found.missing,
        "set_aside": {run.name: record_of(run) for run in found.set_aside},
        "equal_returns": equal,
        "reference": reference,
        "cells": summarise_cells(tidy, reference),
        **compare(tidy),
    }
    record = json.dumps(as_json(results), indent=1, allow_nan=False)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_together({file_of(options.out, "csv"): text, file_of(options.out, "json"): record})


if __name__ == "__main__":
    main()
