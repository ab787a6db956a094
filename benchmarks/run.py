"""
Makes one training run of a suite, in a directory of its own::

    python -m benchmarks.run --suite benchmarks/suites/halfcheetah.yml --index 0 --runs benchmarks/runs

A finished run is skipped. An unfinished one goes on from its last checkpoint; there is one after every evaluation.
The directory holds ``evaluations.csv`` if and only if the run is finished.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

import sb3_gac
from benchmarks.checkpoint import TIMING, checkpoints_of, read_seconds, write_atomically, write_timing
from benchmarks.config import POLICY, fingerprint, normalization, resolve
from benchmarks.environments import EVAL_SEED, make_envs
from benchmarks.external import Program
from benchmarks.finished import is_finished, name_of
from benchmarks.own_code import code_of
from benchmarks.program import read_rows, rows_as_text
from benchmarks.recorded import in_present_names, settings_in_present_names
from benchmarks.suite import RUNS, UNSAID, RunSpec, made_with, needed_runs, read_suite
from sb3_gac.base.recording import holds_every_step
from sb3_gac.checkpoint.lock import locked
from sb3_gac.deploy.statistics import STATISTICS
from sb3_gac.presets import instantiate
from sb3_gac.training.environments import normalized
from sb3_gac.training.options import TEACHER
from sb3_gac.training.provenance import provenance

CONFIGURATION, MODEL = "config.yaml", "model.zip"
RECORDING = "recording.npz"


def run(spec: RunSpec, root: Path, progress_bar: bool = False) -> Path:
    """
    Train, or go on with training, unless the run is finished.

    :param spec: settings of the run
    :param root: directory of all runs
    :param progress_bar: whether to show a progress bar
    :return: the run's directory
    :raises RuntimeError: if another process is making this run
    :raises ValueError: if its directory holds a run with another configuration, or a run that it needs is not finished
    """
    directory = spec.directory(root)
    if is_finished(spec, root):
        return directory
    algorithm_class, arguments = resolve(spec)
    models = {argument: str(file_for(argument, needed, root)) for argument, needed in needed_runs(spec).items()}
    directory.mkdir(parents=True, exist_ok=True)
    with locked(directory):
        configuration = _configuration(spec, arguments)
        _refuse_other_settings(directory / CONFIGURATION, algorithm_class, configuration)
        if issubclass(algorithm_class, Program):
            history = _run_program(spec, directory, algorithm_class(**arguments), configuration)
        else:
            history = _train(spec, directory, algorithm_class, configuration, models, progress_bar)
        write_evaluations(history, directory / "evaluations.csv")
        checkpoints_of(algorithm_class, directory).remove()
    return directory


def file_for(argument: str, spec: RunSpec, root: Path) -> Path:
    """
    :param argument: algorithm's argument that stands for another run's file: ``recording`` for the run's recorded actions and
        rewards, any other name for its model
    :param spec: settings of the other run
    :param root: directory of all runs
    :return: path of that file
    :raises ValueError: if the other run is not finished, or its file is gone
    """
    path = spec.directory(root) / (RECORDING if argument == "recording" else MODEL)
    if not is_finished(spec, root):
        raise ValueError(f"{path.parent} is needed, and not finished: run it first, as benchmarks.launch does.")
    if not path.exists():
        raise ValueError(f"{path} is needed, and gone: remove {path.parent}, and run it again.")
    return path


def _configuration(spec: RunSpec, arguments: dict[str, Any]) -> dict[str, Any]:
    """What is recorded of a run's settings, before the commit and the versions."""
    options = normalization(spec)
    return {"run": dataclasses.asdict(spec), "arguments": arguments} | ({} if options is None else {"normalize": options})


def check_unfinished(spec: RunSpec, root: Path) -> None:
    """
    :param spec: settings of a run that is not finished
    :param root: directory of all runs
    :raises ValueError: if the run was begun with other settings
    """
    algorithm_class, arguments = resolve(spec)
    _refuse_other_settings(spec.directory(root) / CONFIGURATION, algorithm_class, _configuration(spec, arguments))


def _refuse_other_settings(path: Path, algorithm_class: type, configuration: dict[str, Any]) -> None:
    """Refuse to go on with an unfinished run that was begun with other settings: two runs are never mixed."""
    if path.exists():
        before = yaml.safe_load(path.read_text(encoding="utf-8"))
        now, then = (_comparable(algorithm_class, one) for one in (configuration, before))
        changed = [key for key in dict.fromkeys((*configuration, "normalize")) if then.get(key) != now.get(key)]
        if changed:
            raise ValueError(f"{path.parent} holds an unfinished run with other settings under {changed}: remove it first.")


def _comparable(algorithm_class: type, configuration: dict[str, Any]) -> dict[str, Any]:
    """The configuration with its arguments by their present names, so that two can be compared."""
    arguments = in_present_names(algorithm_class, configuration.get("arguments") or {})
    run = settings_in_present_names(algorithm_class, configuration.get("run") or {})
    return {**configuration, "run": UNSAID | run, "arguments": arguments}


def _write_configuration(path: Path, configuration: dict[str, Any], resumed: bool, versions: Mapping[str, str]) -> None:
    """
    Write the configuration with the commit and the versions of this process. If this process goes on with a run, those of the
    earlier processes are kept wherever they differ.

    :param path: YAML file of the configuration
    :param configuration: settings of the run and arguments of its algorithm
    :param resumed: whether an earlier process began this run
    :param versions: what the run needs beside our packages -> its version
    """
    now = provenance()
    now["versions"] = {**now["versions"], **versions}
    before = made_with(yaml.safe_load(path.read_text(encoding="utf-8"))) if resumed else []
    earlier = [origin for origin in before if origin not in made_with(now)]
    write_atomically(path, yaml.safe_dump(configuration | now | {"earlier": earlier}, sort_keys=False))


class Stopwatch(BaseCallback):
    """
    Writes the seconds and steps from a run's start to its last evaluation, over all of its processes, and the return of that
    evaluation. Steps that a killed process made after its last evaluation are made again, so they do not count.

    :param path: JSON file to write
    :param evaluation: callback that evaluates; it is called before this one
    :param resumed: whether the run goes on, so that the seconds in the file are added
    """

    def __init__(self, path: Path, evaluation: sb3_gac.SeededEvalCallback, resumed: bool):
        super().__init__()
        self._path, self._evaluation, self._started = path, evaluation, time.time()
        self._before = read_seconds(path) if resumed else 0.0

    def _on_step(self) -> bool:
        if self.n_calls % self._evaluation.eval_freq == 0:
            self.write()
        return True

    def write(self) -> None:
        """Replace the file by one for the last evaluation."""
        learner = float(self._evaluation.history[-1]["learner"])
        write_timing(self._path, self._before + time.time() - self._started, self.model.num_timesteps, learner)


def _train(
    spec: RunSpec,
    directory: Path,
    algorithm_class: Any,
    configuration: dict[str, Any],
    models: dict[str, str],
    progress_bar: bool,
) -> list[dict[str, float]]:
    """
    Train an algorithm of this package or of SB3's in this process.

    :param spec: settings of the run
    :param directory: directory of the run
    :param algorithm_class: class of the algorithm
    :param configuration: ``arguments`` of the algorithm, and ``normalize`` if observations or rewards are normalised
    :param models: argument of the algorithm -> file of the model that it stands for
    :param progress_bar: whether to show a progress bar
    :return: one row for each evaluation
    """
    options = configuration.get("normalize")
    teacher = models.get(TEACHER)
    env = normalized(make_envs(spec, spec.envs, spec.seed), options, teacher=teacher)
    eval_env = normalized(make_envs(spec, spec.eval_episodes), options, training=False, teacher=teacher)
    every = spec.eval_every // spec.envs
    evaluation = _evaluation_class(algorithm_class)(
        eval_env,
        eval_seed=EVAL_SEED,
        eval_freq=every,
        n_eval_episodes=spec.eval_episodes,
        deterministic=spec.eval_deterministic,
        verbose=0,
    )
    checkpoints = checkpoints_of(algorithm_class, directory)
    arguments = {"policy": POLICY, **instantiate(configuration["arguments"]), **models, "seed": spec.seed}
    resumed = checkpoints.resume(algorithm_class, arguments, env, spec.seed)
    _write_configuration(directory / CONFIGURATION, configuration, resumed is not None, code_of(spec))
    stopwatch = Stopwatch(directory / TIMING, evaluation, resumed=resumed is not None)
    if resumed is None:
        model = algorithm_class(env=env, device="cpu", **arguments)
    else:
        model, state = resumed
        evaluation.restore_checkpoint_state(state)
    model.set_logger(configure(str(directory / "tensorboard"), ["tensorboard"]))
    callbacks = [evaluation, checkpoints.callback(evaluation, every * spec.envs), stopwatch]
    left = spec.steps - model.num_timesteps
    model.learn(left, callback=callbacks, reset_num_timesteps=False, progress_bar=progress_bar)
    model.save(directory / MODEL)
    if holds_every_step(getattr(model, "replay_buffer", None)):
        sb3_gac.write_recording(model, directory / RECORDING)
    if isinstance(env, VecNormalize):
        env.save(str(directory / STATISTICS))
    stopwatch.write()
    return evaluation.history


def _run_program(spec: RunSpec, directory: Path, program: Program, configuration: dict[str, Any]) -> list[dict[str, float]]:
    """
    Start a program that trains in a process of its own, and wait for its end.

    :param spec: settings of the run
    :param directory: directory of the run
    :param program: the program
    :param configuration: settings and arguments to record
    :return: one row for each evaluation
    """
    resumed = bool(read_rows(directory))
    _write_configuration(directory / CONFIGURATION, configuration, resumed, {**code_of(spec), **program.versions()})
    return program.run(spec, directory)


def _evaluation_class(algorithm_class: type) -> type[sb3_gac.SeededEvalCallback]:
    """The class of the evaluation callback: where an algorithm has a guider, the guider is evaluated beside the learner."""
    return sb3_gac.GuiderLearnerEvalCallback if hasattr(algorithm_class, "predict_guider") else sb3_gac.SeededEvalCallback


def write_evaluations(history: list[dict[str, float]], path: Path) -> None:
    """
    Write the table of evaluations. It is written last and in one move, so that it exists if and only if the run is finished.

    :param history: one row for each evaluation
    :param path: CSV file to write
    """
    write_atomically(path, rows_as_text(history))


def main() -> None:
    """Entry point of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.run", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--suite", type=Path, required=True, help="YAML file of the suite")
    parser.add_argument("--index", type=int, required=True, help="which run of the suite, see launch --dry-run")
    parser.add_argument("--runs", type=Path, default=RUNS, help="directory of all runs (default: benchmarks/runs)")
    parser.add_argument(
        "--needed",
        nargs="+",
        default=[],
        metavar="ARGUMENT",
        help="not that run, but the one whose model it needs as this argument",
    )
    parser.add_argument(
        "--expect",
        nargs=2,
        metavar=("NAME", "FINGERPRINT"),
        help="what the run must be; launch gives it, because a suite may change meanwhile",
    )
    options = parser.parse_args()
    try:
        specs = read_suite(options.suite)
    except (ValueError, OSError) as error:
        sys.exit(str(error))
    if not 0 <= options.index < len(specs):
        if options.expect:
            sys.exit(_changed(options.suite, f"{options.expect[0]} was run {options.index}, and there are {len(specs)} now"))
        sys.exit(f"--index: {options.suite} has runs from 0 to {len(specs) - 1}, got {options.index}.")
    spec = specs[options.index]
    for argument in options.needed:
        needed = needed_runs(spec)
        if argument not in needed:
            named = f"it needs runs as {sorted(needed)}" if needed else "it needs no other run"
            sys.exit(f"--needed: {spec.algorithm} needs no run as {argument!r}; {named}.")
        spec = needed[argument]
    _refuse_another(spec, options.suite, options.expect)
    print(run(spec, options.runs, progress_bar=sys.stderr.isatty()))


def _refuse_another(spec: RunSpec, suite: Path, expected: tuple[str, str] | None) -> None:
    """End the process if this is another run than the one of this name and fingerprint."""
    if expected is None:
        return
    name, digits = expected
    if (found := name_of(spec)) != name:
        sys.exit(_changed(suite, f"in place of {name} it has {found} there"))
    if fingerprint(spec) != digits:
        sys.exit(_changed(suite, f"{name} has other settings or arguments now"))


def _changed(suite: Path, how: str) -> str:
    return f"{suite}, or a file that it names, has changed since the launch began: {how}. Launch the suite anew."


if __name__ == "__main__":
    main()
