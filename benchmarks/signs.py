"""
Draws the pictures of docs/signs.md from committed results::

    python -m benchmarks.launch benchmarks/suites/signs.yml
    python -m benchmarks.aggregate benchmarks/suites/signs.yml --out benchmarks/results/signs
    python -m benchmarks.signs

The last command writes ``benchmarks/results/signs-<name>.png``, each with healthy runs behind sick ones, and prints the last
values of both. A picture whose results are missing is named, and not drawn.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import matplotlib
import pandas as pd

from benchmarks.suite import HERE
from benchmarks.tidy import read_tidy

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator


class Runs(NamedTuple):
    """
    The runs of one algorithm in one cell.

    :param results: name of the results, in ``benchmarks/results``
    :param algorithm: name of the algorithm in the suite
    :param task: title of the cell's task
    :param noise: standard deviation of the cell's sensor noise
    """

    results: str
    algorithm: str
    task: str
    noise: float

    def read(self, folder: Path) -> pd.DataFrame:
        """
        :param folder: folder of all results
        :return: evaluations of all seeds, an empty table if there are no such results
        """
        path = folder / f"{self.results}.csv"
        if not path.exists():
            return pd.DataFrame()
        tidy = read_tidy(path)
        return tidy[(tidy.algorithm == self.algorithm) & (tidy.task == self.task) & (tidy.noise == self.noise)]


class Picture(NamedTuple):
    """
    A picture of sick runs, with healthy ones behind them.

    :param label: name of the fault, as the legend shows it
    :param healthy: healthy runs, drawn in grey
    :param sick: sick runs, drawn in red
    """

    label: str
    healthy: Runs
    sick: Runs


PENDULUM = ("Pendulum-history4", 0.2)
HEALTHY = Runs("signs", "gac", *PENDULUM)
#: Name in the picture's file -> picture
PICTURES = {
    "target-kl-too-large": Picture("target_kl too large", HEALTHY, Runs("signs", "gac-kl-too-large", *PENDULUM)),
    "target-kl-too-small": Picture("target_kl too small", HEALTHY, Runs("signs", "gac-kl-too-small", *PENDULUM)),
    "guider-free": Picture("fixed, small kl_coef", HEALTHY, Runs("signs", "gac-guider-far", *PENDULUM)),
    "guider-far": Picture(
        "two networks",
        Runs("halfcheetah", "gac", "HalfCheetah", 0.3),
        Runs("independent", "gac-independent", "HalfCheetah", 0.3),
    ),
    "saturated-actions": Picture("saturated actions", HEALTHY, Runs("signs", "gac-saturated", *PENDULUM)),
    "sees-too-little": Picture(
        "no memory", Runs("memory", "gac-gru", "Pendulum", 0.05), Runs("memory", "gac", "Pendulum", 0.05)
    ),
}
#: Column of the results, or a quantity made of two columns -> title of its axes
PANELS = {
    "returns": "return: learner, and guider dashed",
    "ratio": "train/kl over train/target_kl",
    "kl_coef": "train/kl_coef",
    "learner_mean_abs": "train/learner_mean_abs",
}
LOGARITHMIC = ("ratio", "kl_coef")
GREY, RED = "#8a8a8a", "#d62728"


def draw(label: str, healthy: pd.DataFrame, sick: pd.DataFrame, path: Path) -> None:
    """
    Draw the quantities that the logs of healthy and of sick runs show, in panels side by side.

    :param label: name of the fault, as the legend shows it
    :param healthy: evaluations of healthy runs
    :param sick: evaluations of sick runs
    :param path: file of the picture
    """
    panels = [panel for panel in PANELS if panel != "learner_mean_abs" or panel in sick]
    figure, axes = plt.subplots(1, len(panels), figsize=(3.2 * len(panels), 2.9), layout="constrained")
    for runs, color, name in ((healthy, GREY, "healthy"), (sick, RED, label)):
        for number, (_, run) in enumerate(runs.groupby("seed")):
            for axis, panel in zip(axes, panels, strict=True):
                _plot(axis, panel, run, color, name if number == 0 else None)
    for axis, panel in zip(axes, panels, strict=True):
        axis.set_title(PANELS[panel], fontsize=9)
        axis.set_xlabel("environment steps", fontsize=8)
        axis.tick_params(labelsize=8)
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.grid(alpha=0.25)
        if panel in LOGARITHMIC:
            axis.set_yscale("log")
    axes[panels.index("ratio")].axhline(1.0, color="black", linestyle=":", linewidth=1)
    axes[0].legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _plot(axis: Axes, panel: str, run: pd.DataFrame, color: str, label: str | None) -> None:
    """Add the curve of a run, the evaluations of one seed, to a panel; the panel of returns has the guider's curve too."""
    if panel == "returns":
        axis.plot(run.timesteps, run.learner, color=color, label=label)
        axis.plot(run.timesteps, run.guider, color=color, linestyle="--")
        return
    values = run.kl / run.target_kl if panel == "ratio" else run[panel]
    axis.plot(run.timesteps, values, color=color)


def described(runs: pd.DataFrame) -> str:
    """
    :param runs: evaluations of one algorithm in one cell
    :return: text with the values of each seed's last evaluation
    """
    last = runs.sort_values("timesteps").groupby("seed").tail(1)
    found = {
        "learner": last.learner.round(0).astype(int),
        "guider": last.guider.round(0).astype(int),
        "kl / target": (last.kl / last.target_kl).round(3),
        "kl_coef": last.kl_coef.round(4),
    }
    if "learner_mean_abs" in last:
        found["learner_mean_abs"] = last.learner_mean_abs.round(2)
    return ", ".join(f"{name} {values.tolist()}" for name, values in found.items())


def main() -> None:
    """Entry point of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=HERE / "results", help="with all results")
    folder = parser.parse_args().folder
    for name, picture in PICTURES.items():
        healthy, sick = picture.healthy.read(folder), picture.sick.read(folder)
        if healthy.empty or sick.empty:
            print(f"{name}: not drawn, runs of the suites {picture.healthy.results} and {picture.sick.results} are missing")
            continue
        draw(picture.label, healthy, sick, folder / f"signs-{name}.png")
        print(f"{name}: healthy: {described(healthy)}\n{name}: sick: {described(sick)}")


if __name__ == "__main__":
    main()
