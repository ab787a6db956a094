"""The paper's figures, drawn from aggregated results."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import pandas as pd
import yaml

from benchmarks.finished import name_of
from benchmarks.page.cells import palette, title_of
from benchmarks.suite import HERE, read_suite
from benchmarks.tidy import NEEDED, read_tidy, together, with_needed_steps

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

RESULTS, SUITES = HERE / "results", HERE / "suites"
SCALES = ("two-cores", "paper")
RETURNS, POLICIES, KL, KL_COEF = "returns", "policies", "kl", "kl_coef"
LABELS = {RETURNS: "return", POLICIES: "return", KL: "KL(guider ‖ learner)", KL_COEF: "weight of the KL (kl_coef)"}
MOST_ACROSS = 4
MARGIN = 3.0


class Group(NamedTuple):
    """
    Results of several suites that are drawn on the same axes.

    :param suites: names of the suites
    :param algorithms: names of the algorithms to draw, all if empty
    :param tasks: titles of the tasks to draw, all if empty
    :param noises: sensor noises to draw, all if empty
    :param panels: panels of each cell, keys of ``LABELS``
    :param ends: names of suites with more steps, of which the last return alone is drawn, as a line across
    """

    suites: Sequence[str]
    algorithms: Sequence[str] = ()
    tasks: Sequence[str] = ()
    noises: Sequence[float] = ()
    panels: Sequence[str] = (RETURNS,)
    ends: Sequence[str] = ()

    def wanted(self, tidy: pd.DataFrame) -> pd.DataFrame:
        """
        :param tidy: aggregated evaluations
        :return: evaluations of the algorithms, tasks and noises of this group
        """
        for column, values in (("algorithm", self.algorithms), ("task", self.tasks), ("noise", self.noises)):
            tidy = tidy[tidy[column].isin(values)] if values else tidy
        return tidy


class Figure(NamedTuple):
    """
    A figure of the paper.

    :param number: number of the figure in the paper
    :param title: title of the figure
    :param groups: scale -> groups that are drawn, one below the other
    :param differs: sentences that say how the figure at two cores' scale differs from the paper's
    """

    number: int
    title: str
    groups: Mapping[str, Sequence[Group]]
    differs: Sequence[str]

    def suites(self, scale: str) -> list[str]:
        """
        :param scale: one of ``SCALES``
        :return: names of all suites whose runs the figure needs, each once
        """
        return list(dict.fromkeys(name for group in self.groups[scale] for name in (*group.suites, *group.ends)))


def read_figures() -> dict[int, Figure]:
    """Read the figures of ``figures.yml``, by number."""
    content = yaml.safe_load((HERE / "paper/figures.yml").read_text(encoding="utf-8"))
    return {
        number: Figure(
            number, one["title"], {scale: [Group(**group) for group in one[scale]] for scale in SCALES}, one["differs"]
        )
        for number, one in content.items()
    }


def results_of(suites: Sequence[str]) -> pd.DataFrame:
    """
    :param suites: names of suites
    :return: aggregated evaluations of the suites that have results; steps of needed runs are part of ``timesteps``
    :raises ValueError: if two of the suites have the same run
    """
    paths = [RESULTS / f"{name}.csv" for name in suites]
    frames = [with_needed_steps(read_tidy(path)) for path in paths if path.exists()]
    return together(frames) if frames else pd.DataFrame(columns=["task", "noise", "algorithm"])


def needs(name: str) -> str:
    """
    :param name: name of a suite
    :return: text with the number of the suite's runs, their steps, how many of them its results hold and how many they set
        aside, and the minutes that a run took
    """
    specs = read_suite(SUITES / f"{name}.yml")
    steps = f"{len(specs)} runs of {specs[0].steps:,} steps"
    path = RESULTS / f"{name}.json"
    if not path.exists():
        return f"{steps}, none of them made yet"
    results = json.loads(path.read_text(encoding="utf-8"))
    made, aside = (sum(name_of(spec) in results.get(key, {}) for spec in specs) for key in ("runs", "set_aside"))
    said = "all made" if made == len(specs) else f"{made} of them made"
    median = results["seconds_per_run"].get("median")
    said += f" in {median / 60:.0f} minutes of a core each (median)" if median else ""
    return f"{steps}, {said}" + (f", {aside} set aside, since other runs of their cells are missing" if aside else "")


def cells_drawn(figure: Figure, scale: str) -> list[str]:
    """
    :param figure: figure of the paper
    :param scale: one of ``SCALES``
    :return: for each group that has results, its cells, and the number of seeds of each algorithm there
    """
    told = []
    for group in figure.groups[scale]:
        drawn = _Drawn(group, group.wanted(results_of(group.suites)), group.wanted(results_of(group.ends)))
        if drawn.cells:
            seeds = drawn.tidy.groupby(["task", "noise", "algorithm"]).seed.nunique()
            count = str(seeds.min()) if seeds.min() == seeds.max() else f"{seeds.min()} to {seeds.max()}"
            cells = "; ".join(title_of(*cell) for cell in drawn.cells)
            told.append(f"{cells}: {count} seed{'' if count == '1' else 's'} of each algorithm")
    return told


def draw(figure: Figure, scale: str, path: Path) -> bool:
    """
    :param figure: figure of the paper
    :param scale: one of ``SCALES``
    :param path: file of the picture
    :return: whether there were results to draw; without results, no picture is written
    """
    found = [_Drawn(one, *(one.wanted(results_of(names)) for names in (one.suites, one.ends))) for one in figure.groups[scale]]
    drawn = [one for one in found if one.cells]
    if not drawn:
        return False
    size = (max(4.0 * max(one.across for one in drawn), 6.5), 3.1 * sum(one.down for one in drawn) + 0.4)
    whole = plt.figure(figsize=size, layout="constrained")
    whole.suptitle(f"Figure {figure.number}: {figure.title}", fontsize="medium")
    colors = palette(list(dict.fromkeys(name for one in drawn for name in (*one.tidy.algorithm, *one.ends.algorithm))))
    parts = whole.subfigures(len(drawn), 1, height_ratios=[one.down for one in drawn], squeeze=False).flat
    for part, one in zip(parts, drawn, strict=True):
        _draw_group(part.subplots(one.down, one.across, squeeze=False).flat, one, colors)
    path.parent.mkdir(parents=True, exist_ok=True)
    whole.savefig(path, dpi=80)
    plt.close(whole)
    return True


class _Drawn(NamedTuple):
    """
    A group with its evaluations.

    :param group: the group
    :param tidy: evaluations to draw as curves
    :param ends: evaluations of which the last return alone is drawn
    """

    group: Group
    tidy: pd.DataFrame
    ends: pd.DataFrame

    @property
    def cells(self) -> list[tuple[str, float]]:
        tasks = list(self.tidy.task.unique())
        cells = dict.fromkeys(zip(self.tidy.task, self.tidy.noise, strict=True))
        return sorted(cells, key=lambda cell: (tasks.index(cell[0]), cell[1]))

    @property
    def across(self) -> int:
        """The number of columns; the panels of a cell are side by side."""
        panels = len(self.group.panels)
        return min(len(self.cells), max(MOST_ACROSS // panels, 1)) * panels

    @property
    def steps_label(self) -> str:
        needed = NEEDED in self.tidy and self.tidy[NEEDED].gt(0).any()
        return "thousand steps, those of needed runs too" if needed else "thousand environment steps"

    @property
    def down(self) -> int:
        return math.ceil(len(self.cells) * len(self.group.panels) / self.across)


def _draw_group(axes: Iterator[Axes], one: _Drawn, colors: Mapping[str, str]) -> None:
    first = True
    for task, noise in one.cells:
        cell, ends = (frame[(frame.task == task) & (frame.noise == noise)] for frame in (one.tidy, one.ends))
        for panel in one.group.panels:
            axis = next(axes)
            _draw_panel(axis, panel, cell, ends, colors)
            axis.set(title=title_of(task, noise), xlabel=one.steps_label, ylabel=LABELS[panel])
            axis.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}")
            if first or panel != RETURNS:
                axis.legend(fontsize="x-small")
            first = False
    for axis in axes:
        axis.set_axis_off()


def _draw_panel(axis: Axes, panel: str, cell: pd.DataFrame, ends: pd.DataFrame, colors: Mapping[str, str]) -> None:
    for name, group in cell.groupby("algorithm", sort=False):
        _draw_algorithm(axis, panel, group, str(name), colors[str(name)])
    if panel in (KL, KL_COEF):
        axis.set_yscale("log")
        low, high = (value for value in axis.get_ylim())
        axis.set_ylim(low / MARGIN, high * MARGIN)  # a steady line must look steady
    if panel == KL and cell.target_kl.nunique() == 1:
        axis.axhline(cell.target_kl.max(), color="black", linestyle=":", label="target_kl")
    if panel in (RETURNS, POLICIES):
        for name, group in ends.groupby("algorithm", sort=False):
            last = group.timesteps.max()
            mean = group[group.timesteps == last].learner.mean()
            axis.axhline(mean, color=colors[str(name)], linestyle="-.", label=f"{name} after {last:,}")


def _draw_algorithm(axis: Axes, panel: str, group: pd.DataFrame, name: str, color: str) -> None:
    """Draw the mean over seeds, and for returns each seed's curve too, in thin lines."""
    column = panel if panel in (KL, KL_COEF) else "learner"
    mean = group.groupby("timesteps")[column].mean()
    axis.plot(mean.index, mean, color=color, label=name, linewidth=2)
    if column == "learner":
        for _, run in group.groupby("seed"):
            axis.plot(run.timesteps, run.learner, color=color, linewidth=0.7, alpha=0.4)
    if panel == POLICIES:
        guider = group.groupby("timesteps").guider.mean()
        axis.plot(guider.index, guider, color=color, linestyle="--", label=f"{name}, guider")
