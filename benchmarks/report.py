"""
Finished runs of a suite -> a tidy CSV, a summary as JSON and Markdown, and a figure::

    python -m benchmarks.report benchmarks/suites/halfcheetah.yml --out benchmarks/results/halfcheetah

A missing run is an error, not a smaller average.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
import yaml

from benchmarks.suite import HERE, read_suite

matplotlib.use("Agg")
from matplotlib import pyplot as plt

CELL = ["task", "noise", "algorithm"]


def collect(suite: Path, runs: Path) -> pd.DataFrame:
    """
    :param suite: YAML file
    :param runs: directory of all runs
    :return: one row per evaluation: task, noise, algorithm, seed, timesteps, learner, guider, kl, ...
    :raises FileNotFoundError: naming the runs that are not finished
    """
    specs = read_suite(suite)
    paths = [spec.directory(runs) / "evaluations.csv" for spec in specs]
    missing = [str(path.parent) for path in paths if not path.exists()]
    if missing:
        raise FileNotFoundError(f"{len(missing)} runs are not finished: {missing}")
    frames = []
    for spec, path in zip(specs, paths, strict=True):
        columns = {"task": spec.task, "noise": spec.noise, "algorithm": spec.algorithm, "seed": spec.seed}
        frames.append(pd.read_csv(path).assign(**columns))
    tidy = pd.concat(frames, ignore_index=True)
    return tidy[[*CELL, "seed", *(column for column in tidy.columns if column not in (*CELL, "seed"))]]


def summarise(tidy: pd.DataFrame) -> list[dict[str, Any]]:
    """
    :param tidy: see :func:`collect`
    :return: per task, noise and algorithm: final returns per seed and their mean, and how far KL strayed from its target
    """
    rows = []
    for key, cell in tidy.groupby(CELL, sort=False):
        final = cell[cell.timesteps == cell.timesteps.max()].sort_values("seed")
        steady = cell[cell.timesteps >= 5_000]
        rows.append(
            {
                **dict(zip(CELL, key, strict=True)),
                "learner": final.learner.round(1).tolist(),
                "learner_mean": round(float(final.learner.mean()), 1),
                "guider_mean": round(float(final.guider.mean()), 1),
                "learner_mean_over_training": round(float(cell.learner.mean()), 1),
                "kl_over_target_min": round(float((steady.kl / steady.target_kl).min()), 3),
                "kl_over_target_mean": round(float((steady.kl / steady.target_kl).mean()), 3),
                "kl_over_target_max": round(float((steady.kl / steady.target_kl).max()), 3),
            }
        )
    return rows


def draw(tidy: pd.DataFrame, path: Path) -> None:
    """
    Returns above, KL over its target below, one column per task and noise; thin lines are seeds, dashes the guider.

    :param tidy: see :func:`collect`
    :param path: of the picture
    """
    cells = list(tidy.groupby(["task", "noise"], sort=False))
    figure, axes = plt.subplots(2, len(cells), figsize=(4.5 * len(cells), 6), layout="constrained", squeeze=False)
    for (returns, kl), ((task, noise), cell) in zip(axes.T, cells, strict=True):
        for color, (algorithm, group) in zip(
            matplotlib.color_sequences["tab10"], cell.groupby("algorithm", sort=False), strict=False
        ):
            mean = group.groupby("timesteps").mean(numeric_only=True)
            returns.plot(mean.index, mean.learner, color=color, label=f"{algorithm}, learner", linewidth=2)
            returns.plot(mean.index, mean.guider, color=color, label=f"{algorithm}, guider", linestyle="--")
            for _, run in group.groupby("seed"):
                returns.plot(run.timesteps, run.learner, color=color, linewidth=0.6, alpha=0.6)
                kl.plot(run.timesteps, run.kl / run.target_kl, color=color, linewidth=0.8)
        kl.axhline(1.0, color="black", linestyle=":")
        returns.set(title=f"{task}, noise {noise:g}", ylabel="return")
        kl.set(xlabel="environment steps", ylabel="KL / target", yscale="log", ylim=(0.3, 30))
    axes[0][0].legend(fontsize="small")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def markdown_table(summary: list[dict[str, Any]]) -> str:
    """
    :param summary: see :func:`summarise`
    """
    lines = [
        "| task | noise | algorithm | learner, each seed | mean | guider, mean | KL / target from 5k steps: min, mean, max |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in summary:
        seeds = ", ".join(f"{value:.0f}" for value in row["learner"])
        kl = ", ".join(f"{row[f'kl_over_target_{name}']:.2f}" for name in ("min", "mean", "max"))
        lines.append(
            f"| {row['task']} | {row['noise']:g} | {row['algorithm']} | {seeds} | {row['learner_mean']:.0f} "
            f"| {row['guider_mean']:.0f} | {kl} |"
        )
    return "\n".join(lines)


def origins(suite: Path, runs: Path) -> dict[str, Any]:
    """Commits and versions of the runs, and the command."""
    configurations = [yaml.safe_load((spec.directory(runs) / "config.yaml").read_text()) for spec in read_suite(suite)]
    seconds = [json.loads((spec.directory(runs) / "timing.json").read_text())["seconds"] for spec in read_suite(suite)]
    return {
        "command": f"python -m benchmarks.launch benchmarks/suites/{suite.name}",
        "commits": sorted({configuration["commit"] for configuration in configurations}),
        "versions": configurations[0]["versions"],
        "cpus": configurations[0]["cpus"],
        "seconds_per_run": {"median": float(np.median(seconds)), "max": max(seconds)},
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", type=Path)
    parser.add_argument("--runs", type=Path, default=HERE / "runs")
    parser.add_argument("--out", type=Path, required=True, help="path of the results, without a suffix")
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    tidy = collect(options.suite, options.runs)
    summary = summarise(tidy)
    tidy.round(5).to_csv(options.out.with_suffix(".csv"), index=False)
    results = {**origins(options.suite, options.runs), "summary": summary}
    options.out.with_suffix(".json").write_text(json.dumps(results, indent=1))
    draw(tidy, options.out.with_suffix(".png"))
    print(markdown_table(summary))


if __name__ == "__main__":
    main()
