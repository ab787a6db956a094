"""Student's t without scipy, against tables, scipy and a sample worked out by hand."""

import math

import numpy as np
import pytest

from sb3_gac.evaluation.statistics import mean_interval, probability_within, t_quantile

#: Two-sided 95% and 99%, from printed tables
TABLE = {1: (12.706, 63.657), 2: (4.303, 9.925), 3: (3.182, 5.841), 4: (2.776, 4.604), 9: (2.262, 3.250), 19: (2.093, 2.861)}


@pytest.mark.parametrize("degrees", TABLE)
def test_quantiles_are_those_of_printed_tables(degrees):
    found = t_quantile(degrees), t_quantile(degrees, 0.99)
    assert found == pytest.approx(TABLE[degrees], abs=6e-4)


def test_quantiles_and_probabilities_are_scipys():
    stats = pytest.importorskip("scipy.stats", reason="the oracle")
    for degrees in [*range(1, 40), 99, 100, 999]:
        assert t_quantile(degrees) == pytest.approx(stats.t.ppf(0.975, degrees), rel=1e-9)
        for t in (0.0, 0.3, 1.0, 7.5):
            expected = stats.t.cdf(t, degrees) - stats.t.cdf(-t, degrees)
            assert probability_within(t, degrees) == pytest.approx(expected, abs=1e-12)


def test_an_interval_by_hand():
    """Mean 4, standard deviation 2, four values: 4 +- 3.182 * 2 / 2."""
    sample = np.array([4 - math.sqrt(6), 4 + math.sqrt(6), 4.0, 4.0])
    assert mean_interval(sample) == pytest.approx((4, 4 - 3.182, 4 + 3.182), abs=1e-3)
    assert mean_interval(np.array([5.0])) == (5, -math.inf, math.inf)
    assert mean_interval(np.array([5.0, 5.0])) == (5, 5, 5)
