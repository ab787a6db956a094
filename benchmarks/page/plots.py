"""Interactive plots of a suite's results, whose curves can be switched off."""

from collections.abc import Collection, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from plotly import graph_objects

from benchmarks.bootstrap import profile
from benchmarks.intervals import mean_interval
from benchmarks.page.cells import Lines, folder_of, frame, guider_of, in_cells, palette
from benchmarks.tidy import NEEDED, with_needed_steps

STEPS, RETURN = "environment steps", "return"
WITH_NEEDED = "environment steps, with those of needed runs"


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


def has_guider(group: pd.DataFrame) -> bool:
    """
    :param group: evaluations of one algorithm in one cell
    :return: whether the algorithm's guider was evaluated
    """
    return "guider" in group and bool(group.guider.notna().any())


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
    :param tidy: aggregated evaluations, with each run's own environment steps; over steps, a run is drawn after those that it
        needs, where the column ``needed_steps`` is there
    :param seconds: run's name -> seconds that the run took; if it is empty, there is no plot over seconds
    :param normalised: table with one row for each run: "algorithm", and the "normalised" final return
    :param to_run: names of runs that are not made yet, see :func:`is_wanted`
    :return: plots for which there are data, one for each tab
    """
    timed, tidy, steps = over_seconds(tidy, seconds), with_needed_steps(tidy), steps_label(tidy)
    drawn = [_plot("Returns", tidy, algorithm_lines, RETURN, steps, _RETURNS, to_run)]
    if not timed.empty:
        drawn.append(_plot("Returns over seconds", timed, algorithm_lines, RETURN, "seconds of one core", _SECONDS, to_run))
    if has_guider(tidy):
        gap = tidy.assign(gap=tidy.guider - tidy.learner).dropna(subset="gap")
        lines = partial(_mean_line, "gap")
        drawn.append(_plot("Guider over learner", gap, lines, "guider's return - learner's", steps, _GAP, to_run))
    if {"kl", "target_kl"} <= set(tidy):
        ratio = tidy.assign(ratio=tidy.kl / tidy.target_kl).dropna(subset="ratio")
        if not ratio.empty:
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
    :param tidy: aggregated evaluations, with each run's own environment steps
    :param seconds: run's name -> seconds that the run took, without those of the runs that it needs
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
    figure.update_layout(xaxis_title="normalised score", yaxis_title="share of runs above it", **frame(1))
    figure.update_yaxes(tickformat=".0%")
    return Plot("Performance profile", figure, figure, _PROFILE)
