"""What the speed benchmark counts and compares."""

import cProfile
import json
import multiprocessing
import pstats
import sys
import time

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from benchmarks import speed
from benchmarks.contenders import alternate, process_timers, timer
from benchmarks.models import BASELINES, LoopedGRU, make_baseline_step, recurrent_step_flops, step_flops
from benchmarks.part_speed import compare_buffers, compare_checkpoints, compare_deployment
from benchmarks.profiles import cumulative_seconds, env_step, profile_rollout, profile_step
from benchmarks.step_speed import compare_baselines, compare_recurrent, compare_steps
from sb3_gac.checkpoint.rows import BLOCK_BYTES


def test_arithmetic_of_a_step_by_hand():
    """One partial, one privileged, one action, width 2, batch 1, two critics each: products counted one by one."""
    critic, behind_first = 3 * 2 + 2 * 2 + 2, 2 * 2 + 2  # layers 3-2-2-1, and what lies behind the first of them
    critics = 4 * critic + 4 * critic + 4 * critic  # targets, critic loss, policy loss: forward
    critics += 4 * critic + 4 * behind_first  # critic loss: weights, activations
    critics += 4 * (behind_first + 1 * 2)  # policy loss: activations, and the action
    guider = 2 * (2 * 2 + 4 + 4) + (2 * 2 + 4 + 4) + (4 + 4)  # two batches forward; weights; activations
    learner = 2 * (1 * 2 + 4 + 4) + (1 * 2 + 4 + 4) + (4 + 4)
    assert step_flops((1, 1, 1), batch=1, width=2) == 2 * (critics + guider + learner)


def test_arithmetic_is_linear_in_the_batch():
    assert step_flops((8, 17, 6), 512, 256) == 2 * step_flops((8, 17, 6), 256, 256)


def test_contenders_alternate():
    calls = []
    timers = {"a": timer(lambda: calls.append("a")), "b": timer(lambda: (calls.append("b"), time.sleep(0.001)))}
    seconds = alternate(timers, repetitions=2, rounds=3)
    assert calls == (["a"] * 3 + ["b"] * 3) * 4
    assert [len(values) for values in seconds.values()] == [3, 3]
    assert min(seconds["b"]) >= 0.001


def test_contenders_in_processes_of_their_own_have_their_threads_and_end():
    with process_timers(_sleep, {"short": (0.001,), "long": (0.02,)}, threads=1) as timers:
        assert 0.001 <= timers["short"](2) < 0.02 <= timers["long"](2)
        assert len(multiprocessing.active_children()) == 2
    deadline = time.monotonic() + 20
    while multiprocessing.active_children() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not multiprocessing.active_children()


def _sleep(seconds):
    assert th.get_num_threads() == 1
    return lambda: time.sleep(seconds)


def test_comparisons_give_finite_figures():
    row = compare_steps(("sac", "gac", "sac-asym"), (2, 3, 1), batch=8, width=8, threads=1, rounds=1)
    assert row["sac_per_second"] > 1
    assert row["gac_over_sac"] > 0 < row["sac-asym_over_sac"]
    assert "sac-asym_share_of_limit" not in row, "its limit is another"
    assert 0 < row["gac_share_of_limit"] < 1
    assert compare_buffers((169, 270, 17), capacity=6_000)["bytes_over_sb3"] <= 0.52


def test_every_baseline_takes_the_steps_that_are_timed():
    for name in BASELINES:
        make_baseline_step(name, (2, 3, 1), 8, 8, compiled=False)()
    rows = compare_baselines(("sac", "sac-asym"), (2, 3, 1), batch=8, width=8, rounds=1)
    assert [(row["algorithm"], row["compiled"]) for row in rows] == [("sac", False), ("sac-asym", False), ("sac-asym", True)]
    assert rows[0]["over_sac"] == 1
    assert all(row["milliseconds"] > 0 < row["over_sac"] for row in rows)


def test_a_next_checkpoint_is_a_part_of_the_first(monkeypatch):
    monkeypatch.setattr("sb3_gac.checkpoint.rows.BLOCK_BYTES", BLOCK_BYTES // 10)
    row = compare_checkpoints((8, 17, 6), width=8, capacity=15_000, more=100)
    assert row["first_megabytes"] > 15_000 * 129 / 1e6 < row["sb3_megabytes"]
    assert row["next_megabytes"] < 0.5 * row["first_megabytes"]


def test_a_looped_gru_is_a_gru():
    plain = th.nn.GRU(3, 4)
    x, state = th.randn(5, 2, 3), th.randn(1, 2, 4)
    looped = LoopedGRU(3, 4)
    looped.load_state_dict(plain.state_dict())
    (outputs, last), (expected, expected_last) = looped.unroll(x, state[0]), plain(x, state)
    th.testing.assert_close(outputs, expected)
    th.testing.assert_close(last, expected_last[0])


def test_recurrent_arithmetic_by_hand_and_figures():
    """One number partial, one privileged, two actions, width 2, episodes of one step: products counted one by one."""
    learner, full = 1 * 2 + 3 * (2 * 2 + 2 * 2) + 2 * 2 + 2 * 2, 2 * 2 + 3 * (2 * 2 + 2 * 2) + 2 * 2 + 2 * 2
    assert recurrent_step_flops((1, 1, 2), 1, batch=3, width=2) == 2 * 3 * 2 * (3 * learner + 3 * full + 4 * 5 * full)
    row = compare_recurrent(batch=2, width=8, threads=1, rounds=1)
    assert row["ours_per_second"] > 0 < row["ours_over_looped"]
    assert 0 < row["share_of_limit"] < 1
    assert 0 < row["sampling_share"] < 0.5


def test_shares_of_the_rollout_add_up():
    row = profile_rollout(n_envs=2, vec_steps=20)
    assert row["gradient_share"] + row["physics_share"] + row["other_share"] == pytest.approx(1, abs=0.002)
    assert 0 < row["physics_share"] < row["gradient_share"] < 1


def test_an_exported_learner_beside_predict():
    row = compare_deployment((2, 3, 1), width=8, rounds=2)
    assert 0 < row["exported_microseconds"] < row["gac_predict_microseconds"]
    assert row["exported_times_faster_than_sac"] > 1
    assert row["load_milliseconds"] > 0


def test_a_steps_parts_add_up():
    rows = profile_step("gac-compiled", (2, 3, 1), batch=8, width=8, steps=3)
    assert [row["part"].split(",")[0] for row in rows[:2]] == ["matrix products", "the rest inside compiled code"]
    assert sum(row["share"] for row in rows) == pytest.approx(1, abs=0.01)
    assert all(row["milliseconds"] > 0 for row in rows[1:])


def test_time_in_a_function_and_all_that_it_calls():
    profiler = cProfile.Profile()
    profiler.enable()
    _calls_slow()
    profiler.disable()
    assert cumulative_seconds(pstats.Stats(profiler), "test_speed.py", "_calls_slow") >= 0.01
    assert cumulative_seconds(pstats.Stats(profiler), "other.py", "_calls_slow") == 0


def _calls_slow():
    time.sleep(0.01)


def test_a_table_that_is_measured_again_leaves_the_others_in_the_file(tmp_path, monkeypatch):
    """Each with its own origin; files of earlier versions have one origin for all tables."""
    old = {"command": "old", "commit": "0", "versions": {"torch": "1"}, "cpus": 2, "threads": 2}
    (tmp_path / "speed.json").write_text(json.dumps(old | {"steps": [{"a": 1}], "deployment": [{"a": 2}]}))
    new = {"commit": "1", "versions": {"torch": "2"}, "cpus": 4, "threads": 1}
    monkeypatch.setattr(speed, "provenance", lambda: new)
    monkeypatch.setitem(speed.TABLES, "deployment", lambda threads, quick: [{"a": 3}])
    monkeypatch.setattr(sys, "argv", ["speed", "--tables", "deployment", "--out", str(tmp_path / "speed")])
    speed.main()
    record = json.loads((tmp_path / "speed.json").read_text())
    made_with = record.pop("made_with")
    assert record == {"steps": [{"a": 1}], "deployment": [{"a": 3}]}
    assert made_with["steps"] == old
    assert made_with["deployment"] == new | {"command": "python -m benchmarks.speed --threads 1 2 --tables deployment"}
    monkeypatch.setitem(speed.TABLES, "steps", lambda threads, quick: [{"a": 4}])
    monkeypatch.setattr(sys, "argv", ["speed", "--tables", "steps", "--out", str(tmp_path / "speed")])
    speed.main()
    again = json.loads((tmp_path / "speed.json").read_text())
    assert (again["steps"], again["deployment"]) == ([{"a": 4}], [{"a": 3}])
    assert again["made_with"]["deployment"] == made_with["deployment"]
    assert again["made_with"]["steps"]["commit"] == "1"
    monkeypatch.setattr(sys, "argv", ["speed", "--tables", "steps", "--out", str(tmp_path / "of/its/own")])
    speed.main()
    assert list(json.loads((tmp_path / "of/its/own.json").read_text())) == ["made_with", "steps"]


class Recorder(gym.Wrapper):
    """Keeps the actions."""

    def __init__(self, env):
        super().__init__(env)
        self.actions = []

    def step(self, action):
        self.actions.append(np.array(action))
        return self.env.step(action)


def test_environments_are_timed_with_the_same_actions_and_the_same_physics():
    envs = [Recorder(gym.make("HalfCheetah-v5")), Recorder(gym.make("sb3_gac/HalfCheetah-v5", noise_std=0.1))]
    for env in envs:
        step = env_step(env)
        for _ in range(150):
            step()
    first, second = (np.array(env.actions) for env in envs)
    assert np.array_equal(first, second)
    assert np.array_equal(first[:50], first[100:]), "over and over"
    assert len(np.unique(first, axis=0)) == 100
    assert np.array_equal(*(env.unwrapped.data.qpos for env in envs))
