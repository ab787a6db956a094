"""Speed beside the simulator's own."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.simulators import Overhead, Speed, main, measure, simulator_step
from sb3_gac.envs import make_vec
from tests.envs.vector_helpers import Counters

NOW, WORKED = [0.0], [0.0]


class SlowAdapter(Counters):
    """Its simulator takes 2 ms, what is around it 1 ms, during which others have the processor for 9 ms."""

    def advance(self, actions):
        NOW[0] += 0.002
        WORKED[0] += 0.002
        return super().advance(actions)

    def step_wait(self):
        NOW[0] += 0.010
        WORKED[0] += 0.001
        return super().step_wait()


def test_overhead_is_the_share_of_what_is_around_the_simulator(monkeypatch):
    clocks = SimpleNamespace(perf_counter=lambda: NOW[0], process_time=lambda: WORKED[0])
    monkeypatch.setattr("benchmarks.simulators.time", clocks)
    env = SlowAdapter(4)
    env.reset()
    speed = measure(env, seconds=0.3)
    assert (speed.steps_per_second, speed.alone) == pytest.approx((4 / 0.012, 4 / 0.002))
    assert speed.in_sb3 is speed.overhead_in_sb3 is None
    assert speed.overhead == pytest.approx((0.5, 0.5, 0.5))
    assert speed.overhead_by_clock == pytest.approx((5.0, 5.0, 5.0))
    assert speed.microseconds == pytest.approx((750, 500))
    assert speed.turns == 11  # of 28 ms


def test_the_overheads_spreadspread_is_that_of_the_turns(monkeypatch):
    """Turns in which the adapter takes 1, 2, 3, 4, 5 ms: half of them from 2 to 4."""
    now = [0.0]
    takes = iter([0.001 * (1 + number // 2 % 5) for number in range(100)])  # two steps fill a turn
    monkeypatch.setattr("benchmarks.simulators.MIN_TURNS", 5)
    monkeypatch.setattr(
        "benchmarks.simulators.time", SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: now[0])
    )

    class Varying(Counters):
        def advance(self, actions):
            now[0] += 0.002
            return super().advance(actions)

        def step_wait(self):
            now[0] += next(takes)
            return super().step_wait()

    env = Varying(1)
    env.reset()
    speed = measure(env, seconds=0.0)
    assert speed.overhead == pytest.approx((1.5, 1.0, 2.0))
    assert speed.microseconds == pytest.approx((3000, 2000))


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


def test_in_sb3_are_the_same_simulators_in_its_own_wrappers_alone(monkeypatch):
    """Each of two wrappers takes 1 ms, the simulator 2."""
    now = [0.0]
    monkeypatch.setattr(
        "benchmarks.simulators.time", SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: now[0])
    )

    def waits(seconds, step):
        def waited(action):
            now[0] += seconds
            return step(action)

        return waited

    env = make_vec("sb3_gac/Pendulum-v1", n_envs=2, seed=0)
    for one in env.envs:
        one.unwrapped.step = waits(0.002, one.unwrapped.step)
        for wrapper in (one.env, one.env.env):
            wrapper.step = waits(0.001, wrapper.step)
    env.reset()
    speed = measure(env, seconds=0.0)
    assert (speed.steps_per_second, speed.in_sb3, speed.alone) == pytest.approx((250, 500, 500))
    assert (speed.overhead.median, speed.overhead_in_sb3.median) == pytest.approx((1.0, 1.0))


def test_others_are_refused():
    with pytest.raises(ValueError, match="env must be a DummyVecEnv or a BatchVecEnv, got SimpleNamespace"):
        simulator_step(SimpleNamespace(num_envs=1), np.zeros((1, 1)))


def test_the_command_prints_a_line_for_each_number(capsys):
    main(["Pendulum", "--envs", "1", "2", "--seconds", "0.01"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("|")[2].strip() for line in lines[2:]] == ["1", "2"]


def test_what_a_file_has_of_others_stays(tmp_path, monkeypatch):
    path = tmp_path / "simulators.json"
    speeds = iter(
        [
            Speed(10.04, None, 20.0, Overhead(0.1, 0.05, 0.2), Overhead(0.3, 0.2, 0.4), None, (99.64, 49.0), 9),
            Speed(1.0, 2.0, 3.0, *[Overhead(0.0, 0.0, 0.0)] * 3, (1.0, 1.0, 1.0), 5),
        ]
    )
    monkeypatch.setattr("benchmarks.simulators.measured", lambda *_: next(speeds))
    for task in ("Pendulum", "Hopper"):
        main([task, "--envs", "4", "--out", str(path)])
    environments = json.loads(path.read_text())["environments"]
    assert list(environments) == ["sb3_gac/Pendulum-v1", "sb3_gac/Hopper-v5"]
    assert environments["sb3_gac/Pendulum-v1"]["4"] == {
        "steps_per_second": 10.0,
        "alone": 20.0,
        "overhead": [0.1, 0.05, 0.2],
        "overhead_by_clock": [0.3, 0.2, 0.4],
        "microseconds": [99.64, 49.0],
        "turns": 9,
    }
