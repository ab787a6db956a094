"""The directory of a run: its configuration, from which the run can be resumed, its checkpoints and its results."""

import json
import os
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from datetime import date, datetime
from inspect import isclass, isroutine
from pathlib import Path
from typing import Any

import yaml

from sb3_gac.algorithms import algorithm_class
from sb3_gac.checkpoint.files import checkpoints, step_of
from sb3_gac.checks.arguments import KEPT_AS, constructor_arguments
from sb3_gac.deploy.statistics import STATISTICS
from sb3_gac.envs import PARTIAL
from sb3_gac.envs.suites import SUITES, suite_of
from sb3_gac.stopping import command
from sb3_gac.training.evaluation import EVAL_SEED
from sb3_gac.training.options import DEFAULTS, name_of_run, noise_in_words, resolve
from sb3_gac.training.provenance import provenance

CONFIGURATION, CHECKPOINTS, RESULTS, MODEL = "config.yaml", "checkpoints", "results.json", "model"
_OPTIONS = (
    *("task", "env", "env_kwargs", "whole_state", "noise", "privileged", "history", "algorithm", "teacher", "preset"),
    *("overrides", "normalize", "steps", "seed", "envs", "compile", "episodes", "tensorboard", "runs"),
)
_REQUIRED = ("task", "steps", "seed", "environment")
_PATHS = ("runs", "teacher")
_YAML = (type(None), bool, int, float, str, bytes, date, datetime)  # beside lists, mappings and sets


def options_of(directory: Path) -> Namespace:
    """
    Read the options of a run that is to be resumed.

    :param directory: directory of a run that was stopped
    :return: options of the run, with the directory as ``resume``
    :raises ValueError: if the run is finished, or the directory is none of a run
    """
    check_unfinished(directory)
    configuration = _configuration(directory)
    given = {name: value for name, value in configuration.items() if name in _OPTIONS and value is not None}
    given = {name: value for name, value in given.items() if value != DEFAULTS.get(name)}
    given |= {name: Path(given[name]) for name in _PATHS if name in given}
    given.setdefault("history", 1)  # runs of earlier versions had no history
    if "env" in given:
        given.pop("task", None)
    try:
        made = dict(configuration["environment"]).get("kwargs") or {}
        if given.get("privileged") != made.get("privileged"):  # earlier versions wrote "state" whatever the task has
            given.pop("privileged", None)
        # A run of an earlier version has statistics of its own, and not its teacher's
        as_begun = {"resume": directory, "normalize": configuration.get("normalize", False)}
        return Namespace(**vars(resolve(given)) | as_begun)
    except (TypeError, ValueError) as error:
        raise ValueError(f"--resume {directory}: {CONFIGURATION}: {error}") from error


def check_unfinished(directory: Path) -> None:
    """
    :param directory: directory of a run that is to be resumed
    :raises ValueError: if the run is finished
    """
    if (directory / RESULTS).exists():
        raise ValueError(
            f"--resume {directory}: this run is finished, its results are in {RESULTS}. Its checkpoints are gone: train anew "
            "with more --steps; or go on in Python with an empty replay buffer: "
            f'GAC.load("{directory / MODEL}", env=env).learn(...), with the class of its algorithm.'
        )


def _configuration(directory: Path) -> Mapping[str, Any]:
    path = directory / CONFIGURATION
    if not path.is_file():
        raise ValueError(f"--resume {directory}: there is no {CONFIGURATION} in it, so it is no run's directory.")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"--resume {directory}: {CONFIGURATION} is no YAML: {error}") from None
    missing = [name for name in _REQUIRED if name not in content] if isinstance(content, Mapping) else _REQUIRED
    if missing:
        raise ValueError(
            f"--resume {directory}: this is no run of sb3_gac.train: its {CONFIGURATION} lacks {', '.join(missing)}. "
            "A run of the benchmarks goes on by the command that started it."
        )
    return content


def new_directory(options: Namespace) -> Path:
    """
    :param options: options of the run, see :func:`resolve`
    :return: path of a directory that does not exist yet
    """
    path: Path = options.runs / f"{name_of_run(options)}-{time.strftime('%Y%m%d-%H%M%S')}"
    others = (path.with_name(f"{path.name}-{number}") for number in range(2, 10_000))
    return path if not path.exists() else next(other for other in others if not other.exists())


def write_configuration(directory: Path, options: Namespace, model: Any) -> None:
    """
    Write down all that it takes to repeat a run: options, arguments, seeds, versions and commit.

    :param directory: directory of the run, which is made
    :param options: options of the run, see :func:`resolve`
    :param model: model that the run trains
    """
    suite = suite_of(options.env_id)
    simulators = ["gymnasium-robotics", *filter(None, [SUITES[suite].extra] if suite else [])]
    if suite is None:
        simulators.append(options.env_id.partition(":")[0].partition(".")[0])
    arguments = {name: getattr(model, KEPT_AS.get(name, name)) for name in constructor_arguments(type(model))}
    configuration = {
        **{name: _plain(getattr(options, name)) for name in _OPTIONS},
        "env_kwargs": _plain(_own_kwargs(options)),
        "eval_seed": EVAL_SEED,
        "environment": {"id": options.env_id, "kwargs": _plain(options.env_kwargs), "wrappers": options.wrappers},
        "arguments": _plain(arguments),
        "device": str(model.device),
        **provenance(simulators),
    }
    directory.mkdir(parents=True)  # and fails if another run has taken the name meanwhile
    write_at_once(directory / CONFIGURATION, yaml.safe_dump(configuration, sort_keys=False))


def _own_kwargs(options: Namespace) -> dict[str, Any]:
    """The environment's keyword arguments that are no options of the main job."""
    own = () if options.task is None else ("noise_std", "privileged", "history")
    return {name: value for name, value in options.env_kwargs.items() if name not in own}


def _plain(value: Any) -> Any:
    """The value in the types of YAML; other types as text."""
    if isinstance(value, Mapping):
        return {key if type(key) in _YAML else str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return [_plain(getattr(part, "value", part)) for part in value]
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isclass(value) or isroutine(value):
        return f"{value.__module__}.{value.__qualname__}"
    return value if isinstance(value, _YAML) or type(value) is set else str(value)


def write_at_once(path: Path, text: str) -> None:
    """
    Write a file in one piece: if the process ends meanwhile, the file has either its old or its new content.

    :param path: path of the file
    :param text: new content of the file
    """
    temporary = path.with_name(f"{path.name}.tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def how_to_go_on(directory: Path, steps: int) -> str:
    """
    The message for a run that was stopped.

    :param directory: directory of the run
    :param steps: number of environment steps of the whole run
    :return: number of saved steps and the command that resumes the run, in one line
    """
    if (directory / RESULTS).exists():
        return f"The run is finished; its results are in {directory}."
    found = checkpoints(directory / CHECKPOINTS)
    done = f"{min(step_of(found[0]), steps) if found else 0:,} of {steps:,} steps"
    return f"Stopped; {done} are saved. To go on: {command('--resume', str(directory))}"


def summary(directory: Path, options: Namespace, entries: Sequence[str] = (PARTIAL,), remembers: bool = False) -> str:
    """
    The message at the end of a run.

    :param directory: directory of the finished run
    :param options: options of the run, see :func:`resolve`
    :param entries: entries that the learner reads
    :param remembers: whether the learner has a memory, whose state goes from one action to the next
    :return: text with the results, and how to use the learner
    """
    results = json.loads((directory / RESULTS).read_text(encoding="utf-8"))
    name = algorithm_class(options.algorithm).__name__
    learner = f"{shown(results['learner'])} +- {shown(results['learner_std'])}"
    untrained = ", ".join(f"{name} {shown(mean)} +- {shown(std)}" for name, (mean, std) in results["untrained"].items())
    return f"""
Trained {name} on {in_words(options)} for {results["steps"]:,} steps in {results["minutes"]:.1f} minutes.
Learner, seeing {" and ".join(f"`{key}`" for key in entries)} alone: return {learner} over {options.episodes} episodes.
Without training, same seeds: {untrained}.
Saved in {directory}: model.zip, learning_curve.png, results.json, config.yaml. To use the learner:
{_how_to_use(directory, name, entries, remembers)}"""


def _how_to_use(directory: Path, name: str, entries: Sequence[str], remembers: bool) -> str:
    """Lines of Python that act with the learner, on observations as the environment returns them."""
    shown_to_it = ", ".join(f'"{key}": {"observation" if len(entries) == 1 else f"observation[{key!r}]"}' for key in entries)
    lines = [f'from sb3_gac import {name}; model = {name}.load("{directory / MODEL}")']
    observation, statistics = f"{{{shown_to_it}}}", directory / STATISTICS
    if statistics.exists():
        lines += [
            "import pickle; from sb3_gac import DeploymentNormalizer",
            f'statistics = pickle.load(open("{statistics}", "rb"))',
            f"normalize = DeploymentNormalizer.from_vec_normalize(statistics, {list(entries)})",
        ]
        observation = f"normalize({observation})"
    if remembers:
        lines += [
            "state, start = None, [True]  # once; later the state is that of the last action",
            f"action, state = model.predict({observation}, state, start, deterministic=True)",
            "start = [False]  # [True] before the first action of the next episode",
        ]
    else:
        lines.append(f"action, _ = model.predict({observation}, deterministic=True)")
    return "\n".join(f"    {line}" for line in lines)


def in_words(options: Namespace) -> str:
    """
    :param options: options of the run, see :func:`resolve`
    :return: text with the environment's id, and its noise and history if it has them
    """
    noise = "" if options.noise is None else f"noise {noise_in_words(options.noise).lstrip()}"
    history = "" if options.history == 1 else f"history {options.history}"
    details = ", ".join(filter(None, [noise, history]))
    return f"{options.env_id} ({details})" if details else str(options.env_id)


def shown(value: float) -> str:
    """
    :param value: a number, such as a return
    :return: the number as text, rounded to an integer from 100 on, else to three significant digits
    """
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
