"""
A suite -> its runs, several side by side with one thread each::

    python -m benchmarks.launch benchmarks/suites/foundation.yml --jobs 2

Finished runs are skipped, so an interrupted launch is resumed by the same command.  ``--dry-run`` prints the commands.
"""

import argparse
import os
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from benchmarks.suite import HERE, RunSpec, read_suite


def run_command(suite: Path, index: int, runs: Path) -> list[str]:
    """The exact command of one run."""
    return [sys.executable, "-m", "benchmarks.run", "--suite", str(suite), "--index", str(index), "--runs", str(runs)]


def launch_one(spec: RunSpec, command: list[str], runs: Path) -> bool:
    """
    :param spec: of the run
    :param command: to run it
    :param runs: directory of all runs
    :return: whether it ended well; its output is in ``log.txt``
    """
    directory = spec.directory(runs)
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / "log.txt").open("w") as log:
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        status = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=environment, cwd=HERE.parent, check=False)
    outcome = "finished" if status.returncode == 0 else f"FAILED, see {log.name}"
    print(f"{directory}: {outcome}", flush=True)
    return status.returncode == 0


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", type=Path)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs side by side")
    parser.add_argument("--runs", type=Path, default=HERE / "runs")
    parser.add_argument("--dry-run", action="store_true", help="print the commands of what is left to do")
    options = parser.parse_args()
    suite, runs = options.suite.resolve(), options.runs.resolve()
    specs = read_suite(suite)
    left = [(i, spec) for i, spec in enumerate(specs) if not (spec.directory(runs) / "evaluations.csv").exists()]
    commands = [run_command(suite, index, runs) for index, _ in left]
    if options.dry_run:
        print("\n".join(shlex.join(command) for command in commands))
        return
    with ThreadPoolExecutor(options.jobs) as pool:
        outcomes = list(pool.map(launch_one, [spec for _, spec in left], commands, [runs] * len(left)))
    print(f"{len(specs) - len(left)} were finished before, {sum(outcomes)} now, {outcomes.count(False)} failed.")
    sys.exit(outcomes.count(False) > 0)


if __name__ == "__main__":
    main()
