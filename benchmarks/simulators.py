"""
Steps per second of registered environments, beside those of the simulator alone::

    python -m benchmarks.simulators Go1JoystickFlatTerrain HalfCheetah --envs 1 16 128

Both take turns, a few milliseconds each, so that whatever else the machine does slows down both.  The overhead is the median
over the pairs of turns of how much more processor time the process takes, which waits for no other process; what the clock
says stands beside it.  "Alone" is EnvPool's own ``step`` for tasks of EnvPool, and otherwise the innermost environments' one
after the other, without a wrapper.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gac.envs import BatchVecEnv, make_vec
from sb3_gac.envs.suites import env_id_of
from sb3_gac.envs.table import in_columns

TURN = 0.02  # seconds
MIN_PAIRS = 9


class Overhead(NamedTuple):
    """
    Time per step that is not the simulator's, as a share of the simulator's.

    :param median: over the pairs of turns
    :param low: a quarter of the pairs is below
    :param high: a quarter of them is above
    """

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.median:+.1%} ({self.low:+.1%} to {self.high:+.1%})"


class Speed(NamedTuple):
    """
    Of environments side by side.

    :param steps_per_second: of all together, with everything that SB3 needs, by the clock
    :param alone: the simulator's
    :param overhead: in processor time of the process, all of its threads together
    :param overhead_by_clock: the same as the clock has it, which on a busy machine says little
    :param pairs: of turns that were measured
    """

    steps_per_second: float
    alone: float
    overhead: Overhead
    overhead_by_clock: Overhead
    pairs: int


def measure(env: VecEnv, seconds: float) -> Speed:
    """
    :param env: reset
    :param seconds: to measure for, or longer, until there are nine pairs of turns
    """
    actions = np.stack([env.action_space.sample() for _ in range(env.num_envs)])
    whole, alone = lambda: env.step(actions), simulator_step(env, actions)
    n_calls = max(1, round(TURN / min(_times(alone, 1)[0] for _ in range(5))))
    pairs: list[tuple[tuple[float, float], tuple[float, float]]] = []
    end = time.perf_counter() + seconds
    while len(pairs) < MIN_PAIRS or time.perf_counter() < end:
        pairs.append((_times(whole, n_calls), _times(alone, n_calls)))
    by_clock, by_processor = np.array(pairs).T.swapaxes(1, 2)
    speed, alone_speed = (env.num_envs / np.median(by_clock, axis=0)).tolist()
    return Speed(speed, alone_speed, _overhead(*by_processor.T), _overhead(*by_clock.T), len(pairs))


def _times(call: Callable[[], Any], times: int) -> tuple[float, float]:
    """Seconds of one call, on average, by the clock and of the processor."""
    clock, processor = time.perf_counter(), time.process_time()
    for _ in range(times):
        call()
    return (time.perf_counter() - clock) / times, (time.process_time() - processor) / times


def _overhead(of_whole: np.ndarray, of_alone: np.ndarray) -> Overhead:
    low, median, high = (np.quantile(of_whole / of_alone, [0.25, 0.5, 0.75]) - 1.0).tolist()
    return Overhead(median, low, high)


def simulator_step(env: VecEnv, actions: np.ndarray) -> Callable[[], Any]:
    """
    :param env: reset
    :param actions: one for each environment
    :return: a step of all environments without what is around the simulator, which begins new episodes by itself
    :raises ValueError: if the simulator is not within reach
    """
    if isinstance(env, BatchVecEnv):
        pool = getattr(env, "pool", None)
        in_its_type = actions.astype(np.float64)
        return (lambda: env.advance(actions)) if pool is None else (lambda: pool.step(in_its_type))
    if not isinstance(env, DummyVecEnv):
        raise ValueError(f"env must be a DummyVecEnv or a BatchVecEnv, got {type(env).__name__}.")
    innermost = [getattr(one.unwrapped, "simulated", one.unwrapped) for one in env.envs]

    def step_all() -> None:
        for one, action in zip(innermost, actions, strict=True):
            _, _, terminated, truncated, _ = one.step(action)
            if terminated or truncated:
                one.reset()

    return step_all


def measured(env_id: str, n_envs: int, seconds: float) -> Speed:
    """
    :param env_id: of a registered environment
    :param n_envs: side by side
    :param seconds: to measure for
    """
    env = make_vec(env_id, n_envs, seed=0)
    try:
        env.reset()
        return measure(env, seconds)
    finally:
        env.close()


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Command line.

    :param arguments: by default the process's
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="+", help="as in sb3_gac/<task>-v<version>")
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 16, 128], help="side by side")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each measurement")
    parser.add_argument("--out", type=Path, help="JSON file to write; what it has of other environments stays")
    options = parser.parse_args(arguments)
    lines = []
    for env_id in map(env_id_of, options.tasks):
        for n_envs in options.envs:
            speed = measured(env_id, n_envs, options.seconds)
            if options.out is not None:
                _write(options.out, env_id, n_envs, speed)
            lines.append([env_id, str(n_envs), f"{speed[0]:,.0f}", f"{speed[1]:,.0f}", *map(str, speed[2:4])])
    print(in_columns(["id", "environments", "steps/s", "simulator alone", "overhead, processor time", "by the clock"], lines))


def _write(path: Path, env_id: str, n_envs: int, speed: Speed) -> None:
    """Each measurement as soon as it is made."""
    found = json.loads(path.read_text()) if path.exists() else {}
    one = {
        "steps_per_second": round(speed.steps_per_second, 1),
        "simulator_alone": round(speed.alone, 1),
        "overhead": [round(share, 4) for share in speed.overhead],
        "overhead_by_clock": [round(share, 4) for share in speed.overhead_by_clock],
        "pairs": speed.pairs,
    }
    found.setdefault("columns of overheads", ["median", "lower quartile", "upper quartile"])
    found["made with"] = {name: version(name) for name in ("numpy", "gymnasium", "stable_baselines3", "mujoco")} | {
        "cores": os.cpu_count()
    }
    found.setdefault("environments", {}).setdefault(env_id, {})[str(n_envs)] = one
    path.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
