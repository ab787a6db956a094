"""
One training run -> one directory::

    python -m benchmarks.run --suite benchmarks/suites/foundation.yml --index 0 --runs benchmarks/runs

A finished run is skipped.  An unfinished one starts afresh: its directory holds ``evaluations.csv`` only when done.
"""

import argparse
import csv
import dataclasses
import json
import os
import platform
import subprocess
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch as th
import yaml
from stable_baselines3.common.env_util import make_vec_env

import sb3_gac
from benchmarks.suite import HERE, RunSpec, read_algorithm, read_suite

EVAL_SEED = 10_000


def provenance() -> dict[str, Any]:
    """Commit, versions and machine."""
    git = ["git", "-C", str(HERE)]
    commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    changed = subprocess.run([*git, "status", "--porcelain", "sb3_gac"], capture_output=True, text=True, check=False).stdout
    packages = ("sb3_gac", "stable-baselines3", "torch", "numpy", "gymnasium", "mujoco")
    return {
        "commit": commit + ("+changes" if changed.strip() else ""),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in packages}},
        "cpus": os.cpu_count(),
        "threads": th.get_num_threads(),
    }


def build_arguments(spec: RunSpec) -> tuple[type[Any], dict[str, Any]]:
    """
    :param spec: of the run
    :return: class, and arguments: preset, then suite, then algorithm
    """
    algorithm = read_algorithm(spec.algorithm)
    algorithm_class = getattr(sb3_gac, algorithm.pop("class"))
    buffer_size = min(1_000_000, max(spec.steps, 1_000))
    arguments = {"buffer_size": buffer_size, **spec.overrides, **algorithm, "seed": spec.seed, "device": "cpu"}
    return algorithm_class, sb3_gac.preset(spec.preset, **arguments)


def run(spec: RunSpec, root: Path) -> Path:
    """
    :param spec: of the run
    :param root: directory of all runs
    :return: the run's directory
    """
    directory = spec.directory(root)
    if (directory / "evaluations.csv").exists():
        return directory
    directory.mkdir(parents=True, exist_ok=True)
    algorithm_class, arguments = build_arguments(spec)
    resolved = {
        key: value if isinstance(value, (int, float, str, type(None))) else str(value) for key, value in arguments.items()
    }
    configuration = {"run": dataclasses.asdict(spec), "arguments": resolved, **provenance()}
    (directory / "config.yaml").write_text(yaml.safe_dump(configuration, sort_keys=False))

    env_id, env_kwargs = f"sb3_gac/{spec.task}-v5", {"noise_std": spec.noise}
    env = make_vec_env(env_id, spec.envs, seed=spec.seed, env_kwargs=env_kwargs)
    eval_env = make_vec_env(env_id, spec.eval_episodes, env_kwargs=env_kwargs)
    has_guider = hasattr(algorithm_class, "predict_guider")
    callback = (sb3_gac.GuiderLearnerEvalCallback if has_guider else sb3_gac.SeededEvalCallback)(
        eval_env,
        eval_seed=EVAL_SEED,
        eval_freq=spec.eval_every // spec.envs,
        n_eval_episodes=spec.eval_episodes,
        verbose=0,
    )
    started = time.time()
    model = algorithm_class("MultiInputPolicy", env, **arguments)
    model.learn(spec.steps, callback=callback)
    model.save(directory / "model")
    (directory / "timing.json").write_text(json.dumps({"seconds": time.time() - started}))
    write_evaluations(callback.history, directory / "evaluations.csv")
    return directory


def write_evaluations(history: list[dict[str, float]], path: Path) -> None:
    """
    Written last and in one move: the file exists if and only if the run is finished.

    :param history: one row per evaluation
    :param path: CSV file
    """
    partial_path = path.with_suffix(".tmp")
    with partial_path.open("w", newline="") as file:
        writer = csv.DictWriter(file, history[-1].keys(), restval="nan")
        writer.writeheader()
        writer.writerows(history)
    partial_path.replace(path)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", type=Path, required=True)
    parser.add_argument("--index", type=int, required=True, help="which run of the suite, see launch --dry-run")
    parser.add_argument("--runs", type=Path, default=HERE / "runs")
    options = parser.parse_args()
    print(run(read_suite(options.suite)[options.index], options.runs))


if __name__ == "__main__":
    main()
