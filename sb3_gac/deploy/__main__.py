"""
Write the deployed policy of a trained model to a file for the robot, ONNX or TorchScript by the file's suffix::

    python -m sb3_gac.deploy runs/HalfCheetah-... cheetah.onnx --unit partial="rad, rad/s" --unit action="N m"

The file's actions are compared with those of the model before the file is written.  docs/deployment.md says how to use it.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from sb3_gac.base.loading import load_model, model_file
from sb3_gac.command_line import Parser
from sb3_gac.deploy.export import WRITERS, export_learner
from sb3_gac.deploy.statistics import STATISTICS, normalizer_of
from sb3_gac.deploy.verification import ExportError
from sb3_gac.stopping import StoppedInALine


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Run the command line.

    :param arguments: command-line arguments, ``None`` for those of the process
    """
    parser = Parser("sb3_gac.deploy", __doc__)
    parser.add_argument("model", type=Path, help="a run's directory, or a model's zip")
    parser.add_argument("out", type=Path, help=f"the file to write, with the suffix {' or '.join(WRITERS)}")
    parser.add_argument(
        "--vec-normalize",
        type=Path,
        metavar="FILE",
        help=f"statistics of VecNormalize, as it saved them (default: {STATISTICS} beside the model)",
    )
    parser.add_argument(
        "--unit", action="append", default=[], metavar="ENTRY=UNIT", help="of an entry, or of the action; may be repeated"
    )
    options = parser.parse_args(arguments)
    malformed = [text for text in options.unit if "=" not in text]
    if malformed:
        parser.error(f"--unit: must be ENTRY=UNIT, such as action=Nm, got {malformed[0]!r}.")
    units = dict(text.split("=", 1) for text in options.unit)
    if options.out.is_dir():
        parser.error(f"out: {options.out} is a directory: name a file in it, such as {options.out / 'policy.onnx'}.")
    with StoppedInALine():
        try:
            print(_export(options, units))
        except (ValueError, OSError, ImportError, ExportError) as error:
            sys.exit(str(error))


def _export(options: argparse.Namespace, units: dict[str, str]) -> str:
    file = model_file(options.model)
    model = load_model(file, device="cpu")
    reads = model.policy.deployed_entries
    normalizer = normalizer_of(model, file, options.vec_normalize, reads)
    path = export_learner(model, options.out, normalizer, units)
    policy = f"the deployed policy of {type(model).__name__}, which reads {' and '.join(reads)}"
    return f"Wrote {path}: {policy}; its actions were compared."


if __name__ == "__main__":
    main()
