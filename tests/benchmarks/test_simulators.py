"""Speed beside the simulator's own."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.simulators import main, measure, simulator_step
from sb3_gac.envs import make_vec
from tests.envs.vector_helpers import Counters

NOW = [0.0]


class SlowAdapter(Counters):
    """Its simulator takes 2 ms, what is around it 1 ms."""

    def advance(self, actions):
        NOW[0] += 0.002
        return super().advance(actions)

    def step_wait(self):
        NOW[0] += 0.001
        return super().step_wait()


def test_overhead_is_the_share_of_what_is_around_the_simulator(monkeypatch):
    monkeypatch.setattr("benchmarks.simulators.time", SimpleNamespace(perf_counter=lambda: NOW[0]))
    env = SlowAdapter(4)
    env.reset()
    assert measure(env, seconds=0.3) == pytest.approx((4 / 0.003, 4 / 0.002, 0.5))


def test_the_innermost_environments_are_stepped_without_their_wrappers():
    env = make_vec("sb3_gac/Pendulum-v1", n_envs=2, seed=0)
    env.reset()
    calls = []
    for index, one in enumerate(env.envs):
        inner = one.unwrapped.step
        one.unwrapped.step = lambda action, index=index, inner=inner: calls.append(index) or inner(action)
        one.step = None
    simulator_step(env, np.zeros((2, 1), dtype=np.float32))()
    assert calls == [0, 1]


def test_others_are_refused():
    with pytest.raises(ValueError, match="env must be a DummyVecEnv or a BatchVecEnv, got SimpleNamespace"):
        simulator_step(SimpleNamespace(num_envs=1), np.zeros((1, 1)))


def test_the_command_prints_a_line_for_each_number(capsys):
    main(["Pendulum", "--envs", "1", "2", "--seconds", "0.01"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("|")[2].strip() for line in lines[2:]] == ["1", "2"]
