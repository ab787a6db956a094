"""
How fast is a gradient step, and how large the buffer, beside SB3's SAC in the same run::

    python -m benchmarks.speed --out benchmarks/results/speed [--threads 1 2] [--tables steps growth] [--quick]

The contenders alternate in blocks, each in a process of its own; ratios are medians of the blocks' ratios.  The limit is
that of the arithmetic: the step's matrix products at the rate of a plain one, timed in the same run.  Steps and buffers use
only spaces and sizes of the tasks, with random data; the rollout is that of HalfCheetah itself.
"""

import argparse
import importlib.util
import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger

import sb3_gac
from benchmarks.contenders import alternate, process_timers, timer
from benchmarks.run import provenance

SIZES = {"HalfCheetah": (8, 17, 6), "Ant": (13, 27, 8), "Humanoid": (169, 270, 17)}
COMPILED, MIXED = {"compile": True}, {"compile": True, "mixed_precision": True}
CONTENDERS: dict[str, tuple[Any, dict[str, Any]]] = {  # name -> class and arguments
    "sac": (SAC, {}),
    "gac": (sb3_gac.GAC, {}),
    "gac-compiled": (sb3_gac.GAC, COMPILED),
    "gac-mixed": (sb3_gac.GAC, MIXED),
    "sac-asym": (sb3_gac.AsymmetricSAC, {}),
    "sac-asym-compiled": (sb3_gac.AsymmetricSAC, COMPILED),
}
if importlib.util.find_spec("sbx"):
    import sbx  # type: ignore[import-not-found]

    CONTENDERS["sbx-sac"] = (sbx.SAC, {})
GROWTH_CONTENDERS = ("sac", "gac", "gac-compiled")
BLOCK, ROUNDS = 10, 9
ENVS = (1, 8, 128)
GROWTH = [  # batch, width, size of the privileged entry
    *((batch, 256, 17) for batch in (64, 1024, 4096)),
    *((256, width, 17) for width in (64, 512, 1024)),
    *((256, 256, privileged) for privileged in (9, 376, 1508)),
]


class SpacesOnly(gym.Env):
    """
    An environment that is only asked for its spaces and for random observations.

    :param partial: size of the partial entry
    :param privileged: size of the privileged entry
    :param actions: number of actions
    """

    def __init__(self, partial: int, privileged: int, actions: int):
        self.observation_space = spaces.Dict(
            partial=spaces.Box(-np.inf, np.inf, (partial,), np.float32),
            privileged=spaces.Box(-np.inf, np.inf, (privileged,), np.float32),
        )
        self.action_space = spaces.Box(-1, 1, (actions,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """A random observation."""
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """A random observation and reward."""
        return self.observation_space.sample(), float(self.np_random.standard_normal()), False, False, {}


def make_step(contender: str, sizes: tuple[int, int, int], batch: int, width: int) -> Callable[[], None]:
    """
    :param contender: a key of ``CONTENDERS``
    :param sizes: partial, privileged, actions
    :param batch: batch size
    :param width: of the two hidden layers
    :return: one gradient step, as ``learn`` makes it, on a buffer of random transitions
    """
    algorithm, arguments = CONTENDERS[contender]
    settings = {"batch_size": batch, "learning_starts": 10**9, "buffer_size": 4_000, "seed": 0, "device": "cpu"} | arguments
    if algorithm.__module__.startswith("sbx"):  # knows no dicts
        env: gym.Env = gym.wrappers.FlattenObservation(SpacesOnly(*sizes))
        model = algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [width, width]}, **settings)
    else:
        kwargs = {"net_arch": [width, width], "activation_fn": th.nn.SiLU}
        model = algorithm("MultiInputPolicy", SpacesOnly(*sizes), policy_kwargs=kwargs, **settings)
    model.set_logger(Logger(None, []))
    model.learn(2_000)
    return lambda: model.train(1, batch)


def step_flops(sizes: tuple[int, int, int], batch: int, width: int) -> float:
    """
    Floating-point operations of the matrix products in one GAC step; gradients that nothing uses are not counted.

    :param sizes: partial, privileged, actions
    :param batch: B
    :param width: H, of both hidden layers
    """
    partial, privileged, actions = sizes
    full = partial + privileged

    def passes(inputs: int, outputs: int, forward: int, weights: int, activations: int, input_gradients: int) -> float:
        forward_cost = inputs * width + width * width + width * outputs
        behind_the_first = width * width + width * outputs
        return (forward + weights) * forward_cost + activations * behind_the_first + input_gradients * actions * width

    critics = passes(full + actions, 1, forward=12, weights=4, activations=8, input_gradients=4)
    guider = passes(full, 2 * actions, forward=2, weights=1, activations=1, input_gradients=0)
    learner = passes(partial, 2 * actions, forward=2, weights=1, activations=1, input_gradients=0)
    return 2.0 * batch * (critics + guider + learner)


def matmul_rate(batch: int, width: int) -> float:
    """Floating-point operations per second of one plain (B, H) x (H, H) product."""
    x, weight = th.randn(batch, width), th.randn(width, width)
    seconds = alternate({"mm": timer(lambda: th.mm(x, weight))}, repetitions=100, rounds=5)["mm"]
    return 2.0 * batch * width * width / float(np.median(seconds))


def compare_steps(
    names: Iterable[str], sizes: tuple[int, int, int], batch: int, width: int, threads: int, rounds: int
) -> dict[str, float]:
    """
    :return: gradient steps per second of SB3's SAC, those of each contender as a multiple, and GAC's shares of the limit
    """
    repetitions = max(1, min(BLOCK, BLOCK * 256**3 // (batch * width**2)))
    with process_timers(make_step, {name: (name, sizes, batch, width) for name in names}, threads) as timers:
        seconds = alternate(timers, repetitions, rounds)
    th.set_num_threads(threads)
    limit = matmul_rate(batch, width) / step_flops(sizes, batch, width)
    others = [name for name in seconds if name != "sac"]
    guided = [name for name in others if name.startswith("gac")]
    return {
        "sac_per_second": round(1 / float(np.median(seconds["sac"])), 1),
        **{f"{name}_over_sac": round(median_ratio(seconds["sac"], seconds[name]), 3) for name in others},
        **{f"{name}_share_of_limit": round(1 / float(np.median(seconds[name])) / limit, 3) for name in guided},
    }


def median_ratio(numerators: list[float], denominators: list[float]) -> float:
    """Of two contenders' blocks, taken side by side."""
    return float(np.median(np.array(numerators) / np.array(denominators)))


def compare_buffers(sizes: tuple[int, int, int], batch: int = 256, capacity: int = 20_000) -> dict[str, float]:
    """
    :return: bytes and sampling time of the compact buffer over those of SB3's
    """
    env = SpacesOnly(*sizes)
    assert isinstance(env.observation_space, spaces.Dict)
    arguments = (capacity, env.observation_space, env.action_space)
    compact, twice = sb3_gac.CompactDictReplayBuffer(*arguments, device="cpu"), DictReplayBuffer(*arguments, device="cpu")
    obs = {key: value[None] for key, value in env.observation_space.sample().items()}
    for step in range(5_000):
        following = {key: value[None] for key, value in env.observation_space.sample().items()}
        for buffer in (compact, twice):
            done = np.array([step % 1_000 == 999])
            buffer.add(obs, following, env.action_space.sample()[None], np.zeros(1), done, [{}])
        obs = following
    arrays = [*twice.observations.values(), *twice.next_observations.values()]
    arrays += [twice.actions, twice.rewards, twice.dones, twice.timeouts]
    timers = {"compact": timer(lambda: compact.sample(batch)), "twice": timer(lambda: twice.sample(batch))}
    seconds = alternate(timers, repetitions=100, rounds=9)
    return {
        "bytes_over_sb3": round(compact.nbytes() / sum(array.nbytes for array in arrays), 3),
        "sampling_time_over_sb3": round(median_ratio(seconds["compact"], seconds["twice"]), 3),
        "sampling_microseconds": round(1e6 * float(np.median(seconds["compact"])), 1),
    }


def compare_wrappers(rounds: int = ROUNDS) -> dict[str, float]:
    """
    :return: microseconds of a HalfCheetah step, gymnasium's and ours with noise, and what ours adds as a share
    """
    envs = {"gymnasium": gym.make("HalfCheetah-v5"), "ours": gym.make("sb3_gac/HalfCheetah-v5", noise_std=0.1)}
    seconds = alternate({name: timer(env_step(env)) for name, env in envs.items()}, repetitions=1_000, rounds=rounds)
    return {
        **{f"{name}_microseconds": round(1e6 * float(np.median(values)), 1) for name, values in seconds.items()},
        "added_share": round(median_ratio(seconds["ours"], seconds["gymnasium"]) - 1, 3),
    }


def env_step(env: gym.Env) -> Callable[[], None]:
    """
    :param env: to step with one action over and over, reset where an episode ends
    """
    action = env.action_space.sample()
    env.reset(seed=0)

    def step() -> None:
        if any(env.step(action)[2:4]):
            env.reset()

    return step


def profile_rollout(n_envs: int, vec_steps: int) -> dict[str, float]:
    """
    Where the time of ``learn`` goes on HalfCheetah, with one gradient step per environment step.

    :param n_envs: environments side by side
    :param vec_steps: steps of all of them
    :return: environment steps per second, and the shares of gradient steps, of physics (with our wrappers, without SB3's
        vector environment), and of all else
    """
    vec_env = make_vec_env("sb3_gac/HalfCheetah-v5", n_envs, seed=0, env_kwargs={"noise_std": 0.1})
    small = {**sb3_gac.preset("small"), "learning_starts": 0, "buffer_size": 50_000, "device": "cpu"}
    model = sb3_gac.GAC("MultiInputPolicy", vec_env, **small)
    model.learn(4 * n_envs)
    spent = {"gradient": 0.0}
    train = model.train

    def timed_train(*args: Any, **kwargs: Any) -> None:
        start = time.perf_counter()
        train(*args, **kwargs)
        spent["gradient"] += time.perf_counter() - start

    model.train = timed_train  # type: ignore[method-assign]
    start = time.perf_counter()
    model.learn(vec_steps * n_envs)
    total = time.perf_counter() - start
    physics = n_envs * vec_steps * float(np.median([timer(env_step(vec_env.envs[0]))(300) for _ in range(5)]))  # type: ignore
    shares = {"gradient_share": spent["gradient"] / total, "physics_share": physics / total}
    rounded = {name: round(share, 3) for name, share in shares.items()}
    return {
        "steps_per_second": round(vec_steps * n_envs / total, 1),
        **rounded,
        "other_share": round(1 - sum(shares.values()), 3),
    }


def tabulate_steps(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """Gradient steps: HalfCheetah with one thread, all sizes with more."""
    rows = []
    for count in threads:
        several = count > 1 and not quick
        for task in SIZES if several else ("HalfCheetah",):
            for batch in (256, 512) if several else (256,):
                row = {"task": task, "threads": count, "batch": batch, "width": 256}
                rows.append(row | compare_steps(CONTENDERS, SIZES[task], batch, 256, count, 3 if quick else ROUNDS))
    return rows


def tabulate_growth(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """Gradient steps by batch, width and size of the privileged entry, with the last number of threads."""
    rows = []
    for batch, width, privileged in GROWTH[:1] if quick else GROWTH:
        row = {"threads": threads[-1], "batch": batch, "width": width, "privileged": privileged}
        rows.append(row | compare_steps(GROWTH_CONTENDERS, (8, privileged, 6), batch, width, threads[-1], rounds=3))
    return rows


def tabulate_rollout(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """Where training's time goes, by number of environments, with the last number of threads."""
    th.set_num_threads(threads[-1])
    rows = []
    for n_envs in ENVS:
        vec_steps = max(4, (100 if quick else 1_000) // n_envs)
        rows.append({"envs": n_envs, "threads": threads[-1]} | profile_rollout(n_envs, vec_steps))
    return rows


TABLES: dict[str, Callable[[list[int], bool], list[dict[str, Any]]]] = {  # name -> threads, whether to be quick -> rows
    "wrappers": lambda threads, quick: [compare_wrappers(3 if quick else ROUNDS)],
    "steps": tabulate_steps,
    "growth": tabulate_growth,
    "rollout": tabulate_rollout,
    "buffers": lambda threads, quick: [{"task": task} | compare_buffers(sizes) for task, sizes in SIZES.items()],
}


def markdown(rows: list[dict[str, Any]]) -> str:
    """
    :param rows: with the same keys
    """
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    return "\n".join([*lines, *("| " + " | ".join(str(value) for value in row.values()) + " |" for row in rows)])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="path of the results, without a suffix")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--tables", choices=TABLES, nargs="+", default=list(TABLES))
    parser.add_argument("--quick", action="store_true", help="one size and few rounds")
    options = parser.parse_args()
    flags = f"--threads {' '.join(map(str, options.threads))} --tables {' '.join(options.tables)}"
    record = {"command": f"python -m benchmarks.speed {flags}{' --quick' if options.quick else ''}", **provenance()}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    for name in options.tables:
        record[name] = TABLES[name](options.threads, options.quick)
        options.out.with_suffix(".json").write_text(json.dumps(record, indent=1))
        print(f"\n{name}\n\n{markdown(record[name])}", flush=True)


if __name__ == "__main__":
    main()
