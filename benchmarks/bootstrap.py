"""Stratified bootstraps of 95% over runs and cells (rliable, arXiv 2108.13264)."""

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from itertools import combinations, permutations
from typing import Any, TypeVar

import numpy as np
from rliable import library as rly
from rliable import metrics

REPETITIONS = 2_000
#: A value, and the two ends of its interval
Estimate = tuple[float, tuple[float, float]]
Name = TypeVar("Name", bound=Hashable)


@contextmanager
def _from_one_seed() -> Iterator[None]:
    """Seed numpy's global generator as long as the context lasts, and restore its state afterwards."""
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)


def estimate(scores: dict[Name, Any], metric: Callable[..., float]) -> dict[Name, Estimate]:
    """
    Estimate a metric with its bootstrap interval. The random numbers start from a fixed seed, so that the same scores give the
    same interval.

    :param scores: name -> arguments of the metric: scores of shape (runs, cells), or a tuple of such arrays
    :param metric: one of rliable's metrics
    :return: name -> value of the metric, and its interval
    """
    if not scores:
        return {}

    def as_array(*arguments: np.ndarray) -> np.ndarray:
        return np.array([metric(*arguments)])

    with _from_one_seed():
        points, intervals = rly.get_interval_estimates(scores, as_array, reps=REPETITIONS)
    return {name: (float(points[name][0]), (float(intervals[name][0, 0]), float(intervals[name][1, 0]))) for name in scores}


def interval(scores: np.ndarray) -> list[float]:
    """
    :param scores: one score for each run, shape (N,)
    :return: interquartile mean of the scores, and the two ends of its interval
    """
    point, (low, high) = estimate({"one": scores[:, None]}, metrics.aggregate_iqm)["one"]
    return [point, low, high]


def improvements(matrices: dict[str, np.ndarray]) -> dict[str, Estimate]:
    """
    Estimate the probability of improvement of each algorithm over each other. The bootstrap is drawn once for each pair, since
    the probability in the other direction is the complement.

    :param matrices: algorithm -> scores, shape (runs, cells)
    :return: "one over other" -> probability that a run of the one algorithm scores more than a run of the other, with its
        interval
    """
    pairs = {(one, other): (matrices[one], matrices[other]) for one, other in combinations(matrices, 2)}
    estimates = estimate(pairs, metrics.probability_of_improvement)
    estimates |= {(other, one): _complement(drawn) for (one, other), drawn in estimates.items()}
    return {f"{one} over {other}": estimates[one, other] for one, other in permutations(matrices, 2)}


def _complement(drawn: Estimate) -> Estimate:
    point, (low, high) = drawn
    return 1 - point, (1 - high, 1 - low)


def profile(scores: dict[str, np.ndarray], thresholds: np.ndarray) -> dict[str, np.ndarray]:
    """
    :param scores: algorithm -> one score for each run, of all cells together
    :param thresholds: scores to compare with, shape (T,)
    :return: algorithm -> share of its runs above each threshold, and the two ends of the share's interval, shape (3, T)
    """
    matrices = {name: of_runs[:, None] for name, of_runs in scores.items()}
    with _from_one_seed():
        shares, intervals = rly.create_performance_profile(matrices, thresholds, reps=REPETITIONS)
    return {name: np.stack([shares[name], *intervals[name]]) for name in scores}
