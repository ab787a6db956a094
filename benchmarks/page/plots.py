"""Interactive plots of a suite's results, whose curves can be switched off."""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from plotly import graph_objects
from plotly.subplots import make_subplots

from benchmarks.bootstrap import profile
from benchmarks.intervals import mean_interval
from benchmarks.tidy import NEEDED, NO_NOISE

COLORS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#8c564b", "#e377c2", "#7f7f7f")
STEPS, RETURN, NOT_RUN = "environment steps", "return", "not run yet"
WITH_NEEDED = "environment steps, with those of needed runs"
ROW_HEIGHT, FRAME = 330, 110
Lines = Callable[[pd.DataFrame, str, str], list[graph_objects.Scatter]]


class Plot(NamedTuple):
    """
    One tab of the page.

    :param name: label of the tab
    :param wide: figure for a desktop
    :param narrow: figure for a phone, with the same curves, one cell below the other
    :param caption: explanation of the plot
    """

    name: str
    wide: graph_objects.Figure
    narrow: graph_objects.Figure
    caption: str


def curves(group: pd.DataFrame, column: str = "learner") -> pd.DataFrame:
    """
    :param group: evaluations of one algorithm in one cell
    :param column: name of the column to average
    :return: table indexed by environment steps: "mean" over seeds, and "low" and "high", the ends of its 95% interval by
        Student's t, which for three seeds is 4.3 standard errors to either side; for a single seed both ends are the mean
    """
    rows = {step: mean_interval(of_seeds.dropna().to_numpy()) for step, of_seeds in group.groupby("timesteps")[column]}
    found = pd.DataFrame(rows, index=["mean", "low", "high"]).T
    return found.where(np.isfinite(found), found["mean"], axis=0)


def steps_label(tidy: pd.DataFrame) -> str:
    """
    :param tidy: aggregated evaluations
    :return: label of the axis of environment steps
    """
    return WITH_NEEDED if NEEDED in tidy else STEPS


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


def has_guider(group: pd.DataFrame) -> bool:
    """
    :param group: evaluations of one algorithm in one cell
    :return: whether the algorithm's guider was evaluated
    """
    return "guider" in group and bool(group.guider.notna().any())


def guider_of(algorithm: str) -> str:
    """
    :param algorithm: name of an algorithm
    :return: name of the curve of the algorithm's guider
    """
    return f"{algorithm}, guider"


def _line(algorithm: str, x: Any, y: Any, name: str, **style: Any) -> graph_objects.Scatter:
    return graph_objects.Scatter(x=list(x), y=list(y), name=name, legendgroup=algorithm, **{"mode": "lines", **style})


def algorithm_lines(group: pd.DataFrame, algorithm: str, color: str) -> list[graph_objects.Scatter]:
    """
    :param group: evaluations of one algorithm in one cell
    :param algorithm: name of the algorithm
    :param color: color of the algorithm
    :return: curve of each seed, interval of the mean as a band, mean, and the guider's mean in dashes. Where the pointer is,
        the mean shows its interval and each seed's return
    """
    thin: dict[str, Any] = {"line": {"color": color, "width": 0.7}, "opacity": 0.5, "hoverinfo": "skip"}
    runs = group.groupby("seed")
    lines = [_line(algorithm, run.timesteps, run.learner, f"{algorithm}, seed {seed}", **thin) for seed, run in runs]
    learner = curves(group)
    there, back = list(learner.index), list(learner.index[::-1])
    band: dict[str, Any] = {"fill": "toself", "line": {"color": color, "width": 0}, "opacity": 0.15, "hoverinfo": "skip"}
    lines.append(_line(algorithm, there + back, [*learner.high, *learner.low[::-1]], f"{algorithm}, 95% of the mean", **band))
    lines.append(_line(algorithm, learner.index, learner["mean"], algorithm, **_told(group, learner, color)))
    if has_guider(group):
        guider = curves(group, "guider")["mean"]
        dashes = {"line": {"color": color, "width": 1, "dash": "dash"}, "hovertemplate": "%{y:,.4~g}"}
        lines.append(_line(algorithm, guider.index, guider, guider_of(algorithm), **dashes))
    return lines


def _told(group: pd.DataFrame, learner: pd.DataFrame, color: str) -> dict[str, Any]:
    """The style of the mean's curve, and the text that is shown where the pointer is."""
    at_steps = group.groupby("timesteps").learner
    several = [
        [f"{low:,.4g} to {high:,.4g}", ", ".join(f"{value:,.4g}" for value in at_steps.get_group(step))]
        for step, low, high in zip(learner.index, learner.low, learner.high, strict=True)
    ]
    text = "%{y:,.4~g}  (%{customdata[0]}; seeds %{customdata[1]})"
    return {"line": {"color": color}, "customdata": several, "hovertemplate": text}


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
    return figure.update_layout(**_frame(rows))


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


def _frame(rows: int) -> dict[str, Any]:
    return {
        "height": ROW_HEIGHT * rows + FRAME,
        "hovermode": "x unified",
        "hoverlabel": {"namelength": -1},
        "legend": {"orientation": "h", "yref": "container", "y": 1, "yanchor": "top"},
        "margin": {"l": 60, "r": 20, "t": 90, "b": 50},
        "template": "plotly_white",
    }


def interactive(tidy: pd.DataFrame, one_column: bool = False, to_run: Collection[str] | None = None) -> graph_objects.Figure:
    """
    :param tidy: aggregated evaluations
    :param one_column: whether cells are below each other, see :func:`in_cells`
    :param to_run: names of runs that are not made yet, see :func:`is_wanted`
    :return: figure of the returns over environment steps
    """
    return in_cells(tidy, algorithm_lines, RETURN, steps_label(tidy), one_column, to_run)


def _mean_line(column: str, group: pd.DataFrame, algorithm: str, color: str) -> list[graph_objects.Scatter]:
    """The curve of a column's mean over seeds; none if the algorithm has no such column."""
    if column not in group or group[column].isna().all():
        return []
    mean = group.groupby("timesteps")[column].mean()
    line = {"line": {"color": color}, "hovertemplate": "%{y:,.4~g}"}
    return [_line(algorithm, mean.index, mean, algorithm, **line)]


def _plot(
    name: str,
    tidy: pd.DataFrame,
    lines_of: Lines,
    y_title: str,
    x_title: str,
    caption: str,
    to_run: Collection[str] | None = None,
) -> Plot:
    wide, narrow = (in_cells(tidy, lines_of, y_title, x_title, one_column, to_run) for one_column in (False, True))
    return Plot(name, wide, narrow, caption)


def plots(
    tidy: pd.DataFrame,
    seconds: Mapping[str, float],
    normalised: pd.DataFrame,
    to_run: Collection[str] | None = None,
) -> list[Plot]:
    """
    :param tidy: aggregated evaluations
    :param seconds: run's name -> seconds that the run took; if it is empty, there is no plot over seconds
    :param normalised: table with one row for each run: "algorithm", and the "normalised" final return
    :param to_run: names of runs that are not made yet, see :func:`is_wanted`
    :return: plots for which there are data, one for each tab
    """
    steps = steps_label(tidy)
    drawn = [_plot("Returns", tidy, algorithm_lines, RETURN, steps, _RETURNS, to_run)]
    timed = over_seconds(tidy, seconds)
    if not timed.empty:
        drawn.append(_plot("Returns over seconds", timed, algorithm_lines, RETURN, "seconds of one core", _SECONDS, to_run))
    if has_guider(tidy):
        gap = tidy.assign(gap=tidy.guider - tidy.learner).dropna(subset="gap")
        lines = partial(_mean_line, "gap")
        drawn.append(_plot("Guider over learner", gap, lines, "guider's return - learner's", steps, _GAP, to_run))
    if {"kl", "target_kl"} <= set(tidy) and tidy.kl.notna().any():
        ratio = tidy.assign(ratio=tidy.kl / tidy.target_kl).dropna(subset="ratio")
        drawn.append(_plot("KL", ratio, partial(_mean_line, "ratio"), "KL / target_kl", steps, _KL, to_run))
    if not normalised.empty:
        drawn.append(_profile(normalised))
    return drawn


_RETURNS = (
    "Return of what is deployed, at evaluations on environments that training never sees. Lines are means over seeds, thin "
    "lines the seeds, bands 95% intervals of the mean by Student's t, cut off beyond the runs; dashes are the guider, which "
    "sees the privileged entries too. A click on a name switches an algorithm off."
)
_SECONDS = (
    "The same over the time that a run took on one core, evaluations included; a run's seconds are spread evenly over its "
    "steps. Lines end where a run ended. Runs may have shared their machine with others."
)
_GAP = "How much more the guider returns than the learner, by the same evaluations: what the learner can't do (imitation gap)."
_KL = "KL(guider || learner) over its target, mean over seeds: 1 where the constraint holds."
_PROFILE = (
    "Performance profile: the share of all runs, in all cells, that end above a score; 0 is the lowest point of any mean "
    "curve in the cell, 1 its best algorithm's mean end. The higher line is the better algorithm. Bands are 95% bootstrap "
    "intervals."
)


def over_seconds(tidy: pd.DataFrame, seconds: Mapping[str, float]) -> pd.DataFrame:
    """
    :param tidy: aggregated evaluations
    :param seconds: run's name -> seconds that the run took
    :return: evaluations of the runs whose seconds are known; in place of environment steps, ``timesteps`` has the seconds up
        to that step, as a mean over the algorithm's runs in the cell
    """
    keys = ["task", "noise", "algorithm", "seed"]
    found = {key: taken for key, _ in tidy.groupby(keys) if (taken := _of_run(key, seconds)) is not None}
    rows = tidy[[tuple(row) in found for row in tidy[keys].itertuples(index=False)]].drop(columns=NEEDED, errors="ignore")
    if rows.empty:
        return rows
    taken = pd.Series([found[tuple(row)] for row in rows[keys].itertuples(index=False)], index=rows.index)
    mean = taken.groupby([rows[key] for key in keys[:3]]).transform("mean")
    last = rows.groupby(keys).timesteps.transform("max")
    return rows.assign(timesteps=(mean * rows.timesteps / last).round(2))


def _of_run(key: Any, seconds: Mapping[str, float]) -> float | None:
    task, noise, algorithm, seed = key
    end = f"/{folder_of(task, noise)}/{algorithm}/seed{seed}"
    return next((taken for name, taken in seconds.items() if taken is not None and name.endswith(end)), None)


def _profile(normalised: pd.DataFrame) -> Plot:
    scores = np.linspace(min(0.0, normalised.normalised.min()), max(1.0, normalised.normalised.max()), 61)
    figure = graph_objects.Figure()
    of_algorithms = {str(name): group.normalised.to_numpy() for name, group in normalised.groupby("algorithm", sort=False)}
    found = profile(of_algorithms, scores)
    for name, color in palette(list(of_algorithms)).items():
        share, low, high = found[name]
        band: dict[str, Any] = {"fill": "toself", "line": {"color": color, "width": 0}, "opacity": 0.15, "hoverinfo": "skip"}
        around = _line(name, [*scores, *scores[::-1]], [*high, *low[::-1]], f"{name}, 95%", showlegend=False, **band)
        figure.add_traces([around, _line(name, scores, share, name, line={"color": color}, hovertemplate="%{y:.0%}")])
    figure.update_layout(xaxis_title="normalised score", yaxis_title="share of runs above it", **_frame(1))
    figure.update_yaxes(tickformat=".0%")
    return Plot("Performance profile", figure, figure, _PROFILE)
