"""
Measure what privileged information is worth on a task of your own, by one command::

    python -m sb3_gac.compare --env my_module:MyEnv-v0
    python -m sb3_gac.compare --env my_module:make_env --env-kwargs "{noise: 0.2}" --seeds 10 --steps 50000

The environment's observations are ``Dict(partial=..., privileged=...)``.  The benchmarks' runner trains SAC on the full
state, SAC-asym, GAC and SAC on ``partial`` alone, several runs at the same time; the same command resumes what was stopped.
Then a page shows the curves, the headroom, the worth of each use of privileged information, with intervals, and the
algorithm to train with.
"""

import sys
from pathlib import Path

from sb3_gac.envs.suites.extras import missing_extra
from sb3_gac.stopping import StoppedInALine

CHECKOUT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Run the command line."""
    if (CHECKOUT / "benchmarks").is_dir() and str(CHECKOUT) not in sys.path:
        sys.path.append(str(CHECKOUT))  # some ways of installing a clone leave the path out
    with StoppedInALine():
        _compare()


def _compare() -> None:
    try:
        from benchmarks.comparison import main as compare
    except ImportError as error:
        sys.exit(str(missing_extra("sb3_gac.compare", error.name or "the benchmarks' runner", "benchmarks")))
    compare(__doc__)


if __name__ == "__main__":
    main()
