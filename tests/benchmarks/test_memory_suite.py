"""The suite that tells what a memory is worth compares like with like."""

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.config import resolve
from benchmarks.environments import environment
from benchmarks.suite import read_suite

SPECS = read_suite(Path(__file__).parents[2] / "benchmarks" / "suites" / "memory.yml")


@pytest.mark.parametrize("name", ["gac", "sac-asym"])
def test_twins_differ_in_their_memory_and_learn_from_as_many_transitions(name):
    plain, gru = (resolve(replace(SPECS[0], algorithm=algorithm))[1] for algorithm in (name, f"{name}-gru"))
    changed = {key for key in plain | gru if plain.get(key) != gru.get(key)}
    assert changed == {"policy", "policy_kwargs", "batch_size", "replay_buffer_kwargs"}
    assert gru["batch_size"] * gru["replay_buffer_kwargs"]["sequence_length"] == plain["batch_size"]
    assert gru["policy_kwargs"]["net_arch"] == plain["policy_kwargs"]["net_arch"]


def test_all_four_run_on_the_task_without_its_velocity():
    assert {spec.algorithm for spec in SPECS} == {"gac", "gac-gru", "sac-asym", "sac-asym-gru"}
    for spec in SPECS:
        assert environment(spec) == ("sb3_gac/Pendulum-v1", {"noise_std": spec.noise})
