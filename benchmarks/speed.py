"""
Measures gradient steps, replay buffers and other costs, beside those of SB3's SAC in the same run::

    python -m benchmarks.speed --out benchmarks/results/speed [--threads 1 2] [--tables steps growth] [--quick]

The contenders alternate in blocks, each in a process of its own; a ratio is the median of the blocks' ratios.  The limit of a
gradient step is the rate of its matrix products alone, each as fast as a plain product that is timed in the same run.
Gradient steps and buffers have the sizes of the tasks' spaces and random data; the rollout is one of HalfCheetah itself.
Tables that the file of results has already stay, unless they are measured again.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer

import sb3_gac
from benchmarks.checkpoint import write_atomically
from benchmarks.contenders import alternate, process_timers, timer
from benchmarks.models import (
    BASELINES,
    CONTENDERS,
    SIZES,
    SpacesOnly,
    make_baseline_step,
    make_model,
    make_recurrent_step,
    make_step,
    matmul_rate,
    recurrent_step_flops,
    step_flops,
)
from benchmarks.pixels import tabulate_image_steps, tabulate_pixels
from benchmarks.profiles import env_step, profile_rollout, profile_step
from benchmarks.tidy import file_of
from sb3_gac.training.provenance import provenance

GROWTH_CONTENDERS = ("sac", "gac", "gac-compiled")
BLOCK, ROUNDS = 10, 9
ENVS = (1, 8, 128)
GROWTH = [  # batch, width, size of the privileged entry
    *((batch, 256, 17) for batch in (64, 1024, 4096)),
    *((256, width, 17) for width in (64, 512, 1024)),
    *((256, 256, privileged) for privileged in (9, 376, 1508)),
]


def compare_steps(
    names: Iterable[str], sizes: tuple[int, int, int], batch: int, width: int, threads: int, rounds: int
) -> dict[str, float]:
    """
    :param names: contenders, keys of ``CONTENDERS``, with "sac" among them
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param batch: batch size
    :param width: units of each of the two hidden layers
    :param threads: number of torch's threads
    :param rounds: number of blocks of each contender
    :return: gradient steps per second of SB3's SAC; the rate of each other contender as a multiple of SAC's, "_over_sac"; and
        the rates of GAC's contenders as shares of the limit, "_share_of_limit"
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


def compare_baselines(
    names: Iterable[str], sizes: tuple[int, int, int], batch: int, width: int, rounds: int
) -> list[dict[str, Any]]:
    """
    Measure gradient steps with one thread, in processor time.

    :param names: algorithms, keys of ``BASELINES``, with "sac" among them
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param batch: batch size
    :param width: units of each of the two hidden layers
    :param rounds: number of blocks of each contender
    :return: one row for each algorithm, compiled and not: milliseconds of a gradient step, and its rate as a multiple of the
        rate of SB3's SAC
    """
    arguments = {(name, compiled): (name, sizes, batch, width, compiled) for name in names for compiled in (False, True)}
    del arguments["sac", True]
    by_key = {f"{name}, {compiled}": values for (name, compiled), values in arguments.items()}
    with process_timers(make_baseline_step, by_key, 1, time.process_time) as timers:
        seconds = alternate(timers, BLOCK, rounds)
    sac = seconds["sac, False"]
    return [
        {
            "algorithm": name,
            "compiled": compiled,
            "milliseconds": round(1e3 * float(np.median(own := seconds[f"{name}, {compiled}"])), 2),
            "over_sac": round(median_ratio(sac, own), 2),
        }
        for name, compiled in arguments
    ]


def median_ratio(numerators: list[float], denominators: list[float]) -> float:
    """
    :param numerators: seconds of one contender, one number for each block
    :param denominators: seconds of another contender in the same blocks
    :return: median over the blocks of the ratio of the two
    """
    return float(np.median(np.array(numerators) / np.array(denominators)))


def compare_recurrent(batch: int, width: int, threads: int, rounds: int) -> dict[str, float]:
    """
    Measure gradient steps of GAC with GRUs, on the sizes of RepeatPreviousEasy.

    :param batch: episodes in a batch
    :param width: units of every layer
    :param threads: number of torch's threads
    :param rounds: number of blocks of each contender
    :return: gradient steps per second, their rate as a multiple of the rate with a Python loop over time, their rate as a
        share of the limit, and the share of their time that sampling takes
    """
    arguments = {name: (name, (8, 5, 4), 51, batch, width) for name in ("ours", "looped", "sampling")}
    with process_timers(make_recurrent_step, arguments, threads) as timers:
        seconds = alternate(timers, repetitions=2, rounds=rounds)
    th.set_num_threads(threads)
    limit = matmul_rate(batch * 52, width) / recurrent_step_flops((8, 5, 4), 51, batch, width)
    return {
        "ours_per_second": round(1 / float(np.median(seconds["ours"])), 2),
        "ours_over_looped": round(median_ratio(seconds["looped"], seconds["ours"]), 2),
        "share_of_limit": round(1 / float(np.median(seconds["ours"])) / limit, 3),
        "sampling_share": round(median_ratio(seconds["sampling"], seconds["ours"]), 3),
    }


def compare_buffers(sizes: tuple[int, int, int], batch: int = 256, capacity: int = 20_000) -> dict[str, float]:
    """
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param batch: transitions in a sample
    :param capacity: capacity of both replay buffers, in transitions
    :return: bytes and sampling time of the compact replay buffer as multiples of those of SB3's, and its sampling time in
        microseconds
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
    :param rounds: number of blocks of each environment
    :return: microseconds of a step of gymnasium's HalfCheetah and of ours with sensor noise, and the time that ours adds as a
        share of gymnasium's
    """
    envs = {"gymnasium": gym.make("HalfCheetah-v5"), "ours": gym.make("sb3_gac/HalfCheetah-v5", noise_std=0.1)}
    seconds = alternate({name: timer(env_step(env)) for name, env in envs.items()}, repetitions=1_000, rounds=rounds)
    return {
        **{f"{name}_microseconds": round(1e6 * float(np.median(values)), 1) for name, values in seconds.items()},
        "added_share": round(median_ratio(seconds["ours"], seconds["gymnasium"]) - 1, 3),
    }


def compare_deployment(sizes: tuple[int, int, int], width: int, rounds: int) -> dict[str, float]:
    """
    Measure how long a policy takes for one action, with one thread, in processor time.

    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param width: units of each of the two hidden layers
    :param rounds: number of blocks of each contender
    :return: microseconds of one action from one observation by ``predict`` of SB3's SAC, by that of GAC, and by the
        exported learner; the ratio of the first to the last; and milliseconds to load the exported file
    """
    th.set_num_threads(1)
    gac, sac = (make_model(name, sizes, 256, width) for name in ("gac", "sac"))
    observation = {key: box.sample() for key, box in SpacesOnly(*sizes).observation_space.items()}  # type: ignore[attr-defined]
    with tempfile.TemporaryDirectory() as directory:
        path = sb3_gac.export_learner(gac, Path(directory) / "learner.onnx")
        learner = sb3_gac.OnnxPolicy.load(path)
        load = timer(lambda: sb3_gac.OnnxPolicy.load(path), time.process_time)
        loads = alternate({"load": load}, repetitions=10, rounds=rounds)["load"]
    partial = observation["partial"]
    timers = {
        "sac_predict": timer(lambda: sac.predict(observation, deterministic=True), time.process_time),
        "gac_predict": timer(lambda: gac.predict({"partial": partial}, deterministic=True), time.process_time),
        "exported": timer(lambda: learner.act(partial), time.process_time),
    }
    seconds = alternate(timers, repetitions=200, rounds=rounds)
    return {
        **{f"{name}_microseconds": round(1e6 * float(np.median(values)), 1) for name, values in seconds.items()},
        "exported_times_faster_than_sac": round(median_ratio(seconds["sac_predict"], seconds["exported"]), 1),
        "load_milliseconds": round(1e3 * float(np.median(loads)), 2),
    }


def compare_checkpoints(sizes: tuple[int, int, int], width: int, capacity: int, more: int) -> dict[str, float]:
    """
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param width: units of each of the two hidden layers
    :param capacity: capacity of the replay buffer in transitions; it is full at the first checkpoint
    :param more: number of transitions between the first checkpoint and the next one
    :return: seconds and megabytes of a first checkpoint, of the next one, and of SB3's ``save`` and ``save_replay_buffer``
    """
    gac, sac = (make_model(name, sizes, 256, width, buffer_size=capacity) for name in ("gac", "sac"))
    for model in (gac, sac):
        _fill(model.replay_buffer, capacity)
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        figures = {"first": _writing(lambda: gac.save_checkpoint(root / "ours"), root)}
        _fill(gac.replay_buffer, more)
        figures["next"] = _writing(lambda: gac.save_checkpoint(root / "ours"), root)
        sb3 = _writing(lambda: (sac.save(root / "model"), sac.save_replay_buffer(root / "buffer")), root)
    return {
        f"{name}_{unit}": round(value, 2)
        for name, (seconds, megabytes) in {**figures, "sb3": sb3}.items()
        for unit, value in (("seconds", seconds), ("megabytes", megabytes))
    }


def _fill(buffer: Any, steps: int) -> None:
    """Add transitions of one environment to a replay buffer, in episodes of 1,000 steps."""
    obs = {key: box.sample()[None] for key, box in buffer.observation_space.items()}
    action = buffer.action_space.sample()[None]
    for step in range(steps):
        following = {key: value + 1e-3 for key, value in obs.items()}
        buffer.add(obs, following, action, np.zeros(1), np.array([step % 1_000 == 999]), [{}])
        obs = following


def _writing(write: Callable[[], Any], directory: Path) -> tuple[float, float]:
    """
    :param write: function that writes files
    :param directory: directory in which it writes them
    :return: seconds of ``write``, and megabytes of the files that it wrote
    """
    before = {path: path.stat().st_ino for path in directory.rglob("*")}
    start = time.perf_counter()
    write()
    seconds = time.perf_counter() - start
    written = [path for path in directory.rglob("*") if path.is_file() and before.get(path) != path.stat().st_ino]
    return seconds, sum(path.stat().st_size for path in written) / 1e6


def tabulate_steps(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """
    Tabulate gradient steps: those of HalfCheetah's sizes with one thread, those of all sizes with more.

    :param threads: numbers of torch's threads
    :param quick: whether to measure one size, in few rounds
    :return: one row for each setting
    """
    rows = []
    for count in threads:
        several = count > 1 and not quick
        for task in SIZES if several else ("HalfCheetah",):
            for batch in (256, 512) if several else (256,):
                row = {"task": task, "threads": count, "batch": batch, "width": 256}
                rows.append(row | compare_steps(CONTENDERS, SIZES[task], batch, 256, count, 3 if quick else ROUNDS))
    return rows


def tabulate_growth(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """
    Tabulate gradient steps by batch size, width and size of the entry ``privileged``.

    :param threads: numbers of torch's threads, of which the last is used
    :param quick: whether to measure one setting alone
    :return: one row for each setting
    """
    rows = []
    for batch, width, privileged in GROWTH[:1] if quick else GROWTH:
        row = {"threads": threads[-1], "batch": batch, "width": width, "privileged": privileged}
        rows.append(row | compare_steps(GROWTH_CONTENDERS, (8, privileged, 6), batch, width, threads[-1], rounds=3))
    return rows


def tabulate_rollout(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """
    Tabulate how the time of training divides among its parts, by number of environments.

    :param threads: numbers of torch's threads, of which the last is used
    :param quick: whether to measure few steps
    :return: one row for each number of environments
    """
    th.set_num_threads(threads[-1])
    rows = []
    for n_envs in ENVS:
        vec_steps = max(4, (100 if quick else 1_000) // n_envs)
        rows.append({"envs": n_envs, "threads": threads[-1]} | profile_rollout(n_envs, vec_steps))
    return rows


def tabulate_recurrent(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """
    Tabulate gradient steps of GAC with GRUs on whole episodes.

    :param threads: numbers of torch's threads
    :param quick: whether to measure one small width, in few rounds
    :return: one row for each number of threads and width
    """
    widths = (16,) if quick else (64, 256)
    rows = [(count, width) for count in threads for width in widths]
    return [
        {"threads": count, "episodes": 16, "width": width} | compare_recurrent(16, width, count, 2 if quick else 5)
        for count, width in rows
    ]


TABLES: dict[str, Callable[[list[int], bool], list[dict[str, Any]]]] = {  # name -> function of threads and quick -> rows
    "wrappers": lambda threads, quick: [compare_wrappers(3 if quick else 10 * ROUNDS)],
    "steps": tabulate_steps,
    "baselines": lambda threads, quick: compare_baselines(BASELINES, SIZES["HalfCheetah"], 256, 256, 3 if quick else ROUNDS),
    "profile": lambda threads, quick: profile_step("gac-compiled", SIZES["HalfCheetah"], 256, 256, 20 if quick else 200),
    "growth": tabulate_growth,
    "recurrent": tabulate_recurrent,
    "rollout": tabulate_rollout,
    "deployment": lambda threads, quick: [
        {"width": width} | compare_deployment(SIZES["HalfCheetah"], width, 3 if quick else ROUNDS) for width in (128, 256)
    ],
    "checkpoints": lambda threads, quick: [
        {"task": task} | compare_checkpoints(sizes, 256, 10_000 if quick else 1_000_000, 2_000 if quick else 20_000)
        for task, sizes in SIZES.items()
    ],
    "pixels": tabulate_pixels,
    "image_steps": tabulate_image_steps,
    "buffers": lambda threads, quick: [{"task": task} | compare_buffers(sizes) for task, sizes in SIZES.items()],
}


def markdown(rows: list[dict[str, Any]]) -> str:
    """
    :param rows: at least one row, all with the same keys
    :return: Markdown table of the rows
    """
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    return "\n".join([*lines, *("| " + " | ".join(str(value) for value in row.values()) + " |" for row in rows)])


def with_table(
    record: Mapping[str, Any], name: str, rows: list[dict[str, Any]], made_with: Mapping[str, Any]
) -> dict[str, Any]:
    """
    :param record: content of the file of results, empty if there is none
    :param name: name of a table
    :param rows: rows of the table
    :param made_with: command, commit, versions and machine with which the table was made
    :return: content of the file with this table; all other tables stay, and "made_with" has the origin of each
    """
    tables = {key: value for key, value in record.items() if key not in (*made_with, "made_with")}
    of_all = {key: record[key] for key in made_with if key in record}  # files of earlier versions have one origin
    origins = {**{table: of_all for table in tables if of_all}, **record.get("made_with", {}), name: dict(made_with)}
    return {"made_with": origins, **tables, name: rows}


def main() -> None:
    """Entry point of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="path of the results, without a suffix")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--tables", choices=TABLES, nargs="+", default=list(TABLES))
    parser.add_argument("--quick", action="store_true", help="one size and few rounds")
    options = parser.parse_args()
    flags = f"--threads {' '.join(map(str, options.threads))} --tables {' '.join(options.tables)}"
    made_with = {"command": f"python -m benchmarks.speed {flags}{' --quick' if options.quick else ''}", **provenance()}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    path = file_of(options.out, "json")
    for name in options.tables:
        rows = TABLES[name](options.threads, options.quick)
        before = json.loads(path.read_text()) if path.exists() else {}
        write_atomically(path, json.dumps(with_table(before, name, rows, made_with), indent=1))
        print(f"\n{name}\n\n{markdown(rows)}", flush=True)


if __name__ == "__main__":
    main()
