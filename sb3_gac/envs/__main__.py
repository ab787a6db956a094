"""
Print the registered environments with suites, shapes and installation; with ``--speed`` their steps per second too::

    python -m sb3_gac.envs
    python -m sb3_gac.envs Go1 --speed --envs 1 16 128
"""

import sys

from sb3_gac.command_line import Parser
from sb3_gac.envs.table import Row, by_suite, in_columns, rows, steps_per_second


def main(arguments: list[str] | None = None) -> None:
    """
    Run the command line.

    :param arguments: command-line arguments, ``None`` for those of the process
    """
    parser = Parser("sb3_gac.envs", __doc__)
    parser.add_argument("matching", nargs="?", default="", help="only ids that contain this, in small or capital letters")
    parser.add_argument("--speed", action="store_true", help="measure those that are installed")
    parser.add_argument(
        "--envs",
        type=int,
        nargs="+",
        default=[1, 16],
        metavar="N",
        help="environments side by side, with --speed (default: 1 16)",
    )
    parser.add_argument("--seconds", type=float, default=1.0, help="duration of each measurement, with --speed (default: 1)")
    options = parser.parse_args(arguments)
    if min(options.envs) < 1:
        parser.error(f"--envs: must be integers of at least 1, got {min(options.envs)}.")
    if not options.seconds > 0:
        parser.error(f"--seconds: must be above 0, got {options.seconds:g}.")
    found = list(rows(options.matching))
    if not found:
        sys.exit(f"None of the registered environments' ids contains {options.matching!r}; without it, all are listed.")
    numbers = options.envs if options.speed else []
    header = ["id", *Row._fields[1:], *(f"steps/s, {number}" for number in numbers)]
    lines = [[*row, *(_speed(row, number, options.seconds) for number in numbers)] for row in found]
    print(by_suite(header, lines, bool(options.matching)) if sys.stdout.isatty() else in_columns(header, lines))


def _speed(row: Row, n_envs: int, seconds: float) -> str:
    return f"{steps_per_second(row.env_id, n_envs, seconds):,.0f}" if row.installed == "yes" else "-"


if __name__ == "__main__":
    main()
