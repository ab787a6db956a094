"""
Would the tests notice? Puts in deliberate one-line faults, one at a time, and runs the tests nearest to each::

    python -m tests.mutate --jobs 2 --only losses

The faults, or mutants, are listed in tests/mutants*.yml.  Each is put into a copy of the tree: yours is left alone.  Ends with
status 1 if less than ``--least`` percent of them are killed, with 2 if a mutant can't be put in or a test fails without one.
"""

import argparse
import ast
import multiprocessing
import os
import queue
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("sb3_gac", "benchmarks", "tests", "docs", "*.toml", "*.cfg", "*.md", "*.txt", "Makefile")
#: What takes long to import is imported once; it must not be what mutants change
_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["torch", "stable_baselines3", "gymnasium", "hypothesis", "pytest"])
_PASSED, _FAILED, _BROKEN = 0, 1, 2  # pytest's exit statuses; the last also where a module can't be imported


class MutantError(ValueError):
    """A mutant that can't be put in, or whose tests are not there or fail without it."""


@dataclass(frozen=True)
class Mutant:
    """
    A deliberate fault.

    :param file: path from the root of the tree
    :param old: text that occurs exactly once in it
    :param new: its replacement
    :param why: what becomes wrong
    :param tests: nearest to it, files or node ids
    """

    file: str
    old: str
    new: str
    why: str
    tests: tuple[str, ...]

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.file}: {self.why}"

    def mutated(self, root: Path) -> str:
        """
        :param root: folder of the tree
        :return: the file's text with the fault in it
        :raises MutantError: if the text to replace is not there, or there more than once, or the result does not compile
        """
        path = root / self.file
        if not path.is_file():
            raise MutantError(f"{self.name}: there is no such file.")
        text = path.read_text()
        count = text.count(self.old)
        if count != 1:
            raise MutantError(f"{self.name}: {self.old!r} occurs {count} times in it: renew the entry, or remove it.")
        mutated = text.replace(self.old, self.new)
        if mutated == text:
            raise MutantError(f"{self.name}: nothing is changed.")
        if path.suffix == ".py":
            try:
                compile(mutated, self.file, "exec")
            except SyntaxError as error:
                raise MutantError(f"{self.name}: the result does not compile: {error}.") from error
        return mutated

    def check(self, root: Path) -> None:
        """
        :param root: folder of the tree
        :raises MutantError: if it can't be put in, or one of its tests is not there
        """
        self.mutated(root)
        if not self.tests:
            raise MutantError(f"{self.name}: names no tests.")
        for test in self.tests:
            file, *names = test.partition("[")[0].split("::")
            if not (root / file).is_file():
                raise MutantError(f"{self.name}: there is no {file}.")
            missing = [name for name in names if name not in _names_in(root / file)]
            if missing:
                raise MutantError(f"{self.name}: {file} has no {missing[0]}.")


@cache
def _names_in(path: Path) -> set[str]:
    """Of functions and classes."""
    return {
        node.name
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, (ast.FunctionDef, ast.ClassDef))
    }


def read_mutants(paths: Iterable[Path]) -> list[Mutant]:
    """
    :param paths: paths of YAML lists of mutants
    :return: all of them
    """
    entries = [entry for path in sorted(paths) for entry in yaml.safe_load(path.read_text()) or []]
    return [Mutant(**{**entry, "tests": tuple(entry["tests"])}) for entry in entries]


def listed_mutants(root: Path = ROOT) -> list[Mutant]:
    """
    :param root: folder of the tree
    :return: all that its lists name
    """
    return read_mutants((root / "tests").glob("mutants*.yml"))


def copy_tree(root: Path, to: Path) -> None:
    """
    :param root: folder of the tree
    :param to: an empty directory, which gets what the tests need of it
    """
    for path in sorted(path for pattern in COPIED for path in root.glob(pattern)):
        if path.is_dir():
            shutil.copytree(path, to / path.name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(path, to / path.name)


def run_tests(tree: Path, tests: Sequence[str], timeout: float, *options: str) -> tuple[int | None, str]:
    """
    :param tree: where to run them
    :param tests: files or node ids
    :param timeout: in seconds
    :param options: of pytest
    :return: pytest's exit status, ``None`` if time ran out, and what it printed
    """
    log = tree / "pytest.log"
    process = _CONTEXT.Process(target=_run_pytest, args=(tree, log, ["-q", "-p", "no:cacheprovider", *options, *tests]))
    process.start()
    process.join(timeout)
    in_time = process.exitcode is not None
    if not in_time:
        os.killpg(process.pid or 0, signal.SIGKILL)  # with all that the tests started
        process.join()
    return (process.exitcode if in_time else None), log.read_text() if log.exists() else ""


def _run_pytest(tree: Path, log: Path, arguments: list[str]) -> None:
    """In a process of its own, which has imported this module from the tree that the copy was made of."""
    os.setsid()
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(descriptor, stream)
    os.chdir(tree)
    os.environ |= {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1", "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    sys.dont_write_bytecode = True
    sys.path.insert(0, str(tree))
    for name in [name for name in sys.modules if name.partition(".")[0] in ("sb3_gac", "benchmarks", "tests")]:
        del sys.modules[name]
    import hypothesis
    import pytest

    found_is_enough = (hypothesis.Phase.explicit, hypothesis.Phase.generate)  # to make an example smaller takes longest
    hypothesis.settings.register_profile("mutants", phases=found_is_enough, database=None, derandomize=True)
    hypothesis.settings.load_profile("mutants")
    sys.exit(pytest.main(arguments))


def is_killed(tree: Path, mutant: Mutant, timeout: float) -> bool:
    """
    :param tree: a copy, which is as it was when this returns
    :param mutant: to be put in
    :param timeout: in seconds; where time runs out, the mutant is killed
    :return: whether its tests notice it
    :raises MutantError: if it can't be put in, or its tests can't be run
    """
    path = tree / mutant.file
    original, mutated = path.read_text(), mutant.mutated(tree)
    path.write_text(mutated)
    try:
        status, output = run_tests(tree, mutant.tests, timeout, "-x")
    finally:
        path.write_text(original)
    if status not in (_PASSED, _FAILED, _BROKEN, None):
        raise MutantError(f"{mutant.name}: its tests can't be run: {output[-2000:]}")
    return status != _PASSED


def run_mutants(
    mutants: Sequence[Mutant], jobs: int, timeout: float, root: Path = ROOT, tests_pass: bool = False
) -> list[Mutant]:
    """
    Run the tests of each mutant, and say how it goes.

    :param mutants: to be put in, one at a time
    :param jobs: how many at once, each in a copy of its own
    :param timeout: for the tests of one mutant, in seconds
    :param root: folder of the tree
    :param tests_pass: whether it is known that the tests pass without a mutant
    :return: those that survived
    :raises MutantError: if a mutant can't be put in, or its tests fail without it
    """
    for mutant in mutants:
        mutant.check(root)
    survivors = []
    with ExitStack() as stack:
        trees: queue.Queue[Path] = queue.Queue()
        for _ in range(jobs):
            trees.put(Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mutants-"))))
            copy_tree(root, trees.queue[-1])
        tests = sorted({test for mutant in mutants for test in mutant.tests})
        if not tests_pass:
            print(f"Without a mutant: {len(tests)} tests or files of tests ...", flush=True)
            status, output = run_tests(trees.queue[0], tests, max(timeout * len(tests), 600))
            if status != _PASSED:
                raise MutantError(f"Tests fail without a mutant, so they can't tell:\n{output[-4000:]}")

        def judged(mutant: Mutant) -> tuple[bool, float]:
            tree, start = trees.get(), time.perf_counter()
            try:
                return is_killed(tree, mutant, timeout), time.perf_counter() - start
            finally:
                trees.put(tree)

        with ThreadPoolExecutor(jobs) as pool:
            futures = {pool.submit(judged, mutant): mutant for mutant in mutants}
            for done, future in enumerate(as_completed(futures), start=1):
                mutant, (killed, seconds) = futures[future], future.result()
                if not killed:
                    survivors.append(mutant)
                print(
                    f"[{done}/{len(mutants)}] {'killed' if killed else 'SURVIVED'} {seconds:.1f} s  {mutant.name}", flush=True
                )
    return survivors


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """
    :param arguments: of the command line
    :param root: folder of the tree
    :return: exit status
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=1, help="how many at once (default: 1)")
    parser.add_argument("--only", default="", help="those alone whose file, fault or tests hold this text")
    parser.add_argument("--least", type=float, default=95.0, help="percentage that must be killed (default: 95)")
    parser.add_argument("--sample", type=int, help="so many of them, drawn by chance, always the same ones")
    parser.add_argument("--tests-pass", action="store_true", help="they were just run: do not run them without a mutant first")
    parser.add_argument("--timeout", type=float, default=120.0, help="seconds for one mutant's tests (default: 120)")
    options = parser.parse_args(arguments)
    mutants = [m for m in listed_mutants(root) if options.only in " ".join([m.name, m.old, m.new, *m.tests])]
    if not mutants:
        print(f"No mutant has {options.only!r} in it.")
        return 2
    if options.sample is not None:
        mutants = random.Random(0).sample(mutants, min(options.sample, len(mutants)))
    try:
        survivors = run_mutants(mutants, options.jobs, options.timeout, root, options.tests_pass)
    except MutantError as error:
        print(error)
        return 2
    score = 100 * (1 - len(survivors) / len(mutants))
    print(f"\n{len(mutants) - len(survivors)} of {len(mutants)} mutants killed: {score:.1f} %.")
    for mutant in survivors:
        print(f"Survived: {mutant.name}\n    {mutant.old!r} -> {mutant.new!r}\n    {' '.join(mutant.tests)}")
    return 0 if score >= options.least else 1


if __name__ == "__main__":
    sys.exit(main())
