"""
Measures steps per second of registered environments, beside those of the simulator alone::

    python -m benchmarks.simulators Go1JoystickFlatTerrain HalfCheetah --envs 1 16 128

All contenders take turns of a few milliseconds, so that other work of the machine slows all of them alike.  An overhead is
the additional processor time of a step, as a median over the turns; processor time leaves out the waiting for other processes.
The additional time by the clock is printed too, and the time of each contender's fastest turn, which no other process
disturbed.  The simulator "alone" is EnvPool's own ``step`` for tasks of EnvPool, and for others the innermost environments,
stepped one after the other without a wrapper.  "In SB3" are the same simulators in gymnasium's and SB3's own wrappers and a
``DummyVecEnv``, as without this package.
"""

import argparse
import json
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
from sb3_gac.envs.subprocesses import usable_processors
from sb3_gac.envs.suites import env_id_of
from sb3_gac.envs.table import in_columns

TURN = 0.004  # seconds
MIN_TURNS = 9
PACKAGES = ("brax", "envpool", "gymnasium", "gymnasium-robotics", "jax", "mujoco", "numpy", "popgym", "stable_baselines3")
COLUMNS = ["id", "environments", "steps/s", "in SB3", "alone", "overhead over SB3's", "over the simulator", "by the clock"]
COLUMNS += ["us at best: all, alone, in SB3"]


class Overhead(NamedTuple):
    """
    Additional time of a step over another way of stepping, as a share of the other's time.

    :param median: median over the turns
    :param low: lower quartile over the turns
    :param high: upper quartile over the turns
    """

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.median:+.1%} ({self.low:+.1%} to {self.high:+.1%})"


class Speed(NamedTuple):
    """
    The speed of environments side by side.

    :param steps_per_second: steps per second of all environments together, as an algorithm steps them, by the clock
    :param in_sb3: steps per second without this package's wrappers; ``None`` for simulators that step a batch, for
        which SB3 has no vectorised environment
    :param alone: steps per second of the simulator alone
    :param overhead: overhead over the simulator alone, in processor time of all threads of the process
    :param overhead_by_clock: overhead over the simulator alone by the clock, which says little on a busy machine
    :param overhead_in_sb3: overhead over ``in_sb3`` in processor time, ``None`` where that is ``None``
    :param microseconds: microseconds of processor time for a step of one environment in the fastest turn: with everything, of
        the simulator alone, and in SB3 if it was measured
    :param turns: number of turns that were measured
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
    :param env: vectorised environment that has been reset
    :param seconds: seconds to measure for; the measurement lasts longer if it needs to for nine turns
    :return: speed of the environment
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
    by_clock, by_processor = np.array(turns).T  # each of shape (ways, turns)
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
    """The mean seconds of a call, by the clock and in processor time."""
    clock, processor = time.perf_counter(), time.process_time()
    for _ in range(times):
        call()
    return (time.perf_counter() - clock) / times, (time.process_time() - processor) / times


def _overhead(ours: np.ndarray, theirs: np.ndarray) -> Overhead:
    low, median, high = (np.quantile(ours / theirs, [0.25, 0.5, 0.75]) - 1.0).tolist()
    return Overhead(median, low, high)


def simulator_step(env: VecEnv, actions: np.ndarray) -> Callable[[], Any]:
    """
    :param env: vectorised environment that has been reset
    :param actions: actions, one for each environment
    :return: function that steps all simulators without the wrappers around them, and begins new episodes where one ends
    :raises ValueError: if the environment is of a kind whose simulator cannot be reached
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
    """The same simulators in the wrappers that SB3's ``make_vec_env`` would put around them."""
    limits = [one.spec.max_episode_steps if one.spec else None for one in env.envs]

    def made(one: gym.Env, limit: int | None) -> Callable[[], gym.Env]:
        checked = gym.wrappers.OrderEnforcing(gym.wrappers.PassiveEnvChecker(one))
        return lambda: Monitor(checked if limit is None else gym.wrappers.TimeLimit(checked, limit))

    plain = DummyVecEnv([made(one, limit) for one, limit in zip(_innermost(env), limits, strict=True)])
    plain.reset()
    return plain


def measured(env_id: str, n_envs: int, seconds: float) -> Speed:
    """
    :param env_id: id of a registered environment
    :param n_envs: number of environments side by side
    :param seconds: seconds to measure for
    :return: speed of the environments
    """
    env = make_vec(env_id, n_envs, seed=0)
    try:
        env.reset()
        return measure(env, seconds)
    finally:
        env.close()


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Entry point of the command line.

    :param arguments: command-line arguments, by default those of the process
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
    """Add a measurement to the file."""
    found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    one = {name: _rounded(value) for name, value in speed._asdict().items() if value is not None}
    found.setdefault("columns of overheads", ["median", "lower quartile", "upper quartile"])
    found.setdefault("made with", {}).update(_versions(), cores=usable_processors())
    found.setdefault("environments", {}).setdefault(env_id, {})[str(n_envs)] = one
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


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
