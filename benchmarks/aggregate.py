"""
Finished runs of a suite -> a tidy CSV, and scores as JSON::

    python -m benchmarks.aggregate benchmarks/suites/halfcheetah.yml --out benchmarks/results/halfcheetah

A missing run is an error, not a smaller average; ``--complete-cells`` leaves out the suite's cells of which a run is missing,
all of their runs, and names them in the results.  Intervals are stratified bootstraps of 95% (rliable, arXiv 2108.13264).
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from rliable import library as rly
from rliable import metrics

from benchmarks.suite import HERE, RunSpec, read_cells

CELL = ["task", "noise"]
STEADY_FROM = 5_000
BOOTSTRAPS = 2_000


def finished_runs(suite: Path, runs: Path, complete_cells: bool = False) -> tuple[list[RunSpec], list[str]]:
    """
    :param suite: YAML file
    :param runs: directory of all runs
    :param complete_cells: whether a cell of which a run is missing is left out, instead of an error
    :return: the runs to count, and the directories of those that are missing
    :raises FileNotFoundError: naming the runs that are not finished
    :raises ValueError: if a run was made with other settings
    """
    cells = read_cells(suite)
    complete = [cell for cell in cells if all(spec.is_finished(runs) for spec in cell)]
    missing = [str(spec.directory(runs)) for cell in cells for spec in cell if not spec.is_finished(runs)]
    if missing and not (complete_cells and complete):
        raise FileNotFoundError(f"{len(missing)} runs are not finished: {missing}")
    return [spec for cell in complete for spec in cell], missing


def collect(specs: list[RunSpec], runs: Path) -> pd.DataFrame:
    """
    :param specs: of finished runs
    :param runs: directory of all runs
    :return: one row per evaluation: task, noise, algorithm, seed, timesteps, learner, and guider, kl, ... where there are
    """
    frames = []
    for spec in specs:
        columns = {"task": spec.task, "noise": spec.noise, "algorithm": spec.algorithm, "seed": spec.seed}
        frames.append(pd.read_csv(spec.directory(runs) / "evaluations.csv").assign(**columns))
    tidy = pd.concat(frames, ignore_index=True)
    first = [*CELL, "algorithm", "seed"]
    return tidy[[*first, *(column for column in tidy.columns if column not in first)]]


def run_scores(tidy: pd.DataFrame) -> pd.DataFrame:
    """
    :param tidy: see :func:`collect`
    :return: one row per run: final return, mean return over all evaluations (the area under the curve, over its length)
    """
    by_run = tidy.sort_values("timesteps").groupby([*CELL, "algorithm", "seed"], sort=False)
    return by_run.learner.agg(final="last", area="mean").reset_index()


def summarise_cells(tidy: pd.DataFrame, reference: str) -> list[dict[str, Any]]:
    """
    :param tidy: see :func:`collect`
    :param reference: algorithm whose final mean return in the cell is what "steps_to_reference" are counted to
    :return: per task, noise and algorithm: scores with intervals, and how far KL strayed from its target where there is one
    """
    rows = []
    for cell_key, cell in tidy.groupby(CELL, sort=False):
        scores = run_scores(cell)
        of_reference = scores[scores.algorithm == reference].final.mean()
        for algorithm, group in cell.groupby("algorithm", sort=False):
            own = scores[scores.algorithm == algorithm].sort_values("seed")
            rows.append(
                {
                    **dict(zip(CELL, cell_key, strict=True)),
                    "algorithm": algorithm,
                    "seeds": own.seed.tolist(),
                    "final": own.final.round(1).tolist(),
                    "final_mean": round(float(own.final.mean()), 1),
                    "final_iqm": interval(own.final.to_numpy()),
                    "area_iqm": interval(own.area.to_numpy()),
                    "steps_to_reference": steps_to(group, of_reference),
                    **guidance(group),
                }
            )
    return rows


def interval(scores: np.ndarray) -> list[float]:
    """
    :param scores: one per run
    :return: interquartile mean, and the ends of its interval
    """
    point, (low, high) = _estimate({"one": scores[:, None]}, metrics.aggregate_iqm)["one"]
    return [round(value, 1) for value in (point, low, high)]


def steps_to(group: pd.DataFrame, threshold: float) -> int | None:
    """
    :param group: one algorithm in one cell
    :param threshold: a return
    :return: environment steps at the first evaluation where the mean over seeds reaches it, ``None`` if none does
    """
    mean = group.groupby("timesteps").learner.mean()
    reached = mean.index[mean >= threshold]
    return int(reached[0]) if len(reached) else None


def guidance(group: pd.DataFrame) -> dict[str, float]:
    """
    :param group: one algorithm in one cell
    :return: the guider's final return, and KL over its target from ``STEADY_FROM`` steps on, if there are; nothing without
        a guider. A row's KL is the mean since the evaluation before
    """
    if "guider" not in group or group.guider.isna().all():
        return {}
    final = group[group.timesteps == group.timesteps.max()]
    steady = group[group.timesteps > STEADY_FROM]
    ratio = (steady.kl / steady.target_kl).dropna()
    kl = {f"kl_over_target_{name}": round(float(getattr(ratio, name)()), 3) for name in ("min", "mean", "max") if len(ratio)}
    return {"guider_mean": round(float(final.guider.mean()), 1), **kl}


def compare(tidy: pd.DataFrame) -> dict[str, Any]:
    """
    Over all cells together, for the algorithms that every cell has with equally many seeds.

    :param tidy: see :func:`collect`
    :return: interquartile means of final returns over those of the best algorithm's mean in each cell, and each
        algorithm's probability of improvement over each other, with intervals
    """
    scores = run_scores(tidy)
    best = scores.groupby([*CELL, "algorithm"]).final.mean().groupby(CELL).max().rename("best").reset_index()
    scores = scores.merge(best, on=CELL)
    scores["normalised"] = scores.final / scores.best
    cells = scores[CELL].drop_duplicates()
    matrices = {}
    for algorithm, group in scores.groupby("algorithm", sort=False):
        columns = [group.merge(pd.DataFrame([cell]), on=CELL).normalised.to_numpy() for _, cell in cells.iterrows()]
        if len({len(column) for column in columns}) == 1 and len(columns[0]):
            matrices[str(algorithm)] = np.stack(columns, axis=1)
    pairs = {f"{one} over {other}": (matrices[one], matrices[other]) for one in matrices for other in matrices if one != other}
    improvements = _estimate(pairs, metrics.probability_of_improvement) if pairs else {}
    return {
        "normalised_iqm": _rounded(_estimate(matrices, metrics.aggregate_iqm)),
        "probability_of_improvement": _rounded(improvements),
    }


def _estimate(scores: dict[str, Any], metric: Callable[..., float]) -> dict[str, tuple[float, tuple[float, float]]]:
    """Point estimate and interval of a metric, the same for the same scores."""

    def as_array(*arguments: np.ndarray) -> np.ndarray:
        return np.array([metric(*arguments)])

    points, intervals = rly.get_interval_estimates(scores, as_array, reps=BOOTSTRAPS, random_state=np.random.RandomState(0))
    return {name: (float(points[name][0]), (float(intervals[name][0, 0]), float(intervals[name][1, 0]))) for name in scores}


def _rounded(estimates: dict[str, tuple[float, tuple[float, float]]]) -> dict[str, list[float]]:
    return {name: [round(value, 3) for value in (point, low, high)] for name, (point, (low, high)) in estimates.items()}


def origins(suite: Path, specs: list[RunSpec], runs: Path) -> dict[str, Any]:
    """Command, commits and versions of the runs, their arguments and directories, and the hours that they took."""
    configurations = [yaml.safe_load((spec.directory(runs) / "config.yaml").read_text()) for spec in specs]
    seconds = [json.loads((spec.directory(runs) / "timing.json").read_text())["seconds"] for spec in specs]
    return {
        "command": f"python -m benchmarks.launch benchmarks/suites/{suite.name}",
        "commits": sorted({configuration["commit"] for configuration in configurations}),
        "versions": configurations[0]["versions"],
        "cpus": configurations[0]["cpus"],
        "hours": round(sum(seconds) / 3600, 2),
        "seconds_per_run": {"median": round(float(np.median(seconds)), 1), "max": round(max(seconds), 1)},
        "arguments": _arguments_by_algorithm(specs, configurations),
        "directories": [str(spec.directory(Path())) for spec in specs],
    }


def _arguments_by_algorithm(specs: list[RunSpec], configurations: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        f"{spec.algorithm}, {spec.task}, noise {spec.noise:g}": configuration["arguments"]
        for spec, configuration in zip(specs, configurations, strict=True)
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", type=Path)
    parser.add_argument("--runs", type=Path, default=HERE / "runs")
    parser.add_argument("--out", type=Path, required=True, help="path of the results, without a suffix")
    parser.add_argument("--reference", default="sac-asym", help="algorithm to whose final return steps are counted")
    parser.add_argument("--complete-cells", action="store_true", help="leave out cells of which a run is missing")
    options = parser.parse_args()
    specs, missing = finished_runs(options.suite, options.runs, options.complete_cells)
    tidy = collect(specs, options.runs)
    results = {
        **origins(options.suite, specs, options.runs),
        "still_to_run": [str(Path(directory).relative_to(options.runs)) for directory in missing],
        "cells": summarise_cells(tidy, options.reference),
        **compare(tidy),
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    tidy.round(5).to_csv(options.out.with_suffix(".csv"), index=False)
    options.out.with_suffix(".json").write_text(json.dumps(results, indent=1, allow_nan=False))


if __name__ == "__main__":
    main()
