"""
Steps per second of registered environments, beside those of the simulator alone::

    python -m benchmarks.simulators Go1JoystickFlatTerrain HalfCheetah --envs 1 16 128

Both take turns, a few milliseconds each, so that whatever else the machine does slows down both: the overhead is the median
over the pairs of turns.  "Alone" is EnvPool's own ``step`` for tasks of EnvPool, and otherwise the innermost environments' one
after the other, without a wrapper.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gac.envs import BatchVecEnv, make_vec
from sb3_gac.envs.suites import env_id_of
from sb3_gac.envs.table import in_columns

TURN = 0.02  # seconds


class Speed(NamedTuple):
    """
    Of environments side by side.

    :param steps_per_second: of all together, with everything that SB3 needs
    :param alone: the simulator's
    :param overhead: time per step that is not the simulator's, as a share of the simulator's
    """

    steps_per_second: float
    alone: float
    overhead: float


def measure(env: VecEnv, seconds: float) -> Speed:
    """
    :param env: reset
    :param seconds: to measure for
    """
    actions = np.stack([env.action_space.sample() for _ in range(env.num_envs)])
    whole, alone = lambda: env.step(actions), simulator_step(env, actions)
    n_calls = max(1, round(TURN / min(_seconds(alone, 1) for _ in range(5))))
    pairs: list[tuple[float, float]] = []
    end = time.perf_counter() + seconds
    while len(pairs) < 3 or time.perf_counter() < end:
        pairs.append((_seconds(whole, n_calls), _seconds(alone, n_calls)))
    of_whole, of_alone = np.array(pairs).T
    speed, alone_speed = (env.num_envs / float(np.median(times)) for times in (of_whole, of_alone))
    return Speed(speed, alone_speed, float(np.median(of_whole / of_alone)) - 1.0)


def _seconds(call: Callable[[], Any], times: int) -> float:
    """Of one call, on average."""
    started = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - started) / times


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


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Command line.

    :param arguments: by default the process's
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="+", help="as in sb3_gac/<task>-v<version>")
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 16, 128], help="side by side")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each measurement")
    options = parser.parse_args(arguments)
    lines = []
    for env_id in map(env_id_of, options.tasks):
        for n_envs in options.envs:
            env = make_vec(env_id, n_envs, seed=0)
            env.reset()
            speed = measure(env, options.seconds)
            env.close()
            lines.append([env_id, str(n_envs), f"{speed[0]:,.0f}", f"{speed[1]:,.0f}", f"{speed.overhead:+.1%}"])
    print(in_columns(["id", "environments", "steps/s", "simulator alone", "overhead"], lines))


if __name__ == "__main__":
    main()
