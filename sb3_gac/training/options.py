"""Options of the main job: the parser of the command line, and the values of options that it leaves out."""

import argparse
import re
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_gac.algorithms import ALGORITHMS, algorithm_class
from sb3_gac.base.loading import model_file
from sb3_gac.checks.arguments import constructor_parameters
from sb3_gac.command_line import Parser, mapping, one_of, positive
from sb3_gac.deploy.statistics import STATISTICS
from sb3_gac.envs.suites import SUITES, Suite, env_id_of, registered_id, suite_of, task_of
from sb3_gac.presets import PRESETS, instantiate, merge, preset, read_preset

#: Number of noisy observations that the learner sees: on HalfCheetah, 50,000 steps, it returned 3766 with four, 3432 with one
HISTORY = 4
#: Default values of the options that do not depend on others
DEFAULTS: Mapping[str, Any] = {
    "task": "HalfCheetah",
    "env_kwargs": {},
    "whole_state": False,
    "algorithm": "gac",
    "overrides": {},
    "normalize": False,
    "steps": 50_000,
    "seed": 0,
    "compile": "auto",
    "episodes": 10,
    "tensorboard": False,
    "runs": Path("runs"),
}
#: Most episodes of an evaluation on the way, side by side: enough for a curve
EPISODES_ON_THE_WAY = 5
#: Name of the argument by which algorithms take a teacher
TEACHER = "teacher"
#: Argument of an algorithm -> option of the main job that sets it
_OWN_OPTIONS = {"env": "--env", "seed": "--seed", "tensorboard_log": "--tensorboard", TEACHER: "--teacher"}
_COMPILE = {"auto": "auto", "yes": True, "no": False}
#: Argument of this package's environments -> option of the main job
_OF_TASKS = {"noise_std": "noise", "privileged": "privileged", "history": "history"}


def make_parser(description: str | None = None) -> argparse.ArgumentParser:
    """
    :param description: description of the program, for its help
    :return: parser of the command line, which sets options that are not given to ``None``
    """
    parser = Parser("sb3_gac.train", description)
    _add_environment(parser.add_argument_group("what to train on"))
    _add_training(parser.add_argument_group("how to train"))
    _add_results(parser.add_argument_group("what is left of it"))
    return parser


def _add_environment(group: Any) -> None:
    tasks = sorted(task_of(env_id) for suite in SUITES.values() if suite.sensor_noise for env_id in suite.environments)
    group.add_argument(
        "--task",
        type=one_of(tasks, "sb3-gac envs lists the tasks. Every other environment goes by --env."),
        metavar="TASK",
        help=f"registered task that takes --noise, one of {', '.join(tasks)}; other registered tasks go by --env, and "
        f"sb3-gac envs lists them (default: {DEFAULTS['task']})",
    )
    group.add_argument(
        "--env",
        help="another environment, with Dict(partial, privileged) observations: a registered id; my_module:MyEnv-v0, whose "
        "module registers it; or my_module:make_env, a class or function that makes one",
    )
    group.add_argument(
        "--env-kwargs", type=mapping, metavar="YAML", help='its arguments, such as "{mass: 2.0}" (default: none)'
    )
    group.add_argument(
        "--whole-state",
        action="store_true",
        default=None,
        help="for an --env of your own: privileged has all that partial shows, without noise, so critics read privileged "
        "alone (default: critics read both entries). Registered tasks do not take it, since this is known of them",
    )
    group.add_argument(
        "--noise",
        type=float,
        help="standard deviation of a task's sensor noise, in the units of partial (default: 0.1, or 0 where sensors have "
        "their own)",
    )
    group.add_argument(
        "--privileged",
        choices=sorted({value for suite in SUITES.values() for value in suite.privileged}),
        help="what a task's privileged entry shows: state or velocity; where sensors are missing rather than noisy, hidden or "
        "state (default: the first of the two)",
    )
    group.add_argument(
        "--history",
        type=positive,
        help=f"observations that the learner sees, with the actions between (default: {HISTORY} where a task's sensors are "
        "noisy, else 1)",
    )


def _add_training(group: Any) -> None:
    group.add_argument(
        "--algorithm",
        type=one_of(list(ALGORITHMS)),
        metavar="NAME",
        help=f"one of {', '.join(ALGORITHMS)} (default: {DEFAULTS['algorithm']})",
    )
    group.add_argument(
        "--teacher", type=Path, metavar="MODEL", help="model.zip of another run, for algorithms that have a teacher"
    )
    group.add_argument(
        "--steps", type=positive, help=f"environment steps, of all environments together (default: {DEFAULTS['steps']})"
    )
    group.add_argument("--seed", type=int, help=f"seed of everything random (default: {DEFAULTS['seed']})")
    group.add_argument("--envs", type=positive, help="environments side by side (default: as many as the preset is for)")
    group.add_argument(
        "--preset",
        type=one_of(sorted(PRESETS)),
        metavar="NAME",
        help=f"arguments of the algorithm: {', '.join(sorted(PRESETS))} (default: those for the task's suite, or small)",
    )
    group.add_argument(
        "--overrides",
        type=mapping,
        metavar="YAML",
        help='changes to the preset, such as "{gamma: 0.95, learning_rate: 1e-3}" (default: none)',
    )
    group.add_argument(
        "--normalize",
        action="store_true",
        default=None,
        help="bring each number of the observations to mean 0 and standard deviation 1, by SB3's VecNormalize, whose "
        "statistics are saved beside the model (default: as the preset does; paper-brax alone does)",
    )
    group.add_argument(
        "--compile",
        nargs="?",
        const="yes",
        choices=list(_COMPILE),
        help="faster gradient steps after half a minute (default: auto, where there is a C++ compiler and the run is long)",
    )


def _add_results(group: Any) -> None:
    group.add_argument(
        "--episodes",
        type=positive,
        help=f"of the last evaluation (default: {DEFAULTS['episodes']}); those on the way have {EPISODES_ON_THE_WAY}",
    )
    group.add_argument(
        "--tensorboard",
        action="store_true",
        default=None,
        help="log for TensorBoard in the run's directory, which needs pip install tensorboard (default: no)",
    )
    group.add_argument("--runs", type=Path, help=f"where runs have their directories (default: {DEFAULTS['runs']})")
    group.add_argument(
        "--resume", type=Path, metavar="DIRECTORY", help="of a run that was stopped, to go on with it and its options"
    )


def given_options(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> dict[str, Any]:
    """
    :param parser: parser from :func:`make_parser`
    :param arguments: words of the command line; ``None`` for those of the process
    :return: name -> value, for the options that were given
    """
    given = {name: value for name, value in vars(parser.parse_args(arguments)).items() if value is not None}
    return given | ({"compile": _COMPILE[given["compile"]]} if "compile" in given else {})


def resolve(given: Mapping[str, Any]) -> Namespace:
    """
    Complete and check the options.

    :param given: name -> value, for the options that were given
    :return: all options, with ``env_id``, ``env_kwargs`` and ``wrappers``, from which the environment is made
    :raises ValueError: if an option does not go with the others; the message names the option
    """
    if "task" in given and "env" in given:
        raise ValueError("--task and --env: give one of them.")
    open_ones = dict.fromkeys(("env", "noise", "privileged", "history", "envs", "preset", "teacher"))
    options = Namespace(**{**open_ones, **DEFAULTS, **given})
    options.env_id = env_id_of(options.task) if options.env is None else registered_id(options.env)
    suite = suite_of(options.env_id)
    if suite is None:
        _resolve_own(options, given)
    else:
        _resolve_task(options, given, SUITES[suite])
    options.envs = options.envs or read_preset(options.preset).envs
    _check_teacher(options)
    if options.teacher is not None and (options.teacher.parent / STATISTICS).is_file():
        options.normalize = TEACHER
    _check_overrides(options.overrides)
    _check_runs(options.runs)
    return options


def _resolve_task(options: Namespace, given: Mapping[str, Any], suite: Suite) -> None:
    _refuse(options, given, ("whole_state",), f"whether privileged is the whole state of {options.env_id} is known")
    options.task = task_of(options.env_id)
    own = {option: options.env_kwargs[name] for name, option in _OF_TASKS.items() if name in options.env_kwargs}
    for option, value in own.items():
        if given.get(option, value) != value:
            raise ValueError(f"--env-kwargs and --{option} say different things: give one of them.")
        setattr(options, option, value)
    if not suite.sensor_noise:
        _refuse(options, given, ("noise",), f"{options.env_id} has no such argument")
    elif options.noise is None:
        options.noise = suite.noise_std
    if not suite.privileged:
        _refuse(options, given, ("privileged",), f"{options.env_id} has no such argument")
    elif options.privileged is None:
        options.privileged = suite.privileged[0]
    elif options.privileged not in suite.privileged:
        raise ValueError(f"--privileged: {options.env_id} has {' or '.join(suite.privileged)}, got {options.privileged}.")
    _check_noise(options.noise)
    options.preset = options.preset or suite.preset
    if options.history is None:
        options.history = HISTORY if suite.history and np.max(options.noise or 0.0) > 0 else 1
    if options.history != 1 and not suite.history:
        raise ValueError(f"--history: {options.task} takes none.")
    options.wrappers = []
    options.env_kwargs = {
        **({"noise_std": options.noise} if suite.sensor_noise else {}),
        **({"privileged": options.privileged} if options.privileged not in (None, *suite.privileged[:1]) else {}),
        **({"history": options.history} if options.history != 1 else {}),
        **options.env_kwargs,
    }


def _check_noise(noise: Any) -> None:
    components = noise if isinstance(noise, list) and noise else [noise]
    if noise is not None and not all(isinstance(part, int | float) and not isinstance(part, bool) for part in components):
        raise ValueError(f"--env-kwargs: noise_std must be a number, or a list of one for each component, got {noise!r}.")


def noise_in_words(noise: float | Sequence[float]) -> str:
    """
    :param noise: standard deviation of the sensor noise: a number, or one for each component
    :return: the noise as a short text
    """
    return " by component" if isinstance(noise, Sequence) else f"{noise:g}"


def _resolve_own(options: Namespace, given: Mapping[str, Any]) -> None:
    _refuse(options, given, ("noise", "privileged"), "an environment of one's own has its arguments in --env-kwargs")
    options.task = None
    options.preset = options.preset or "small"
    options.history = options.history or 1
    options.wrappers = (
        [] if options.history == 1 else [{"sb3_gac.training.environments:with_history": {"length": options.history}}]
    )


def _refuse(options: Namespace, given: Mapping[str, Any], names: Sequence[str], why: str) -> None:
    for name in names:
        if given.get(name) is not None:
            raise ValueError(f"--{name.replace('_', '-')}: {why}.")
        setattr(options, name, DEFAULTS.get(name))


def _check_teacher(options: Namespace) -> None:
    kind: Any = algorithm_class(options.algorithm)
    has_one = TEACHER in kind.frozen_arguments
    if options.teacher is None and has_one:
        raise ValueError(
            f"--algorithm {options.algorithm}: {kind.__name__} learns from a teacher, a model that was trained before. "
            "Train one, such as with --algorithm gac, and give --teacher runs/<its directory>/model.zip."
        )
    if options.teacher is not None and not has_one:
        raise ValueError(f"--teacher: {kind.__name__} has none.")
    if options.teacher is not None:
        try:
            options.teacher = model_file(options.teacher).absolute()  # the run may be resumed in another folder
        except FileNotFoundError as error:
            raise ValueError(f"--teacher: {error}") from None


def _check_overrides(overrides: Mapping[str, Any]) -> None:
    for name in overrides:
        if not isinstance(name, str):
            raise ValueError(f"--overrides: must have names of arguments as keys, got {name!r}.")
        if name in _OWN_OPTIONS:
            raise ValueError(f"--overrides: {name} is no argument of the preset: leave it out, and give {_OWN_OPTIONS[name]}.")


def _check_runs(runs: Path) -> None:
    there = next(path for path in (runs, *runs.absolute().parents) if path.exists())
    if not there.is_dir():
        raise ValueError(f"--runs: {there} is a file: give a directory.")


def algorithm_arguments(options: Namespace) -> dict[str, Any]:
    """
    :param options: options of the run, see :func:`resolve`
    :return: keyword arguments of the algorithm: the preset's for the task and its noise, below those of the command line; a
        noise for each component counts as its mean
    """
    kind: Any = algorithm_class(options.algorithm)
    own: dict[str, Any] = {"compile": options.compile}
    if "buffer_size" in constructor_parameters(kind):
        own["buffer_size"] = min(1_000_000, max(options.steps, 1_000))
    if options.teacher is not None:
        own[TEACHER] = str(options.teacher)
    if not (options.task or options.whole_state):  # without the whole state in one entry, critics need all entries
        own["role_keys"] = None
    task = {"task": options.task, "privileged": options.privileged} if options.task else {}
    of_preset = preset(options.preset, algorithm=kind, noise=float(np.mean(options.noise or 0.0)), **task)
    return instantiate(merge(of_preset, merge(own, options.overrides)))


def check_steps(name: str, steps: int, learning_starts: int) -> None:
    """
    Refuse a run that would end before the first gradient step: its results would be those of a policy without training.

    :param name: name of the algorithm
    :param steps: number of environment steps of the run
    :param learning_starts: number of environment steps after which gradient steps begin
    :raises ValueError: if the run has no step after these
    """
    if steps <= learning_starts:
        raise ValueError(
            f"--steps: {name} makes its first gradient step after {learning_starts:,} steps (learning_starts), so in "
            f'{steps:,} steps nothing is learned: give more --steps, or --overrides "{{learning_starts: ...}}".'
        )


def name_of_run(options: Namespace) -> str:
    """
    :param options: options of the run, see :func:`resolve`
    :return: name of the run's directory, without the time
    """
    environment = options.task or re.sub(r"[^\w.+-]", "-", re.split("[:/]", options.env_id)[-1])
    parts = [
        "" if options.algorithm == DEFAULTS["algorithm"] else options.algorithm,
        environment,
        "" if options.noise is None else f"noise{noise_in_words(options.noise)}".replace(" ", "-"),
        "" if options.history == 1 else f"history{options.history}",
        f"seed{options.seed}",
    ]
    return "-".join(filter(None, parts))
