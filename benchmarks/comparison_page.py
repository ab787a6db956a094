"""The page of a comparison: a recommendation in words, above the returns and differences that it follows from."""

import html
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from plotly import graph_objects

from benchmarks.advice import counted, findings, in_words, recommendation, title
from benchmarks.headroom import Worth, headroom_curve
from benchmarks.intervals import CONFIDENCE, Difference, mean_interval
from benchmarks.page.cells import palette, title_of
from benchmarks.page.document import document, tabs
from benchmarks.page.plots import RETURN, STEPS, Plot, algorithm_lines
from benchmarks.page.tables import Field, table
from benchmarks.tidy import after_needed, number, with_needed_steps

_FRAME = {
    "template": "plotly_white",
    "height": 430,
    "margin": {"l": 60, "r": 20, "t": 20, "b": 90},
    "hovermode": "x unified",
    "hoverlabel": {"namelength": -1},
    "legend": {"orientation": "h", "y": -0.22},
}
#: First part of training whose returns the axis need not hold
HIDDEN = 0.25
_RETURNS = (
    "Mean return of what is deployed, over all seeds. Bands hold the mean with 95% confidence by Student's t; those of two "
    "seeds would hide the plot, and are in the table alone. Thin lines are the seeds, dashes the guider. A click on a name "
    "switches it off. The axis fits the last three quarters of training; a double click shows all."
)
_HEADROOM = (
    "Headroom over training: SAC on the full state over SAC-asym at the same step, with its interval. Above 0, seeing more "
    "would return more."
)


def page(tidy: pd.DataFrame, found: Worth, command: str, results: Path, steps: int) -> str:
    """
    :param tidy: evaluations of the task
    :param found: conclusions from the evaluations
    :param command: shell command that makes the comparison again
    :param results: JSON file of the aggregated results
    :param steps: environment steps of each run
    :return: HTML of the page, which needs no other file
    """
    task = title_of(str(tidy.task.iloc[0]), float(tidy.noise.iloc[0]))
    verdict = "".join(f"<p>{html.escape(text)}</p>" for text in recommendation(found, steps))
    told = "".join(f"<li>{html.escape(text)}</li>" for text in findings(found))
    plots = [_plot("Returns", _curves(with_needed_steps(tidy), found.floor, found.untrained[found.floor][0]), _RETURNS)]
    if found.headroom is not None:
        plots.append(_plot("Headroom", _headroom(tidy), _HEADROOM))
    heading = f"{task}: what privileged information is worth"
    body = (
        f"<h1>{html.escape(heading)}</h1><div class=short>{verdict}</div><ul>{told}</ul>{tabs(plots)}"
        f"<h2>Returns</h2>{_ends_table(found)}<h2>Differences</h2>{_differences_table(found)}"
        f"{_how(found, command, results, steps)}"
    )
    return document(heading, body)


def _plot(name: str, figure: graph_objects.Figure, caption: str) -> Plot:
    return Plot(name, figure, figure, caption)


def _curves(tidy: pd.DataFrame, floor: str, floor_return: float) -> graph_objects.Figure:
    figure = graph_objects.Figure()
    tidy = tidy.assign(algorithm=tidy.algorithm.map(title))
    for algorithm, color in palette(list(tidy.algorithm.unique())).items():
        runs = tidy[tidy.algorithm == algorithm]
        lines = [line for line in algorithm_lines(runs, algorithm, color) if not line.fill or runs.seed.nunique() > 2]
        for line in lines:
            line.showlegend = line.name == algorithm
        figure.add_traces(lines)
    ends = [tidy.timesteps.min(), tidy.timesteps.max()]
    style: dict[str, Any] = {"mode": "lines", "line": {"color": "#888", "width": 1, "dash": "dot"}, "hoverinfo": "skip"}
    figure.add_scatter(x=ends, y=[floor_return] * 2, name=f"{floor}, without training", **style)
    shown = _shown(tidy, floor_return)
    return figure.update_layout(xaxis_title=STEPS, yaxis_title=RETURN, yaxis_range=shown, **_FRAME)


def _shown(tidy: pd.DataFrame, floor_return: float) -> tuple[float, float]:
    """The ends of the axis of returns: without the first quarter of training, whose falls would flatten all that follows."""
    late = tidy[tidy.timesteps >= HIDDEN * tidy.timesteps.max()]
    values = np.append(late[[name for name in ("learner", "guider") if name in late]].to_numpy(float), floor_return)
    low, high = np.nanmin(values), np.nanmax(values)
    margin = 0.08 * (high - low) or 1.0
    return low - margin, high + margin


def _headroom(tidy: pd.DataFrame) -> graph_objects.Figure:
    curve = headroom_curve(tidy)
    there, back = list(curve.timesteps), list(curve.timesteps[::-1])
    figure = graph_objects.Figure()
    if not any(map(math.isinf, curve.low)):
        band = {"fill": "toself", "line": {"color": "#1f77b4", "width": 0}, "opacity": 0.15, "hoverinfo": "skip"}
        figure.add_scatter(x=there + back, y=[*curve.high, *curve.low[::-1]], mode="lines", showlegend=False, **band)
    figure.add_scatter(x=there, y=curve.value, mode="lines", line={"color": "#1f77b4"}, name="headroom", showlegend=False)
    figure.add_hline(y=0, line={"color": "#888", "width": 1})
    return figure.update_layout(xaxis_title=STEPS, yaxis_title="headroom (return)", **_FRAME)


def _ends_table(found: Worth) -> str:
    learned = [name for name in found.deployable or found.ends if name in found.learned]
    best = max(learned, key=lambda name: float(found.ends[name].mean()), default=None)
    rows = []
    for name, ends in sorted(found.ends.items(), key=lambda item: -float(item[1].mean())):
        mean, low, high = mean_interval(ends)
        interval = "one seed" if math.isinf(low) else f"{number(low)} to {number(high)}"
        seeds, curve = ", ".join(map(number, ends)), float(found.areas[name].mean())
        shown = after_needed(title(name), found.needed.get(name, 0))
        fields = [Field(shown), _return(mean), Field(interval), Field(seeds), _return(curve)]
        rows.append((fields, name == best))
    for name, (mean, low, high) in found.untrained.items():
        interval = f"{number(low)} to {number(high)}"
        rows.append(([Field(f"{name}, without training"), _return(mean), Field(interval), Field(""), Field("")], False))
    head = ["algorithm", "mean at the end", f"{CONFIDENCE:.0%} interval", "each seed at the end", "mean of the whole curve"]
    return table(head, rows)


def _return(value: float) -> Field:
    return Field(number(value), value)


def _differences_table(found: Worth) -> str:
    questions: list[tuple[str, Difference | None]] = [
        ("headroom: privileged entries at deployment too", found.headroom),
        ("privileged entries in training, for critics", found.in_training),
        ("a guider on top", found.guider),
    ]
    rows = [
        ([Field(question), Field(f"{title(one.better)} - {title(one.other)}"), Field(in_words(found, one))], False)
        for question, one in questions
        if one is not None
    ]
    return table(["what it is worth", "difference at the end", "return"], rows, sortable=False)


def _how(found: Worth, command: str, results: Path, steps: int) -> str:
    made = json.loads(results.read_text(encoding="utf-8"))
    seeds = max(len(end) for end in found.ends.values())
    origin = {
        key: made[key]
        for key in ("made_with", "cpus", "hours", "settings", "arguments", "normalize", "particulars")
        if key in made
    }
    more = "; ".join(after_needed(title(name), number) for name, number in found.needed.items())
    needed = f" ({more})" if more else ""
    return (
        f"<h2>How it was made</h2><p>{counted(seeds, 'seed')} of each algorithm, {steps:,} environment steps each{needed}. "
        "A run's end is the mean of the last quarter of its evaluations, on environments that training never sees. "
        "Intervals of differences are Welch's t intervals over seeds. “What was learned” is the distance from the return of "
        f"the best policy without training, {found.floor}, to the best mean end; for a difference of two algorithms that are "
        "deployed without privileged entries, to the best mean end of such an algorithm. Less than a twentieth of it counts "
        "as no difference.</p>"
        f"<pre>{html.escape(command)}</pre>"
        f"<details><summary>Settings and versions</summary><pre>{html.escape(json.dumps(origin, indent=1))}</pre></details>"
    )
