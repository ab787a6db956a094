"""
How fast is a gradient step, and how large the buffer, beside SB3's SAC in the same run::

    python -m benchmarks.speed --out benchmarks/results/speed [--threads 1 2] [--quick]

The contenders alternate in blocks, so that whatever else the machine does falls on all of them; ratios are medians of
the blocks' ratios.  The limit is that of the arithmetic: the step's matrix products at the rate of a plain one, timed in
the same run.  Only spaces and sizes of the tasks are used, with random data: physics has no part in it.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.logger import Logger

import sb3_gac
from benchmarks.run import provenance

SIZES = {"HalfCheetah": (8, 17, 6), "Ant": (13, 27, 8), "Humanoid": (169, 270, 17)}
BLOCK, ROUNDS = 20, 9


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


def make_model(algorithm: Any, sizes: tuple[int, int, int], batch: int, width: int) -> Any:
    """
    :param algorithm: GAC or SAC
    :param sizes: partial, privileged, actions
    :param batch: batch size
    :param width: of the two hidden layers
    :return: model with a buffer of random transitions
    """
    kwargs = {"net_arch": [width, width], "activation_fn": th.nn.SiLU}
    settings = {"batch_size": batch, "learning_starts": 10**9, "buffer_size": 4_000, "seed": 0, "device": "cpu"}
    model = algorithm("MultiInputPolicy", SpacesOnly(*sizes), policy_kwargs=kwargs, **settings)
    model.set_logger(Logger(None, []))
    return model.learn(2_000)


def alternate(contenders: dict[str, Callable[[], Any]], block: int = BLOCK, rounds: int = ROUNDS) -> dict[str, list[float]]:
    """
    :param contenders: name -> one step
    :param block: steps per measurement
    :param rounds: measurements of each
    :return: name -> seconds per step, one number per round
    """
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds + 1):  # the first warms up
        for name, step in contenders.items():
            step()  # what the others left in the caches and thread pools is not this one's
            start = time.perf_counter()
            for _ in range(block):
                step()
            seconds[name].append((time.perf_counter() - start) / block)
    return {name: values[1:] for name, values in seconds.items()}


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
    seconds = alternate({"mm": lambda: th.mm(x, weight)}, block=100, rounds=5)["mm"]
    return 2.0 * batch * width * width / float(np.median(seconds))


def compare_steps(sizes: tuple[int, int, int], batch: int, width: int, rounds: int) -> dict[str, float]:
    """
    :return: steps per second of both, GAC's over SAC's, and GAC's share of the arithmetic's limit
    """
    gac, sac = (make_model(algorithm, sizes, batch, width) for algorithm in (sb3_gac.GAC, SAC))
    seconds = alternate({"gac": lambda: gac.train(1, batch), "sac": lambda: sac.train(1, batch)}, rounds=rounds)
    ratios = np.array(seconds["sac"]) / np.array(seconds["gac"])
    limit = matmul_rate(batch, width) / step_flops(sizes, batch, width)
    gac_rate = 1 / float(np.median(seconds["gac"]))
    return {
        "gac_per_second": round(gac_rate, 1),
        "sac_per_second": round(1 / float(np.median(seconds["sac"])), 1),
        "gac_over_sac": round(float(np.median(ratios)), 3),
        "gac_share_of_limit": round(gac_rate / limit, 3),
    }


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
    seconds = alternate({"compact": lambda: compact.sample(batch), "twice": lambda: twice.sample(batch)}, block=100)
    ratios = np.array(seconds["compact"]) / np.array(seconds["twice"])
    return {
        "bytes_over_sb3": round(compact.nbytes() / sum(array.nbytes for array in arrays), 3),
        "sampling_time_over_sb3": round(float(np.median(ratios)), 3),
        "sampling_microseconds": round(1e6 * float(np.median(seconds["compact"])), 1),
    }


def measure(threads: list[int], quick: bool) -> dict[str, Any]:
    """
    :param threads: torch's, one table each
    :param quick: two sizes and few rounds
    :return: tables
    """
    rounds = 3 if quick else ROUNDS
    results: dict[str, Any] = {"steps": [], "growth": [], "buffers": []}
    for count in threads:
        th.set_num_threads(count)
        for task, batch in [("HalfCheetah", 256)] if quick else [(task, batch) for task in SIZES for batch in (256, 512)]:
            row = {"task": task, "threads": count, "batch": batch, "width": 256}
            results["steps"].append(row | compare_steps(SIZES[task], batch, 256, rounds))
    for batch, width in [] if quick else [(64, 256), (1024, 256), (4096, 256), (256, 64), (256, 128), (256, 512), (256, 1024)]:
        row = {"threads": threads[-1], "batch": batch, "width": width}
        results["growth"].append(row | compare_steps(SIZES["HalfCheetah"], batch, width, rounds=3))
    for task, sizes in SIZES.items():
        results["buffers"].append({"task": task} | compare_buffers(sizes))
    return results


def markdown(rows: list[dict[str, Any]]) -> str:
    """
    :param rows: with the same keys
    """
    if not rows:
        return ""
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    return "\n".join([*lines, *("| " + " | ".join(str(value) for value in row.values()) + " |" for row in rows)])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="path of the results, without a suffix")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    results = measure(options.threads, options.quick)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    flags = f"--threads {' '.join(map(str, options.threads))}{' --quick' if options.quick else ''}"
    record = {"command": f"python -m benchmarks.speed {flags}", **provenance(), **results}
    options.out.with_suffix(".json").write_text(json.dumps(record, indent=1))
    for name in ("steps", "growth", "buffers"):
        print(f"\n{name}\n\n{markdown(results[name])}")


if __name__ == "__main__":
    main()
