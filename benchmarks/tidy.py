"""The table of evaluations that ``aggregate`` writes and other programs read, the scores of its runs, and their digits."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import pandas as pd

#: The columns that together identify a cell of a suite, and those that identify a run
CELL = ["task", "noise"]
NAMES = [*CELL, "algorithm", "seed"]
#: Value that stands for the noise of environments that take no sensor noise; in files the field is empty
NO_NOISE = -1.0
#: Column with the environment steps of the runs that a run needs
NEEDED = "needed_steps"


def file_of(results: Path, suffix: str) -> Path:
    """
    :param results: path of results, without a suffix; a dot in their name, as in ``noise0.1``, begins none
    :param suffix: suffix of one of their files, without its dot
    :return: path of that file
    """
    return results.with_name(f"{results.name}.{suffix}")


def read_tidy(path: Path | TextIO) -> pd.DataFrame:
    """
    :param path: CSV file of aggregated evaluations, or its text in an open file
    :return: table of evaluations, with ``NO_NOISE`` where the noise is empty
    """
    # A task may be named 2048, and an algorithm NA: names are no numbers, and none of them is missing. Python reads the number
    # that was written, to the last digit; pandas need not
    as_written = {"task": str, "algorithm": str, "noise": lambda text: float(text) if text else NO_NOISE}
    return pd.read_csv(path, converters=as_written)


def as_csv(tidy: pd.DataFrame) -> str:
    """
    :param tidy: evaluations, see :func:`read_tidy`
    :return: text of a CSV file, in which measured numbers have six significant digits, and the noise, which identifies a run,
        as many as it takes
    """
    return tidy.assign(noise=tidy.noise.map(_in_full)).to_csv(index=False, float_format="%.6g")


def _in_full(noise: float) -> str | None:
    if noise == NO_NOISE:
        return None
    short = f"{noise:.6g}"
    return short if float(short) == noise else repr(noise)


def together(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """
    :param tables: evaluations of several results, see :func:`read_tidy`
    :return: one table of them all; if any of them has ``needed_steps``, this column is 0 for the runs of those without it
    :raises ValueError: if two of them have the same run, so that its evaluations would count twice
    """
    runs = pd.concat([table[NAMES].drop_duplicates() for table in tables])
    if runs.duplicated().any():
        run = runs[runs.duplicated()].iloc[0]
        noise = "" if run.noise == NO_NOISE else f", noise {run.noise:g}"
        raise ValueError(f"Several results have the run {run.algorithm}, {run.task}{noise}, seed {run.seed}: leave one out.")
    tidy = pd.concat(tables, ignore_index=True)
    return tidy.assign(**{NEEDED: tidy[NEEDED].fillna(0).astype(int)}) if NEEDED in tidy else tidy


def names_apart(paths: Sequence[Path]) -> list[str]:
    """
    :param paths: paths of results
    :return: for each path its name, after as many of its folders as no other path ends with
    :raises ValueError: if two paths are the same
    """
    parts = [path.resolve().parts for path in paths]
    return [_shortest_end(one, [*parts[:index], *parts[index + 1 :]]) for index, one in enumerate(parts)]


def _shortest_end(parts: tuple[str, ...], others: Sequence[tuple[str, ...]]) -> str:
    for length in range(1, len(parts) + 1):
        if all(other[-length:] != parts[-length:] for other in others):
            return str(Path(*parts[-length:]))
    raise ValueError(f"{Path(*parts)} is among the results more than once: leave one out.")


def with_needed_steps(tidy: pd.DataFrame) -> pd.DataFrame:
    """
    :param tidy: evaluations, see :func:`read_tidy`
    :return: the same table, with ``timesteps`` counted from the start of the first run that a run needs
    """
    return tidy.assign(timesteps=tidy.timesteps + tidy[NEEDED]) if NEEDED in tidy else tidy


def steps_before(group: pd.DataFrame) -> int:
    """
    :param group: evaluations of one algorithm in one cell, see :func:`read_tidy`
    :return: environment steps of the runs that one run of the algorithm needs
    """
    return int(group[NEEDED].max()) if NEEDED in group else 0


def after_needed(text: str, steps: int) -> str:
    """
    :param text: name of an algorithm
    :param steps: environment steps of the runs that one run of the algorithm needs
    :return: the name, with these steps if there are any
    """
    return f"{text}, after {steps:,} steps of needed runs" if steps else text


def run_scores(tidy: pd.DataFrame) -> pd.DataFrame:
    """
    :param tidy: evaluations, see :func:`read_tidy`
    :return: table with one row for each run: "final", the mean return of the last evaluation, and "area", the mean return over
        all evaluations, which is the area under the curve divided by its length
    """
    by_run = tidy.sort_values("timesteps", kind="stable").groupby(NAMES, sort=False)
    return by_run.learner.agg(final="last", area="mean").reset_index()


def normalised_scores(tidy: pd.DataFrame) -> pd.DataFrame:
    """
    Normalise the returns of each cell, from the lowest point of its curves to its best end. A constant that is added to all
    returns, or a positive factor, changes nothing.

    :param tidy: evaluations, see :func:`read_tidy`
    :return: table of :func:`run_scores` with three more columns: "low", the lowest mean over seeds of any algorithm at any
        evaluation in the cell; "high", the best algorithm's mean final return in the cell; and "normalised", the final return
        on a scale with "low" at 0 and "high" at 1
    """
    scores = run_scores(tidy)
    low = tidy.groupby([*CELL, "algorithm", "timesteps"]).learner.mean().groupby(CELL).min()
    high = scores.groupby([*CELL, "algorithm"]).final.mean().groupby(CELL).max()
    scores = scores.merge(pd.DataFrame({"low": low, "high": high}).reset_index(), on=CELL)
    span = (scores.high - scores.low).replace(0.0, 1.0)  # where no returns differ, all algorithms are the best
    return scores.assign(normalised=1 - (scores.high - scores.final) / span)


def significant(value: float) -> float:
    """
    :param value: score, of any size
    :return: the same score with six significant digits, as many as the table of evaluations has
    """
    return float(f"{value:.6g}")


def number(value: float, thousands: str = ",") -> str:
    """
    :param value: return, or difference of returns
    :param thousands: what separates thousands, a comma or nothing
    :return: text with three significant digits, or with all digits before the point if there are more
    """
    if value == 0:
        return "0"  # and never -0
    if not math.isfinite(value) or abs(value) >= 100:
        return f"{value:{thousands}.0f}"
    rounded = float(f"{value:.3g}")  # 99.96 is 100
    if abs(rounded) < 1e-3:
        return f"{rounded:g}"
    return f"{rounded:.{max(0, 2 - math.floor(math.log10(abs(rounded))))}f}"
