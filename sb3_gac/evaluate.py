"""
Evaluate how robust a trained policy is to its sensors: to noise, to late observations, and to lost observations::

    python -m sb3_gac.evaluate runs/HalfCheetah-... --noise 0 0.1 0.2 0.3 --delay 0 1 2 --drop 0 0.1 0.3 --guider
    python -m sb3_gac.evaluate cheetah.zip --env sb3_gac/HalfCheetah-v5 --env-kwargs "{history: 4}" --video worst.mp4

One of the three is varied at a time; the other two are as in training, or as their single value says.  Every setting has the
same seeds: the same first states, and the same noise but for its size.  The learner is given the entries that it reads and
nothing else; with --guider the privileged policy is evaluated beside it.  A table, the curves, and all numbers as JSON are
saved.
"""

import argparse
import json
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from ctypes.util import find_library
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import gymnasium as gym
import torch as th
from tqdm import tqdm

from sb3_gac.base.loading import MODEL, load_model, model_file
from sb3_gac.command_line import Parser, mapping
from sb3_gac.deploy.statistics import STATISTICS, normalizer_of
from sb3_gac.envs.table import in_columns
from sb3_gac.evaluation.episodes import Episode, run_episodes
from sb3_gac.evaluation.figure import draw
from sb3_gac.evaluation.policies import (
    EXPORTED,
    EvaluatedPolicy,
    guider_of,
    learner_of,
    load_exported,
)
from sb3_gac.evaluation.results import HEADER, LEGEND, Outcome, header_of, outcome, row
from sb3_gac.evaluation.settings import (
    CONFIGURATION,
    DEFAULTS,
    UNDISTURBED,
    Environment,
    Setting,
    check_fits,
    environment_of_run,
    is_real_valued,
    plan,
)
from sb3_gac.evaluation.video import VIDEOS, check_can_film, film
from sb3_gac.stopping import StoppedInALine
from sb3_gac.training.provenance import provenance

EVAL_SEED = 10_000
SIDE_BY_SIDE = 10  # environments: more of them save little, since they are stepped one after the other
WIDTHS = (5, 5, 5, 7, 7, 6, 18, 5, 25, 7)  # widths of the table's columns, before its cells are known


def parse_arguments(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """
    Parse the command line.

    :param arguments: command-line arguments, ``None`` for those of the process
    :return: options; ``asked`` has the values of noise, delay and drop that were given, by name
    """
    parser = Parser("sb3_gac.evaluate", __doc__)
    parser.add_argument(
        "model",
        type=Path,
        help="directory of a run, of train or of the benchmarks; a model's zip, or an exported .onnx or .pt file",
    )
    for name, kind, text in (
        ("noise", float, "standard deviations of the sensor noise, in the units of partial"),
        ("delay", int, "steps by which observations are late"),
        ("drop", float, "probabilities that an observation is lost, and the last one seen again"),
    ):
        values = " ".join(map(str, DEFAULTS[name]))
        parser.add_argument(
            f"--{name}", type=kind, nargs="+", metavar="X", help=f"{text} ({values}, if none of the three is given)"
        )
    parser.add_argument("--episodes", type=int, default=20, help="of each setting (default: 20)")
    parser.add_argument("--guider", action="store_true", help="evaluate the privileged policy too, on the same seeds")
    parser.add_argument("--env", metavar="ID", help="environment, by default that of the run; module:id and module:name too")
    parser.add_argument("--env-kwargs", type=mapping, default={}, metavar="YAML", help='its arguments, such as "{history: 4}"')
    parser.add_argument(
        "--vec-normalize",
        type=Path,
        metavar="FILE",
        help=f"statistics of VecNormalize, as it saved them (default: {STATISTICS} beside the model)",
    )
    parser.add_argument("--seed", type=int, default=EVAL_SEED, help=f"of the first episode (default: {EVAL_SEED})")
    parser.add_argument("--device", default="auto", help="to act on (default: auto)")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="for table, curve and JSON (default: evaluation/ beside the model)"
    )
    parser.add_argument("--video", type=Path, metavar="MP4", help="film the first episode of the learner's worst setting")
    options = parser.parse_args(arguments)
    if options.episodes < 1:
        parser.error(f"--episodes: must be at least 1, got {options.episodes}.")
    if options.seed < 0:
        parser.error(f"--seed: must be at least 0, got {options.seed}.")
    if options.video is not None and (options.video.suffix not in VIDEOS or options.video.is_dir()):
        parser.error(f"--video: must be a file that ends in {' or '.join(VIDEOS)}, got {options.video}.")
    options.asked = {name: getattr(options, name) for name in DEFAULTS if getattr(options, name) is not None}
    return options


def environment_for(options: argparse.Namespace, file: Path) -> Environment:
    """
    Find the environment of the evaluation.

    :param options: options of the command line
    :param file: file of the model
    :return: environment that the options name, otherwise that of the model's run, with the options' arguments
    :raises ValueError: if neither the options nor a run beside the model say which environment is meant
    """
    if options.env is not None:
        return Environment(options.env, options.env_kwargs)
    recorded = environment_of_run(file.parent)
    if recorded is None:
        raise ValueError(
            f"--env is needed: there is no {CONFIGURATION} beside {file} that says where it was trained. Give the environment "
            'with its arguments, such as --env sb3_gac/HalfCheetah-v5 --env-kwargs "{history: 4}".'
        )
    return replace(recorded, kwargs={**recorded.kwargs, **options.env_kwargs})


def policies_of(options: argparse.Namespace, file: Path) -> tuple[str, dict[str, EvaluatedPolicy]]:
    """
    Load the policies to evaluate.

    :param options: options of the command line
    :param file: file of the model
    :return: name of the algorithm, or of the kind of file; and name -> policy
    :raises ValueError: if the model can't be loaded, or lacks the guider that is to be evaluated
    """
    if file.suffix in EXPORTED:
        if options.guider:
            raise ValueError(
                f"--guider: {file.name} is an exported file, which holds the learner alone. Evaluate the model's zip."
            )
        if options.vec_normalize is not None:
            raise ValueError(
                f"--vec-normalize: {file.name} is an exported file, which has its normalisation in it: leave it out."
            )
        return f"exported {file.suffix} file", {"learner": load_exported(file)}
    model = load_model(file, options.device)
    makers = {"learner": learner_of, **({"guider": guider_of} if options.guider else {})}
    entries = {key for make in makers.values() for key in make(model).entries}
    normalize = normalizer_of(model, file, options.vec_normalize, entries)
    return type(model).__name__, {name: make(model, normalize) for name, make in makers.items()}


class Evaluation:
    """
    The evaluation of all settings of one command.

    :param options: options of the command line
    :raises ValueError: if an option is wrong; all such errors come before the first episode
    """

    def __init__(self, options: argparse.Namespace):
        self.options, self.file = options, model_file(options.model)
        self.environment = environment_for(options, self.file)
        self.trained = self.environment.trained
        env = self._made()
        asked = options.asked or {name: values for name, values in DEFAULTS.items() if name != "noise" or is_real_valued(env)}
        self.settings, self.curves = plan(asked, self.trained)
        self.algorithm, self.policies = policies_of(options, self.file)
        for policy in self.policies.values():
            check_fits(policy.entries, env, self.environment.env_id)
        env.close()
        for setting in self.settings:
            self.environment.make(setting).close()  # raises where a value is wrong, before the first episode
        if options.video is not None:
            self._drawable(UNDISTURBED, check=True).close()
        self.directory = options.out or self.file.parent / _folder_for(self.file)
        _make_folder("--out", self.directory)
        if options.video is not None:
            _make_folder("--video", options.video.parent)
        self.outcomes: dict[Setting, dict[str, Outcome]] = {}
        self.header: Sequence[str] = HEADER

    def _made(self) -> gym.Env:
        try:
            return self.environment.make(UNDISTURBED)
        except TypeError as error:
            raise ValueError(f"--env-kwargs: {self.environment.env_id} can't be made with its arguments: {error}") from error

    def run(self) -> None:
        """Evaluate, and print the table as it grows."""
        reads = (f"The {name} reads {' and '.join(policy.entries)}." for name, policy in self.policies.items())
        print(f"{self.title}. {' '.join(reads)}")
        if beside := self.environment.beside:
            print(f"{self.environment.env_id}: settings come on top of {beside}.")
        undisturbed: dict[str, list[Episode]] = {}
        for setting in self.settings:
            self.outcomes[setting] = {}
            for name, policy in self.policies.items():
                episodes = self._episodes(policy, setting)
                if not undisturbed:
                    self.header = header_of(episodes)
                    print(f"\n{_cells(self.header)}\n{_cells(['-' * width for width in WIDTHS[: len(self.header)]])}")
                found = outcome(episodes, undisturbed.setdefault(name, episodes))
                self.outcomes[setting][name] = found
                print(_cells(self._row(setting, name, found)), flush=True)
        print(f"{LEGEND}\n")

    def _row(self, setting: Setting, name: str, found: Outcome) -> list[str]:
        return row(setting, name, found)[: len(self.header)]

    def _episodes(self, policy: EvaluatedPolicy, setting: Setting) -> list[Episode]:
        count = self.options.episodes
        envs = [self.environment.make(setting) for _ in range(min(count, SIDE_BY_SIDE))]
        try:
            with tqdm(total=count, unit="episode", desc=str(setting), leave=False, disable=not sys.stderr.isatty()) as bar:
                return run_episodes(policy, envs, range(self.options.seed, self.options.seed + count), bar.update)
        finally:
            for env in envs:
                env.close()

    @property
    def title(self) -> str:
        """Algorithm, environment and number of episodes, in words."""
        count = self.options.episodes
        return f"{self.algorithm} on {self.environment.env_id}, {count} episode{'s' * (count > 1)} for each setting"

    def save(self, command: str) -> None:
        """
        Write the table, the figure and all numbers to the evaluation's folder.

        :param command: command line that made the results
        """
        lines = [self._row(*of) for of in self._all()]
        (self.directory / "evaluation.md").write_text(
            f"{self.title}\n\n{in_columns(self.header, lines)}\n\n{LEGEND}\n", encoding="utf-8"
        )
        labels = {name: f"{name} (reads {', '.join(policy.entries)})" for name, policy in self.policies.items()}
        draw(self.outcomes, self.curves, self.trained, labels, self.title, self.directory / "evaluation.png")
        results = [{**setting._asdict(), "policy": name, **found.as_json()} for setting, name, found in self._all()]
        (self.directory / "evaluation.json").write_text(
            json.dumps({**self._origin(command), "results": results}, indent=1), encoding="utf-8"
        )

    def _all(self) -> list[tuple[Setting, str, Outcome]]:
        return [(setting, name, found) for setting, of in self.outcomes.items() for name, found in of.items()]

    def _origin(self, command: str) -> dict[str, Any]:
        seeds = [self.options.seed, self.options.seed + self.options.episodes - 1]
        return {
            "command": command,
            **provenance(),
            "model": str(self.file),
            "algorithm": self.algorithm,
            "environment": asdict(self.environment),
            "trained": self.trained._asdict(),
            "first_and_last_seed": seeds,
        }

    def film_worst(self, path: Path) -> str:
        """
        Film the learner's first episode in the setting in which it returned least.

        :param path: file of the video
        :return: description of the video, in words
        """
        worst = min(self.outcomes, key=lambda setting: self.outcomes[setting]["learner"].mean.mean)
        env = self._drawable(worst)
        total = film(self.policies["learner"], env, self.options.seed, str(worst), path)
        env.close()
        return f"{path}: the learner's episode from seed {self.options.seed} with {worst}; return {total:.5g}"

    def _drawable(self, setting: Setting, check: bool = False) -> gym.Env:
        try:
            env = self.environment.make(setting, "rgb_array")
        except TypeError:
            raise ValueError(f"--video: {self.environment.env_id} takes no render_mode: leave --video out.") from None
        if check:
            check_can_film(env, self.environment.env_id)
        return env


def _folder_for(file: Path) -> str:
    """Name of the folder of a file's evaluations, so that those of several files in one folder do not replace each other's."""
    if file.name == MODEL:
        return "evaluation"
    return f"evaluation-{file.stem if file.suffix == '.zip' else file.name}"


def _make_folder(option: str, folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):  # or else the results would be lost when they are written
            pass
    except OSError as error:
        raise ValueError(f"{option}: nothing can be written in the folder {folder}: {error}") from None


def _cells(texts: Sequence[str]) -> str:
    return "| " + " | ".join(text.ljust(width) for text, width in zip(texts, WIDTHS, strict=False)) + " |"


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Run the command line.

    :param arguments: command-line arguments, ``None`` for those of the process
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    options = parse_arguments(arguments)
    if options.video is not None and "DISPLAY" not in os.environ and find_library("EGL") is not None:
        os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it when it is first imported
    with StoppedInALine(), one_thread():
        _evaluate(options, shlex.join(["python", "-m", "sb3_gac.evaluate", *arguments]))


def _evaluate(options: argparse.Namespace, command: str) -> None:
    try:
        evaluation = Evaluation(options)
    except (ValueError, OSError, ImportError, RuntimeError, gym.error.Error) as error:
        sys.exit(str(error))
    evaluation.run()
    try:
        evaluation.save(command)
        print(f"Saved in {evaluation.directory}: evaluation.md, evaluation.png, evaluation.json.")
        if options.video is not None:
            print(evaluation.film_worst(options.video))
    except OSError as error:
        sys.exit(f"Not all could be saved: {error}")


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread: for a few rows at a time, several threads would mostly wait for each other."""
    before = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(before)


if __name__ == "__main__":
    main()
