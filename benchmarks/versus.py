"""
Compares the speed of gradient steps of this checkout with that of another one, in alternation::

    git worktree add ../before v1.0
    python -m benchmarks.versus ../before --out benchmarks/results/versus.json

Each checkout has its model in a process of its own, and only one process works at a time. Other work of the machine slows both
measurements of a pair alike, since they follow each other. The results are the median and the quartiles of the pairs' ratios.
"""

import argparse
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_gac.training.provenance import commit, provenance

HERE = Path(__file__).resolve().parent.parent
PACKAGE = "sb3_gac"
SIZES = {"128 units, batch 128": (128, 128), "256 units, batch 256": (256, 256), "512 units, batch 256": (512, 256)}
#: Program of each process: it reads lines with a number of gradient steps, and answers with the mean seconds of a step
PROGRAM = """
import sys, time, warnings
warnings.simplefilter("ignore")
import torch as th
algorithm, width, batch, threads, compiled, clock = sys.argv[1], *map(int, sys.argv[2:6]), getattr(time, sys.argv[6])
th.set_num_threads(threads)
import gymnasium
import sb3_gac
model = getattr(sb3_gac, algorithm)("MultiInputPolicy", gymnasium.make("sb3_gac/HalfCheetah-v5", noise_std=0.1), seed=0,
    buffer_size=2000, learning_starts=1000, policy_kwargs={"net_arch": [width, width]}, compile=bool(compiled), device="cpu")
model.learn(500)
model.train(3, batch)
print("ready", sb3_gac.__file__, flush=True)
for line in sys.stdin:
    start = clock()
    model.train(int(line), batch)
    print((clock() - start) / int(line), flush=True)
"""


class Contender:
    """
    A model of one checkout, in a process of its own.

    :param checkout: directory of the checkout
    :param arguments: arguments of ``PROGRAM``: algorithm, width, batch size, threads, whether to compile, and clock
    :raises RuntimeError: if the process ends, or imports the package of another checkout
    """

    def __init__(self, checkout: Path, arguments: Sequence[Any]):
        self._what = f"{checkout.name}, {arguments}"
        command = [sys.executable, "-c", PROGRAM, *map(str, arguments)]
        env = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": str(arguments[3])}
        self._process = subprocess.Popen(
            command, cwd=checkout, env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        said = self._read().split()
        if Path(said[1]).resolve().parent.parent != checkout.resolve():
            raise RuntimeError(f"{checkout}: its process imports {said[1]}.")

    def _read(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self._what}: the process ended, see above.")
        return line

    def seconds(self, steps: int) -> float:
        """
        :param steps: number of gradient steps to make
        :return: mean seconds of a gradient step
        """
        assert self._process.stdin is not None
        self._process.stdin.write(f"{steps}\n")
        self._process.stdin.flush()
        return float(self._read())

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def compare(other: Path, arguments: Sequence[Any], steps: int, pairs: int) -> dict[str, float]:
    """
    :param other: directory of the other checkout
    :param arguments: arguments of ``PROGRAM``
    :param steps: gradient steps of each measurement
    :param pairs: number of pairs of measurements
    :return: median milliseconds of a gradient step in this checkout and in the other; and the quartiles of the ratio, which is
        above 1 where this checkout is faster
    """
    contenders = [Contender(checkout, arguments) for checkout in (HERE, other)]
    times = np.array([[contender.seconds(steps) for contender in contenders] for _ in range(pairs + 1)])[1:]
    for contender in contenders:
        contender.close()
    low, middle, high = np.percentile(times[:, 1] / times[:, 0], [25, 50, 75])
    here, there = 1e3 * np.median(times, axis=0)
    numbers = {"here_ms": here, "there_ms": there, "ratio_q1": low, "ratio": middle, "ratio_q3": high}
    return {name: round(float(value), 3) for name, value in numbers.items()}


def command(words: Sequence[str], checkout: Path) -> str:
    """
    :param words: command-line arguments of this program
    :param checkout: directory of the other checkout, one of the arguments
    :return: shell command of the same measurement, with the checkout's name in place of its path
    """
    given = [checkout.resolve().name if Path(word) == checkout else word for word in words]
    return shlex.join(["python", "-m", "benchmarks.versus", *given])


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Entry point of the command line.

    :param arguments: command-line arguments, by default those of the process
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path, help="directory of the other one")
    parser.add_argument("--algorithms", nargs="+", default=["GAC", "AsymmetricSAC"])
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--compiled", nargs="+", type=int, choices=[0, 1], default=[0, 1])
    parser.add_argument("--pairs", type=int, default=15, help="of measurements")
    parser.add_argument("--seconds", type=float, default=0.5, help="of each measurement")
    parser.add_argument("--clock", choices=["perf_counter", "process_time"], default="perf_counter")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args(arguments)
    package = options.checkout.resolve() / PACKAGE
    if not (package / "__init__.py").exists():
        sys.exit(
            f"{options.checkout} is no checkout of this repository, since it has no {PACKAGE}: git worktree add makes one."
        )
    rows = []
    for algorithm in options.algorithms:
        for size in options.sizes:
            for threads in options.threads:
                for compiled in options.compiled:
                    width, batch = SIZES[size]
                    steps = max(3, round(options.seconds / (width * width * batch * (1 if threads > 1 else 2) / 3e9)))
                    program = (algorithm, width, batch, threads, compiled, options.clock)
                    numbers = compare(options.checkout.resolve(), program, steps, options.pairs)
                    rows.append(
                        {"algorithm": algorithm, "size": size, "threads": threads, "compiled": bool(compiled), **numbers}
                    )
                    print(json.dumps(rows[-1]), flush=True)
    if options.out is not None:
        record = {
            "command": command(sys.argv[1:] if arguments is None else arguments, options.checkout),
            "there": commit(package),
            **provenance(),
            "rows": rows,
        }
        options.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
