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
import shlex
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Table

from benchmarks.engines import Engine, LocalEngine, RayEngine
from benchmarks.finished import add_earlier_options, name_of, read_earlier
from benchmarks.suite import HERE, RunSpec, read_suite


@dataclass
class Job:
    """
    A run that is left to do.

    :param spec: of the run
    :param directory: of the run
    :param command: to run it
    :param state: "waiting", "running", "finished" or "failed"
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
    """
    specs = read_suite(suite)
    made = read_earlier(earlier, specs, renewed)
    left = [(index, spec) for index, spec in enumerate(specs) if not spec.is_finished(runs) and name_of(spec) not in made]
    jobs = [Job(spec, spec.directory(runs), run_command(suite, index, runs)) for index, spec in left]
    return jobs, len(specs) - len(left)


def run_command(suite: Path, index: int, runs: Path) -> list[str]:
    """The exact command of one run."""
    return [sys.executable, "-m", "benchmarks.run", "--suite", str(suite), "--index", str(index), "--runs", str(runs)]


def launch_one(job: Job, retries: int, engine: Engine) -> None:
    """
    :param job: to run in a process of its own with one thread; its state says how it ended
    :param retries: further attempts after one that failed
    :param engine: where
    """
    job.directory.mkdir(parents=True, exist_ok=True)
    job.state = "running"
    done = any(engine.run(job.command, job.log) == 0 for _ in range(retries + 1))
    job.state = "finished" if done else "failed"


def progress(job: Job) -> tuple[str, str]:
    """
    :param job: in any state
    :return: steps of its last evaluation and the learner's return there
    """
    try:
        last = json.loads((job.directory / "timing.json").read_text())
        return f"{last['steps']} / {job.spec.steps}", f"{last['learner']:.1f}"
    except (OSError, ValueError, KeyError):
        return ("", "") if job.state == "waiting" else (f"0 / {job.spec.steps}", "")


def table(jobs: list[Job]) -> Table:
    """
    :param jobs: of this launch; those that wait are counted
    """
    waiting = sum(job.state == "waiting" for job in jobs)
    result = Table("task", "noise", "algorithm", "seed", "state", "steps", "return", caption=f"{waiting} waiting")
    for job in jobs:
        if job.state != "waiting":
            spec, reached = job.spec, ("", "") if job.state == "finished" else progress(job)
            result.add_row(spec.task, f"{spec.noise:g}", spec.algorithm, str(spec.seed), job.state, *reached)
    return result


def launch(jobs: list[Job], at_once: int, retries: int, engine: Engine) -> None:
    """
    :param jobs: to run
    :param at_once: how many side by side
    :param retries: further attempts after one that failed
    :param engine: where
    """
    console = Console()
    with ThreadPoolExecutor(at_once) as pool:
        futures = [pool.submit(launch_one, job, retries, engine) for job in jobs]
        with Live(
            get_renderable=lambda: table(jobs), console=console, refresh_per_second=1, transient=not console.is_terminal
        ):
            for future in futures:
                future.result()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", type=Path)
    parser.add_argument("--engine", choices=["local", "ray"], default="local")
    parser.add_argument("--address", default="auto", help="of the Ray cluster")
    parser.add_argument("--jobs", type=int, help="runs side by side; default: one on each CPU")
    parser.add_argument("--retries", type=int, default=1, help="further attempts after a run that failed")
    parser.add_argument("--runs", type=Path, default=HERE / "runs")
    add_earlier_options(parser)
    parser.add_argument("--dry-run", action="store_true", help="print the commands of what is left to do")
    options = parser.parse_args()
    jobs, finished = jobs_left(options.suite.resolve(), options.runs.resolve(), options.earlier, options.renewed)
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
