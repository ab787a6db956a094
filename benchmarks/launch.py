"""
A suite -> its runs, several side by side with one thread each::

    python -m benchmarks.launch benchmarks/suites/halfcheetah.yml --jobs 2

Finished runs are skipped and unfinished ones go on from their checkpoints, so an interrupted launch is resumed by the same
command; runs whose directories are elsewhere, or gone, count as finished if ``--reuse-results`` have them.  A failed run is
tried again.  What a run needs another run's model for comes first, once for all that need it; where that fails, they are not
started.  ``--dry-run`` prints the commands of what is left to do.  ``--engine ray`` runs on a Ray cluster whose nodes
share this checkout, its Python and the runs' directory.
"""

import argparse
import json
import os
import shlex
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.table import Table
from rich.text import Text

from benchmarks.config import check_programs, check_runs
from benchmarks.engines import Engine, LocalEngine, RayEngine
from benchmarks.finished import add_reuse_options, name_of, read_reused
from benchmarks.run import file_for
from benchmarks.suite import RUNS, RunSpec, needed_runs, read_suite

COLUMNS = ("task", "noise", "algorithm", "seed", "state", "steps", "return")
STATES = ("waiting", "running", "finished", "not started", "failed")
_ENDED_BADLY = ("not started", "failed")
_FRAME = 6  # lines that are no runs: borders, names of columns, how many there are, and one of the terminal's own


@dataclass
class Job:
    """
    A run that is left to do.

    :param spec: of the run
    :param directory: of the run
    :param command: to run it
    :param state: one of ``STATES``
    :param needs: jobs that must be finished before
    """

    spec: RunSpec
    directory: Path
    command: list[str]
    state: str = "waiting"
    needs: list["Job"] = field(default_factory=list)

    @property
    def lacking(self) -> list["Job"]:
        """Those that it needs, and that will never be finished."""
        return [job for job in self.needs if job.state in _ENDED_BADLY]

    @property
    def is_ready(self) -> bool:
        """Whether nothing that it needs is still to come."""
        return all(job.state not in ("waiting", "running") for job in self.needs)

    @property
    def log(self) -> Path:
        """Where the run's output goes, that of all attempts."""
        return self.directory / "log.txt"


def jobs_left(suite: Path, runs: Path, reuse: Sequence[Path] = (), rerun: Sequence[str] = ()) -> tuple[list[Job], int]:
    """
    :param suite: YAML file
    :param runs: directory of all runs
    :param reuse: results, without a suffix, whose runs are finished too
    :param rerun: algorithms of which they are not
    :return: the runs that are not finished, those first that others need; and how many of the suite's are finished
    :raises ValueError: naming what is wrong with the suite
    """
    specs = read_suite(suite)
    check_runs(suite.name, specs)
    made = read_reused(reuse, specs, rerun)
    left = [(index, spec) for index, spec in enumerate(specs) if not spec.is_finished(runs) and name_of(spec) not in made]
    jobs: dict[str, Job] = {}
    for index, spec in left:
        _add_job(jobs, spec, partial(run_command, suite, index, runs), runs)
    needed = {name_of(other.spec) for job in jobs.values() for other in job.needs}
    return sorted(jobs.values(), key=lambda job: name_of(job.spec) not in needed), len(specs) - len(left)


def _add_job(
    jobs: dict[str, Job], spec: RunSpec, command: Callable[..., list[str]], runs: Path, needed: tuple[str, ...] = ()
) -> Job:
    """
    :param jobs: by name, to which the run and those that it needs are added, unless they are there
    :param spec: of the run
    :param command: of a run of the suite, or, with names of arguments, of what it needs
    :param runs: directory of all runs
    :param needed: from a run of the suite to this one
    :return: the run's job
    """
    name = name_of(spec)
    if name not in jobs:
        needs = [
            _add_job(jobs, other, command, runs, (*needed, argument))
            for argument, other in needed_runs(spec).items()
            if not _has_left(argument, other, runs)
        ]
        jobs[name] = Job(spec, spec.directory(runs), command(needed), needs=needs)
    return jobs[name]


def _has_left(argument: str, spec: RunSpec, runs: Path) -> bool:
    """Whether a run is finished, and what another one needs of it is there."""
    return spec.is_finished(runs) and file_for(argument, spec, runs).exists()


def run_command(suite: Path, index: int, runs: Path, needed: Sequence[str] = ()) -> list[str]:
    """The exact command of one run, or of one that it needs."""
    command = [sys.executable, "-m", "benchmarks.run", "--suite", str(suite), "--index", str(index), "--runs", str(runs)]
    return [*command, *(["--needed", *needed] if needed else [])]


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
    return ", ".join(f"{states[state]} {state}" for state in reversed(STATES) if states[state] or state not in _ENDED_BADLY)


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
            noise = "" if spec.noise is None else f"{spec.noise:g}"
            result.add_row(spec.title, noise, spec.algorithm, str(spec.seed), job.state, *progress(job))
        yield result
        hidden = sum(job.state != "waiting" for job in self._jobs) - len(shown)
        yield Text(count(self._jobs) + (f"; {hidden} of them not shown" if hidden else ""), no_wrap=True, overflow="ellipsis")

    def shown(self, rows: int) -> list[Job]:
        """
        :param rows: that there are
        :return: the jobs in them, the most important ones last
        """
        jobs = [job for state in ("finished", *_ENDED_BADLY, "running") for job in self._jobs if job.state == state]
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
    print(f"{name_of(job.spec)}: {job.state}{reached}{_reason(job)} ({count(jobs)})", flush=True)


def _reason(job: Job) -> str:
    """Why a job was not started."""
    verbs = {"failed": "failed", "not started": "was not started"}
    return "".join(f", for it needs {name_of(other.spec)}, which {verbs[other.state]}" for other in job.lacking)


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
        try:
            with Live(table(jobs), console=console, refresh_per_second=1) if console.is_terminal else nullcontext():
                for future in in_order(jobs, lambda job: pool.submit(launch_one, job, retries, engine, tell), tell):
                    future.result()
        except KeyboardInterrupt:
            print("Stopped. The same command goes on from the runs' checkpoints.", flush=True)
            os._exit(130)  # a pool would first start and wait for all that is left


def in_order(
    jobs: Sequence[Job], submit: Callable[[Job], "Future[None]"], tell: Callable[[Job], None]
) -> Iterator["Future[None]"]:
    """
    Each job when all that it needs has ended; not at all, if that did not end well.

    :param jobs: to run
    :param submit: starts a job as soon as there is room for it
    :param tell: called when a job's state has changed to "not started"
    :return: the futures of those that were submitted, as they end
    """
    left = list(jobs)
    running: set[Future[None]] = set()
    while left or running:
        ready = [job for job in left if job.is_ready]
        left = [job for job in left if not job.is_ready]
        for job in ready:
            if job.lacking:
                job.state = "not started"
                tell(job)
            else:
                running.add(submit(job))
        if running:
            # Where another thread gets Ctrl-C's signal, this one learns of it when it next runs
            ended, running = wait(running, timeout=1, return_when=FIRST_COMPLETED)
            yield from ended


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", type=Path)
    parser.add_argument("--engine", choices=["local", "ray"], default="local")
    parser.add_argument("--address", default="auto", help="of the Ray cluster")
    parser.add_argument("--jobs", type=int, help="runs side by side; default: one on each CPU")
    parser.add_argument("--retries", type=int, default=1, help="further attempts after a run that failed")
    parser.add_argument("--runs", type=Path, default=RUNS)
    add_reuse_options(parser)
    parser.add_argument("--dry-run", action="store_true", help="print the commands of what is left to do")
    options = parser.parse_args()
    try:
        jobs, finished = jobs_left(options.suite.resolve(), options.runs.resolve(), options.reuse_results, options.rerun)
        if not options.dry_run:
            check_programs(job.spec for job in jobs)
    except ValueError as error:
        sys.exit(str(error))
    if options.dry_run:
        print("\n".join(shlex.join(job.command) for job in jobs))
        return
    engine = LocalEngine() if options.engine == "local" else RayEngine(options.address)
    launch(jobs, options.jobs or engine.cpus, options.retries, engine)
    failed, not_started = ([job for job in jobs if job.state == state] for state in ("failed", "not started"))
    for job in failed:
        print(f"{job.directory}: FAILED, see {job.log}")
    for job in not_started:
        print(f"{job.directory}: NOT STARTED{_reason(job)}")
    now = len(jobs) - len(failed) - len(not_started)
    more = f", {len(not_started)} not started" if not_started else ""
    print(f"{finished} were finished before, {now} now, {len(failed)} failed{more}.")
    sys.exit(bool(failed or not_started))


if __name__ == "__main__":
    main()
