"""Means over episodes, with intervals by Student's t; scipy, which has its quantiles, is no requirement of this package."""

import math
from typing import NamedTuple

import numpy as np

CONFIDENCE = 0.95


class Interval(NamedTuple):
    """
    A mean and where it may be.

    :param mean: of a sample
    :param low: end of its interval, ``-inf`` for a sample of one
    :param high: the other end
    """

    mean: float
    low: float
    high: float


def probability_within(t: float, degrees: int) -> float:
    """
    :param t: at least 0
    :param degrees: of freedom, a whole number of at least 1
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
    :param degrees: of freedom, a whole number of at least 1
    :param confidence: above 0, below 1
    :return: t with :func:`probability_within` of ``confidence``
    """
    low, high = 0.0, 1.0
    while probability_within(high, degrees) < confidence:
        high *= 2
    for _ in range(80):  # halving: more than the digits of a float
        middle = (low + high) / 2
        low, high = (middle, high) if probability_within(middle, degrees) < confidence else (low, middle)
    return (low + high) / 2


def mean_interval(sample: np.ndarray) -> Interval:
    """
    :param sample: independent values, shape (N,), at least one
    :return: their mean, and its interval by Student's t
    """
    mean, count = float(sample.mean()), len(sample)
    if count < 2:
        return Interval(mean, -math.inf, math.inf)
    half = t_quantile(count - 1) * float(sample.std(ddof=1)) / math.sqrt(count)
    return Interval(mean, mean - half, mean + half)
