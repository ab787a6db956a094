"""
The programs of this package under one name: ``sb3-gac NAME ...``, or ``python -m sb3_gac NAME ...``.

A program is imported when it is called, so that the help appears at once.
"""

import argparse
import difflib
import runpy
import sys
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from sb3_gac.stopping import StoppedInALine
from sb3_gac.version import __version__

NAME = "sb3-gac"


class Program(NamedTuple):
    """
    A program of this package.

    :param module: name of a module that ``python -m`` runs, whose function ``main`` reads the process's command line
    :param summary: what the program does, in one line
    """

    module: str
    summary: str


PROGRAMS = {
    "train": Program("sb3_gac.train", "train GAC, evaluate the learner, save model, curve and configuration"),
    "evaluate": Program("sb3_gac.evaluate", "how robust a trained policy is to noise, delay and lost observations"),
    "compare": Program("sb3_gac.compare", "what privileged information is worth on a task of your own"),
    "export": Program("sb3_gac.deploy", "a trained policy as .onnx or .pt file for the robot"),
    "envs": Program("sb3_gac.envs", "the registered environments: shapes, how to install them, speed"),
    "zoo": Program("sb3_gac.zoo", "rl_zoo3 with the algorithms of this package: train, tune, enjoy"),
    "bench": Program("benchmarks", "the benchmarks, in a clone: launch, aggregate, report and others"),
}
#: Names of the programs under ``benchmarks`` that users call
BENCHMARKS = ("launch", "aggregate", "report", "headroom", "versus", "speed", "simulators", "theory", "signs", "soak")


def main(arguments: list[str] | None = None) -> None:
    """
    Run the command line.

    :param arguments: name of a program and its own arguments; ``None`` for those of the process
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    names, rest = arguments[:1], arguments[1:]
    if names and not names[0].startswith("-") and names[0] not in PROGRAMS:
        sys.exit(_unknown(names[0], "command", list(PROGRAMS), f"See {NAME} --help."))
    parser = argparse.ArgumentParser(
        prog=NAME,
        usage=f"{NAME} COMMAND ...",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Training with what only the simulator knows, and deploying without it.",
        epilog=_listed() + f"\n\n{NAME} COMMAND --help says what a command takes.",
    )
    parser.add_argument("--version", action="version", version=f"sb3_gac {__version__}")
    if not names or names[0].startswith("-"):
        parser.parse_args(names)
        parser.print_help()
        return
    # Like python -m, so that --env can name modules in the working directory
    sys.path.insert(0, str(Path.cwd()))
    before = sys.argv
    sys.argv = [f"{NAME} {names[0]}", *rest]
    try:
        with StoppedInALine():
            _bench(rest) if names[0] == "bench" else import_module(_module(names[0])).main()
    except ImportError as error:
        if error.name is not None:
            raise
        sys.exit(str(error))  # an error of this package, which says what to install
    finally:
        sys.argv = before
        sys.path.remove(str(Path.cwd()))


def _module(name: str) -> str:
    """The module of a program; the program of a package is its ``__main__``."""
    module = PROGRAMS[name].module
    return f"{module}.__main__" if name in ("export", "envs") else module


def _bench(arguments: list[str]) -> None:
    checkout = Path(__file__).resolve().parents[1]
    if not (checkout / "benchmarks").is_dir():
        sys.exit(
            f"{NAME} bench needs the benchmarks, which are not installed with the package: clone the repository, "
            'pip install -e ".[benchmarks]" there, and call it again.'
        )
    if not arguments or arguments[0] in ("-h", "--help"):
        print(f"usage: {NAME} bench PROGRAM ...\n\nPROGRAM is one of {', '.join(BENCHMARKS)}; docs/benchmarks.md has them.")
        return
    if arguments[0] not in BENCHMARKS:
        sys.exit(_unknown(arguments[0], "program", list(BENCHMARKS), "See docs/benchmarks.md."))
    sys.path.append(str(checkout))  # some ways of installing a clone leave the path out
    sys.argv = [f"{NAME} bench {arguments[0]}", *arguments[1:]]
    runpy.run_module(f"benchmarks.{arguments[0]}", run_name="__main__")


def _unknown(name: str, kind: str, known: list[str], where: str) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f'Is "{close[0]}" meant?' if close else f"There are {', '.join(known)}."
    return f'There is no {kind} "{name}". {hint} {where}'


def _listed() -> str:
    width = max(map(len, PROGRAMS))
    return "commands:\n" + "\n".join(f"  {name:{width}}  {program.summary}" for name, program in PROGRAMS.items())


if __name__ == "__main__":
    main()
