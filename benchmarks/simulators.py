"""
Steps per second of registered environments, beside those of the simulator alone::

    python -m benchmarks.simulators Go1JoystickFlatTerrain HalfCheetah --envs 1 16 128

All take turns, a few milliseconds each, so that whatever else the machine does slows down all.  An overhead is the median over
the turns of how much more processor time the process takes, which waits for no other process; what the clock says is there
too, and what the fastest turn of each needs, which no other process disturbed.  "Alone" is EnvPool's own ``step`` for tasks of
EnvPool, and otherwise the innermost environments' one after the other, without a wrapper.  "In SB3" are those in gymnasium's
and SB3's own wrappers and a ``DummyVecEnv``, as without this package.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gac.envs import BatchVecEnv, make_vec
from sb3_gac.envs.suites import env_id_of
from sb3_gac.envs.table import in_columns

TURN = 0.004  # seconds
MIN_TURNS = 9
PACKAGES = ("brax", "envpool", "gymnasium", "gymnasium-robotics", "jax", "mujoco", "numpy", "popgym", "stable_baselines3")
COLUMNS = ["id", "environments", "steps/s", "in SB3", "alone", "overhead over SB3's", "over the simulator", "by the clock"]
COLUMNS += ["us at best: all, alone, in SB3"]


class Overhead(NamedTuple):
    """
    Time per step that another way of stepping does not need, as a share of what it needs.

    :param median: over the turns
    :param low: a quarter of the turns is below
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
    :param in_sb3: without this package's wrappers; None for simulators that step a batch, which SB3 has nothing for
    :param alone: the simulator's
    :param overhead: over the simulator alone, in processor time of the process, all of its threads together
    :param overhead_by_clock: the same as the clock has it, which on a busy machine says little
    :param overhead_in_sb3: over ``in_sb3``, in processor time
    :param microseconds: of the processor for a step of one environment in the fastest turn: with everything, alone, in SB3
    :param turns: that were measured
    """

    steps_per_second: float
    in_sb3: float | None
    alone: float
    overhead: Overhead
    overhead_by_clock: Overhead
    overhead_in_sb3: Overhead | None
    microseconds: tuple[float, ...]
    turns: int


def measure(env: VecEnv, seconds: float) -> Speed:
    """
    :param env: reset
    :param seconds: to measure for, or longer, until there are nine turns
    """
    actions = np.stack([env.action_space.sample() for _ in range(env.num_envs)])
    ways = [lambda: env.step(actions), simulator_step(env, actions)]
    if isinstance(env, DummyVecEnv):
        plain = _in_sb3(env)
        ways.append(lambda: plain.step(actions))
    n_calls = max(1, round(TURN / min(_times(ways[1], 1)[0] for _ in range(5))))
    turns: list[list[tuple[float, float]]] = []
    end = time.perf_counter() + seconds
    while len(turns) < MIN_TURNS or time.perf_counter() < end:
        turns.append([_times(way, n_calls) for way in ways])
    by_clock, by_processor = np.array(turns).T  # (ways, turns) each
    whole, alone, *in_sb3 = (env.num_envs / np.median(by_clock, axis=1)).tolist()
    return Speed(
        whole,
        in_sb3[0] if in_sb3 else None,
        alone,
        _overhead(by_processor[0], by_processor[1]),
        _overhead(by_clock[0], by_clock[1]),
        _overhead(by_processor[0], by_processor[2]) if in_sb3 else None,
        tuple((1e6 * by_processor.min(axis=1) / env.num_envs).tolist()),
        len(turns),
    )


def _times(call: Callable[[], Any], times: int) -> tuple[float, float]:
    """Seconds of one call, on average, by the clock and of the processor."""
    clock, processor = time.perf_counter(), time.process_time()
    for _ in range(times):
        call()
    return (time.perf_counter() - clock) / times, (time.process_time() - processor) / times


def _overhead(ours: np.ndarray, theirs: np.ndarray) -> Overhead:
    low, median, high = (np.quantile(ours / theirs, [0.25, 0.5, 0.75]) - 1.0).tolist()
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
    innermost = _innermost(env)

    def step_all() -> None:
        for one, action in zip(innermost, actions, strict=True):
            _, _, terminated, truncated, _ = one.step(action)
            if terminated or truncated:
                one.reset()

    return step_all


def _innermost(env: DummyVecEnv) -> list[gym.Env]:
    return [getattr(one.unwrapped, "simulated", one.unwrapped) for one in env.envs]


def _in_sb3(env: DummyVecEnv) -> DummyVecEnv:
    """The same simulators as SB3's ``make_vec_env`` would have them."""
    limits = [one.spec.max_episode_steps if one.spec else None for one in env.envs]

    def made(one: gym.Env, limit: int | None) -> Callable[[], gym.Env]:
        checked = gym.wrappers.OrderEnforcing(gym.wrappers.PassiveEnvChecker(one))
        return lambda: Monitor(checked if limit is None else gym.wrappers.TimeLimit(checked, limit))

    plain = DummyVecEnv([made(one, limit) for one, limit in zip(_innermost(env), limits, strict=True)])
    plain.reset()
    return plain


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
            lines.append([env_id, str(n_envs), *_in_words(speed)])
    print(in_columns(COLUMNS, lines))


def _in_words(speed: Speed) -> list[str]:
    speeds = ["" if one is None else f"{one:,.0f}" for one in speed[:3]]
    medians = [str(speed.overhead_in_sb3 or ""), str(speed.overhead), f"{speed.overhead_by_clock.median:+.1%}"]
    return [*speeds, *medians, ", ".join(f"{one:.1f}" for one in speed.microseconds)]


def _write(path: Path, env_id: str, n_envs: int, speed: Speed) -> None:
    """Each measurement as soon as it is made."""
    found = json.loads(path.read_text()) if path.exists() else {}
    one = {name: _rounded(value) for name, value in speed._asdict().items() if value is not None}
    found.setdefault("columns of overheads", ["median", "lower quartile", "upper quartile"])
    found.setdefault("made with", {}).update(_versions(), cores=os.cpu_count())
    found.setdefault("environments", {}).setdefault(env_id, {})[str(n_envs)] = one
    path.write_text(json.dumps(found, indent=1) + "\n")


def _versions() -> dict[str, str]:
    installed = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            installed[name] = version(name)
    return installed


def _rounded(value: Any) -> Any:
    return [round(share, 4) for share in value] if isinstance(value, tuple) else round(value, 1)


if __name__ == "__main__":
    main()
