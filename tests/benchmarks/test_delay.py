"""The comparison of memories on delays: what it prepares, measures, keeps and prints."""

import json

import pytest
import torch as th

from benchmarks import delay
from benchmarks.delay import Trial, chrono_, orthogonal_, run, table
from sb3_gac.networks.recurrent import RecurrentCore


@pytest.mark.parametrize(("cell", "gates"), [("gru", 3), ("lstm", 4)])
def test_initialisations(cell, gates):
    th.manual_seed(0)
    core = RecurrentCore(cell, 4, [64], 64)
    orthogonal_(core, 10)
    for matrix in core.cells[0].weight_hh_l0.view(gates, 64, 64):
        th.testing.assert_close(matrix @ matrix.T, th.eye(64), atol=1e-5, rtol=0)
    chrono_(core, 10)
    bias = (core.cells[0].bias_ih_l0 + core.cells[0].bias_hh_l0).view(gates, 64)
    steps = 1 / (1 - th.sigmoid(bias[1]))  # that a unit keeps what it holds
    assert 2 <= steps.min() < 4
    assert 17 < steps.max() <= 20
    assert cell == "gru" or th.equal(bias[0], -bias[1])
    assert not bias[2:].any()


def test_a_trial_ends_at_its_goal_or_its_last_step():
    reached = run(Trial("lru", 2, 0, 300))
    assert 20 <= reached["needed"] < 300
    assert reached["accuracy"] >= 0.95
    assert run(Trial("gru", 2, 0, 5))["needed"] is None


def test_trials_are_kept_and_a_table_printed(tmp_path, monkeypatch, capsys):
    out = tmp_path / "delay"
    monkeypatch.setattr(delay, "CONTENDERS", {"lru": delay.CONTENDERS["lru"]})
    monkeypatch.setattr("sys.argv", ["delay", "--delays", "1", "--seeds", "1", "--steps", "2", "--out", str(out)])
    delay.main()
    (row,) = json.loads(out.with_suffix(".json").read_text())["trials"]
    assert (row["contender"], row["delay"], row["steps"]) == ("lru", 1, 2)
    assert "| lru | (0." in capsys.readouterr().out
    with monkeypatch.context() as context:
        context.setattr(delay.multiprocessing, "get_context", lambda kind: pytest.fail("trials were made again"))
        delay.main()
    monkeypatch.setattr("sys.argv", ["delay", "--delays", "2", "--seeds", "1", "--steps", "2", "--out", str(out)])
    delay.main()
    trials = json.loads(out.with_suffix(".json").read_text())["trials"]
    assert [trial["delay"] for trial in trials] == [1, 2], "those of other delays stay"
    assert trials[0] == row


def test_the_table_has_steps_or_the_share_of_right_answers():
    row = {"contender": "gru", "delay": 4, "seed": 1, "steps": 10, "needed": None, "accuracy": 0.5, "seconds": 0.1}
    rows = [row, row | {"seed": 0, "needed": 6, "accuracy": 0.97, "seconds": 0.06}]
    assert table(rows).splitlines()[-1] == "| gru | 6, (0.50) | 10 |"
