"""The page's sentences and tables, without a browser."""

import re

import pytest

from benchmarks.page.document import _about_intervals, normalised_returns
from benchmarks.page.plots import over_seconds, plots
from benchmarks.page.summary import in_short, listed, seeds_compared, what_was_compared
from benchmarks.page.tables import differences_table, overall_table, returns_table
from benchmarks.report import cells_table
from benchmarks.report import overall_table as markdown_over_all
from tests.benchmarks.test_report import _tidy


def _cell(algorithm, final, noise=0.1, **more):
    mean = sum(final) / len(final)
    return {"task": "T", "noise": noise, "algorithm": algorithm, "seeds": list(range(len(final))), "final": final} | {
        "final_mean": mean,
        "final_iqm": [mean + 0.4, 1.0, 9.0],
        "area_iqm": [mean / 2, 0.0, 0.0],
        "steps_to_reference": None,
        **more,
    }


def _results(low=0.6, final=(3.0, 5.0, 7.0), seeds=3, **more):
    cells = [
        _cell("gac", (list(final) * 4)[:seeds]),
        _cell("sac", ([1.0, 2.0, 3.0] * 4)[:seeds]),
        _cell("gac", [1.0] * seeds, 0.3),
        _cell("sac", [2.0] * seeds, 0.3),
    ]
    scales = [{"task": "T", "noise": noise, "low": 1.0, "high": 5.0} for noise in (0.1, 0.3)]
    return {
        "cells": cells,
        "settings": {"steps": 1000},
        "normalised_iqm": {"sac": [0.5, 0.4, 0.6], "gac": [0.9, 0.7, 1.1]},
        "probability_of_improvement": {"gac over sac": [0.8, low, 0.9], "sac over gac": [0.2, 0.1, 1 - low]},
        "compared": {"algorithms": ["gac", "sac"], "cells": scales},
        **more,
    }


def test_who_comes_first_and_how_sure_that_is():
    assert (
        what_was_compared(_results())
        == "gac and sac on T, sensor noise 0.1 and 0.3: 1,000 environment steps, 3 seeds of each."
    )
    highest, overall, seeds = in_short(_results())
    assert highest == "gac has the highest mean return at the end in 1 of 2 cells, sac in 1."
    assert "gac comes first and sac second (interquartile mean of normalised returns 0.90 and 0.50)" in overall
    assert overall.endswith("with probability 0.80: 3 seeds of each can't tell whether that is more than chance.")
    assert seeds == "3 seeds are few: an interval of their mean is 4.3 standard errors to either side (Student's t)."
    assert in_short(_results(seeds=5))[1].endswith("with probability 0.80 (95% interval 0.60 to 0.90), beyond chance.")
    assert in_short(_results(low=0.4, seeds=5))[1].endswith("which these runs can't tell from chance.")


def test_the_only_cell_with_several_algorithms_is_named():
    results = _results()
    results["cells"] = results["cells"][:3]  # of noise 0.3, one algorithm alone is left
    assert (
        in_short(results)[0]
        == "gac has the highest mean return at the end on T, noise 0.1, the only cell with several algorithms."
    )
    results["cells"] = results["cells"][:2]
    assert in_short(results)[0] == "gac has the highest mean return at the end."


@pytest.mark.parametrize(("seeds", "said"), [(1, "1 seed of"), (2, "2 seeds of"), (4, "4 seeds of"), (5, "beyond chance")])
def test_fewer_than_five_seeds_give_no_verdict(seeds, said):
    """The bootstrap's interval of two equal algorithms leaves 0.5 out in 17 to 20% of all cases with three seeds."""
    results = _results(seeds=seeds)
    overall = in_short(results)[1]
    assert said in overall
    assert ("beyond chance" in overall) == (seeds == 5)
    assert ("95% interval" in overall) == (seeds == 5)
    results["cells"][1]["seeds"] = results["cells"][1]["seeds"][:4]
    assert "beyond chance" not in in_short(results)[1], "as many runs of each count as the fewest are"
    assert seeds_compared(results) == min(seeds, 4)


def test_of_one_seed_there_is_no_interval():
    one, three = (overall_table(_results(seeds=seeds)) for seeds in (1, 3))
    assert "<td class=short-text>one seed</td>" in one
    assert "0.70 to 1.10" not in one
    assert '<td class=number data-value="0.8">0.80</td>' in one
    assert "<td class=short-text>0.70 to 1.10</td>" in three
    assert "0.90 [0.70, 1.10]" in markdown_over_all(_results(seeds=2))
    assert "[" not in markdown_over_all(_results(seeds=1)).replace("estimate [95%]", "")
    assert "Those of 2 seeds are too narrow for a verdict." in markdown_over_all(_results(seeds=2))
    assert "too narrow" not in markdown_over_all(_results(seeds=1)) + markdown_over_all(_results(seeds=5))


def test_intervals_of_the_printed_table_hold_for_the_number_of_seeds():
    """Student's t of the mean, by hand: of 4 and 6 it is 5, and 12.706 times 1 to both sides. The IQM of few is the mean."""
    assert "| 4.00, 6.00 | 5.00 [-7.71, 17.7] |  |" in cells_table([_cell("gac", [4.0, 6.0])])
    assert "| 5.00 | 5.00 |  |" in cells_table([_cell("gac", [5.0])])
    assert "| 5.40 [1.00, 9.00] |" in cells_table([_cell("gac", [4.0, 5.0, 5.0, 6.0])])
    assert "Those of 2 seeds are too narrow for a verdict." in _about_intervals(_results(seeds=2))
    assert _about_intervals(_results(seeds=1)) == _about_intervals(_results(seeds=5)) == ""


def test_what_is_missing_is_said_and_many_seeds_need_no_word():
    results = _results(still_to_run=["a"])
    for cell in results["cells"]:
        cell["seeds"] = list(range(5))
    assert in_short(results)[2:] == ["1 run of the suite is still to make."]
    assert listed(["a"]) == "a"


def test_a_single_algorithm_is_compared_with_nothing():
    results = _results()
    results["cells"] = [_cell("gac", [1.0])]
    results["normalised_iqm"] = {"gac": [1.0, 1.0, 1.0]}
    assert what_was_compared(results) == "gac on T, sensor noise 0.1: 1,000 environment steps, 1 seed of each."
    assert in_short(results) == ["One seed can't tell a difference from chance."]


def test_the_returns_table_has_students_interval_and_the_best_in_bold():
    shown = returns_table(_results()["cells"])
    assert "<td class=short-text>0.0317 to 9.97</td>" in shown, "5 -+ 4.3027 * 2 / sqrt(3)"
    assert shown.count("class=best") == 2
    assert "guider" not in shown, "a column of which all fields are empty"
    assert "guider" in returns_table([_cell("gac", [1.0], guider_mean=2.0)])
    assert "one seed" in returns_table([_cell("gac", [1.0])])
    assert "IQM" not in shown, "which is the mean of three seeds"
    assert "4.15 [1.00, 9.00]" in returns_table([_cell("gac", [1.0, 2.0, 4.0, 8.0])])


def test_the_better_algorithm_is_the_first_row_of_the_overall_table():
    shown = overall_table(_results())
    assert shown.index("<td class=short-text>gac") < shown.index("<td class=short-text>sac")
    assert '<td class=number data-value="0.8">0.80 [0.60, 0.90]</td>' in shown


def test_arguments_that_all_share_are_told_apart_from_those_that_differ():
    arguments = {
        "gac, T, noise 0.1": {"gamma": 1, "tau": 0.1, "policy_kwargs": {"net_arch": [1, 2], "n": 1}},
        "gac, T, noise 0.3": {"gamma": 1, "tau": 0.5},
        "sac, T, noise 0.1": {"gamma": 1, "tau": 0.1, "policy_kwargs": {"net_arch": [1, 2], "n": 2}, "own": True},
    }
    shown, shared = differences_table(arguments)
    assert shared == {"gamma": 1}
    for row in (
        ["tau", "0.1 (T, noise 0.1); 0.5 (T, noise 0.3)", "0.1"],
        ["policy_kwargs.net_arch", "1, 2 (T, noise 0.1); none (T, noise 0.3)", "1, 2"],
        ["policy_kwargs.n", "1 (T, noise 0.1); none (T, noise 0.3)", "2"],
        ["own", "", "True"],
    ):
        assert "".join(f"<td>{text}</td>" for text in row) in re.sub(r"<td [^>]*>", "<td>", shown)
    assert differences_table({"gac, T": {"tau": 1}})[0] == "<p>They have the same arguments.</p>"


def test_normalised_returns_are_between_the_cells_lowest_and_best():
    rows = normalised_returns(_results())
    assert rows[rows.algorithm == "gac"].normalised.tolist() == [0.5, 1.0, 1.5, 0.0, 0.0, 0.0]


def test_seconds_are_spread_over_a_runs_steps_and_untimed_runs_left_out():
    tidy = _tidy(["gac", "sac"])
    seconds = {f"small-2000/{task}-noise0.1/gac/seed{seed}": 10.0 + 20 * seed for task in ("Ant", "Hopper") for seed in (0, 1)}
    timed = over_seconds(tidy, seconds)
    assert set(timed.algorithm) == {"gac"}
    assert sorted(set(timed.timesteps)) == [10.0, 20.0], "20 seconds is the mean of 10 and 30"
    assert over_seconds(tidy, {}).empty


def test_seconds_are_of_a_runs_own_steps_and_the_needed_steps_of_its_axis_alone():
    """Half of its own steps take half of its seconds, though the axis of steps has 3,000 more in front."""
    tidy = _tidy(["cosil"]).assign(needed_steps=3000)
    seconds = {f"small-2000/{task}-noise0.1/cosil/seed{seed}": 20.0 for task in ("Ant", "Hopper") for seed in (0, 1)}
    drawn = {plot.name: plot.wide for plot in plots(tidy, seconds, normalised_returns(_results()))}
    shown = {name: {x for line in drawn[name].data for x in line.x} for name in ("Returns", "Returns over seconds")}
    assert shown == {"Returns": {4000, 5000}, "Returns over seconds": {10.0, 20.0}}


def test_tabs_without_data_are_not_there():
    tidy = _tidy(["gac"])
    nothing = normalised_returns({"cells": [], "compared": {"cells": [], "algorithms": []}})
    assert [one.name for one in plots(tidy, {}, nothing)] == ["Returns"]
    assert [one.name for one in plots(_tidy(["gac"], guider=True), {}, nothing)] == ["Returns", "Guider over learner", "KL"]


@pytest.mark.parametrize("one_column", [False, True])
def test_axes_hold_the_runs_and_not_the_intervals(one_column):
    from benchmarks.report import interactive

    low, high = interactive(_tidy(["gac"]), one_column).layout.yaxis.range
    assert (low, high) == pytest.approx((1000 - 150, 4000 + 150))
