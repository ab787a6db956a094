"""
Makes the runs of a suite, several side by side with one thread each::

    python -m benchmarks.launch benchmarks/suites/halfcheetah.yml --jobs 2

Finished runs are skipped and unfinished ones go on from their checkpoints, so the same command resumes an interrupted launch.
Runs whose directories are elsewhere, or gone, count as finished if the results named by ``--reuse-results`` contain them.
The whole suite is checked before the first run.  Runs start in the suite's order: what matters most stands first in the file.
A failed run is tried again; if it fails for good, the reason is printed.
Where a run needs another run's model, the other run is made first, once for all that need it; if it fails, the runs that
need it are not started.  ``--dry-run`` prints the commands of the runs that are left, and counts them.  ``--engine ray``
makes the runs on a Ray cluster whose nodes share this checkout, its Python and the directory of the runs.
"""

import argparse
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import nullcontext
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.text import Text

from benchmarks.config import check_programs, check_runs, check_simulators, fingerprint
from benchmarks.engines import Engine, LocalEngine, RayEngine
from benchmarks.finished import add_reuse_options, is_finished, name_of, read_reused
from benchmarks.jobs import Clock, Job, reason_in
from benchmarks.overview import Overview, line, table, why_not_started
from benchmarks.own_code import about_changed_code
from benchmarks.run import file_for
from benchmarks.suite import RUNS, RunSpec, needed_runs, read_suite

__all__ = ["Job", "in_order", "jobs_left", "launch", "launch_one", "run_command", "table"]


def jobs_left(suite: Path, runs: Path, reuse: Sequence[Path] = (), rerun: Sequence[str] = ()) -> tuple[list[Job], int]:
    """
    :param suite: YAML file of the suite
    :param runs: directory of all runs
    :param reuse: paths of results, without a suffix, whose runs count as finished too
    :param rerun: names of the algorithms whose runs in ``reuse`` do not count
    :return: jobs of the runs that are not finished, in the suite's order, each after those that it needs; and the
        number of the suite's finished runs
    :raises ValueError: naming the place and the fault in the suite
    """
    specs = read_suite(suite)
    check_runs(suite.name, specs)
    for sentence in about_changed_code(specs, runs):
        print(sentence, file=sys.stderr)
    return jobs_of(specs, suite, runs, reuse, rerun)


def jobs_of(
    specs: Sequence[RunSpec], suite: Path, runs: Path, reuse: Sequence[Path] = (), rerun: Sequence[str] = ()
) -> tuple[list[Job], int]:
    """
    :param specs: settings of a suite's runs, which have been checked
    :param suite: YAML file of the suite, which the jobs' processes read
    :param runs: directory of all runs
    :param reuse: paths of results, without a suffix, whose runs count as finished too
    :param rerun: names of the algorithms whose runs in ``reuse`` do not count
    :return: jobs and number of finished runs, see :func:`jobs_left`
    :raises ValueError: if the directory of a run holds a finished run with other settings
    """
    made = read_reused(reuse, specs, rerun)
    left = [(index, spec) for index, spec in enumerate(specs) if not is_finished(spec, runs) and name_of(spec) not in made]
    jobs: dict[str, Job] = {}
    for index, spec in left:
        _add_job(jobs, spec, partial(run_command, suite, index, runs), runs)
    return list(jobs.values()), len(specs) - len(left)


def _add_job(
    jobs: dict[str, Job], spec: RunSpec, command: Callable[..., list[str]], runs: Path, needed: tuple[str, ...] = ()
) -> Job:
    """
    Add the jobs of a run and of all runs that it needs, unless they have been added before.

    :param jobs: run's name -> job, to which the jobs are added
    :param spec: settings of the run
    :param command: function that makes the command of a run, from its settings and the arguments that lead to it from a run of
        the suite
    :param runs: directory of all runs
    :param needed: arguments that lead from a run of the suite to this one, empty for a run of the suite itself
    :return: job of the run
    """
    name = name_of(spec)
    if name not in jobs:
        needs = [
            _add_job(jobs, other, command, runs, (*needed, argument))
            for argument, other in needed_runs(spec).items()
            if not _has_left(argument, other, runs)
        ]
        jobs[name] = Job(spec, spec.directory(runs), command(spec, needed), needs=needs)
    return jobs[name]


def _has_left(argument: str, spec: RunSpec, runs: Path) -> bool:
    """Whether a run is finished, and the file that another run needs of it is there."""
    return is_finished(spec, runs) and file_for(argument, spec, runs).exists()


def run_command(suite: Path, index: int, runs: Path, spec: RunSpec, needed: Sequence[str] = ()) -> list[str]:
    """
    :param suite: YAML file of the suite
    :param index: index of the run in the suite
    :param runs: directory of all runs
    :param spec: settings of the run to make, since another process may change the suite before this one starts
    :param needed: arguments that lead from this run to a run that it needs, empty for the run itself
    :return: words of the command that makes the run, or the run that it needs
    """
    command = [sys.executable, "-m", "benchmarks.run", "--suite", str(suite), "--index", str(index), "--runs", str(runs)]
    return [*command, "--expect", name_of(spec), fingerprint(spec), *(["--needed", *needed] if needed else [])]


def launch_one(job: Job, retries: int, engine: Engine, tell: Callable[[Job], None]) -> None:
    """
    Make a run in a process of its own with one thread. Its outcome is the job's state, with a reason if it failed.

    :param job: job of the run
    :param retries: number of further attempts after one that failed
    :param engine: engine that starts the process
    :param tell: function that is called with the job when its state has changed, and before another attempt
    """
    job.state, job.reason = "running", ""
    tell(job)
    for left in reversed(range(retries + 1)):
        job.reason = _why_failed(job, engine)
        if not job.reason:
            break
        if left:
            tell(job)
    job.state, job.ended = "failed" if job.reason else "finished", time.monotonic()
    tell(job)


def _why_failed(job: Job, engine: Engine) -> str:
    """
    Make one attempt at a run. Any error of the engine or of the file system counts as the failure of this run alone.

    :return: reason why the attempt failed, empty if it did not
    """
    try:
        job.directory.mkdir(parents=True, exist_ok=True)
        status = engine.run(job.command, job.log)
        return reason_in(job.log, status) if status else ""
    except Exception as error:
        return f"{type(error).__name__}: {error}".rstrip(": ")


def launch(jobs: list[Job], at_once: int, retries: int, engine: Engine, finished_before: int = 0) -> None:
    """
    Make runs, and show their progress. Ctrl-C ends all of them at once, and this process too; their checkpoints stay.

    :param jobs: jobs of the runs to make
    :param at_once: number of runs side by side
    :param retries: number of further attempts after one that failed
    :param engine: engine that starts the processes
    :param finished_before: number of the suite's runs that were finished before
    """
    console, clock = Console(), Clock(jobs)
    draws = console.is_interactive and console.file.isatty()

    def tell(job: Job) -> None:
        said = line(jobs, job, clock)
        if not draws:
            print(said, flush=True)
        elif job.reason:  # a failure stays above the table
            console.print(Text(said, style="red"))

    shown = Live(Overview(jobs, finished_before, clock), console=console, refresh_per_second=1) if draws else nullcontext()
    with ThreadPoolExecutor(at_once) as pool:
        try:
            with shown:
                for future in in_order(jobs, at_once, lambda job: pool.submit(launch_one, job, retries, engine, tell), tell):
                    future.result()
        except KeyboardInterrupt:
            print("Stopped. The same command goes on from the runs' checkpoints.", flush=True)
            os._exit(130)  # a pool would first make all runs that are left


def in_order(
    jobs: Sequence[Job], at_once: int, submit: Callable[[Job], "Future[None]"], tell: Callable[[Job], None]
) -> Iterator["Future[None]"]:
    """
    Submit jobs in their order as others end. A job leaves its place to the next until the jobs that it needs have ended; if
    one of these failed, the job is not submitted.

    :param jobs: jobs of the runs to make
    :param at_once: number of jobs side by side
    :param submit: function that starts a job, and returns its future
    :param tell: function that is called with a job when its state has changed to "not started"
    :return: futures of the jobs that were submitted, as they end
    """
    left = list(jobs)
    running: set[Future[None]] = set()
    while left or running:
        for job in left:
            if job.lacking:
                job.state = "not started"
                tell(job)
        left = [job for job in left if job.state == "waiting"]
        for job in [job for job in left if job.is_ready][: at_once - len(running)]:
            left.remove(job)
            running.add(submit(job))
        if running:
            # If another thread gets Ctrl-C's signal, this thread sees it when it next runs: within a second
            ended, running = wait(running, timeout=1, return_when=FIRST_COMPLETED)
            yield from ended


def _at_least(least: int) -> Callable[[str], int]:
    def whole_number(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"must be a whole number from {least} on, got {text!r}")
        return int(text)

    return whole_number


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.launch", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("suite", type=Path, help="YAML file of the suite, such as benchmarks/suites/halfcheetah.yml")
    parser.add_argument("--engine", choices=["local", "ray"], default="local", help="what makes the runs (default: local)")
    parser.add_argument("--address", default="auto", help="of the Ray cluster, with --engine ray (default: auto)")
    parser.add_argument("--jobs", type=_at_least(1), help="runs side by side (default: one on each CPU)")
    parser.add_argument(
        "--retries", type=_at_least(0), default=1, help="further attempts after a run that failed (default: 1)"
    )
    parser.add_argument("--runs", type=Path, default=RUNS, help="directory of all runs (default: benchmarks/runs)")
    add_reuse_options(parser)
    parser.add_argument(
        "--dry-run", action="store_true", help="print the commands of what is left to do, and how many there are"
    )
    return parser


def main() -> None:
    """Entry point of the command line."""
    options = _parser().parse_args()
    try:
        jobs, finished = jobs_left(options.suite.resolve(), options.runs.resolve(), options.reuse_results, options.rerun)
        if not options.dry_run:
            check_programs(job.spec for job in jobs)
            check_simulators(job.spec for job in jobs)
            engine = LocalEngine() if options.engine == "local" else RayEngine(options.address)
    except (ValueError, OSError, ImportError) as error:  # a cluster that is not there is an OSError
        sys.exit(str(error))
    except KeyboardInterrupt:
        print("Stopped before the first run.", file=sys.stderr)
        sys.exit(130)
    left = f"{len(jobs)} left to run, {sum(job.spec.steps for job in jobs):,} environment steps"
    if options.dry_run:
        print("\n".join([*(shlex.join(job.command) for job in jobs), f"# {finished} finished, {left}."]))
        return
    at_once = options.jobs or engine.cpus
    print(f"{options.suite.name}: {finished} finished before, {left}, {at_once} at once.", flush=True)
    launch(jobs, at_once, options.retries, engine, finished)
    sys.exit(_tell_end(jobs, finished))


def _tell_end(jobs: Sequence[Job], finished: int) -> bool:
    """Print how a launch ended, and return whether any run failed or was not started."""
    failed, not_started = ([job for job in jobs if job.state == state] for state in ("failed", "not started"))
    for job in failed:
        print(f"{job.directory}: FAILED, see {job.log}: {job.reason}")
    for job in not_started:
        print(f"{job.directory}: NOT STARTED{why_not_started(job)}")
    now = len(jobs) - len(failed) - len(not_started)
    more = f", {len(not_started)} not started" if not_started else ""
    print(f"{finished} were finished before, {now} now, {len(failed)} failed{more}.")
    return bool(failed or not_started)


if __name__ == "__main__":
    main()
