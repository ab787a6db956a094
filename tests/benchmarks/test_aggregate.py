"""Scores of finished runs, by hand."""

import io
import math
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import benchmarks.bootstrap
from benchmarks.aggregate import choose_reference, compare, main, normalised_scores, run_scores, summarise_cells
from benchmarks.bootstrap import interval
from benchmarks.finished import FinishedRun
from benchmarks.run_checks import check_finite, with_equal_returns
from benchmarks.suite import RunSpec
from benchmarks.tidy import NO_NOISE, as_csv, read_tidy

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
#: Written by an earlier version, with more digits
WITH_MORE_DIGITS = {"halfcheetah", "independent", "precision"}


@pytest.fixture(autouse=True)
def _few_resamples(monkeypatch):
    monkeypatch.setattr(benchmarks.bootstrap, "REPETITIONS", 200)


def _evaluations(algorithm, seed, learner, task="T", guider=None):
    rows = pd.DataFrame({"timesteps": [5_000, 10_000], "learner": learner, "task": task, "noise": 0.1, "algorithm": algorithm})
    if guider is not None:
        rows = rows.assign(guider=guider, kl=[0.5, 0.008 + 0.003 * seed], target_kl=0.01)
    return rows.assign(seed=seed)


def test_summary_by_hand():
    """Curves that end below where they began, seeds in disorder, and one far from the others."""
    ours = {3: [50, 40], 0: [34, 10], 4: [500, 400], 1: [30, 20], 2: [46, 22]}
    tidy = pd.concat(
        [
            *(_evaluations("gac", seed, learner, guider=[1, learner[1] + 1]) for seed, learner in ours.items()),
            *(_evaluations("sac-asym", seed, [97, 98.4]) for seed in (0, 1)),
        ]
    ).sort_values("timesteps", ascending=False, kind="stable")
    ours, theirs = summarise_cells(tidy, reference="sac-asym")
    assert (ours["seeds"], ours["final"]) == ([0, 1, 2, 3, 4], [10, 20, 22, 40, 400])
    assert ours["final_mean"] == 98.4
    assert ours["final_iqm"][0] == 27.3333, "(20 + 22 + 40) / 3; the median is 22"
    assert ours["area_iqm"][0] == 34.6667, "(25 + 34 + 45) / 3, of means over the two evaluations"
    assert (ours["steps_to_reference"], theirs["steps_to_reference"]) == (5_000, 10_000)
    assert ours["guider_mean"] == 99.4
    assert (ours["kl_over_target_min"], ours["kl_over_target_mean"], ours["kl_over_target_max"]) == (0.8, 1.4, 2.0)
    assert theirs["final_iqm"] == [98.4, 98.4, 98.4]
    assert "guider_mean" not in theirs


def test_an_algorithm_reaches_its_own_end():
    """The mean of these three differs in its last digit by the order of the sum."""
    ends = {0: 2002.46, 1: 1996.09, 2: 2001.34}
    tidy = pd.concat([_evaluations("sac-asym", seed, [0, end]) for seed, end in ends.items()])
    (cell,) = summarise_cells(tidy, reference="sac-asym")
    assert cell["steps_to_reference"] == 10_000


@pytest.mark.parametrize("name", sorted({path.stem for path in RESULTS.glob("*.csv")} - WITH_MORE_DIGITS))
def test_committed_results_are_written_as_they_are(name):
    path = RESULTS / f"{name}.csv"
    assert as_csv(read_tidy(path)) == path.read_text()


def test_returns_have_six_digits_and_a_noise_as_many_as_it_takes():
    noises = {0.1: "0.1", 0.0: "0", 1.0: "1", 0.33333333: "0.33333333", 1e-7: "1e-07", NO_NOISE: ""}
    tidy = pd.concat([_evaluations("gac", 0, [1 / 3, 2]).assign(noise=noise) for noise in noises])
    rows = [line.split(",") for line in as_csv(tidy).splitlines()]
    assert [row[rows[0].index("noise")] for row in rows[1::2]] == list(noises.values())
    assert {row[rows[0].index("learner")] for row in rows[1:]} == {"0.333333", "2"}


@pytest.mark.parametrize("name", ["NA", "None", "2048", "0.10", "nan"])
def test_names_that_look_like_numbers_or_gaps_are_names(name):
    written = io.StringIO()
    pd.concat([_evaluations(name, 0, [1, 2], task=name), _evaluations("sac", 0, [1, 2], task=name)]).to_csv(
        written, index=False
    )
    written.seek(0)
    cells = summarise_cells(read_tidy(written), reference=name)
    assert [(cell["task"], cell["algorithm"], cell["steps_to_reference"]) for cell in cells] == [
        (name, name, 10_000),
        (name, "sac", 10_000),
    ]


def test_a_runs_scores_are_its_last_return_and_the_mean_of_all():
    rows = [{"timesteps": steps, "learner": value} for steps, value in ((300, 3.0), (100, 0.0), (200, 30.0))]
    tidy = pd.DataFrame(rows).assign(task="T", noise=0.1, algorithm="gac", seed=0)
    (scores,) = run_scores(tidy).to_dict("records")
    assert (scores["final"], scores["area"]) == (3, 11)


def test_the_ends_of_an_interval_leave_out_5_percent():
    """
    The mean of three values from 0, 3 and 30 that are drawn with replacement is 0 once in 27 times, and 30 as often: more than
    2.5%, less than 5%. In five draws, the middle three are all 0 in 0.7% of all cases, and 0, 0 and 3 in as much as 2.5%.
    """
    assert interval(np.array([0.0, 3.0, 30.0])) == [11, 0, 30]
    _, low, _ = interval(np.array([0.0, 3.0, 30.0, 300.0, 3000.0]))
    assert low > 0


def _finals(finals_of, start=0.0):
    """
    :param finals_of: (algorithm, task) -> final return by seed, in order or as a dict
    :param start: return at the first evaluation of all
    """
    return pd.concat(
        [
            _evaluations(algorithm, seed, [start, final], task)
            for (algorithm, task), finals in finals_of.items()
            for seed, final in (finals if isinstance(finals, dict) else dict(enumerate(finals))).items()
        ]
    )


def test_comparison_by_hand():
    """One algorithm is twice as good in the first task and worse in one of two runs of the second."""
    finals = {("gac", "T"): [20, 20], ("sac", "T"): [10, 10], ("gac", "U"): [30, 50], ("sac", "U"): [40, 40]}
    results = compare(_finals(finals))
    # Between 0 and 20, 0 and 40: gac 1, 1, 0.75, 1.25; sac 0.5, 0.5, 1, 1; the middle half of each
    assert results["normalised_iqm"]["gac"][0] == 1.0
    assert results["normalised_iqm"]["sac"][0] == 0.75
    assert results["probability_of_improvement"]["gac over sac"][0] == pytest.approx((1 + 0.5) / 2)
    point, low, high = results["probability_of_improvement"]["sac over gac"]
    assert low <= point <= high


@pytest.mark.parametrize("shift", [-1000.0, -30.0, -20.0, 7.0])
def test_the_comparison_does_not_depend_on_where_returns_are_zero(shift):
    finals = {("gac", "T"): [20, 20], ("sac", "T"): [10, 15], ("gac", "U"): [30, 50], ("sac", "U"): [40, 44]}
    shifted = {key: [final + shift for final in values] for key, values in finals.items()}
    plain, moved = compare(_finals(finals)), compare(_finals(shifted, start=shift))
    assert moved["normalised_iqm"] == plain["normalised_iqm"]
    assert moved["normalised_iqm"]["gac"][0] > moved["normalised_iqm"]["sac"][0], "less negative is better"
    assert moved["compared"]["cells"][0]["low"] == shift


def test_intervals_are_the_same_every_time_and_leave_the_global_generator_alone():
    tidy = _finals({(name, "T"): np.random.RandomState(seed).normal(size=5) for seed, name in enumerate(("gac", "sac"))})
    np.random.seed(1)
    first, drawn = compare(tidy), np.random.random()
    np.random.seed(1)
    assert np.random.random() == drawn
    assert compare(tidy) == first


def test_where_nobody_differs_all_are_the_best():
    results = compare(_finals({("gac", "T"): [0, 0], ("sac", "T"): [0, 0]}))
    assert results["normalised_iqm"] == {"gac": [1, 1, 1], "sac": [1, 1, 1]}


def test_cells_with_other_numbers_of_seeds_are_compared_on_equally_many():
    finals = {
        ("gac", "T"): [20, 20, 90],
        ("sac", "T"): [10, 10, 90],
        ("gac", "U"): {5: 30, 6: 50},
        ("sac", "U"): {5: 40, 6: 40},
        ("sb3", "T"): [1, 1],
    }
    compared = compare(_finals(finals))["compared"]
    assert (compared["algorithms"], compared["left_out"]) == (["gac", "sac"], ["sb3"])
    assert [cell["seeds"]["gac"] for cell in compared["cells"]] == [[0, 1], [5, 6]]
    assert [cell["seeds"]["sac"] for cell in compared["cells"]] == [[0, 1], [5, 6]]


def test_nothing_in_common_is_no_comparison():
    results = compare(_finals({("gac", "T"): [1, 2], ("sac", "U"): [1, 2]}))
    assert results["compared"] == {"algorithms": [], "left_out": ["gac", "sac"], "cells": []}
    assert results["normalised_iqm"] == results["probability_of_improvement"] == {}


def test_the_reference_is_one_that_is_there():
    assert choose_reference(["gac", "sac-asym"]) == "sac-asym"
    assert choose_reference(["gac", "gac-independent"]) == "gac"
    assert choose_reference(["gac", "sac-asym"], "gac") == "gac"
    with pytest.raises(ValueError, match=r"reference must be one of \['gac'\], got 'sac'"):
        choose_reference(["gac"], "sac")


def test_runs_keep_their_order_whatever_a_machine_sorts_with():
    """Unstable sorts differ between processors, and with the order the intervals' random numbers."""
    names = [f"a{number}" for number in np.random.default_rng(0).permutation(200)]
    tidy = pd.concat([_evaluations(name, 0, [0, 1]) for name in names])
    assert run_scores(tidy).algorithm.tolist() == names


@pytest.mark.parametrize(
    ("one", "other", "low", "high"),
    [([5.0, 1.0], [3.0, 9.0], 1.0, 9.0), ([5.0, 4.0], [9.0, 3.0], 3.0, 4.0), ([2.0, 6.0], [3.0, 5.0], 2.0, 6.0)],
)
def test_scores_lie_between_the_lowest_point_of_any_curve_and_the_best_end(one, other, low, high):
    """Wherever the lowest point is: curves may fall."""
    scores = normalised_scores(pd.concat([_evaluations("a", 0, one), _evaluations("b", 0, other)]))
    assert scores.low.unique().tolist() == [low]
    assert scores.high.unique().tolist() == [high]
    assert scores.normalised.tolist() == pytest.approx([(end - low) / (high - low) for end in (one[-1], other[-1])])


def test_the_probability_of_the_other_way_round_is_the_complement():
    finals = {(name, "T"): np.random.RandomState(seed).normal(size=5) for seed, name in enumerate(("gac", "sac", "tgrl"))}
    chances = compare(_finals(finals))["probability_of_improvement"]
    assert list(chances) == [f"{a} over {b}" for a in ("gac", "sac", "tgrl") for b in ("gac", "sac", "tgrl") if a != b]
    for one, other in (("gac", "sac"), ("gac", "tgrl"), ("sac", "tgrl")):
        point, low, high = chances[f"{one} over {other}"]
        assert chances[f"{other} over {one}"] == pytest.approx([1 - point, 1 - high, 1 - low], abs=2e-3)
        assert low <= point <= high


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"learner": [1.0, math.nan]}, "gac/seed3, after 20 steps: learner is nan"),
        ({"learner": [-math.inf, 1.0]}, "gac/seed3, after 10 steps: learner is -inf"),
        ({"guider": [1.0, math.inf]}, "gac/seed3, after 20 steps: guider is inf"),
        ({"kl": [math.nan, 0.1], "target_kl": [math.nan, 0.0]}, "gac/seed3, after 20 steps: kl / target_kl is inf"),
        ({"kl": [math.nan, 0.1], "target_kl": [math.nan, 0.1]}, ""),
    ],
)
def test_a_run_whose_numbers_cannot_be_averaged_is_named(change, message):
    spec = RunSpec("gac", "Hopper", 0.1, 3, 20, 1, "small", 10, 1)
    rows = pd.DataFrame({"timesteps": [10, 20], "learner": [1.0, 2.0], **change})
    with pytest.raises(ValueError, match=message) if message else nullcontext():
        check_finite([FinishedRun(spec, rows, {}, [], 1.0, 1)])


def test_algorithms_with_equal_returns_are_named():
    """Their settings amount to the same, which their names hide."""

    def found(of_b, of_c=(5.0, 6.0)):
        runs = [_evaluations("a", seed, [seed, seed + 0.5]) for seed in (0, 3)] + [_evaluations("b", 0, of_b[:2])]
        runs += [_evaluations("b", 3, of_b[2:]), _evaluations("c", 0, of_c), _evaluations("c", 3, of_c)]
        return with_equal_returns(pd.concat(runs))

    equal = ["T, noise 0.1: a and b have equal returns in all runs, so their settings amount to the same."]
    assert found([0.0, 0.5, 3.0, 3.5]) == equal
    assert found([0.0, 0.5, 3.0, 3.4]) == []
    won_or_lost = pd.concat([_evaluations(name, seed, [0.0, 1.0]) for name in "ab" for seed in range(3)])
    assert with_equal_returns(won_or_lost) == []
    other_tasks = pd.concat([_evaluations("a", 0, [1.0, 2.0]), _evaluations("b", 0, [1.0, 2.0], task="U")])
    assert with_equal_returns(other_tasks) == []
    assert with_equal_returns(pd.concat([_evaluations("a", 0, [1.0, 2.0]), _evaluations("b", 1, [1.0, 2.0])])) == []


def test_results_are_not_begun_without_their_runs(tmp_path):
    suite = Path(__file__).parents[2] / "benchmarks/suites/smoke.yml"
    for more, message in (
        ([], "4 runs are not finished"),
        (["--rerun", "gca"], r"--rerun: the suite has no algorithms \['gca'\]; it has \['gac', 'sac-asym'\]"),
    ):
        with pytest.raises(SystemExit, match=message):
            main([str(suite), "--runs", str(tmp_path), "--out", str(tmp_path / "made"), *more])
    assert not list(tmp_path.iterdir())
