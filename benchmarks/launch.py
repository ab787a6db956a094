"""
A suite -> its runs, several side by side with one thread each::

    python -m benchmarks.launch benchmarks/suites/halfcheetah.yml --jobs 2

Finished runs are skipped and unfinished ones go on from their checkpoints, so an interrupted launch is resumed by the same
command; runs whose directories are elsewhere, or gone, count as finished if ``--earlier`` results have them.  A failed run is
tried again.  ``--dry-run`` prints the commands of what is left to do.  ``--engine ray`` runs on a Ray cluster whose nodes
share this checkout, its Python and the runs' directory.
"""

import argparse
import json
import os
import shlex
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.table import Table
from rich.text import Text

from benchmarks.config import check_runs
from benchmarks.engines import Engine, LocalEngine, RayEngine
from benchmarks.finished import add_earlier_options, name_of, read_earlier
from benchmarks.suite import RUNS, RunSpec, read_suite

COLUMNS = ("task", "noise", "algorithm", "seed", "state", "steps", "return")
STATES = ("waiting", "running", "finished", "failed")
_FRAME = 6  # lines that are no runs: borders, names of columns, how many there are, and one of the terminal's own


@dataclass
class Job:
    """
    A run that is left to do.

    :param spec: of the run
    :param directory: of the run
    :param command: to run it
    :param state: one of ``STATES``
    """

    spec: RunSpec
    directory: Path
    command: list[str]
    state: str = "waiting"

    @property
    def log(self) -> Path:
        """Where the run's output goes, that of all attempts."""
        return self.directory / "log.txt"


def jobs_left(suite: Path, runs: Path, earlier: Sequence[Path] = (), renewed: Sequence[str] = ()) -> tuple[list[Job], int]:
    """
    :param suite: YAML file
    :param runs: directory of all runs
    :param earlier: results, without a suffix, whose runs are finished too
    :param renewed: algorithms of which they are not
    :return: the runs that are not finished, and how many are
    :raises ValueError: naming what is wrong with the suite
    """
    specs = read_suite(suite)
    check_runs(suite.name, specs)
    made = read_earlier(earlier, specs, renewed)
    left = [(index, spec) for index, spec in enumerate(specs) if not spec.is_finished(runs) and name_of(spec) not in made]
    jobs = [Job(spec, spec.directory(runs), run_command(suite, index, runs)) for index, spec in left]
    return jobs, len(specs) - len(left)


def run_command(suite: Path, index: int, runs: Path) -> list[str]:
    """The exact command of one run."""
    return [sys.executable, "-m", "benchmarks.run", "--suite", str(suite), "--index", str(index), "--runs", str(runs)]


def launch_one(job: Job, retries: int, engine: Engine, tell: Callable[[Job], None]) -> None:
    """
    :param job: to run in a process of its own with one thread; its state says how it ended
    :param retries: further attempts after one that failed
    :param engine: where
    :param tell: called when the state has changed
    """
    job.directory.mkdir(parents=True, exist_ok=True)
    job.state = "running"
    tell(job)
    done = any(engine.run(job.command, job.log) == 0 for _ in range(retries + 1))
    job.state = "finished" if done else "failed"
    tell(job)


def progress(job: Job) -> tuple[str, str]:
    """
    :param job: in any state
    :return: steps of its last evaluation and the learner's return there, as far as there was one
    """
    try:
        last = json.loads((job.directory / "timing.json").read_text())
        return f"{last['steps']} / {job.spec.steps}", f"{last['learner']:.1f}"
    except (OSError, ValueError, KeyError):
        return (f"0 / {job.spec.steps}", "") if job.state == "running" else ("", "")


def count(jobs: Sequence[Job]) -> str:
    """
    :param jobs: of this launch
    :return: how many are in each state
    """
    states = Counter(job.state for job in jobs)
    return ", ".join(f"{states[state]} {state}" for state in reversed(STATES) if states[state] or state != "failed")


class Overview:
    """
    A table as high as the terminal allows, made anew from the jobs' states whenever it is drawn: all those that run, as many
    of those that failed as there is room for, then of those that finished last. Below it, how many there are of each.

    :param jobs: of this launch
    """

    def __init__(self, jobs: Sequence[Job]):
        self._jobs = jobs

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Called by rich."""
        shown = self.shown(max((options.height or console.height) - _FRAME, 1))
        result = Table(*COLUMNS)
        for column in result.columns:
            column.no_wrap = True
        for job in shown:
            spec = job.spec
            result.add_row(spec.task, f"{spec.noise:g}", spec.algorithm, str(spec.seed), job.state, *progress(job))
        yield result
        hidden = sum(job.state != "waiting" for job in self._jobs) - len(shown)
        yield Text(count(self._jobs) + (f"; {hidden} of them not shown" if hidden else ""), no_wrap=True, overflow="ellipsis")

    def shown(self, rows: int) -> list[Job]:
        """
        :param rows: that there are
        :return: the jobs in them, the most important ones last
        """
        jobs = [job for state in ("finished", "failed", "running") for job in self._jobs if job.state == state]
        return jobs[-rows:]


def table(jobs: Sequence[Job]) -> Overview:
    """
    :param jobs: of this launch
    :return: for a terminal
    """
    return Overview(jobs)


def print_line(jobs: Sequence[Job], job: Job) -> None:
    """
    For a log, where a table can't be drawn anew.

    :param jobs: of this launch
    :param job: one of them, whose state has changed
    """
    steps, value = progress(job) if job.state != "running" else ("", "")
    reached = f", {steps} steps, return {value}" if steps else ""
    print(f"{name_of(job.spec)}: {job.state}{reached} ({count(jobs)})", flush=True)


def launch(jobs: list[Job], at_once: int, retries: int, engine: Engine) -> None:
    """
    Ctrl-C ends all runs at once, which then have their checkpoints, and with them this process.

    :param jobs: to run
    :param at_once: how many side by side
    :param retries: further attempts after one that failed
    :param engine: where
    """
    console = Console()
    tell = (lambda job: None) if console.is_terminal else partial(print_line, jobs)
    with ThreadPoolExecutor(at_once) as pool:
        futures = [pool.submit(launch_one, job, retries, engine, tell) for job in jobs]
        try:
            with Live(table(jobs), console=console, refresh_per_second=1) if console.is_terminal else nullcontext():
                for future in futures:
                    future.result()
        except KeyboardInterrupt:
            print("Stopped. The same command goes on from the runs' checkpoints.", flush=True)
            os._exit(130)  # a pool would first start and wait for all that is left


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", type=Path)
    parser.add_argument("--engine", choices=["local", "ray"], default="local")
    parser.add_argument("--address", default="auto", help="of the Ray cluster")
    parser.add_argument("--jobs", type=int, help="runs side by side; default: one on each CPU")
    parser.add_argument("--retries", type=int, default=1, help="further attempts after a run that failed")
    parser.add_argument("--runs", type=Path, default=RUNS)
    add_earlier_options(parser)
    parser.add_argument("--dry-run", action="store_true", help="print the commands of what is left to do")
    options = parser.parse_args()
    try:
        jobs, finished = jobs_left(options.suite.resolve(), options.runs.resolve(), options.earlier, options.renewed)
    except ValueError as error:
        sys.exit(str(error))
    if options.dry_run:
        print("\n".join(shlex.join(job.command) for job in jobs))
        return
    engine = LocalEngine() if options.engine == "local" else RayEngine(options.address)
    launch(jobs, options.jobs or engine.cpus, options.retries, engine)
    failed = [job for job in jobs if job.state == "failed"]
    for job in failed:
        print(f"{job.directory}: FAILED, see {job.log}")
    print(f"{finished} were finished before, {len(jobs) - len(failed)} now, {len(failed)} failed.")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
