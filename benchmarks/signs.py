"""
The pictures of docs/signs.md, from the committed results of the suite ``signs``::

    python -m benchmarks.launch benchmarks/suites/signs.yml
    python -m benchmarks.aggregate benchmarks/suites/signs.yml --out benchmarks/results/signs
    python -m benchmarks.signs

writes ``benchmarks/results/signs-<what is wrong>.png``, each with a healthy run behind a sick one, and prints what they show.
"""

import argparse
from pathlib import Path

import matplotlib
import pandas as pd

from benchmarks.suite import HERE
from benchmarks.tidy import read_tidy

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

HEALTHY = "gac"
#: Algorithm of the suite -> what is wrong with it
SICK = {
    "gac-kl-too-large": "target_kl too large",
    "gac-kl-too-small": "target_kl too small",
    "gac-guider-far": "guider far",
    "gac-saturated": "saturated actions",
}
#: Column of the results, or what is made of two -> title of its axes
PANELS = {
    "returns": "return: learner, and guider dashed",
    "ratio": "train/kl over train/target_kl",
    "kl_coef": "train/kl_coef",
    "learner_mean_abs": "train/learner_mean_abs",
}
LOGARITHMIC = ("ratio", "kl_coef")
GREY, RED = "#8a8a8a", "#d62728"


def draw(tidy: pd.DataFrame, algorithm: str, path: Path) -> None:
    """
    One panel beside the other: what the logs of a sick run show, and of a healthy one.

    :param tidy: as aggregated
    :param algorithm: the sick one, a key of ``SICK``
    :param path: of the picture
    """
    figure, axes = plt.subplots(1, len(PANELS), figsize=(3.2 * len(PANELS), 2.9), layout="constrained")
    for name, color, label in ((HEALTHY, GREY, "healthy"), (algorithm, RED, SICK[algorithm])):
        for number, (_, run) in enumerate(tidy[tidy.algorithm == name].groupby("seed")):
            for axis, panel in zip(axes, PANELS, strict=True):
                _plot(axis, panel, run, color, label if number == 0 else None)
    for axis, (panel, title) in zip(axes, PANELS.items(), strict=True):
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("environment steps", fontsize=8)
        axis.tick_params(labelsize=8)
        axis.grid(alpha=0.25)
        if panel in LOGARITHMIC:
            axis.set_yscale("log")
    axes[list(PANELS).index("ratio")].axhline(1.0, color="black", linestyle=":", linewidth=1)
    axes[0].legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _plot(axis: Axes, panel: str, run: pd.DataFrame, color: str, label: str | None) -> None:
    """:param run: rows of one seed"""
    if panel == "returns":
        axis.plot(run.timesteps, run.learner, color=color, label=label)
        axis.plot(run.timesteps, run.guider, color=color, linestyle="--")
        return
    values = run.kl / run.target_kl if panel == "ratio" else run[panel]
    axis.plot(run.timesteps, values, color=color)


def described(tidy: pd.DataFrame, algorithm: str) -> str:
    """
    :param tidy: as aggregated
    :param algorithm: one that is in it
    :return: a line with what its last evaluations found, of each seed
    """
    last = tidy[tidy.algorithm == algorithm].sort_values("timesteps").groupby("seed").tail(1)
    found = {
        "learner": last.learner.round(0).astype(int),
        "guider": last.guider.round(0).astype(int),
        "kl / target": (last.kl / last.target_kl).round(3),
        "kl_coef": last.kl_coef.round(4),
        "learner_mean_abs": last.learner_mean_abs.round(2),
    }
    return f"{algorithm}: " + ", ".join(f"{name} {values.tolist()}" for name, values in found.items())


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="?", default=HERE / "results/signs", help="without a suffix")
    results = parser.parse_args().results
    tidy = read_tidy(results.with_suffix(".csv"))
    print(described(tidy, HEALTHY))
    for algorithm in SICK:
        if algorithm in set(tidy.algorithm):
            path = results.with_name(f"{results.name}-{SICK[algorithm].replace(' ', '-').replace('_', '-')}.png")
            draw(tidy, algorithm, path)
            print(described(tidy, algorithm), path, sep="\n")


if __name__ == "__main__":
    main()
