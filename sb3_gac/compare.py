"""
What privileged information is worth on a task of one's own, in one command::

    python -m sb3_gac.compare --env my_module:MyEnv-v0
    python -m sb3_gac.compare --env my_module:make_env --env-kwargs "{noise: 0.2}" --seeds 10 --steps 50000

The environment's observations are ``Dict(partial=..., privileged=...)``.  SAC on the full state, SAC-asym, GAC and SAC on
``partial`` alone are trained on it, several runs side by side, by the benchmarks' runner; the same command goes on where it
was stopped.  Then a page shows the curves, the headroom, what each use of privileged information is worth, with intervals,
and which algorithm to train with.
"""

import sys
from pathlib import Path

from sb3_gac.envs.suites.extras import missing_extra

CHECKOUT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Command line."""
    if (CHECKOUT / "benchmarks").is_dir() and str(CHECKOUT) not in sys.path:
        sys.path.append(str(CHECKOUT))  # which some ways of installing a clone leave out
    try:
        from benchmarks.comparison import main as compare
    except ImportError as error:
        sys.exit(str(missing_extra("sb3_gac.compare", error.name or "the benchmarks' runner", "benchmarks")))
    compare(__doc__)


if __name__ == "__main__":
    main()
