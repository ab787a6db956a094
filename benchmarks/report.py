"""
Draws aggregated results as a figure in the paper's layout and as a page with interactive curves, and prints tables::

    python -m benchmarks.report benchmarks/results/halfcheetah

The command reads ``halfcheetah.csv`` and ``halfcheetah.json``. Beside them, it writes the figure as ``.png``, ``.pdf`` and
``.svg``, and the page as ``.html``. The tables are in Markdown.
"""

import argparse
import json
import math
import os
import sys
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from benchmarks.intervals import mean_interval
from benchmarks.page.cells import NOT_RUN, grid, is_wanted, palette, returns_range, title_of
from benchmarks.page.digits import with_all_digits
from benchmarks.page.document import page
from benchmarks.page.plots import RETURN, curves, has_guider, steps_label
from benchmarks.page.plots import interactive as interactive  # the plot of returns on the page, a figure of plotly
from benchmarks.page.summary import about_intervals, seeds_compared
from benchmarks.page.tables import SAME_MEAN
from benchmarks.tidy import NEEDED, after_needed, file_of, number, read_tidy, with_needed_steps

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FORMATS = ("png", "pdf", "svg")
#: Largest number of runs in a cell whose lines a reader can follow
MOST_RUNS = 50


def draw(tidy: pd.DataFrame, paths: Sequence[Path], to_run: Collection[str] | None = None) -> None:
    """
    Draw the figure: tasks across, noises down; each run's learner in a thin line, where there are few enough to follow, the
    mean of the learners with its interval, and the mean of the guiders in dashes.

    :param tidy: aggregated evaluations
    :param paths: files of the figure; a suffix names the file's format
    :param to_run: names of the suite's runs that are not made yet; ``None`` where they are not known
    """
    tasks, noises, algorithms = grid(tidy)
    size = (max(4.2 * len(tasks), 6.0), 3.0 * len(noises))
    figure, axes = plt.subplots(len(noises), len(tasks), figsize=size, layout="constrained", squeeze=False)
    for row, noise in enumerate(noises):
        for column, task in enumerate(tasks):
            axis = axes[row][column]
            cell = tidy[(tidy.task == task) & (tidy.noise == noise)]
            draws_runs = cell.groupby(["algorithm", "seed"]).ngroups <= MOST_RUNS
            for algorithm, color in palette(algorithms).items():
                group = cell[cell.algorithm == algorithm]
                if group.empty:
                    continue
                for _, run in group.groupby("seed") if draws_runs else ():
                    axis.plot(run.timesteps, run.learner, color=color, linewidth=0.6, alpha=0.5)
                learner = curves(group)
                axis.plot(learner.index, learner["mean"], color=color, label=algorithm, linewidth=1.8)
                axis.fill_between(learner.index, learner.low, learner.high, color=color, alpha=0.15, linewidth=0)
                if has_guider(group):
                    guider = curves(group, "guider")
                    axis.plot(guider.index, guider["mean"], color=color, linestyle="--", linewidth=1)
            if not cell.empty:
                axis.set_ylim(returns_range(cell))
            wanted = is_wanted(tidy, task, noise, to_run)
            axis.set(title=title_of(task, noise) if wanted else "", xlabel=steps_label(tidy), ylabel=RETURN)
            axis.xaxis.set_major_formatter(EngFormatter(sep=""))  # 50k is as wide as its place, 50000 is not
            if cell.empty:
                axis.set_axis_off()
                axis.text(0.5, 0.5, NOT_RUN if wanted else "", ha="center", transform=axis.transAxes)
    shown = {label: line for axis in axes.flat for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    names = [name for name in algorithms if name in shown]
    _legend_below(figure, {name: shown[name] for name in names})
    for path in paths:
        figure.savefig(path, dpi=110)
    plt.close(figure)


def _legend_below(figure: Figure, lines: Mapping[str, Artist]) -> None:
    """Put a legend below the axes, with as many names side by side as the figure has room for."""
    for columns in range(len(lines), 0, -1):
        legend = figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=columns, fontsize="small")
        if legend.get_window_extent().width <= figure.bbox.width or columns == 1:
            rows = -(-len(lines) // columns)
            more = legend.get_window_extent().height / figure.dpi * (rows - 1) / rows  # so that the axes keep their height
            figure.set_figheight(figure.get_figheight() + more)
            return
        legend.remove()


def cells_table(cells: list[dict[str, Any]]) -> str:
    """
    :param cells: "cells" of the aggregated results: one mapping for each algorithm in each cell
    :return: Markdown table of the final returns
    """
    returns = ("learner, each seed", "mean [95%]", "IQM [95%]", "guider")
    head = ("task", "noise", "algorithm", *returns, "KL / target: min, mean, max")
    plain = partial(number, thousands="")
    rows = []
    for cell in cells:
        kl = (
            ", ".join(f"{cell[f'kl_over_target_{name}']:.2f}" for name in ("min", "mean", "max"))
            if "kl_over_target_min" in cell
            else ""
        )
        guider = plain(cell["guider_mean"]) if "guider_mean" in cell else ""
        seeds = ", ".join(map(plain, cell["final"]))
        noise = "" if cell["noise"] is None else f"{cell['noise']:g}"
        mean = _with_interval(mean_interval(np.array(cell["final"], dtype=float)))
        iqm = _with_interval(cell["final_iqm"]) if len(cell["final"]) > SAME_MEAN else ""
        rows.append((cell["task"], noise, after_needed(cell["algorithm"], cell.get(NEEDED, 0)), seeds, mean, iqm, guider, kl))
    return markdown(head, rows)


def _with_interval(estimate: Sequence[float]) -> str:
    value, low, high = (number(part, thousands="") for part in estimate)
    return value if math.isinf(estimate[1]) else f"{value} [{low}, {high}]"


def overall_table(results: dict[str, Any]) -> str:
    """
    :param results: aggregated results
    :return: Markdown table of the comparisons over all cells, with a sentence where the intervals are of few seeds
    """
    sections = (("normalised_iqm", "normalised IQM"), ("probability_of_improvement", "probability of improvement"))
    several = seeds_compared(results) > 1
    rows = [
        (label, name, f"{value:.2f}" + (f" [{low:.2f}, {high:.2f}]" if several else ""))
        for key, label in sections
        for name, (value, low, high) in results[key].items()
    ]
    table = markdown(("over all cells", "algorithm", "estimate [95%]"), rows)
    note = about_intervals(results)
    return f"{table}\n\n{note}" if note else table


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """
    :param head: names of the columns
    :param rows: rows, each with one text for each column
    :return: Markdown table
    """
    lines = [tuple(head), tuple("---" for _ in head), *map(tuple, rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    """Entry point of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="path of the results, without a suffix")
    parser.add_argument(
        "--runs", type=Path, default=Path(__file__).parent / "runs", help="what the page's links to logs point at"
    )
    parser.add_argument(
        "--own-steps", action="store_true", help="draw a run from its own start, not after those that it needs"
    )
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=FORMATS, help="of the figure (default: all)")
    options = parser.parse_args()
    try:
        tidy = read_tidy(file_of(options.results, "csv"))
        results = with_all_digits(json.loads(file_of(options.results, "json").read_text(encoding="utf-8")), tidy)
    except OSError as error:
        sys.exit(str(error))
    if options.own_steps:
        tidy = tidy.drop(columns=NEEDED, errors="ignore")
    draw(
        with_needed_steps(tidy), [file_of(options.results, suffix) for suffix in options.formats], results.get("still_to_run")
    )
    runs = os.path.relpath(options.runs, options.results.parent)
    file_of(options.results, "html").write_text(page(tidy, results, options.results.name, runs), encoding="utf-8")
    print(f"{cells_table(results['cells'])}\n\n{overall_table(results)}")


if __name__ == "__main__":
    main()
