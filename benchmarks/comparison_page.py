"""The page of a comparison: what to train with, in words, above what it was concluded from."""

import html
import json
import math
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from plotly import graph_objects

from benchmarks.headroom import (
    CONFIDENCE,
    Difference,
    Worth,
    findings,
    headroom_curve,
    in_words,
    mean_interval,
    number,
    recommendation,
    title,
)
from benchmarks.report import RETURN, STEPS, STYLE, algorithm_lines, palette, title_of

_STYLE = """
body {max-width: 60em; margin: 2em auto; padding: 0 1em; line-height: 1.45}
.verdict {border-left: 4px solid #1f77b4; background: #f2f7fb; padding: .6em 1em; font-size: 1.1em}
.wide {overflow-x: auto}
th {text-align: left} td.number {text-align: right; white-space: nowrap} td.text {min-width: 14em}
tr.best td {font-weight: bold}
pre {white-space: pre-wrap; overflow-wrap: anywhere}
"""
_AXES = {"template": "plotly_white", "height": 430, "margin": {"l": 60, "r": 20, "t": 20, "b": 50}, "hovermode": "x unified"}
_LEGEND = {"orientation": "h", "y": -0.22}


def page(tidy: pd.DataFrame, found: Worth, command: str, results: Path, steps: int) -> str:
    """
    :param tidy: evaluations of the task
    :param found: what was concluded from them
    :param command: that makes them again
    :param results: JSON file of the aggregated results
    :param steps: of each run
    :return: HTML that needs nothing else
    """
    task = html.escape(title_of(str(tidy.task.iloc[0]), float(tidy.noise.iloc[0])))
    verdict = "".join(f"<p>{html.escape(text)}</p>" for text in recommendation(found, steps))
    told = "".join(f"<li>{html.escape(text)}</li>" for text in findings(found))
    figures = [_curves(tidy, found.random[0])] + ([_headroom(tidy)] if found.headroom is not None else [])
    plots = [
        figure.to_html(full_html=False, include_plotlyjs=index == 0, config={"responsive": True, "displaylogo": False})
        for index, figure in enumerate(figures)
    ]
    captions = [
        "Mean return of what is deployed, over all seeds. Bands hold the mean with 95% confidence by Student's t; dashes "
        "are the guider.",
        "Headroom over training: SAC on the full state over SAC-asym at the same step, with its interval. Above 0, seeing "
        "more would return more.",
    ]
    shown = "".join(
        f"<figure><div>{plot}</div><figcaption>{caption}</figcaption></figure>"
        for plot, caption in zip(plots, captions, strict=False)
    )
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{task}: what privileged information is worth</title><style>{STYLE}{_STYLE}</style></head><body>"
        f"<h1>{task}: what privileged information is worth</h1><div class=verdict>{verdict}</div><ul>{told}</ul>{shown}"
        f"<h2>Returns</h2><div class=wide>{_ends_table(found)}</div>"
        f"<h2>Differences</h2><div class=wide>{_differences_table(found)}</div>"
        f"{_how(found, command, results, steps)}</body></html>"
    )


def _curves(tidy: pd.DataFrame, random_return: float) -> graph_objects.Figure:
    figure = graph_objects.Figure()
    tidy = tidy.assign(algorithm=tidy.algorithm.map(title))
    for algorithm, color in palette(list(tidy.algorithm.unique())).items():
        lines = algorithm_lines(tidy[tidy.algorithm == algorithm], algorithm, color)
        for line in lines:
            line.showlegend = line.name == algorithm
            if "seed" in str(line.name):
                line.hoverinfo = "skip"
        figure.add_traces(lines)
    note = {"annotation_text": "random actions", "annotation_position": "bottom right"}
    figure.add_hline(y=random_return, line={"color": "#888", "width": 1, "dash": "dot"}, **note)
    return figure.update_layout(xaxis_title=STEPS, yaxis_title=RETURN, legend=_LEGEND, **_AXES)


def _headroom(tidy: pd.DataFrame) -> graph_objects.Figure:
    curve = headroom_curve(tidy)
    there, back = list(curve.timesteps), list(curve.timesteps[::-1])
    figure = graph_objects.Figure()
    if not any(map(math.isinf, curve.low)):
        band = {"fill": "toself", "line": {"color": "#1f77b4", "width": 0}, "opacity": 0.15, "hoverinfo": "skip"}
        figure.add_scatter(x=there + back, y=[*curve.high, *curve.low[::-1]], mode="lines", showlegend=False, **band)
    figure.add_scatter(x=there, y=curve.value, mode="lines", line={"color": "#1f77b4"}, name="headroom", showlegend=False)
    figure.add_hline(y=0, line={"color": "#888", "width": 1})
    return figure.update_layout(xaxis_title=STEPS, yaxis_title="headroom (return)", **_AXES)


def _ends_table(found: Worth) -> str:
    best = max(found.deployable or found.ends, key=lambda name: float(found.ends[name].mean()))
    rows = []
    for name, ends in sorted(found.ends.items(), key=lambda item: -float(item[1].mean())):
        mean, low, high = mean_interval(ends)
        interval = "one seed" if math.isinf(low) else f"{number(low)} to {number(high)}"
        seeds = ", ".join(map(number, ends))
        cells = [title(name), number(mean), interval, seeds, number(float(found.areas[name].mean()))]
        rows.append((cells, name == best))
    mean, low, high = found.random
    rows.append((["random actions", number(mean), f"{number(low)} to {number(high)}", "", ""], False))
    head = ["algorithm", "mean at the end", f"{CONFIDENCE:.0%} interval", "each seed at the end", "mean of the whole curve"]
    return _table(head, rows)


def _differences_table(found: Worth) -> str:
    questions: list[tuple[str, Difference | None]] = [
        ("headroom: privileged entries at deployment too", found.headroom),
        ("privileged entries in training, for critics", found.in_training),
        ("a guider on top", found.guider),
    ]
    rows = [
        ([question, f"{title(one.better)} - {title(one.other)}", in_words(found, one)], False)
        for question, one in questions
        if one is not None
    ]
    return _table(["what it is worth", "difference at the end", "return"], rows, "text")


def _table(head: Sequence[str], rows: Sequence[tuple[Sequence[str], bool]], kind: str = "number") -> str:
    def row(tag: str, cells: Sequence[str], best: bool = False) -> str:
        kinds = ["" if index == 0 or tag == "th" else f" class={kind}" for index in range(len(cells))]
        inner = "".join(f"<{tag}{one}>{html.escape(cell)}</{tag}>" for cell, one in zip(cells, kinds, strict=True))
        return f"<tr{' class=best' if best else ''}>{inner}</tr>"

    return f"<table>{row('th', head)}{''.join(row('td', cells, best) for cells, best in rows)}</table>"


def _how(found: Worth, command: str, results: Path, steps: int) -> str:
    made = json.loads(results.read_text())
    seeds = max(len(end) for end in found.ends.values())
    origin = {key: made[key] for key in ("made_with", "cpus", "hours", "settings", "arguments") if key in made}
    return (
        f"<h2>How it was made</h2><p>{seeds} seeds of each algorithm, {steps:,} environment steps each. A run's end is the "
        "mean of the last quarter of its evaluations, on environments that training never sees. Intervals of differences are "
        "Welch's t intervals over seeds. “What was learned” is the distance from the return of random actions to the best "
        "mean end; less than a twentieth of it counts as no difference.</p>"
        f"<pre>{html.escape(command)}</pre>"
        f"<details><summary>Settings and versions</summary><pre>{html.escape(json.dumps(origin, indent=1))}</pre></details>"
    )
