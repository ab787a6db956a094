"""
Checks of finished runs before they are compared: returns that are no numbers, seeds with other arguments, and algorithms that
are one and the same.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pandas as pd

from benchmarks.config import read_algorithm
from benchmarks.finished import FinishedRun, conflicts, kind_of
from benchmarks.recorded import with_defaults
from benchmarks.tidy import CELL, NO_NOISE


def check_finite(runs: Sequence[FinishedRun]) -> None:
    """
    :param runs: records of finished runs
    :raises ValueError: naming a run and an evaluation whose return, or whose KL over its target, is no number to average
    """
    for run in runs:
        rows = run.evaluations
        numbers = {name: rows[name] for name in ("learner", "guider") if name in rows}
        if {"kl", "target_kl"} <= set(rows):
            numbers["kl / target_kl"] = rows.kl / rows.target_kl
        for name, values in numbers.items():
            wrong = np.isinf(values) if name != "learner" else ~np.isfinite(values)  # others may be missing at first
            if wrong.any():
                where = f"{run.name}, after {rows.timesteps[wrong].iloc[0]:,} steps"
                raise ValueError(
                    f"{where}: {name} is {values[wrong].iloc[0]}: make the run again, or leave it out of the suite."
                )


def check_same_settings(runs: Sequence[FinishedRun]) -> None:
    """
    :param runs: records of finished runs
    :raises ValueError: naming two seeds of one algorithm in one cell that were made with other arguments or another
        normalisation, of which no average would mean anything
    """
    by_kind: dict[str, list[FinishedRun]] = {}
    for run in runs:
        by_kind.setdefault(kind_of(run.spec), []).append(run)
    for of_kind in by_kind.values():
        for one, other in combinations(of_kind, 2):
            differing = _differing_arguments(one, other)
            if None not in (one.normalize, other.normalize) and one.normalize != other.normalize:
                differing.append("normalize")
            if differing:
                raise ValueError(
                    f"{one.name} and {other.name} were made with different values of {differing}: make one of them again, "
                    "with the suite's settings, or leave it out of the suite."
                )


def _differing_arguments(one: FinishedRun, other: FinishedRun) -> list[str]:
    kind, _ = read_algorithm(one.spec.algorithm, one.spec.definition)
    mine, others = with_defaults(kind, one.arguments, other.arguments), with_defaults(kind, other.arguments, one.arguments)
    back = conflicts("arguments", others, mine)
    # What one of the two did not record, and what has no default, is in one list alone
    return [name for name in conflicts("arguments", mine, others) if name in back]


def with_equal_returns(tidy: pd.DataFrame) -> list[str]:
    """
    Find algorithms whose settings amount to the same.

    :param tidy: evaluations, see :func:`collect`
    :return: a sentence for each two algorithms of a cell with the same returns in all evaluations of all seeds that both have;
        returns of which most occur several times, as in games that are won or lost, may agree by chance, and are left out
    """
    found = []
    for (task, noise), cell in tidy.groupby(CELL, sort=False):
        returns = cell.pivot_table("learner", ["seed", "timesteps"], "algorithm", sort=False)
        for one, other in combinations(returns, 2):
            both = returns[[one, other]].dropna()
            if (both[one] == both[other]).all() and both[one].nunique() > max(1, len(both) / 2):
                where = task if noise == NO_NOISE else f"{task}, noise {noise}"
                found.append(
                    f"{where}: {one} and {other} have equal returns in all runs, so their settings amount to the same."
                )
    return found
