"""Means over episodes, with intervals by Student's t; its quantiles are here, since this package does not require scipy."""

import math
from typing import NamedTuple

import numpy as np

CONFIDENCE = 0.95


class Interval(NamedTuple):
    """
    A mean and its confidence interval.

    :param mean: mean of a sample
    :param low: lower end of the interval, ``-inf`` for a sample of one
    :param high: upper end of the interval, ``inf`` for a sample of one
    """

    mean: float
    low: float
    high: float


def probability_within(t: float, degrees: int) -> float:
    """
    :param t: bound on the variable's size, at least 0
    :param degrees: degrees of freedom, a whole number of at least 1
    :return: probability that a variable with Student's t distribution is between -t and t (Abramowitz and Stegun, 26.7.3 and
        26.7.4)
    """
    angle = math.atan(t / math.sqrt(degrees))
    is_odd = degrees % 2 == 1
    term, total = (math.cos(angle), 0.0) if is_odd else (1.0, 0.0)
    for power in range(1 if is_odd else 0, degrees - 1, 2):
        total += term
        term *= math.cos(angle) ** 2 * (power + 1) / (power + 2)
    return 2 / math.pi * (angle + math.sin(angle) * total) if is_odd else math.sin(angle) * total


def t_quantile(degrees: int, confidence: float = CONFIDENCE) -> float:
    """
    :param degrees: degrees of freedom, a whole number of at least 1
    :param confidence: probability, above 0 and below 1
    :return: t at which :func:`probability_within` is ``confidence``
    """
    low, high = 0.0, 1.0
    while probability_within(high, degrees) < confidence:
        high *= 2
    for _ in range(80):  # bisection: more halvings than a float has digits
        middle = (low + high) / 2
        low, high = (middle, high) if probability_within(middle, degrees) < confidence else (low, middle)
    return (low + high) / 2


def mean_interval(sample: np.ndarray) -> Interval:
    """
    Compute the mean of a sample and its confidence interval.

    :param sample: independent values, shape (N,), at least one
    :return: mean of the sample, with its interval by Student's t
    """
    mean, count = float(sample.mean()), len(sample)
    if count < 2:
        return Interval(mean, -math.inf, math.inf)
    half = t_quantile(count - 1) * float(sample.std(ddof=1)) / math.sqrt(count)
    return Interval(mean, mean - half, mean + half)
