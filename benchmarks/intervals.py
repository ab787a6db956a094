"""Intervals of means and of their differences that hold for few seeds, by Student's t and Welch's."""

import math
import warnings
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy import stats

CONFIDENCE = 0.95


class Difference(NamedTuple):
    """
    Of two algorithms' mean scores.

    :param better: name of the first
    :param other: name of the one whose mean is taken off
    :param value: of the difference
    :param low: end of its interval by Welch's t test; ``-inf`` with a single seed
    :param high: the other end
    """

    better: str
    other: str
    value: float
    low: float
    high: float

    def verdict(self, negligible: float) -> str:
        """
        :param negligible: a difference that does not matter
        :return: "more", "less", "same", if all of the interval does not matter, or "unknown"
        """
        if -negligible < self.low and self.high < negligible:
            return "same"
        return "more" if self.low > 0 else "less" if self.high < 0 else "unknown"


def mean_interval(scores: np.ndarray) -> tuple[float, float, float]:
    """
    :param scores: one by seed
    :return: their mean, and the ends of its interval by Student's t, which are infinite with a single seed
    """
    mean, count = float(scores.mean()), len(scores)
    if count < 2:
        return mean, -math.inf, math.inf
    half = float(stats.t.ppf((1 + CONFIDENCE) / 2, count - 1) * scores.std(ddof=1) / math.sqrt(count))
    return mean, mean - half, mean + half


def difference(scores: Mapping[str, np.ndarray], better: str, other: str) -> Difference:
    """
    :param scores: algorithm -> one by seed
    :param better: one of them
    :param other: another
    :return: of their means, with Welch's interval: the two may vary differently
    """
    one, two = scores[better], scores[other]
    value = float(one.mean() - two.mean())
    if min(len(one), len(two)) < 2:
        return Difference(better, other, value, -math.inf, math.inf)
    if one.std() == two.std() == 0:
        return Difference(better, other, value, value, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # that one of the two does not vary is no loss of precision
        low, high = stats.ttest_ind(one, two, equal_var=False).confidence_interval(CONFIDENCE)
    return Difference(better, other, value, float(low), float(high))
