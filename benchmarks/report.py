"""
Aggregated results -> a figure in the paper's layout, a page with curves to hover over, and tables in Markdown::

    python -m benchmarks.report benchmarks/results/halfcheetah

reads ``halfcheetah.csv`` and ``halfcheetah.json`` and writes ``.png`` and ``.html`` beside them.
"""

import argparse
import html
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from plotly import graph_objects
from plotly.subplots import make_subplots

from benchmarks.intervals import mean_interval

matplotlib.use("Agg")
from matplotlib import pyplot as plt

COLORS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#8c564b", "#e377c2", "#7f7f7f")
STEPS, RETURN, NOT_RUN = "environment steps", "return", "not run yet"
WITH_NEEDED = "environment steps, with those of needed runs"
NO_NOISE = -1.0  # in the place of a noise, for environments that are not asked for one
NEEDED = "needed_steps"
_SHOWN_ELSEWHERE = ("cells", "normalised_iqm", "probability_of_improvement", "runs")
STYLE = """
body {font: 15px sans-serif; margin: 2em}
table {border-collapse: collapse; margin: 1em 0}
td, th {border: 1px solid #ccc; padding: 4px 8px}
"""


def curves(group: pd.DataFrame, column: str = "learner") -> pd.DataFrame:
    """
    :param group: one algorithm in one cell
    :param column: what to average
    :return: indexed by environment steps: mean over seeds, and the ends of its interval of 95% by Student's t, which for
        three seeds is 4.3 standard errors to either side; of a single seed there is none, and the ends are the mean
    """
    rows = {step: mean_interval(of_seeds.dropna().to_numpy()) for step, of_seeds in group.groupby("timesteps")[column]}
    found = pd.DataFrame(rows, index=["mean", "low", "high"]).T
    return found.where(np.isfinite(found), found["mean"], axis=0)


def read_tidy(path: Path, own_steps: bool = False) -> pd.DataFrame:
    """
    :param path: of an aggregated CSV
    :param own_steps: whether a run's steps are counted from its own start, not from that of the first run that it needs
    :return: its rows
    """
    tidy = pd.read_csv(path).fillna({"noise": NO_NOISE})
    if own_steps or NEEDED not in tidy:
        return tidy.drop(columns=NEEDED, errors="ignore")
    return tidy.assign(timesteps=tidy.timesteps + tidy[NEEDED])


def steps_label(tidy: pd.DataFrame) -> str:
    """
    :param tidy: see :func:`read_tidy`
    :return: what its timesteps are
    """
    return WITH_NEEDED if NEEDED in tidy else STEPS


def title_of(task: str, noise: float) -> str:
    """
    :param task: of a cell
    :param noise: of a cell
    :return: the cell's title
    """
    return task if noise == NO_NOISE else f"{task}, noise {noise:g}"


def is_wanted(tidy: pd.DataFrame, task: str, noise: float) -> bool:
    """
    :param tidy: as aggregated
    :param task: of a cell
    :param noise: of a cell
    :return: whether there is, or could be, such a cell: tasks with a noise and tasks without one share a figure
    """
    without = (tidy[tidy.task == task].noise == NO_NOISE).unique()
    return (noise == NO_NOISE) in without


def grid(tidy: pd.DataFrame) -> tuple[list[str], list[float], list[str]]:
    """Tasks, noises and algorithms, in the order of the runs."""
    return list(tidy.task.unique()), sorted(tidy.noise.unique()), list(tidy.algorithm.unique())


def palette(algorithms: list[str]) -> dict[str, str]:
    """
    :param algorithms: any number
    :return: a color for each, in the same order
    """
    if len(algorithms) <= len(COLORS):
        return dict(zip(algorithms, COLORS, strict=False))
    hues = matplotlib.colormaps["hsv"]
    return {name: matplotlib.colors.to_hex(hues(index / len(algorithms))) for index, name in enumerate(algorithms)}


def has_guider(group: pd.DataFrame) -> bool:
    """
    :param group: one algorithm in one cell
    """
    return "guider" in group and bool(group.guider.notna().any())


def draw(tidy: pd.DataFrame, path: Path) -> None:
    """
    Tasks across, noises down; mean and interval of the learner, dashes the guider.

    :param tidy: as aggregated
    :param path: of the picture
    """
    tasks, noises, algorithms = grid(tidy)
    size = (4.2 * len(tasks), 3.0 * len(noises))
    figure, axes = plt.subplots(len(noises), len(tasks), figsize=size, layout="constrained", squeeze=False)
    for row, noise in enumerate(noises):
        for column, task in enumerate(tasks):
            axis = axes[row][column]
            cell = tidy[(tidy.task == task) & (tidy.noise == noise)]
            for algorithm, color in palette(algorithms).items():
                group = cell[cell.algorithm == algorithm]
                if group.empty:
                    continue
                learner = curves(group)
                axis.plot(learner.index, learner["mean"], color=color, label=algorithm, linewidth=1.8)
                axis.fill_between(learner.index, learner.low, learner.high, color=color, alpha=0.15, linewidth=0)
                if has_guider(group):
                    guider = curves(group, "guider")
                    axis.plot(guider.index, guider["mean"], color=color, linestyle="--", linewidth=1)
            wanted = is_wanted(tidy, task, noise)
            axis.set(title=title_of(task, noise) if wanted else "", xlabel=steps_label(tidy), ylabel=RETURN)
            if cell.empty:
                axis.set_axis_off()
                axis.text(0.5, 0.5, NOT_RUN if wanted else "", ha="center", transform=axis.transAxes)
    shown = next(axis for axis in axes.flat if axis.get_legend_handles_labels()[0])
    shown.legend(fontsize="small")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def interactive(tidy: pd.DataFrame) -> graph_objects.Figure:
    """
    :param tidy: as aggregated
    :return: the same grid, with each seed's curve; a click on a name switches an algorithm off in all cells
    """
    tasks, noises, algorithms = grid(tidy)
    wanted = {(task, noise): is_wanted(tidy, task, noise) for noise in noises for task in tasks}
    titles = [title_of(*cell) if wanted[cell] else "" for cell in wanted]
    gap = {"vertical_spacing": 0.3 / len(noises), "horizontal_spacing": 0.25 / len(tasks)}  # where names of axes go
    figure = make_subplots(rows=len(noises), cols=len(tasks), subplot_titles=titles, **gap)
    figure.update_xaxes(title_text=steps_label(tidy))
    figure.update_yaxes(title_text=RETURN)
    named: set[str] = set()
    for row, noise in enumerate(noises, start=1):
        for column, task in enumerate(tasks, start=1):
            cell = tidy[(tidy.task == task) & (tidy.noise == noise)]
            if cell.empty:
                place = figure.get_subplot(row, column)  # whose axes no note can refer to, for nothing is drawn in it
                x, y = (sum(axis.domain) / 2 for axis in (place.xaxis, place.yaxis))
                text = NOT_RUN if wanted[task, noise] else ""
                figure.add_annotation(text=text, x=x, y=y, xref="paper", yref="paper", showarrow=False)
                figure.update_xaxes(visible=False, row=row, col=column)
                figure.update_yaxes(visible=False, row=row, col=column)
            for algorithm, color in palette(algorithms).items():
                group = cell[cell.algorithm == algorithm]
                if not group.empty:
                    lines = algorithm_lines(group, algorithm, color)
                    for line in lines:
                        line.showlegend = line.name in (algorithm, guider_of(algorithm)) and line.name not in named
                    named.update(line.name for line in lines)
                    figure.add_traces(lines, rows=row, cols=column)
    figure.update_layout(
        height=340 * len(noises) + 80, hovermode="closest", hoverlabel={"namelength": -1}, template="plotly_white"
    )
    return figure


def guider_of(algorithm: str) -> str:
    """
    :param algorithm: its name
    :return: that of its guider's curve
    """
    return f"{algorithm}, guider"


def algorithm_lines(group: pd.DataFrame, algorithm: str, color: str) -> list[graph_objects.Scatter]:
    """
    :param group: one algorithm in one cell
    :param algorithm: its name
    :param color: its color
    :return: each seed's curve, the interval around the mean as a band, the mean, and the guider's mean in dashes
    """

    def line(x: Any, y: Any, name: str, **style: Any) -> graph_objects.Scatter:
        style = {"mode": "lines", "line": {"color": color}, **style}
        return graph_objects.Scatter(x=x, y=y, name=name, legendgroup=algorithm, **style)

    thin: dict[str, Any] = {
        "mode": "lines+markers",
        "marker": {"size": 3},
        "line": {"color": color, "width": 0.7},
        "opacity": 0.5,
    }
    lines = [line(run.timesteps, run.learner, f"{algorithm}, seed {seed}", **thin) for seed, run in group.groupby("seed")]
    learner = curves(group)
    there, back = list(learner.index), list(learner.index[::-1])
    band: dict[str, Any] = {"fill": "toself", "line": {"color": color, "width": 0}, "opacity": 0.15, "hoverinfo": "skip"}
    lines.append(line(there + back, [*learner.high, *learner.low[::-1]], f"{algorithm}, 95% of the mean", **band))
    lines.append(line(learner.index, learner["mean"], algorithm))
    if has_guider(group):
        guider = curves(group, "guider")["mean"]
        lines.append(line(guider.index, guider, guider_of(algorithm), line={"color": color, "width": 1, "dash": "dash"}))
    return lines


def cells_table(cells: list[dict[str, Any]]) -> str:
    """
    :param cells: as aggregated
    :return: Markdown
    """
    head = ("task", "noise", "algorithm", "learner, each seed", "mean", "IQM [95%]", "guider", "KL / target: min, mean, max")
    rows = []
    for cell in cells:
        iqm, low, high = cell["final_iqm"]
        kl = (
            ", ".join(f"{cell[f'kl_over_target_{name}']:.2f}" for name in ("min", "mean", "max"))
            if "kl_over_target_min" in cell
            else ""
        )
        guider = f"{cell['guider_mean']:.0f}" if "guider_mean" in cell else ""
        seeds = ", ".join(f"{value:.0f}" for value in cell["final"])
        noise = "" if cell["noise"] is None else f"{cell['noise']:g}"
        after = f", after {cell[NEEDED]:,} steps of needed runs" if NEEDED in cell else ""
        first = (cell["task"], noise, cell["algorithm"] + after, seeds, f"{cell['final_mean']:.0f}")
        rows.append((*first, f"{iqm:.0f} [{low:.0f}, {high:.0f}]", guider, kl))
    return markdown(head, rows)


def overall_table(results: dict[str, Any]) -> str:
    """
    :param results: as aggregated
    :return: Markdown
    """
    sections = (("normalised_iqm", "normalised IQM"), ("probability_of_improvement", "probability of improvement"))
    rows = [
        (label, name, f"{value:.2f} [{low:.2f}, {high:.2f}]")
        for key, label in sections
        for name, (value, low, high) in results[key].items()
    ]
    return markdown(("over all cells", "algorithm", "estimate [95%]"), rows)


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """
    :param head: column names
    :param rows: as many texts each
    """
    lines = [tuple(head), tuple("---" for _ in head), *map(tuple, rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def page(tidy: pd.DataFrame, results: dict[str, Any], title: str, runs: str) -> str:
    """
    :param tidy: as aggregated
    :param results: as aggregated
    :param title: of the page
    :param runs: directory of all runs, as seen from the page: where its links to logs go
    :return: HTML that needs nothing else
    """
    tables = "".join(_html_table(table) for table in (cells_table(results["cells"]), overall_table(results)))
    plot = interactive(tidy).to_html(full_html=False, include_plotlyjs=True)
    origin = {key: value for key, value in results.items() if key not in _SHOWN_ELSEWHERE}
    logs = "".join(f"<li>{_link(f'{runs}/{directory}', directory)}</li>" for directory in results["runs"])
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title><style>{STYLE}</style>'
        f"</head><body><h1>{html.escape(title)}</h1>{plot}{tables}<h2>Configuration and versions</h2>"
        f"<pre>{html.escape(json.dumps(origin, indent=1))}</pre><h2>Runs</h2><p>Each with log.txt, its TensorBoard log, "
        f"configuration and model, on the machine that made this page.</p><ul>{logs}</ul></body></html>"
    )


def _link(target: str, text: str) -> str:
    return f'<a href="{html.escape(target, quote=True)}">{html.escape(text)}</a>'


def _html_table(table: str) -> str:
    head, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines())
    tagged = [
        "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells)
        for tag, cells in [("th", head), *(("td", row) for row in rows)]
    ]
    return "<table>" + "".join(f"<tr>{row}</tr>" for row in tagged) + "</table>"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="path of the results, without a suffix")
    parser.add_argument(
        "--runs", type=Path, default=Path(__file__).parent / "runs", help="what the page's links to logs point at"
    )
    parser.add_argument(
        "--own-steps", action="store_true", help="draw a run from its own start, not after those that it needs"
    )
    options = parser.parse_args()
    tidy = read_tidy(options.results.with_suffix(".csv"), options.own_steps)
    results = json.loads(options.results.with_suffix(".json").read_text())
    draw(tidy, options.results.with_suffix(".png"))
    runs = os.path.relpath(options.runs, options.results.parent)
    options.results.with_suffix(".html").write_text(page(tidy, results, options.results.stem, runs))
    print(f"{cells_table(results['cells'])}\n\n{overall_table(results)}")


if __name__ == "__main__":
    main()
