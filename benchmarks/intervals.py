"""Confidence intervals of means and of their differences that hold for few seeds, by Student's t and Welch's t."""

import math
import warnings
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy import stats

CONFIDENCE = 0.95


class Difference(NamedTuple):
    """
    The difference of two algorithms' mean scores.

    :param better: name of the first algorithm
    :param other: name of the algorithm whose mean is subtracted
    :param value: difference of the means
    :param low: lower end of the difference's interval by Welch's t test, ``-inf`` with a single seed
    :param high: upper end of the interval, ``inf`` with a single seed
    """

    better: str
    other: str
    value: float
    low: float
    high: float

    def verdict(self, negligible: float) -> str:
        """
        :param negligible: size from which on a difference matters
        :return: "same" if the whole interval is nearer to 0 than that; otherwise "more" if the interval is above 0, "less" if
            it is below 0, and "unknown" if it contains 0
        """
        if -negligible < self.low and self.high < negligible:
            return "same"
        return "more" if self.low > 0 else "less" if self.high < 0 else "unknown"


def mean_interval(scores: np.ndarray) -> tuple[float, float, float]:
    """
    :param scores: one score for each seed, shape (N,)
    :return: mean of the scores, and the ends of its interval by Student's t, which are infinite with a single seed
    """
    mean, count = float(scores.mean()), len(scores)
    if count < 2:
        return mean, -math.inf, math.inf
    half = float(stats.t.ppf((1 + CONFIDENCE) / 2, count - 1) * scores.std(ddof=1) / math.sqrt(count))
    return mean, mean - half, mean + half


def difference(scores: Mapping[str, np.ndarray], better: str, other: str) -> Difference:
    """
    :param scores: algorithm -> one score for each seed
    :param better: name of an algorithm
    :param other: name of the algorithm whose mean is subtracted
    :return: difference of the two means, with Welch's interval, which lets the two variances differ
    """
    one, two = scores[better], scores[other]
    value = float(one.mean() - two.mean())
    if min(len(one), len(two)) < 2:
        return Difference(better, other, value, -math.inf, math.inf)
    if one.std() == two.std() == 0:
        return Difference(better, other, value, value, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # scipy warns where one of the two does not vary
        low, high = stats.ttest_ind(one, two, equal_var=False).confidence_interval(CONFIDENCE)
    return Difference(better, other, value, float(low), float(high))
