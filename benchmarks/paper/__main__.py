"""
Draws the paper's figures and prints its tables, by number::

    python -m benchmarks.paper figure 1                  # drawn from committed results, and what differs from the paper
    python -m benchmarks.paper figure 1 --run            # its runs are made, or gone on with, first
    python -m benchmarks.paper figure 1 --scale paper    # as in the paper: its physics, steps and settings
    python -m benchmarks.paper table 3                   # the paper's numbers, and ours beside them
"""

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.paper.figures import RESULTS, SCALES, SUITES, Figure, cells_drawn, draw, needs, read_figures
from benchmarks.paper.tables import TABLES
from benchmarks.tidy import file_of


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Entry point of the command line.

    :param arguments: command-line arguments, by default those of the process
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(dest="kind", required=True)
    figures = read_figures()
    one = kinds.add_parser("figure", help="returns, KL and its weight, as curves")
    one.add_argument("number", type=int, choices=sorted(figures))
    one.add_argument("--scale", choices=SCALES, default=SCALES[0])
    one.add_argument("--run", action="store_true", help="make the runs that are missing first")
    one.add_argument("--jobs", type=int, help="runs side by side (default: one on each CPU)")
    one.add_argument("--out", type=Path, help="the picture (default: in benchmarks/results/paper)")
    table = kinds.add_parser("table", help="settings and sizes of observations")
    table.add_argument("number", type=int, choices=sorted(TABLES))
    options = parser.parse_args(arguments)
    if options.kind == "table":
        print(TABLES[options.number]())
        return
    figure = figures[options.number]
    if options.run:
        make(figure.suites(options.scale), options.jobs)
    show(figure, options.scale, options.out or RESULTS / f"paper/figure-{figure.number}{suffix(options.scale)}.png")


def suffix(scale: str) -> str:
    """
    :param scale: one of ``SCALES``
    :return: end of the name of a picture at this scale, empty for the first scale
    """
    return "" if scale == SCALES[0] else f"-{scale}"


def make(suites: Sequence[str], jobs: int | None) -> None:
    """
    Make the missing runs of suites, and aggregate the suites. Runs that a suite's results hold are not made again.

    :param suites: names of the suites
    :param jobs: number of runs side by side, ``None`` for one on each CPU
    """
    for name in suites:
        suite, results = str(SUITES / f"{name}.yml"), RESULTS / name
        at_once = [] if jobs is None else ["--jobs", str(jobs)]
        reuse = ["--reuse-results", str(results)] if file_of(results, "json").exists() else []
        for program, own in (("launch", at_once), ("aggregate", ["--out", str(results), "--complete-cells"])):
            words = [sys.executable, "-m", f"benchmarks.{program}", suite, *own, *reuse]
            status = subprocess.run(words, check=False).returncode
            if status:
                sys.exit(f"{name}: {program} ended with status {status}. The same command goes on.")


def show(figure: Figure, scale: str, out: Path) -> None:
    """
    Draw a figure, and print its title, its differences from the paper's, and the runs and the command that it needs.

    :param figure: figure of the paper
    :param scale: one of ``SCALES``
    :param out: file of the picture
    """
    print(f"Figure {figure.number}: {figure.title}.")
    if scale == SCALES[0]:
        print("Other than in the paper:", *(f"  - {text}" for text in figure.differs), sep="\n")
    if cells := cells_drawn(figure, scale):
        print("Drawn so far:", *(f"  - {text}" for text in cells), sep="\n")
    print("Runs:", *(f"  - benchmarks/suites/{name}.yml: {needs(name)}" for name in figure.suites(scale)), sep="\n")
    command = f"python -m benchmarks.paper figure {figure.number}" + ("" if scale == SCALES[0] else f" --scale {scale}")
    print(f"To make those that are missing: {command} --run")
    drawn = f"Drawn: {out}. Thick lines are means over seeds, thin ones the seeds."
    print(drawn if draw(figure, scale, out) else "There is nothing to draw yet.")


if __name__ == "__main__":
    main()
