"""
Algorithms that are programs of their own, in any language, with an interpreter and packages of their own. An entry is::

    mine: {class: "benchmarks.external:Program", command: [python, -m, my_module], packages: [my-package], arguments: {a: 1}}

The program is started in the checkout. Its last argument is the path of ``request.json`` in the run's directory, which has
the keys ``run`` (the run's settings), ``environment`` (``id``, ``kwargs``, ``wrappers``), ``evaluations`` (environment steps
at which the program evaluates), ``eval_seed`` (seed of the evaluation environments before every evaluation), ``arguments``
(the program's own) and ``path`` (folders where the environment's modules may be, beside those on Python's path).

The program writes ``checkpoint/evaluations.csv`` beside the request, anew and in one move after every evaluation. The file
has one row for each of ``evaluations``, with ``timesteps``, ``learner`` (the mean return) and any other numbers. At its end
the program exits with status 0. The folder ``checkpoint`` is for the program's own checkpoints, from which it goes on when
it is started again; it is removed when the run is finished, while the files beside it stay. :mod:`benchmarks.program` does
all of this for programs in Python.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from benchmarks.checkpoint import CHECKPOINT, TIMING, read_seconds, write_atomically, write_timing
from benchmarks.engines import end_with_parent, module_path
from benchmarks.environments import EVAL_SEED, environment
from benchmarks.program import REQUEST, Rows, read_rows
from benchmarks.suite import RunSpec
from benchmarks.yaml_checks import check_is

_ASK = """
import json, platform, sys
from importlib.metadata import PackageNotFoundError, version
found = {"python": platform.python_version()}
for name in sys.argv[1:]:
    try:
        found[name] = version(name)
    except PackageNotFoundError:
        found[name] = None
print(json.dumps(found))
"""
_LOOK_EVERY = 1.0  # seconds


class Program:
    """
    A program that stands in the place of an algorithm's class.

    :param command: words of the command; ``python`` as the first word stands for the interpreter
    :param python: environment variable that holds the path of the interpreter; if it is ``None`` or not set, this process's
        interpreter is used
    :param packages: names of the distributions that the interpreter must have, whose versions are recorded
    :param arguments: arguments of the program itself
    :raises ValueError: naming an argument of another type
    """

    #: A program has no policy classes; code that handles algorithms reads this attribute
    policy_aliases: ClassVar[Mapping[str, type]] = {}

    def __init__(
        self,
        command: Sequence[str],
        python: str | None = None,
        packages: Sequence[str] = (),
        arguments: Mapping[str, Any] | None = None,
    ):
        check_is("command", command, "a list of words, such as [python, -m, my_module]", list, len)
        check_is("python", python, "the name of an environment variable", (str, type(None)))
        check_is("packages", packages, "a list of names", (list, tuple))
        check_is("arguments", arguments, "a mapping", (Mapping, type(None)))
        for words in (command, packages):
            check_is("command and packages", words, "lists of text", (list, tuple), lambda words: _are_texts(words))
        self._words, self._packages, self._arguments = command, packages, dict(arguments or {})
        self._variable = python

    @property
    def interpreter(self) -> str:
        """The path of the Python interpreter."""
        return os.environ.get(self._variable or "") or sys.executable

    @property
    def command(self) -> list[str]:
        """The words of the command, without the path of the request, which is added as the last one."""
        first, *others = self._words
        return [self.interpreter if first == "python" else first, *others]

    def versions(self) -> dict[str, str]:
        """
        :return: "python" and each package -> version; empty if the program needs no packages
        :raises ValueError: naming the packages that are not installed and the interpreter, or if the interpreter can't be run
        """
        if not self._packages:
            return {}
        is_named = bool(os.environ.get(self._variable or ""))
        where = f"the interpreter that {self._variable} names" if is_named else "this interpreter"
        try:
            asked = subprocess.run([self.interpreter, "-c", _ASK, *self._packages], capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise ValueError(f"{where}, {self.interpreter}, can't be run: {error}") from None
        versions: dict[str, str] = json.loads(asked.stdout)
        if missing := [name for name in self._packages if versions[name] is None]:
            other = f", or set {self._variable} to the path of one that has them" if self._variable else ""
            raise ValueError(f"{where}, {self.interpreter}, lacks {missing}: install them there{other}.")
        return versions

    def run(self, spec: RunSpec, directory: Path) -> Rows:
        """
        Make a run, or go on with it.

        :param spec: settings of the run
        :param directory: directory of the run, which no other process uses
        :return: one row for each evaluation
        :raises RuntimeError: if the program fails, or ends without all evaluations
        """
        (directory / CHECKPOINT).mkdir(exist_ok=True)
        write_atomically(directory / REQUEST, json.dumps(request_of(spec, self._arguments), indent=1))
        command = [*self.command, str((directory / REQUEST).resolve())]
        rows, times = _watch(command, directory), evaluation_times(spec)
        if (found := [row["timesteps"] for row in rows]) != times:
            raise RuntimeError(f"{command} ended with evaluations at {found} steps, not at {times}.")
        return rows


def request_of(spec: RunSpec, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param spec: settings of a run
    :param arguments: arguments of the program itself
    :return: content of the run's ``request.json``
    """
    env_id, kwargs = environment(spec)
    wrappers = spec.environment["wrappers"] if spec.environment else []
    return {
        "run": asdict(spec),
        "environment": {"id": env_id, "kwargs": kwargs, "wrappers": wrappers},
        "evaluations": evaluation_times(spec),
        "eval_seed": EVAL_SEED,
        "arguments": arguments,
        "path": _own_places(),
    }


def _watch(command: list[str], directory: Path) -> Rows:
    """
    Run a program to its end, and keep ``timing.json`` up to date with its last evaluation.

    :param command: words of the command
    :param directory: directory of the run
    :return: one row for each evaluation
    """
    rows, started = read_rows(directory), time.time()
    before = read_seconds(directory / TIMING) if rows else 0.0
    ends = partial(end_with_parent, os.getpid())
    process = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": module_path()}, preexec_fn=ends)
    status = None
    while status is None:
        with suppress(subprocess.TimeoutExpired):
            status = process.wait(_LOOK_EVERY)
        if (now := read_rows(directory)) and now != rows:
            rows = now
            seconds = before + time.time() - started
            write_timing(directory / TIMING, seconds, int(rows[-1]["timesteps"]), rows[-1]["learner"])
    if status:
        raise RuntimeError(f"{command} ended with status {status}.")
    return rows


def _are_texts(words: Sequence[Any]) -> bool:
    return all(isinstance(word, str) for word in words)


def _own_places() -> list[str]:
    """The folders on Python's path outside of this interpreter's installation, such as the one beside a suite."""
    installed = {Path(prefix).resolve() for prefix in (sys.prefix, sys.base_prefix)}
    places = [Path(place).resolve() for place in sys.path if place]
    return [str(place) for place in places if not any(place.is_relative_to(prefix) for prefix in installed)]


def evaluation_times(spec: RunSpec) -> list[int]:
    """
    :param spec: settings of a run
    :return: environment steps at which every algorithm is evaluated, each a multiple of the number of environments
    """
    every = spec.eval_every // spec.envs * spec.envs
    end = -(-spec.steps // spec.envs) * spec.envs
    return list(range(every, end + 1, every))
