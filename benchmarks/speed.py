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
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch as th

from benchmarks.checkpoint import write_atomically
from benchmarks.models import BASELINES, SIZES
from benchmarks.part_speed import compare_buffers, compare_checkpoints, compare_deployment, compare_wrappers
from benchmarks.pixels import tabulate_image_steps, tabulate_pixels
from benchmarks.profiles import profile_rollout, profile_step
from benchmarks.step_speed import ROUNDS, compare_baselines, tabulate_growth, tabulate_recurrent, tabulate_steps
from benchmarks.tidy import file_of
from sb3_gac.training.provenance import provenance

#: Numbers of environments in the table of rollouts
ENVS = (1, 8, 128)


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
        before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        write_atomically(path, json.dumps(with_table(before, name, rows, made_with), indent=1))
        print(f"\n{name}\n\n{markdown(rows)}", flush=True)


if __name__ == "__main__":
    main()
