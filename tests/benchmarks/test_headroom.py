"""What privileged information is worth: differences and intervals by hand, verdicts, and the sentences that they give."""

import math
import re
import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from benchmarks.advice import findings, in_words, recommendation
from benchmarks.comparison_page import page
from benchmarks.headroom import ends_table, headroom_curve, main, number, power, read_together, seeds_to_see, worth
from benchmarks.tidy import NO_NOISE, together

DOCS = Path(__file__).parents[2] / "docs"

RANDOM = {"random actions": np.array([-2.0, 0.0, 2.0, 0.0])}


def _tidy(ends, steps=(100, 200, 300, 400), start=0.0):
    """Curves that rise in their last quarter: algorithm -> end of each seed."""
    return pd.DataFrame(
        [
            {"task": "T", "algorithm": name, "seed": seed, "timesteps": step, "learner": end if step == steps[-1] else start}
            for name, of_seeds in ends.items()
            for seed, end in enumerate(of_seeds)
            for step in steps
        ]
    )


DEPLOYABLE = {"gac", "sac-asym", "sac", "random-actions"}


def _worth(**ends):
    return worth(_tidy({name.replace("_", "-"): values for name, values in ends.items()}), RANDOM, DEPLOYABLE)


def test_a_run_ends_with_its_last_quarter_and_is_measured_from_a_policy_without_training():
    tidy = _tidy({"sac": [8.0, 10.0]}, steps=tuple(range(8)), start=-4.0)
    found = worth(tidy, RANDOM, DEPLOYABLE)
    assert found.ends["sac"].tolist() == [2.0, 3.0], "the mean of the last two of eight evaluations"
    assert found.areas["sac"].tolist() == [(8 - 28) / 8, (10 - 28) / 8]
    assert found.span == 2.5 - 0.0
    assert found.headroom is found.in_training is found.guider is None


def test_clear_results_are_told():
    found = _worth(sac_full=[100, 101, 102], sac_asym=[60, 61, 62], gac=[60, 61, 62], sac=[20, 21, 22])
    headroom, in_training, guider = findings(found)
    assert headroom.startswith("There is headroom.")
    assert "40.0 (37.7 to 42.3 with 95% confidence; 40% of what was learned)" in headroom
    assert in_training.startswith("Privileged information in training alone is worth 40.0")
    assert guider.startswith("A guider changes next to nothing on top of such critics, 0 (-2.27 to 2.27 with 95% confidence")
    assert recommendation(found, 1000) == [
        "Train with SAC-asym.",
        "It is the simplest of those that do best: GAC comes about equally far.",
        "Since there is headroom, try what shows the policy more: the History wrapper, a recurrent policy, another sensor.",
    ]


def test_a_clear_winner_is_recommended():
    found = _worth(sac_full=[100, 101, 102], sac_asym=[60, 61, 62], gac=[98, 99, 100], sac=[20, 21, 22])
    assert findings(found)[2].startswith("A guider is worth 38.0")
    first, second, *_ = recommendation(found, 1000)
    assert (first, second) == ("Train with GAC.", "It ends above SAC on partial alone and SAC-asym, beyond chance.")


def test_steps_of_needed_runs_are_told_wherever_the_algorithm_is(tmp_path):
    """A student that had a teacher's steps too is not set beside the others as if it had not."""
    tidy = _tidy({"tgrl": [98.0, 99.0, 100.0], "sac-asym": [60.0, 61.0, 62.0]})
    tidy = tidy.assign(noise=NO_NOISE, needed_steps=np.where(tidy.algorithm == "tgrl", 20_000, 0))
    found = worth(tidy, RANDOM, DEPLOYABLE | {"tgrl"})
    assert found.needed == {"tgrl": 20_000}
    told = "tgrl had 20,000 environment steps beside its own, those of the runs that it needs, such as a teacher's."
    assert told in recommendation(found, 400)
    assert [row[2] for row in ends_table(tidy, "sac-asym")] == ["tgrl, after 20,000 steps of needed runs", "sac-asym"]
    (tmp_path / "results.json").write_text("{}")
    shown = page(tidy, found, "command", tmp_path / "results.json", 400)
    assert "tgrl, after 20,000 steps of needed runs" in shown
    assert "400 environment steps each (tgrl, after 20,000 steps of needed runs)." in shown
    without = tidy[tidy.algorithm == "sac-asym"]
    shown = page(without, worth(without, RANDOM, DEPLOYABLE), "command", tmp_path / "results.json", 400)
    assert "of needed runs" not in shown


def test_harm_is_told():
    found = _worth(sac_full=[40, 41, 42], sac_asym=[60, 61, 62], gac=[20, 21, 22], sac=[99, 100, 101])
    headroom, in_training, guider = findings(found)
    assert headroom.startswith("SAC on the full state ends below SAC-asym, by -20.0")
    assert in_training.startswith("Critics that see the privileged entries do harm")
    assert guider.startswith("A guider costs return here: GAC over SAC-asym is -40.0")


def test_what_can_not_be_told_is_said_with_the_seeds_that_would_tell():
    found = _worth(sac_full=[100, 40, 70], sac_asym=[90, 30, 50], gac=[95, 20, 60], sac=[80, 20, 60])
    assert all("can't be told" in sentence for sentence in findings(found))
    first, second, third, *_ = recommendation(found, 1000)
    assert first == "Train with SAC on partial alone."
    assert second.endswith("SAC-asym and GAC can't be told from it with these seeds.")
    needed = seeds_to_see(found)
    assert needed > 3
    assert third.startswith(
        f"What can't be told is a matter of seeds: {needed} of each algorithm would most likely show a difference of 10%"
    )


def test_where_nothing_that_can_be_deployed_has_learned_there_are_no_shares_and_no_seeds_to_ask_for():
    found = _worth(sac_full=[100, 101, 99], sac_asym=[0, 0.1, -0.1], gac=[-1, -2, 0], sac=[-3, -2, -1])
    assert found.learned == ["sac-full"]
    assert math.isnan(found.deployable_span)
    assert seeds_to_see(found) is None
    headroom, in_training, guider = findings(found)
    assert "100% of what was learned" in headroom
    assert in_training.startswith(
        "Whether critics that see the privileged entries help can't be told, since neither SAC-asym nor"
    )
    assert guider.startswith(
        "Whether a guider adds to such critics can't be told, since neither GAC nor SAC-asym has learned: "
    )
    said = recommendation(found, 1000)
    assert said[0].startswith("None that can be deployed has learned")
    assert "of what was learned" not in in_training + guider
    assert not any("seeds" in sentence or "would most likely" in sentence for sentence in said)


def test_an_algorithm_that_may_be_lower_by_chance_alone_is_not_recommended_for_being_simple():
    found = _worth(sac_asym=[90, 10], gac=[80, 15], sac=[60, 0])
    first, second, third, fourth, fifth = recommendation(found, 1000)
    assert (first, second) == (
        "Train with SAC-asym.",
        "It is the simplest of those that do best: GAC can't be told from it with these seeds.",
    )
    assert third == "SAC on partial alone ends lower on average, which may be chance with these seeds."
    assert fourth.startswith(f"What can't be told is a matter of seeds: {seeds_to_see(found)} of each algorithm")
    assert seeds_to_see(found) > 20
    assert fifth.endswith("so try more --steps first.")


def test_the_seeds_that_tell_a_difference_by_hand():
    """
    Two groups, standard deviation 10, a difference of 10: 2 (1.960 + 0.842)^2 = 15.7 if the deviation were known; Student's t
    needs 17, as tables of sample sizes have it.
    """
    found = _worth(sac=[90, 110, 100], sac_asym=[90, 110, 100])
    assert found.span == found.deployable_span == 100
    assert seeds_to_see(found) == 17
    assert seeds_to_see(_worth(sac=[90, 110, 100], sac_asym=[90, 110, 100], sac_full=[990, 1010, 1000])) == 17
    assert seeds_to_see(_worth(sac=[5, 5], sac_asym=[9, 9])) == 2, "what does not vary shows every difference"


@pytest.mark.parametrize("seeds", [2, 5, 12])
def test_the_power_is_the_share_of_repetitions_that_show_the_difference(seeds):
    """By simulation, with a deviation of 2 and a difference of 3."""
    drawn = np.random.default_rng(0).normal(size=(2, 20_000, seeds)) * 2 + np.array([3.0, 0.0])[:, None, None]
    shown = stats.ttest_ind(*drawn, axis=1).pvalue < 0.05
    assert power(seeds, 3.0, 2.0) == pytest.approx(shown.mean(), abs=0.012)


def test_the_number_of_seeds_has_the_power_that_is_claimed_and_one_seed_less_has_not():
    """The quantiles of a normal distribution gave numbers whose true power was 0.35 for two seeds and 0.69 for five."""
    for ends in ([80.0, 120.0], [92.0, 108.0, 100.0], [97.0, 103.0, 100.0, 99.0]):
        found = _worth(sac=ends, sac_asym=ends)
        needed, deviation = seeds_to_see(found), float(np.std(ends, ddof=1))
        assert power(needed, 10.0, deviation) >= 0.8
        assert needed == 2 or power(needed - 1, 10.0, deviation) < 0.8
    assert seeds_to_see(_worth(sac=[100], sac_asym=[90])) is None, "one seed has no variance"


def test_what_has_not_learned_is_not_recommended_though_it_is_the_simplest():
    """SAC on partial alone ends where it began, and is near SAC-asym if a span that the full state inflates is the measure."""
    found = _worth(sac_full=[900, 910, 920], sac_asym=[30.5, 31, 31.5], gac=[30.5, 31.5, 31], sac=[0, 1, 2])
    assert found.learned == ["sac-full", "sac-asym", "gac"]
    first, second, third, *_ = recommendation(found, 1000)
    assert first == "Train with SAC-asym."
    assert second == "It is the simplest of those that do best: GAC comes about equally far."
    assert third == (
        "SAC on partial alone does not end above the return of random actions without training, 0, beyond the spread of its "
        "episodes (to 2.60)."
    )
    assert findings(found)[1].startswith("Privileged information in training alone is worth 30.0"), "3% of 910, 97% of 31"


def test_where_nothing_that_can_be_deployed_has_learned_nothing_is_recommended():
    found = _worth(sac_full=[90, 91, 92], sac_asym=[0, 1, 2], gac=[0, 2, 1])
    told = recommendation(found, 1000)
    assert told[0].startswith("None that can be deployed has learned: SAC-asym and GAC do not end above the return of random")
    assert not any("Train with" in text for text in told)
    assert any(text.startswith("Since there is headroom") for text in told)
    assert recommendation(_worth(sac_full=[90, 91], sb3_sac=[80, 81]), 1)[0].startswith("None of these algorithms can be")


def test_what_another_one_leaves_behind_beyond_chance_is_not_recommended():
    """Neither can be told from GAC, whose two seeds vary; but SAC-asym is 6 above SAC, and its seeds vary by 0.6."""
    found = _worth(gac=[92, 112], sac_asym=[99, 99.5, 100, 100.5], sac=[93, 93.5, 94, 94.5])
    assert recommendation(found, 1000)[:3] == [
        "Train with SAC-asym.",
        "It is the simplest of those that do best: GAC can't be told from it with these seeds.",
        "SAC on partial alone ends below SAC-asym, beyond chance.",
    ]


def test_equal_and_unknown_neighbours_are_told_apart():
    found = _worth(sac=[100, 101, 102], sac_asym=[100, 102, 101], gac=[80, 125, 105])
    first, second, *_ = recommendation(found, 1000)
    assert first == "Train with SAC on partial alone."
    assert second.endswith("SAC-asym comes about equally far; GAC can't be told from it with these seeds.")


def test_the_committed_runs_of_the_pendulum_do_not_recommend_what_is_no_better_than_doing_nothing():
    """SAC on partial alone ends at 85.8, below the middle action; SAC-asym is 36.2 above it, beyond chance."""
    tidy = pd.read_csv("benchmarks/results/baselines.csv")
    tidy = tidy[(tidy.task == "InvertedDoublePendulum") & tidy.algorithm.isin(["sac-full", "sac-asym", "gac", "sac"])]
    found = worth(tidy, {"random actions": np.array([40.0, 50.0]), "the middle action": np.array([87.2, 89.2])}, DEPLOYABLE)
    assert found.ends["sac"].mean() == pytest.approx(85.8, abs=0.05)
    assert found.in_training.value == pytest.approx(36.2, abs=0.05)
    told = recommendation(found, 25_000)
    assert told[0] == "Train with SAC-asym."
    assert any(text.startswith("SAC on partial alone does not end above the return of the middle action") for text in told)


def test_random_actions_are_nothing_to_deploy():
    found = _worth(random_actions=[0.0, 1.0], sac=[5.0, 6.0], gac=[5.0, 6.0], zzz=[1.0, 2.0])
    assert found.deployable == ["sac", "gac"]


def test_with_one_seed_nothing_is_told():
    found = _worth(sac_full=[100], sac_asym=[60])
    (headroom,) = findings(found)
    assert headroom.endswith("40.0 (of one seed each, which can't tell it from chance).")
    (only,) = recommendation(found, 1000)
    assert only.startswith("One seed of each algorithm is no basis for a recommendation")


def test_where_nothing_was_learned_that_is_all_that_is_said():
    found = _worth(sac_full=[0.3, 0.1], sac_asym=[0.2, -0.2])
    first, second = recommendation(found, 5000)
    assert "nothing was learned in 5,000 steps" in first
    assert second == "Give more --steps, or another --preset."


def test_the_best_policy_without_training_is_the_floor():
    tidy = _tidy({"sac-full": [9.0, 11.0], "sac-asym": [4.5, 5.5]})
    found = worth(tidy, RANDOM | {"the middle action": np.array([3.0, 5.0])}, DEPLOYABLE)
    assert (found.floor, found.span) == ("the middle action", 10.0 - 4.0)
    assert found.learned == [], "its interval ends at 16.7"
    bar = "the return of the middle action without training, 4.00, beyond the spread of its episodes (to 16.7)"
    assert recommendation(found, 1)[0].startswith(f"No algorithm ends above {bar}: nothing was learned")
    assert worth(tidy, RANDOM | {"the middle action": np.full(2, -1.0)}, DEPLOYABLE).floor == "random actions"


def test_the_headroom_at_each_step():
    curve = headroom_curve(_tidy({"sac-full": [9.0, 11.0], "sac-asym": [4.0, 4.0]}))
    assert curve.timesteps.tolist() == [100, 200, 300, 400]
    assert curve.value.tolist() == [0, 0, 0, 6]
    assert curve.low.iloc[-1] < 6 < curve.high.iloc[-1]
    assert headroom_curve(_tidy({"sac": [1.0]})).empty


def test_numbers_have_three_digits_or_all_before_the_point():
    assert [number(value) for value in (12345.6, 123.4, 12.34, 1.234, 0.01234, 0.0, -5.678)] == [
        "12,346", "123", "12.3", "1.23", "0.0123", "0", "-5.68",
    ]  # fmt: skip


def test_a_difference_in_words_where_nothing_varies():
    found = _worth(sac=[100.0, 100.0], sac_asym=[200.0, 200.0])
    assert in_words(found, found.in_training) == "100 (100 to 100 with 95% confidence; 50% of what was learned)"


def test_the_ends_of_aggregated_results_by_hand():
    tidy = _tidy({"sac-asym": [9.0, 11.0], "gac": [20.0, 22.0]}).assign(noise=0.1)
    first, second = ends_table(tidy, "sac-asym")
    assert first == ["T", "0.1", "sac-asym", "9.00, 11.0", "10.0", "14%", ""]
    low, high = (11 + sign * 4.3027 * math.sqrt(2) for sign in (-1, 1))  # two degrees of freedom, variances 2 and 2
    assert second == ["T", "0.1", "gac", "20.0, 22.0", "21.0", "7%", f"11.0, {number(low)}, {number(high)}"]


def test_several_results_are_read_together_and_told_apart(tmp_path):
    for name, end in (("few", 10.0), ("many", 20.0)):
        tidy = _tidy({"gac": [end, end + 2], f"of-{name}": [1.0, 2.0]}).assign(noise=0.1)
        tidy.to_csv(tmp_path / f"{name}.csv", index=False)
    rows = ends_table(read_together([tmp_path / "few", tmp_path / "many"]), "gac (many)")
    assert [(row[2], row[4]) for row in rows] == [
        ("gac", "11.0"),
        ("of-few", "1.50"),
        ("gac (many)", "21.0"),
        ("of-many", "1.50"),
    ]
    assert rows[0][-1].startswith("-10.0, "), "gac over gac (many)"


def test_results_of_one_name_are_told_apart_by_their_folders(tmp_path):
    paths = [tmp_path / folder / "results" for folder in ("a", "b", "c")]
    for path, end in zip(paths, (10.0, 20.0, 90.0), strict=True):
        path.parent.mkdir()
        _tidy({"gac": [end, end + 2]}).assign(noise=0.1).to_csv(path.with_suffix(".csv"), index=False)
    rows = ends_table(read_together(paths), "sac-asym")
    assert [(row[2], row[3]) for row in rows] == [
        ("gac", "10.0, 12.0"),
        ("gac (b/results)", "20.0, 22.0"),
        ("gac (c/results)", "90.0, 92.0"),
    ]
    with pytest.raises(ValueError, match=r"a/results is among the results more than once: leave one out"):
        read_together([paths[0], paths[1], paths[0]])


def test_a_run_that_several_results_have_does_not_count_twice():
    few, more = _tidy({"gac": [1.0, 2.0]}).assign(noise=0.1), _tidy({"gac": [3.0]}, steps=(50, 150)).assign(noise=0.1)
    with pytest.raises(ValueError, match=r"Several results have the run gac, T, noise 0\.1, seed 0: leave one out"):
        together([few, more])
    pd.testing.assert_frame_equal(
        together([few, more.assign(seed=2)]), pd.concat([few, more.assign(seed=2)], ignore_index=True)
    )


def test_needed_steps_that_results_do_not_have_are_0():
    taught = _tidy({"tgrl": [1.0]}).assign(noise=0.1, needed_steps=20_000)
    tidy = together([_tidy({"gac": [1.0]}).assign(noise=0.1), taught])
    assert [row[2] for row in ends_table(tidy, "sac-asym")] == ["gac", "tgrl, after 20,000 steps of needed runs"]


DOCUMENTED = sorted(
    {
        " ".join(command.split())
        for page in DOCS.glob("*.md")
        for command in re.findall(r"benchmarks\.headroom\s+([^`\n]*(?:\n[^`\n]+)?)`", page.read_text())
    }
)


def test_the_documented_commands_are_found():
    assert len(DOCUMENTED) > 10
    assert "benchmarks/results/baselines benchmarks/results/brax-choices" in DOCUMENTED


@pytest.mark.parametrize("command", DOCUMENTED)
def test_documented_commands_print_a_table(command, capsys, monkeypatch):
    monkeypatch.chdir(DOCS.parent)
    main(shlex.split(command))
    assert "each seed's end" in capsys.readouterr().out


def test_the_command_prints_the_committed_results(capsys):
    main(["benchmarks/results/baselines", "--reference", "sac"])
    out = capsys.readouterr().out
    assert "over sac: value, low, high" in out
    assert "2,386, 1,939, 2,833" in out, "of SAC-asym at noise 0.1, as docs/results.md has it"


def test_a_task_without_noise_has_an_empty_field_and_returns_of_0_no_spread(recwarn):
    tidy = _tidy({"sac-asym": [0.0, 0.0]}).assign(noise=NO_NOISE)
    assert ends_table(tidy, "sac-asym") == [["T", "", "sac-asym", "0, 0", "0", "", ""]]
    assert not recwarn.list


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["made", "--reference", "nosuch"], r"--reference: the results have no algorithm 'nosuch'; they have \['gac'\]"),
        (["gone"], r"No such file .*gone\.csv"),
    ],
)
def test_what_does_not_exist_is_said_in_a_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    _tidy({"gac": [1.0, 2.0]}).assign(noise=0.1).to_csv("made.csv", index=False)
    with pytest.raises(SystemExit, match=message):
        main(arguments)
    main(["made"])
    assert "over sac-asym" in capsys.readouterr().out, "the default need not be among the algorithms"
