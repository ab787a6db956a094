"""The main job: train a model, evaluate the learner on what it reads alone, and save the results."""

import json
import shutil
import time
import warnings
from argparse import Namespace
from contextlib import AbstractContextManager, ExitStack, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

from gymnasium.error import Error as GymnasiumError
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common import utils
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, sync_envs_normalization

from sb3_gac import ExactCheckpointCallback, GuiderLearnerEvalCallback, SeededEvalCallback
from sb3_gac.algorithms import algorithm_class
from sb3_gac.checkpoint.files import checkpoints
from sb3_gac.checkpoint.lock import InUseError, locked
from sb3_gac.deploy.statistics import STATISTICS
from sb3_gac.envs.suites import suite_of
from sb3_gac.presets import PRESETS
from sb3_gac.stopping import when_stopped_say
from sb3_gac.training.curve import draw_learning_curve
from sb3_gac.training.directory import (
    CHECKPOINTS,
    CONFIGURATION,
    MODEL,
    RESULTS,
    check_unfinished,
    how_to_go_on,
    in_words,
    new_directory,
    write_at_once,
    write_configuration,
)
from sb3_gac.training.environments import check_split, entries_of_floats, find_modules_here, make_envs, normalized
from sb3_gac.training.evaluation import EVAL_SEED, DeployedView, EndlessEpisodesWarning, evaluate, untrained_policies
from sb3_gac.training.options import EPISODES_ON_THE_WAY, TEACHER, algorithm_arguments, check_steps
from sb3_gac.training.progress import Progress

EVALUATIONS = 10


class Job(NamedTuple):
    """
    A run that is ready to train.

    :param options: options of the run, see :func:`sb3_gac.training.options.resolve`
    :param directory: directory that everything is saved in
    :param model: model to train, new or from its last checkpoint
    :param eval_env: vectorised environments to evaluate in
    :param alone: context in which no other process makes the run
    """

    options: Namespace
    directory: Path
    model: Any
    eval_env: VecEnv
    alone: AbstractContextManager[Any] = nullcontext()


def prepare(options: Namespace) -> Job:
    """
    Make the environments and the model, and a directory with the configuration.

    :param options: options of the run, see :func:`sb3_gac.training.options.resolve`
    :return: run that is ready to train
    :raises ValueError: if the environment or an argument is wrong, or another process makes the run; then nothing was written
    """
    _check_log(options)
    set_random_seed(options.seed)
    env, eval_env = open_environments(options)
    if options.task is None and "role_keys" not in options.overrides:
        check_split(options.env_id, env.observation_space)
    with ExitStack() as held:
        begin = _begun if options.resume is None else _taken_up
        directory, model, goes_on = begin(options, env, held)
        when_stopped_say(lambda: how_to_go_on(directory, options.steps))
        name = type(model).__name__
        begins = f"Going on after {model.num_timesteps:,} of" if goes_on else "Training for"
        print(f"{begins} {options.steps:,} steps: {name} on {in_words(options)}. Ctrl-C stops, and says how to go on.")
        print(f"All of it is in {directory}", flush=True)
        return Job(options, directory, model, eval_env, held.pop_all())


def _check_log(options: Namespace) -> None:
    if options.tensorboard and getattr(utils, "SummaryWriter", None) is None:  # SB3 says so only when training starts
        raise ValueError("--tensorboard: TensorBoard is not installed: pip install tensorboard.")


def _begun(options: Namespace, env: VecEnv, held: ExitStack) -> tuple[Path, Any, bool]:
    """Directory and model of a new run, which the context keeps for this process."""
    directory = new_directory(options)
    model = _new(options, directory, env)
    check_steps(type(model).__name__, options.steps, getattr(model, "learning_starts", 0))
    write_configuration(directory, options, model)
    held.enter_context(locked(directory, CONFIGURATION))
    return directory, model, False


def _taken_up(options: Namespace, env: VecEnv, held: ExitStack) -> tuple[Path, Any, bool]:
    """Directory and model of a run that was stopped, which the context keeps, and whether the run has a checkpoint."""
    directory = options.resume
    try:
        held.enter_context(locked(directory, CONFIGURATION))
    except InUseError as error:
        raise ValueError(f"--resume: {error} Wait until that process has ended, or stop it.") from None
    check_unfinished(directory)  # again, for another process may have finished the run since the options were read
    goes_on = bool(checkpoints(directory / CHECKPOINTS))
    return directory, _resumed(options, directory, env) if goes_on else _new(options, directory, env), goes_on


def run(job: Job) -> None:
    """
    Train to the end, evaluate, and save the results.

    :param job: run that is ready to train, new or resumed
    """
    with job.alone:
        history, minutes = learn(job)
        finish(job, history, minutes)


def open_environments(options: Namespace) -> tuple[VecEnv, VecEnv]:
    """
    Make the environments of a run.

    :param options: options of the run, see :func:`sb3_gac.training.options.resolve`
    :return: vectorised environments to train in, and to evaluate in
    :raises ValueError: if an environment or wrapper can't be made; the message names the environment
    """
    find_modules_here()
    made = (options.env_id, options.env_kwargs, options.wrappers)
    try:
        env = make_envs(*made, options.envs, options.seed)
        eval_env = make_envs(*made, min(EPISODES_ON_THE_WAY, options.episodes))
        normalization = PRESETS[options.preset].normalization(options.algorithm)
        teacher = options.teacher if options.normalize == TEACHER else None
        if normalization is None and options.normalize is True:
            normalization = {"norm_obs_keys": entries_of_floats(env)}
        return (
            normalized(env, normalization, teacher=teacher),
            normalized(eval_env, normalization, training=False, teacher=teacher),
        )
    except (ImportError, GymnasiumError, TypeError, ValueError) as error:
        raise ValueError(f"{options.env_id}: {error}") from error


def _new(options: Namespace, directory: Path, env: VecEnv) -> Any:
    kind: Any = algorithm_class(options.algorithm)
    log = str(directory / "tensorboard") if options.tensorboard else None
    arguments = {"policy": "MultiInputPolicy", "tensorboard_log": log, **algorithm_arguments(options)}
    return kind(env=env, seed=options.seed, **arguments)


def _resumed(options: Namespace, directory: Path, env: VecEnv) -> Any:
    kind: Any = algorithm_class(options.algorithm)
    return kind.resume(directory / CHECKPOINTS, env)


def learn(job: Job) -> tuple[list[dict[str, float]], float]:
    """
    Train to the end. Checkpoints are written at the start, at every evaluation, at the end, and when Ctrl-C is pressed.

    :param job: run that is ready to train
    :return: results of the evaluations, and duration of training in minutes, earlier processes of the same run included
    """
    options, directory, model, eval_env, _ = job
    every = max(options.steps // EVALUATIONS // options.envs, 1)
    evaluation = _evaluation_class(model)(
        eval_env, eval_seed=EVAL_SEED, eval_freq=every, n_eval_episodes=eval_env.num_envs, verbose=0
    )
    started, before, resumed = time.time(), 0.0, model.resumed_notes is not None
    if resumed:
        before = model.resumed_notes["minutes"]
        evaluation.restore_checkpoint_state(model.resumed_notes)
        evaluation.n_calls = model.num_timesteps // options.envs  # evaluations are counted from the run's start
    left = model.steps_left if resumed else options.steps

    def notes() -> dict[str, Any]:
        return {**evaluation.checkpoint_state(), "minutes": before + (time.time() - started) / 60}

    if left > 0:
        root = directory / CHECKPOINTS
        checkpoint = ExactCheckpointCallback(root, every * options.envs, notes=notes, at_start=not resumed)
        endless = [EndlessEpisodesWarning(options.env_id, every)] if _has_no_time_limit(options, model.get_env()) else []
        callbacks = [*endless, evaluation, checkpoint, Progress(evaluation, options.steps)]
        model.learn(left, callback=callbacks, reset_num_timesteps=not resumed)
        _save_checkpoint(model, root, notes())
    final = notes()
    return final["history"], final["minutes"]


def _has_no_time_limit(options: Namespace, env: VecEnv) -> bool:
    """Whether the environment is none of this package's, and in no wrapper that ends its episodes."""
    return suite_of(options.env_id) is None and not any(env.env_is_wrapped(TimeLimit))


def _evaluation_class(model: Any) -> type[SeededEvalCallback]:
    return GuiderLearnerEvalCallback if hasattr(model, "predict_guider") else SeededEvalCallback


def _save_checkpoint(model: Any, root: Path, notes: dict[str, Any]) -> None:
    """Write the checkpoint of the end of training, since the evaluation that follows can be stopped as well."""
    try:
        model.save_checkpoint(root, notes=notes)
    except OSError as error:
        warnings.warn(f"The checkpoint at the end of training could not be written: {error}", stacklevel=2)


def finish(job: Job, history: list[dict[str, float]], minutes: float) -> None:
    """
    Save the model, evaluate it, write the results, and delete the checkpoints; then the run can't be resumed any more.

    :param job: run whose model is trained
    :param history: results of the evaluations during training
    :param minutes: duration of training, in minutes
    """
    options, directory, model, eval_env, _ = job
    if isinstance(eval_env, VecNormalize):
        of_training = model.get_vec_normalize_env()
        of_training.save(str(directory / STATISTICS))
        sync_envs_normalization(of_training, eval_env)
    _save(model, directory / f"{MODEL}.zip")
    learner, learner_std = evaluate(DeployedView(model), eval_env, options.episodes)
    untrained = {name: evaluate(policy, eval_env, options.episodes) for name, policy in untrained_policies(eval_env).items()}
    warm_up = getattr(model, "learning_starts", 0)
    title, seen = _title(options, model), " and ".join(model.policy.deployed_entries)
    draw_learning_curve(history, title, directory / "learning_curve.png", untrained, warm_up, seen)
    results = {
        "learner": learner,
        "learner_std": learner_std,
        "untrained": untrained,
        "steps": model.num_timesteps,
        "minutes": minutes,
        "compiled": model.compiles,
        "history": history,
    }
    write_at_once(directory / RESULTS, json.dumps(results, indent=1))
    shutil.rmtree(directory / CHECKPOINTS)


def _save(model: Any, path: Path) -> None:
    """Save the model in one move, since other programs take a run that has the file for finished."""
    whole = path.with_suffix(".tmp")
    model.save(whole)
    whole.replace(path)


def _title(options: Namespace, model: Any) -> str:
    return f"{type(model).__name__} on {in_words(options)}"
