"""
Kills training at random moments, again and again, and lets it go on from its last checkpoint::

    python -m benchmarks.soak /tmp/soak --minutes 60 --out benchmarks/results/soak.json

A worker trains GAC on HalfCheetah and makes checkpoints; this program ends the worker by SIGKILL or SIGTERM after a random
time and starts it again.  The report has the steps lost by each kill, the memory at the start and at the end, and whether the
networks at the end are, to the bit, those of training without a kill.
"""

import argparse
import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_gac import GAC, CheckpointError, ExactCheckpointCallback, preset
from sb3_gac.training.provenance import provenance

ENVS = 2
MEGABYTE = 1 << 20
FOREVER = 10**8


class ProgressCallback(BaseCallback):
    """
    Adds a line to a file at the start and every few calls: the event, environment steps so far, and memory in MB.

    :param path: file to append to
    :param every: calls between two lines
    """

    def __init__(self, path: Path, every: int = 50):
        super().__init__()
        self._path, self._every = path, every

    def _on_training_start(self) -> None:
        self._write("start")

    def _on_step(self) -> bool:
        if self.n_calls % self._every == 0:
            self._write("step")
        return True

    def _write(self, event: str) -> None:
        memory = psutil.Process().memory_info().rss / MEGABYTE
        with self._path.open("a", encoding="utf-8") as file:
            file.write(f"{event},{self.num_timesteps},{memory:.1f}\n")


def work(directory: Path, steps: int, interval: int, seed: int) -> None:
    """
    Train, or go on with training from the last checkpoint.

    :param directory: directory of the run; its "end.json" has the steps and the networks at the end of the last process that
        was not ended by SIGKILL
    :param steps: environment steps of the whole run, over all of its processes
    :param interval: environment steps between two checkpoints
    :param seed: seed of everything random
    """
    th.set_num_threads(1)
    env = make_vec_env("sb3_gac/HalfCheetah-v5", ENVS, seed=seed, env_kwargs={"noise_std": 0.1})
    callbacks = [
        ExactCheckpointCallback(directory / "checkpoints", interval),
        ProgressCallback(directory / "progress.csv"),
    ]
    try:
        model = GAC.resume(directory / "checkpoints", env, device="cpu")
        left = model.steps_left
    except CheckpointError:
        arguments = {**preset("small"), "buffer_size": 20_000, "learning_starts": 500, "seed": seed, "device": "cpu"}
        model, left = GAC("MultiInputPolicy", env, **arguments), steps
    try:
        model.learn(left, reset_num_timesteps=False, callback=callbacks)
    finally:
        parameters = [value.double().sum().item().hex() for value in model.get_parameters()["policy"].values()]
        (directory / "end.json").write_text(
            json.dumps({"steps": model.num_timesteps, "parameters": parameters}), encoding="utf-8"
        )


def disturb(
    directory: Path, arguments: list[str], until: float, least: int, pause: tuple[float, float], seed: int
) -> list[str]:
    """
    Run a worker, and kill and restart it until a given time.

    :param directory: directory of the run
    :param arguments: command-line arguments of the worker
    :param until: time from which on a kill is the last one, in seconds since the epoch; the last kill is by SIGTERM
    :param least: least number of kills, however long they take
    :param pause: shortest and longest time between a start and its kill, in seconds of training
    :param seed: seed of the moments and the signals
    :return: names of the signals that ended the workers
    :raises RuntimeError: if a worker ends by itself
    """
    generator = random.Random(seed)
    kills: list[str] = []
    while True:
        before = _starts(directory)
        with subprocess.Popen(_command(directory, arguments)) as worker:
            while _starts(directory) == before and worker.poll() is None:
                time.sleep(0.05)
            last = time.time() >= until and len(kills) + 1 >= least
            time.sleep(generator.uniform(*pause))
            number = signal.SIGTERM if last else generator.choice([signal.SIGKILL, signal.SIGTERM])
            if worker.poll() is not None:
                raise RuntimeError(f"The worker ended with status {worker.returncode} by itself.")
            worker.send_signal(number)
        kills.append(number.name)
        if last:
            return kills


def _command(directory: Path, arguments: list[str]) -> list[str]:
    return [sys.executable, "-W", "ignore", "-m", "benchmarks.soak", str(directory), *arguments, "--work"]


def _starts(directory: Path) -> int:
    path = directory / "progress.csv"
    return path.read_text(encoding="utf-8").count("start") if path.exists() else 0


def losses(lines: list[str]) -> list[int]:
    """
    :param lines: lines of "progress.csv": event, steps, memory
    :return: number of environment steps that were lost and made again, one for each start but the first
    """
    lost, furthest = [], 0
    for line in lines:
        event, steps, _ = line.split(",")
        if event == "start" and furthest:
            lost.append(max(furthest - int(steps), 0))
        furthest = int(steps)
    return lost


def main() -> None:
    """Entry point of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--minutes", type=float, default=60, help="during which it is disturbed")
    parser.add_argument("--kills", type=int, default=1, help="at least, however long they take")
    parser.add_argument("--steps", type=int, default=FOREVER, help=argparse.SUPPRESS)
    parser.add_argument("--interval", type=int, default=2_000, help="steps between two checkpoints")
    parser.add_argument("--pause", type=float, nargs=2, default=(5, 60), help="seconds of training between two kills")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="JSON file of the report")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.directory.mkdir(parents=True, exist_ok=True)
    if options.work:
        work(options.directory, options.steps, options.interval, options.seed)
        return
    report = soak(options)
    print(json.dumps(report, indent=1))
    if options.out:
        options.out.write_text(json.dumps(report, indent=1), encoding="utf-8")


def soak(options: argparse.Namespace) -> dict[str, Any]:
    """
    Disturb one run, make the same run undisturbed, and compare the two.

    :param options: options of the command line
    :return: content of the report
    """
    started = time.time()
    disturbed, undisturbed = options.directory / "disturbed", options.directory / "undisturbed"
    for directory in (disturbed, undisturbed):
        directory.mkdir()
    common = [f"--interval={options.interval}", f"--seed={options.seed}"]
    until = started + 60 * options.minutes
    kills = disturb(disturbed, [*common, f"--steps={FOREVER}"], until, options.kills, tuple(options.pause), options.seed)
    minutes = (time.time() - started) / 60
    asked = [f"--minutes {options.minutes:g}", f"--kills {options.kills}", *common]
    end = json.loads((disturbed / "end.json").read_text(encoding="utf-8"))
    subprocess.run(_command(undisturbed, [*common, f"--steps={end['steps']}"]), check=True)
    lines = (disturbed / "progress.csv").read_text(encoding="utf-8").splitlines()
    memory = [float(line.split(",")[2]) for line in lines if line.startswith("step")]
    lost = losses(lines)
    return {
        "command": f"python -m benchmarks.soak {options.directory.name} {' '.join(asked)}",
        **provenance(),
        "minutes": round(minutes, 1),
        "kills": {number: kills.count(number) for number in ("SIGKILL", "SIGTERM")},
        "steps": end["steps"],
        "checkpoint_interval": options.interval,
        "steps_lost": {"largest": max(lost, default=0), "all": lost},
        "memory_mb": {"first": memory[0], "last": memory[-1], "largest": max(memory)},
        "same_as_undisturbed": end == json.loads((undisturbed / "end.json").read_text(encoding="utf-8")),
    }


if __name__ == "__main__":
    main()
