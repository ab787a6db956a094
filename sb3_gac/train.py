"""
Train GAC on a task with noisy sensors, then evaluate the learner on its partial observation alone::

    python -m sb3_gac.train --task HalfCheetah --noise 0.1 --steps 50000 --seed 0
    python -m sb3_gac.train --history 1    # the learner sees the newest observation alone, not the last four
    python -m sb3_gac.train --env my_module:MyEnv-v0 --env-kwargs "{mass: 2.0}" --algorithm asymmetric_sac

Everything is saved under ``runs/``: the model, the learning curve as a picture, the evaluations and the resolved
configuration.  A run that was stopped, by Ctrl-C or otherwise, can be resumed from its last checkpoint, and then ends with
the same results as a run that was not stopped::

    python -m sb3_gac.train --resume runs/<its directory>
"""

import sys
from argparse import Namespace
from collections.abc import Sequence

from sb3_gac.command_line import called_as
from sb3_gac.stopping import INTERRUPTED, last_words
from sb3_gac.training.directory import options_of, summary
from sb3_gac.training.job import prepare, run
from sb3_gac.training.options import given_options, make_parser, resolve
from sb3_gac.training.progress import warnings_in_a_line

_TERMINATED = 143


def parse_arguments(arguments: Sequence[str] | None = None) -> Namespace:
    """
    Read the command line.

    :param arguments: words of the command line; ``None`` for those of the process
    :return: all options, see :func:`sb3_gac.training.options.resolve`, with ``resume``, the directory of a stopped run, or
        ``None``
    """
    parser = make_parser(__doc__)
    given = given_options(parser, arguments)
    directory = given.pop("resume", None)
    try:
        if directory is None:
            return Namespace(**vars(resolve(given)), resume=None)
        if given:
            names = ", ".join(f"--{name.replace('_', '-')}" for name in given)
            anew = " A run with other options is a new one: leave out --resume."
            raise ValueError(f"--resume goes on with the options of the run: leave out {names}.{anew}")
        return options_of(directory)
    except ValueError as error:
        parser.error(str(error))


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Run the command line.

    :param arguments: words of the command line; ``None`` for those of the process
    """
    options = parse_arguments(arguments)
    try:
        with warnings_in_a_line():
            try:
                job = prepare(options)
            except (OSError, TypeError, ValueError) as error:
                sys.exit(f"{called_as('sb3_gac.train')}: error: {error}")
            run(job)
    except KeyboardInterrupt:
        _say_how_to_go_on()
        sys.exit(INTERRUPTED)
    except SystemExit as stop:
        if stop.code == _TERMINATED:
            _say_how_to_go_on()
        raise
    except Exception:
        _say_how_to_go_on()
        raise
    policy = job.model.policy
    print(summary(job.directory, options, policy.deployed_entries, remembers=policy.deployed.memory is not None))


def _say_how_to_go_on() -> None:
    print(last_words(), file=sys.stderr)


if __name__ == "__main__":
    main()
