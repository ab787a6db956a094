"""The HTML document of a page, put together from summary, plots and tables."""

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from plotly.offline import get_plotlyjs

from benchmarks.page.plots import Plot, plots
from benchmarks.page.summary import about_intervals, in_short, what_was_compared
from benchmarks.page.tables import differences_table, overall_table, returns_table, with_surroundings

HERE = Path(__file__).parent


def page(tidy: pd.DataFrame, results: dict[str, Any], title: str, runs: str) -> str:
    """
    :param tidy: aggregated evaluations, with each run's own environment steps
    :param results: aggregated results
    :param title: title of the page
    :param runs: directory of all runs, relative to the page, to which the page's links to logs point
    :return: HTML of the page, which needs no other file
    """
    seconds = {name: run["seconds"] for name, run in results["runs"].items() if run.get("seconds")}
    drawn = plots(tidy, seconds, normalised_returns(results), results.get("still_to_run"))
    short = "".join(f"<li>{html.escape(text)}</li>" for text in in_short(results))
    body = (
        f"<h1>{html.escape(title)}</h1><p>{html.escape(what_was_compared(results))}</p>"
        f"<ul class=short>{short}</ul>{tabs(drawn)}"
        f"<h2>Returns</h2>{returns_table(results['cells'])}{_notes(results.get('equal_returns', []))}"
        f"<h2>Over all cells</h2>{overall_table(results)}{_about_intervals(results)}"
        f"<h2>How it was made</h2>{_origin(results)}{_logs(results['runs'], runs)}"
    )
    return document(title, body)


def document(title: str, body: str) -> str:
    """
    :param title: title of the page
    :param body: HTML of the page's body, which contains :func:`tabs`
    :return: HTML of a page whose script draws the plots and sorts tables
    """
    style, script = ((HERE / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{style}</style></head><body>{body}"
        f"<script>{get_plotlyjs()}</script><script>{script}</script></body></html>"
    )


def normalised_returns(results: dict[str, Any]) -> pd.DataFrame:
    """
    :param results: aggregated results
    :return: table with one row for each run of the algorithms that are compared over all cells: "algorithm", and the
        "normalised" final return
    """
    compared = results["compared"]
    scales = {(cell["task"], cell["noise"]): cell for cell in compared["cells"]}
    rows = []
    for cell in results["cells"]:
        scale = scales.get((cell["task"], cell["noise"]))
        if scale is None or cell["algorithm"] not in compared["algorithms"]:
            continue
        span = scale["high"] - scale["low"] or 1.0
        rows += [{"algorithm": cell["algorithm"], "normalised": (end - scale["low"]) / span} for end in cell["final"]]
    return pd.DataFrame(rows, columns=["algorithm", "normalised"])


def tabs(drawn: Sequence[Plot]) -> str:
    """
    :param drawn: at least one plot
    :return: HTML of a row of buttons, one for each plot; the page's script draws the plot that is chosen
    """
    figures = {one.name: _as_data(one) for one in drawn}
    buttons = "".join(
        f'<button role=tab data-figure="{html.escape(one.name)}" aria-selected=false>{html.escape(one.name)}</button>'
        for one in drawn
    )
    data = json.dumps(figures).replace("</", "<\\/")
    return (
        f'<nav role=tablist>{buttons}</nav><figure style="margin:0"><div id=plot class=plot></div>'
        f'<figcaption id=caption></figcaption></figure><script type="application/json" id=figures>{data}</script>'
    )


def _as_data(plot: Plot) -> dict[str, Any]:
    """A plot's data for the page's script; the curves are written once, since they are the same at either width."""
    wide, narrow = (json.loads(figure.to_json()) for figure in (plot.wide, plot.narrow))
    return {"data": wide["data"], "wide": wide["layout"], "narrow": narrow["layout"], "caption": plot.caption}


def _notes(equal_returns: Sequence[str]) -> str:
    equal = "".join(f"<p class=note>{html.escape(sentence)}</p>" for sentence in equal_returns)
    return (
        f"{equal}"
        "<p class=note>Bold: the highest mean of its cell. The end is the last evaluation. The interval of the mean is by "
        "Student's t. The interquartile mean (IQM), with rliable's bootstrap interval, is shown of more than three seeds: of "
        "fewer it is their mean. A click on a column's name sorts.</p>"
    )


def _about_intervals(results: dict[str, Any]) -> str:
    note = about_intervals(results)
    return f"<p class=note>{note}</p>" if note else ""


def _origin(results: dict[str, Any]) -> str:
    """The HTML with the command, the arguments in which algorithms differ, the settings that they share, and the versions."""
    differing, shared = differences_table(with_surroundings(results)) if "arguments" in results else ("", {})
    settings = yaml.safe_dump({**results.get("settings", {}), "arguments of all": shared}, sort_keys=False)
    known = ("made_with", "mixed_runs", "cpus", "hours", "timed_runs", "seconds_per_run", "particulars", "still_to_run")
    made = {key: results[key] for key in known if key in results} | {"set_aside": list(results.get("set_aside", {}))}
    origin = yaml.safe_dump(made, sort_keys=False)
    return (
        f"<p>Runs, or those that are missing, and these results again:</p><pre>{html.escape(results['command'])}</pre>"
        f"<details><summary>In what the algorithms differ</summary>{differing}</details>"
        f"<details><summary>Settings of all</summary><pre>{html.escape(settings)}</pre></details>"
        f"<details><summary>Versions, commits and hours</summary><pre>{html.escape(origin)}</pre></details>"
    )


def _logs(names: Sequence[str], runs: str) -> str:
    links = "".join(f"<li>{_link(f'{runs}/{name}', name)}</li>" for name in names)
    return (
        "<details><summary>Runs</summary><p>Each with log.txt, its TensorBoard log, configuration and model, on the machine "
        f"that made this page.</p><ul>{links}</ul></details>"
    )


def _link(target: str, text: str) -> str:
    return f'<a href="{html.escape(target, quote=True)}">{html.escape(text)}</a>'
