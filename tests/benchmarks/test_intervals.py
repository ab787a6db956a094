"""Intervals of means and of differences by hand, and that they hold for few seeds."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.intervals import Difference, difference, mean_interval


def test_a_difference_by_hand():
    """Variances 1 and 4, three seeds: standard error sqrt(5 / 3), Welch's degrees of freedom (5/3)^2 / (1/18 + 16/18)."""
    one, other = np.array([9.0, 10.0, 11.0]), np.array([3.0, 5.0, 7.0])
    freedom = (5 / 3) ** 2 / ((1 / 3) ** 2 / 2 + (4 / 3) ** 2 / 2)
    assert freedom == pytest.approx(2.941, abs=1e-3)
    found = difference({"a": one, "b": other}, "a", "b")
    half = 3.2187 * math.sqrt(5 / 3)  # the 97.5% point of Student's t with so many degrees of freedom, from a table
    assert found.value == 5.0
    assert (found.low, found.high) == pytest.approx((5 - half, 5 + half), abs=0.01)


def test_the_interval_of_a_mean_by_hand():
    mean, low, high = mean_interval(np.array([1.0, 2.0, 3.0]))
    assert (mean, low, high) == pytest.approx((2.0, 2 - 4.3027 / math.sqrt(3), 2 + 4.3027 / math.sqrt(3)), abs=1e-3)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31), n_seeds=st.integers(2, 8), shift=st.floats(-1e3, 1e3))
def test_a_difference_is_antisymmetric_and_does_not_see_a_shift(seed, n_seeds, shift):
    scores = dict(zip("ab", np.random.RandomState(seed).normal(size=(2, n_seeds)), strict=True))
    found = difference(scores, "a", "b")
    back = difference(scores, "b", "a")
    shifted = difference({name: values + shift for name, values in scores.items()}, "a", "b")
    assert (back.value, back.low, back.high) == pytest.approx((-found.value, -found.high, -found.low))
    assert shifted[2:] == pytest.approx(found[2:], abs=1e-6)
    assert found.low <= found.value <= found.high


def test_intervals_hold_for_three_seeds():
    """Of a hundred repetitions without any difference, about five exclude 0: 1.96 standard errors would exclude it in 16."""
    numbers = np.random.RandomState(0).normal(size=(500, 2, 3))
    found = [difference({"a": one, "b": other}, "a", "b") for one, other in numbers]
    assert 0.01 < np.mean([one.low > 0 or one.high < 0 for one in found]) < 0.06


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (1, 9, "more"),
        (-9, -1, "less"),
        (-1, 9, "unknown"),
        (-0.4, 0.4, "same"),
        (0.1, 0.4, "same"),
        (-math.inf, math.inf, "unknown"),
    ],
)
def test_verdicts(low, high, verdict):
    assert Difference("a", "b", (low + high) / 2, low, high).verdict(negligible=0.5) == verdict
