"""
The worth of privileged information on a task: differences of returns between algorithms that see it at deployment, in
training, or never, with intervals that hold for few seeds, and conclusions in words. For aggregated results, the command ::

    python -m benchmarks.headroom benchmarks/results/baselines --reference sac-asym

prints the ends of all runs, how much they vary, and each algorithm's difference from one of them.
"""

import argparse
import math
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from benchmarks.intervals import CONFIDENCE, Difference, difference, mean_interval
from benchmarks.tidy import NO_NOISE, after_needed, file_of, names_apart, number, read_tidy, steps_before, together
from sb3_gac.envs.table import in_columns

FULL, ASYMMETRIC, GUIDED, PARTIAL = "sac-full", "sac-asym", "gac", "sac"
#: Algorithms without privileged entries at deployment, the simplest first: of several that come equally far, it is enough
SIMPLER_FIRST = (PARTIAL, ASYMMETRIC, GUIDED)
#: What trains nothing, so that nobody need deploy it
UNTRAINED = "random-actions"
#: Share of a run's evaluations, the last ones, whose mean is the run's end; one evaluation of a few episodes says little
END = 0.25
#: Share of the learned return below which a difference does not matter
NEGLIGIBLE = 0.05
#: Share of the learned return that the recommended number of seeds shows in four of five repetitions
WORTH_SEEING, POWER = 0.1, 0.8


class Worth(NamedTuple):
    """
    The worth of privileged information on a task.

    :param ends: algorithm -> each seed's end, the mean return over the last quarter of the evaluations, shape (N,)
    :param areas: algorithm -> each seed's mean return over all evaluations, shape (N,)
    :param untrained: name of a policy without training -> its mean return, and the two ends of its interval
    :param span: learned return: the best algorithm's mean end, less the mean return of the best policy without training
    :param headroom: difference of SAC on the full state over SAC-asym, ``None`` if one of the two has no runs
    :param in_training: difference of SAC-asym over SAC on partial alone, ``None`` if one of the two has no runs
    :param guider: difference of GAC over SAC-asym, ``None`` if one of the two has no runs
    :param deployable: algorithms that need no privileged entry at deployment, the simplest first
    :param needed: algorithm -> environment steps of the runs that one of its runs needs, such as a teacher's, on top of its
        own; without those that need none
    """

    ends: dict[str, np.ndarray]
    areas: dict[str, np.ndarray]
    untrained: dict[str, tuple[float, float, float]]
    span: float
    headroom: Difference | None
    in_training: Difference | None
    guider: Difference | None
    deployable: list[str]
    needed: dict[str, int]

    @property
    def floor(self) -> str:
        """The best policy without training, which a trained one must leave behind."""
        return max(self.untrained, key=lambda name: self.untrained[name][0])

    @property
    def learned(self) -> list[str]:
        """The algorithms whose median end is above the interval of the best policy without training."""
        return [name for name, end in self.ends.items() if np.median(end) > self.untrained[self.floor][2]]

    @property
    def deployable_span(self) -> float:
        """
        The learned return of the best algorithm that can be deployed, so that one that can't be does not make it larger; NaN
        if none of them has learned.
        """
        best = max((float(self.ends[name].mean()) for name in self.deployable if name in self.learned), default=math.nan)
        return best - self.untrained[self.floor][0]

    def span_of(self, one: Difference) -> float:
        """
        :param one: difference of two algorithms
        :return: learned return that the difference is a share of: that of the deployable ones, if both are; NaN if none of
            these has learned
        """
        return self.deployable_span if {one.better, one.other} <= set(self.deployable) else self.span

    def verdict(self, one: Difference) -> str:
        """
        :param one: difference of two algorithms
        :return: "same", "more", "less" or "unknown", see :meth:`Difference.verdict`; "unlearned" if there is no learned return
            that the difference could be a share of
        """
        span = self.span_of(one)
        return "unlearned" if math.isnan(span) else one.verdict(NEGLIGIBLE * span)


def worth(tidy: pd.DataFrame, untrained: Mapping[str, np.ndarray], deployable: Collection[str]) -> Worth:
    """
    :param tidy: evaluations of one task, with the columns algorithm, seed, timesteps and learner
    :param untrained: name of a policy without training, such as "random actions" -> returns of its episodes, shape (N,)
    :param deployable: names of the algorithms whose deployed policy reads no privileged entry
    :return: worth of privileged information on the task
    """
    ends = by_algorithm(tidy, end_of)
    pairs = ((FULL, ASYMMETRIC), (ASYMMETRIC, PARTIAL), (GUIDED, ASYMMETRIC))
    headroom, in_training, guider = (difference(ends, *pair) if set(pair) <= set(ends) else None for pair in pairs)
    best = max(float(end.mean()) for end in ends.values())
    means = {name: mean_interval(returns) for name, returns in untrained.items()}
    span = best - max(mean for mean, _, _ in means.values())
    names = [name for name in ends if name in deployable and name != UNTRAINED]
    simpler_first = sorted(names, key=lambda name: SIMPLER_FIRST.index(name) if name in SIMPLER_FIRST else len(SIMPLER_FIRST))
    areas = by_algorithm(tidy, np.mean)
    return Worth(ends, areas, means, span, headroom, in_training, guider, simpler_first, steps_needed(tidy))


def steps_needed(tidy: pd.DataFrame) -> dict[str, int]:
    """
    :param tidy: evaluations, see :func:`worth`
    :return: algorithm -> environment steps of the runs that one of its runs needs, without algorithms that need none
    """
    steps = {str(name): steps_before(runs) for name, runs in tidy.groupby("algorithm")}
    return {name: number for name, number in steps.items() if number}


def end_of(returns: np.ndarray) -> float:
    """
    :param returns: mean returns of a run's evaluations, in their order, shape (N,)
    :return: mean of the last quarter of the evaluations
    """
    return float(returns[-math.ceil(END * len(returns)) :].mean())


def by_algorithm(tidy: pd.DataFrame, score: Callable[[np.ndarray], float]) -> dict[str, np.ndarray]:
    """
    :param tidy: evaluations, see :func:`worth`
    :param score: function of a run's mean returns, in the order of the evaluations
    :return: algorithm -> scores of its runs, shape (N,)
    """
    scores: dict[str, list[float]] = {str(name): [] for name in tidy.algorithm.unique()}
    for (name, _), run in tidy.sort_values("timesteps", kind="stable").groupby(["algorithm", "seed"], sort=False):
        scores[name].append(score(run.learner.to_numpy()))
    return {name: np.array(of_seeds) for name, of_seeds in scores.items()}


def headroom_curve(tidy: pd.DataFrame) -> pd.DataFrame:
    """
    :param tidy: evaluations, see :func:`worth`
    :return: table with one row for each evaluation: "timesteps", and the mean return of SAC on the full state less that of
        SAC-asym, "value", with the ends of its interval, "low" and "high"; empty if one of the two has no runs
    """
    rows = []
    for step, at_step in tidy.groupby("timesteps"):
        scores = {str(name): group.learner.to_numpy() for name, group in at_step.groupby("algorithm")}
        if {FULL, ASYMMETRIC} <= set(scores):
            of_both = difference(scores, FULL, ASYMMETRIC)
            rows.append({"timesteps": step, "value": of_both.value, "low": of_both.low, "high": of_both.high})
    return pd.DataFrame(rows, columns=["timesteps", "value", "low", "high"])


def seeds_to_see(found: Worth, part: float = WORTH_SEEING) -> int | None:
    """
    :param found: worth of privileged information on the task
    :param part: size of a difference, as a share of the learned return of the best algorithm that can be deployed
    :return: number of seeds of each algorithm that shows such a difference in four of five repetitions, estimated from the
        variances of the runs; ``None`` with single seeds, which have no variance, or if nothing was learned
    """
    variances = [float(end.var(ddof=1)) for end in found.ends.values() if len(end) > 1]
    size = part * found.deployable_span
    if not variances or not size > 0:
        return None
    deviation = math.sqrt(np.mean(variances))
    normal = float(stats.norm.ppf((1 + CONFIDENCE) / 2) + stats.norm.ppf(POWER))
    seeds = max(2, math.floor(2 * (normal * deviation / size) ** 2))  # for known variances, so at most as many as are needed
    while power(seeds, size, deviation) < POWER:
        seeds += 1
    return seeds


def power(seeds: int, size: float, deviation: float) -> float:
    """
    :param seeds: number of seeds of each of two algorithms
    :param size: difference of the algorithms' means
    :param deviation: standard deviation of the runs of each algorithm
    :return: probability that the interval of the difference, by Student's t, leaves 0 out
    """
    if deviation == 0:
        return 1.0
    freedom, shift = 2 * seeds - 2, size / (deviation * math.sqrt(2 / seeds))
    bound = float(stats.t.ppf((1 + CONFIDENCE) / 2, freedom))
    return float(stats.nct.sf(bound, freedom, shift) + stats.nct.cdf(-bound, freedom, shift))


def ends_table(tidy: pd.DataFrame, reference: str) -> list[list[str]]:
    """
    :param tidy: aggregated evaluations of any number of cells
    :param reference: name of the algorithm with whose mean end the others' are compared
    :return: one row for each algorithm of each cell: task, noise, algorithm, each seed's end, their mean, their standard
        deviation as a share of the mean, and the difference from the reference with its interval; a value that does not exist
        is an empty text
    """
    rows = []
    for (task, noise), cell in tidy.groupby(["task", "noise"], sort=False):
        ends, needed = by_algorithm(cell, end_of), steps_needed(cell)
        for name, of_seeds in ends.items():
            spread = f"{of_seeds.std(ddof=1) / abs(of_seeds.mean()):.0%}" if len(of_seeds) > 1 and of_seeds.mean() else ""
            compared = difference(ends, name, reference)[2:] if reference in ends and name != reference else ()
            seeds, over = ", ".join(map(number, of_seeds)), ", ".join(map(number, compared))
            rows.append(
                [
                    str(task),
                    "" if noise == NO_NOISE else f"{noise:g}",
                    after_needed(name, needed.get(name, 0)),
                    seeds,
                    number(float(of_seeds.mean())),
                    spread,
                    over,
                ]
            )
    return rows


def read_together(paths: Sequence[Path]) -> pd.DataFrame:
    """
    Read several results, such as those of as many steps and of five times as many.

    :param paths: paths of aggregated results, without a suffix
    :return: aggregated evaluations of all; an algorithm that earlier results have too bears the name of its own results, after
        as many of their folders as tell them apart
    :raises ValueError: if two paths are the same
    """
    tables: list[pd.DataFrame] = []
    for path, of_results in zip(paths, names_apart(paths), strict=True):
        tidy = read_tidy(file_of(path, "csv"))
        known = {name for table in tables for name in table.algorithm}
        tables.append(tidy.assign(algorithm=[f"{name} ({of_results})" if name in known else name for name in tidy.algorithm]))
    return together(tables)


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Entry point of the command line.

    :param arguments: command-line arguments, by default those of the process
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+", help="paths of aggregated results, without a suffix")
    parser.add_argument("--reference", help=f"algorithm to compare with (default: {ASYMMETRIC})")
    options = parser.parse_args(arguments)
    try:
        tidy = read_together(options.results)
    except (ValueError, OSError) as error:
        sys.exit(str(error))
    reference, names = options.reference or ASYMMETRIC, sorted(tidy.algorithm.unique())
    if options.reference and reference not in names:
        sys.exit(f"--reference: the results have no algorithm {reference!r}; they have {names}.")
    head = ["task", "noise", "algorithm", "each seed's end", "mean", "spread", f"over {reference}: value, low, high"]
    print(in_columns(head, ends_table(tidy, reference)))


if __name__ == "__main__":
    main()
