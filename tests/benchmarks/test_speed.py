"""What the speed benchmark counts and compares."""

import time

import pytest

from benchmarks.speed import alternate, compare_buffers, compare_steps, step_flops


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
    seconds = alternate({"a": lambda: calls.append("a"), "b": lambda: (calls.append("b"), time.sleep(0.001))}, 2, 3)
    assert calls == ["a"] * 3 + ["b"] * 3 + (["a"] * 3 + ["b"] * 3) * 3
    assert [len(values) for values in seconds.values()] == [3, 3]
    assert min(seconds["b"]) >= 0.001


def test_comparisons_give_finite_figures():
    row = compare_steps((2, 3, 1), batch=8, width=8, rounds=1)
    assert row["gac_over_sac"] == pytest.approx(row["gac_per_second"] / row["sac_per_second"], rel=0.02)
    assert 0 < row["gac_share_of_limit"] < 1
    assert compare_buffers((169, 270, 17), capacity=6_000)["bytes_over_sb3"] <= 0.52
