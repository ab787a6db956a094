"""The cells of a figure, a task at a noise each: which there are, their titles, colors and axes."""

from collections.abc import Callable, Collection, Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from plotly import graph_objects
from plotly.subplots import make_subplots

from benchmarks.tidy import NO_NOISE

COLORS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#8c564b", "#e377c2", "#7f7f7f")
NOT_RUN = "not run yet"
ROW_HEIGHT, FRAME = 330, 110
Lines = Callable[[pd.DataFrame, str, str], list[graph_objects.Scatter]]


def title_of(task: str, noise: float) -> str:
    """
    :param task: title of the cell's task
    :param noise: standard deviation of the cell's sensor noise, or ``NO_NOISE``
    :return: title of the cell
    """
    return task if noise == NO_NOISE else f"{task}, noise {noise:g}"


def folder_of(task: str, noise: float) -> str:
    """
    :param task: title of a cell's task
    :param noise: standard deviation of the cell's sensor noise, or ``NO_NOISE``
    :return: folder of the cell's runs, a part of their names
    """
    return task if noise == NO_NOISE else f"{task}-noise{noise:g}"


def is_wanted(tidy: pd.DataFrame, task: str, noise: float, to_run: Collection[str] | None = None) -> bool:
    """
    :param tidy: aggregated evaluations
    :param task: title of the cell's task
    :param noise: standard deviation of the cell's sensor noise, or ``NO_NOISE``
    :param to_run: names of the suite's runs that are not made yet; ``None`` where they are not known
    :return: whether such a cell exists or is still to run; a figure of tasks by noises has places for other cells too
    """
    if ((tidy.task == task) & (tidy.noise == noise)).any():
        return True
    if to_run is not None:
        return any(f"/{folder_of(task, noise)}/" in name for name in to_run)
    without = (tidy[tidy.task == task].noise == NO_NOISE).unique()
    return (noise == NO_NOISE) in without


def grid(tidy: pd.DataFrame) -> tuple[list[str], list[float], list[str]]:
    """
    :param tidy: aggregated evaluations
    :return: tasks in the order of the runs, sorted noises, and algorithms in the order of the runs
    """
    return list(tidy.task.unique()), sorted(tidy.noise.unique()), list(tidy.algorithm.unique())


def palette(algorithms: list[str]) -> dict[str, str]:
    """
    :param algorithms: names of algorithms, any number
    :return: algorithm -> its color, in the same order
    """
    if len(algorithms) <= len(COLORS):
        return dict(zip(algorithms, COLORS, strict=False))
    distinct = matplotlib.colormaps["tab20"].colors if len(algorithms) <= 20 else None  # type: ignore[attr-defined]
    hues = distinct or [matplotlib.colormaps["hsv"](index / len(algorithms)) for index in range(len(algorithms))]
    return {name: matplotlib.colors.to_hex(color) for name, color in zip(algorithms, hues, strict=False)}


def guider_of(algorithm: str) -> str:
    """
    :param algorithm: name of an algorithm
    :return: name of the curve of the algorithm's guider
    """
    return f"{algorithm}, guider"


def in_cells(
    tidy: pd.DataFrame,
    lines_of: Lines,
    y_title: str,
    x_title: str,
    one_column: bool = False,
    to_run: Collection[str] | None = None,
) -> graph_objects.Figure:
    """
    :param tidy: aggregated evaluations
    :param lines_of: function of the evaluations of one algorithm in one cell, its name and its color that returns its curves
    :param y_title: title of all vertical axes
    :param x_title: title of all horizontal axes
    :param one_column: whether cells are below each other; otherwise tasks are across and noises down
    :param to_run: names of runs that are not made yet, see :func:`is_wanted`
    :return: figure with the curves of each cell; a click on a name switches an algorithm off in all cells
    """
    tasks, noises, algorithms = grid(tidy)
    cells = {(task, noise): is_wanted(tidy, task, noise, to_run) for noise in noises for task in tasks}
    titles = [title_of(*cell) if wanted else "" for cell, wanted in cells.items()]
    columns = 1 if one_column else len(tasks)
    rows = len(cells) // columns
    gap = {"vertical_spacing": 0.3 / rows, "horizontal_spacing": 0.28 / columns}  # room for the titles of axes
    figure = make_subplots(rows=rows, cols=columns, subplot_titles=titles, **gap)
    figure.update_xaxes(title_text=x_title)
    figure.update_yaxes(title_text=y_title)
    named: set[str] = set()
    for place, ((task, noise), wanted) in enumerate(cells.items()):
        row, column = place // columns + 1, place % columns + 1
        cell = tidy[(tidy.task == task) & (tidy.noise == noise)]
        if cell.empty:
            _say(figure, row, column, NOT_RUN if wanted else "")
        for algorithm, color in palette(algorithms).items():
            group = cell[cell.algorithm == algorithm]
            lines = lines_of(group, algorithm, color) if not group.empty else []
            for line in lines:
                line.showlegend = line.name in (algorithm, guider_of(algorithm)) and line.name not in named
            named.update(line.name for line in lines)
            figure.add_traces(lines, rows=row, cols=column)
        if not cell.empty:
            figure.update_yaxes(range=_range(figure, place), row=row, col=column)
    return figure.update_layout(**frame(rows))


def _range(figure: graph_objects.Figure, place: int) -> tuple[float, float]:
    axis = "y" if place == 0 else f"y{place + 1}"
    return _around([line.y for line in figure.data if line.yaxis == axis and line.fill is None])


def returns_range(cell: pd.DataFrame) -> tuple[float, float]:
    """
    :param cell: evaluations of one cell
    :return: lower and upper limit of an axis that shows all runs; intervals of few seeds are cut off where they reach further
    """
    return _around([cell[column] for column in ("learner", "guider") if column in cell])


def _around(values: Sequence[Any]) -> tuple[float, float]:
    together = np.concatenate([np.asarray(one, dtype=float) for one in values] or [np.array([0.0, 1.0])])
    low, high = float(np.nanmin(together)), float(np.nanmax(together))
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin


def _say(figure: graph_objects.Figure, row: int, column: int, text: str) -> None:
    """Write a text in the place of a cell's curves. A note cannot refer to axes in which nothing is drawn."""
    place = figure.get_subplot(row, column)
    x, y = (sum(axis.domain) / 2 for axis in (place.xaxis, place.yaxis))
    figure.add_annotation(text=text, x=x, y=y, xref="paper", yref="paper", showarrow=False)
    figure.update_xaxes(visible=False, row=row, col=column)
    figure.update_yaxes(visible=False, row=row, col=column)


def frame(rows: int) -> dict[str, Any]:
    """
    :param rows: number of rows of cells
    :return: options of plotly's layout that all figures of the page share
    """
    return {
        "height": ROW_HEIGHT * rows + FRAME,
        "hovermode": "x unified",
        "hoverlabel": {"namelength": -1},
        "legend": {"orientation": "h", "yref": "container", "y": 1, "yanchor": "top"},
        "margin": {"l": 60, "r": 20, "t": 90, "b": 50},
        "template": "plotly_white",
    }
