"""
Which memory learns a long delay, and in how many gradient steps::

    python -m benchmarks.delay --jobs 2 --out benchmarks/results/delay

The task is POPGym's RepeatPrevious without rewards: each step shows one of four symbols at random, and the label is the symbol
of ``delay`` steps ago. So no exploration and no critic has a part in the result. The memory lies between layers of 64 units,
as in the preset ``learner-memory``, and learns with Adam from batches of 16 new sequences. A trial ends when 95% of the
answers are right in each of 20 batches in a row, or after ``--steps`` gradient steps. Trials in the file of ``--out`` stay.
"""

import argparse
import itertools
import json
import multiprocessing
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch import nn

from benchmarks.checkpoint import write_atomically
from benchmarks.tidy import file_of
from sb3_gac.networks.recurrent import RecurrentCore
from sb3_gac.training.provenance import provenance

UNITS, SYMBOLS, BATCH, ANSWERS = 64, 4, 16, 72
GOAL, BATCHES_IN_A_ROW = 0.95, 20


@th.no_grad()
def orthogonal_(core: RecurrentCore, delay: int) -> None:
    """
    Make the matrices from state to state orthogonal, gate by gate.

    :param core: GRU or LSTM
    :param delay: not used
    """
    cell: Any = core.cells[0]
    for matrix in cell.weight_hh_l0.split(UNITS):
        nn.init.orthogonal_(matrix)


@th.no_grad()
def chrono_(core: RecurrentCore, delay: int) -> None:
    """
    Set the biases of the gates so that units forget over 1 to 2 ``delay`` steps (Tallec and Ollivier 2018, arXiv 1804.11188).

    :param core: GRU or LSTM
    :param delay: number of steps
    """
    cell: Any = core.cells[0]
    kept = th.empty(UNITS).uniform_(1, 2 * delay - 1).log()
    cell.bias_hh_l0.zero_()
    cell.bias_ih_l0.zero_()
    cell.bias_ih_l0[UNITS : 2 * UNITS] = kept  # what a GRU's update gate and an LSTM's forget gate keep
    if core.state_size == 2 * UNITS:  # an LSTM has an input gate besides
        cell.bias_ih_l0[:UNITS] = -kept


class Contender(NamedTuple):
    """
    A memory and the way it learns.

    :param cell: kind of recurrent layer
    :param prepare: function that changes its initial parameters, of the memory and the delay
    :param learning_rate: learning rate
    :param memory_scale: multiple of the learning rate for the memory
    """

    cell: str
    prepare: Callable[[RecurrentCore, int], None] | None = None
    learning_rate: float = 3e-3
    memory_scale: float = 1.0


CONTENDERS = {
    "lru": Contender("lru"),
    "gru": Contender("gru"),
    "gru, orthogonal": Contender("gru", orthogonal_),
    "gru, chrono": Contender("gru", chrono_),
    "gru, 1e-5 beside 3e-4": Contender("gru", None, 3e-4, 1 / 30),
    "lstm": Contender("lstm"),
    "lstm, chrono": Contender("lstm", chrono_),
}


class Trial(NamedTuple):
    """
    One training of one contender.

    :param contender: key of ``CONTENDERS``
    :param delay: number of steps from a symbol to the answer
    :param seed: seed of parameters and sequences
    :param steps: gradient steps at most
    """

    contender: str
    delay: int
    seed: int
    steps: int


def run(trial: Trial) -> dict[str, Any]:
    """
    :param trial: trial to make
    :return: the trial's fields, ``needed``, the gradient steps to the goal (``None`` if not reached), ``accuracy`` of the last
        batches, and processor ``seconds``
    """
    th.manual_seed(trial.seed)
    contender = CONTENDERS[trial.contender]
    core = RecurrentCore(contender.cell, SYMBOLS, [UNITS], UNITS)
    if contender.prepare is not None:
        contender.prepare(core, trial.delay)
    head = nn.Sequential(nn.Linear(UNITS, UNITS), nn.SiLU(), nn.Linear(UNITS, SYMBOLS))
    memory: dict[str, Any] = {"params": core.cells.parameters(), "lr": contender.learning_rate * contender.memory_scale}
    others = {"params": [*core.hidden.parameters(), *head.parameters()], "lr": contender.learning_rate}
    optimizer = th.optim.Adam([memory, others])
    right: list[float] = []
    start = time.process_time()
    while len(right) < trial.steps and not _reached(right):
        symbols = th.randint(SYMBOLS, (trial.delay + ANSWERS, BATCH))
        logits = head(core(nn.functional.one_hot(symbols, SYMBOLS).float())[0][0, trial.delay :])
        loss = nn.functional.cross_entropy(logits.flatten(0, 1), symbols[: -trial.delay].flatten())
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_([*core.parameters(), *head.parameters()], 1.0)
        optimizer.step()
        right.append((logits.argmax(dim=-1) == symbols[: -trial.delay]).float().mean().item())
    return {
        **trial._asdict(),
        "needed": len(right) if _reached(right) else None,
        "accuracy": round(float(np.mean(right[-BATCHES_IN_A_ROW:])), 3),
        "seconds": round(time.process_time() - start, 1),
    }


def _reached(right: list[float]) -> bool:
    return len(right) >= BATCHES_IN_A_ROW and min(right[-BATCHES_IN_A_ROW:]) >= GOAL


def _run_all(trials: list[Trial], jobs: int) -> Iterator[dict[str, Any]]:
    if trials:
        with multiprocessing.get_context("spawn").Pool(jobs, th.set_num_threads, (1,)) as pool:
            yield from pool.imap_unordered(run, trials)


def table(rows: list[dict[str, Any]]) -> str:
    """
    :param rows: results of trials
    :return: Markdown table of contenders and delays: gradient steps to the goal, or the share of right answers at the end
    """
    delays = sorted({row["delay"] for row in rows})
    lines = ["| memory | " + " | ".join(f"delay {delay}" for delay in delays) + " | ms per step |"]
    lines.append("|---" * (len(delays) + 2) + "|")
    for name in CONTENDERS:
        mine = sorted((row for row in rows if row["contender"] == name), key=lambda row: row["seed"])
        if not mine:
            continue
        cells = [", ".join(_cell(row) for row in mine if row["delay"] == delay) for delay in delays]
        made = sum(row["needed"] or row["steps"] for row in mine)
        cells.append(f"{1000 * sum(row['seconds'] for row in mine) / made:.0f}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(row: dict[str, Any]) -> str:
    return str(row["needed"]) if row["needed"] is not None else f"({row['accuracy']:.2f})"


def main() -> None:
    """Entry point of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--delays", type=int, nargs="+", default=[4, 32])
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds")
    parser.add_argument("--steps", type=int, default=1500, help="gradient steps of a trial at most")
    parser.add_argument("--jobs", type=int, default=1, help="trials side by side")
    parser.add_argument("--out", required=True, help="path of the results, without a suffix")
    args = parser.parse_args()
    path = file_of(Path(args.out), "json")
    saved = json.loads(path.read_text(encoding="utf-8"))["trials"] if path.exists() else []
    known = {Trial(*(row[key] for key in Trial._fields)): row for row in saved}
    wanted = [Trial(*key) for key in itertools.product(CONTENDERS, args.delays, range(args.seeds), [args.steps])]
    rows = [known[trial] for trial in wanted if trial in known]
    others = [row for trial, row in known.items() if trial not in wanted]
    for row in _run_all([trial for trial in wanted if trial not in known], args.jobs):
        rows.append(row)
        print(row, flush=True)
        command = shlex.join(["python", "-m", "benchmarks.delay", *sys.argv[1:]])
        record = {"command": command, **provenance(), "trials": [*others, *rows]}
        write_atomically(path, json.dumps(record, indent=2) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
