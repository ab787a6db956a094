"""The program behind :mod:`sb3_gac.compare`: it makes a suite of one task from its options, the suite's runs, and a page."""

import argparse
import json
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from stable_baselines3.common.evaluation import evaluate_policy

from benchmarks import aggregate, launch
from benchmarks.advice import counted, findings, recommendation
from benchmarks.checkpoint import write_atomically
from benchmarks.comparison_page import page
from benchmarks.config import (
    check_programs,
    check_runs,
    check_simulators,
    first_gradient_step,
    read_algorithm,
    reads_partial_alone,
)
from benchmarks.environments import EVAL_SEED, environment, make_envs
from benchmarks.external import Program
from benchmarks.headroom import ASYMMETRIC, FULL, GUIDED, PARTIAL, worth
from benchmarks.own_code import about_changed_code, code_of
from benchmarks.run import check_unfinished
from benchmarks.suite import NAME, RunSpec, cells_of, default_name, read_definitions
from benchmarks.tidy import file_of, read_tidy
from benchmarks.yaml_checks import check_is
from sb3_gac.base.compiling import AUTO
from sb3_gac.checkpoint.lock import InUseError, locked
from sb3_gac.checks.arguments import constructor_parameters
from sb3_gac.command_line import Parser, from_yaml, mapping, one_of, positive
from sb3_gac.envs.goals import DESIRED_GOAL
from sb3_gac.envs.suites import SUITES, suite_of, task_of
from sb3_gac.optim.compile import PAYS_FROM
from sb3_gac.presets import PRESETS, read_preset
from sb3_gac.training.environments import check_split
from sb3_gac.training.evaluation import untrained_policies
from sb3_gac.training.options import check_steps

ALGORITHMS = (FULL, ASYMMETRIC, GUIDED, PARTIAL)
EVALUATIONS, UNTRAINED_EPISODES = 20, 30
SUITE = "suite.yml"
_OF_TASKS = {"noise_std", "history"}


def parse_arguments(description: str | None, arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """
    :param description: text that ``--help`` shows above the options
    :param arguments: command-line arguments, by default those of the process
    :return: options of the comparison
    """
    parser = Parser("sb3_gac.compare", description)
    known = sorted(read_definitions())
    parser.add_argument(
        "--env", required=True, help="an id, my_module:MyEnv-v0, or my_module:make_env, a class or function that makes one"
    )
    parser.add_argument("--env-kwargs", type=mapping, default={}, metavar="YAML", help='such as "{noise_std: 0.1}"')
    parser.add_argument(
        "--wrappers",
        nargs="+",
        type=from_yaml,
        default=[],
        metavar="MODULE:CLASS",
        help='around it, from the inside to the outside; with arguments as in "sb3_gac.envs:History: {length: 4}"',
    )
    parser.add_argument(
        "--whole-state",
        action="store_true",
        help="the privileged entry has all that partial shows: critics then see it alone, and no sensor noise",
    )
    parser.add_argument(
        "--algorithms", nargs="+", default=ALGORITHMS, type=one_of(known), metavar="NAME", help=f"of {', '.join(known)}"
    )
    parser.add_argument("--seeds", type=positive, default=5, help="runs of each algorithm (default: 5)")
    parser.add_argument("--steps", type=positive, default=20_000, help="of each run (default: 20000)")
    parser.add_argument("--eval-episodes", type=positive, default=10, help="of each evaluation (default: 10)")
    parser.add_argument(
        "--preset", type=one_of(sorted(PRESETS)), metavar="NAME", help=f"of {', '.join(sorted(PRESETS))} (default: small)"
    )
    parser.add_argument("--overrides", type=mapping, default={}, metavar="YAML", help='of the preset, such as "{gamma: 0.95}"')
    parser.add_argument("--jobs", type=positive, help="runs side by side (default: one on each CPU)")
    parser.add_argument("--ray", nargs="?", const="auto", metavar="ADDRESS", help="run on a Ray cluster instead")
    parser.add_argument("--out", type=Path, help="directory of everything (default: comparisons/<environment>)")
    options = parser.parse_args(arguments)
    options.out = (options.out or Path("comparisons") / default_name(options.env).replace(":", "-")).resolve()
    return options


def suite_of_options(options: argparse.Namespace) -> dict[str, Any]:
    """
    :param options: options of the comparison, see :func:`parse_arguments`
    :return: content of the suite's YAML file
    """
    runs = {"algorithms": list(options.algorithms), "seeds": list(range(options.seeds))}
    cell = _registered(options) or _own(options)
    preset = read_preset(options.preset or _preset_for(options.env))
    overrides = dict(options.overrides)
    if "env" in cell and not options.whole_state:
        overrides = {"role_keys": None, **overrides}
    if "compile" not in overrides and options.steps >= PAYS_FROM and all(map(_takes_compile, options.algorithms)):
        overrides["compile"] = AUTO  # overrides tell runs apart, so they must not depend on this machine's compiler
    return {
        "steps": options.steps,
        "envs": preset.envs,
        "preset": preset.name,
        "eval_every": max(options.steps // EVALUATIONS // preset.envs, 1) * preset.envs,
        "eval_episodes": options.eval_episodes,
        "overrides": overrides,
        "cells": [cell | runs],
    }


def _takes_compile(algorithm: str) -> bool:
    """Whether an algorithm's overrides may have ``compile``: SB3's own algorithms refuse it, and programs get no overrides."""
    kind, _ = read_algorithm(algorithm)
    return issubclass(kind, Program) or "compile" in constructor_parameters(kind)


def _registered(options: argparse.Namespace) -> dict[str, Any] | None:
    """The cell of a registered task; ``None`` for any other environment, or one with wrappers or other arguments."""
    suite = suite_of(options.env)
    if suite is None or options.wrappers or set(options.env_kwargs) - _OF_TASKS:
        return None
    given = options.env_kwargs.get("history", 1)
    history = {} if given == 1 else {"history": given}  # a suite leaves out a history of the newest observation alone
    default = SUITES[suite].noise_std if SUITES[suite].sensor_noise else 0.0
    return {"task": task_of(options.env), "noises": [options.env_kwargs.get("noise_std", default)], **history}


def _own(options: argparse.Namespace) -> dict[str, Any]:
    name = default_name(options.env)
    check_is("--env", name, "an id or module:name whose name has letters, digits and . + - alone", str, NAME.fullmatch)
    return {"env": options.env, "env_kwargs": options.env_kwargs, "wrappers": options.wrappers, "name": name}


def _preset_for(env_id: str) -> str:
    suite = suite_of(env_id)
    return "small" if suite is None else SUITES[suite].preset


def write_suite(options: argparse.Namespace) -> Path:
    """
    :param options: options of the comparison, see :func:`parse_arguments`
    :return: path of the suite's file
    """
    options.out.mkdir(parents=True, exist_ok=True)
    path: Path = options.out / SUITE
    write_atomically(path, f"# {command(options)}\n{_as_yaml(options)}")
    return path


def _as_yaml(options: argparse.Namespace) -> str:
    return yaml.safe_dump(suite_of_options(options), sort_keys=False)


def command(options: argparse.Namespace) -> str:
    """
    :param options: options of the comparison, see :func:`parse_arguments`
    :return: shell command that makes the same comparison again
    """
    given = {
        "--env": [options.env],
        "--env-kwargs": [_flow(options.env_kwargs)] if options.env_kwargs else [],
        "--wrappers": [_wrapper(wrapper) for wrapper in options.wrappers],
        "--algorithms": options.algorithms if tuple(options.algorithms) != ALGORITHMS else [],
        "--seeds": [options.seeds],
        "--steps": [options.steps],
        "--eval-episodes": [options.eval_episodes],
        "--preset": [options.preset] if options.preset else [],
        "--overrides": [_flow(options.overrides)] if options.overrides else [],
    }
    words = [str(word) for name, values in given.items() if values for word in (name, *values)]
    return shlex.join(["python", "-m", "sb3_gac.compare", *words, *(["--whole-state"] * options.whole_state)])


def _wrapper(wrapper: Any) -> str:
    """The text of a wrapper as a person would type it: without braces and quotes around a name and its arguments."""
    if isinstance(wrapper, Mapping) and len(wrapper) == 1:
        ((name, arguments),) = wrapper.items()
        return f"{name}: {_flow(arguments)}"
    return wrapper if isinstance(wrapper, str) else _flow(wrapper)


def _flow(values: Any) -> str:
    given = dict(values) if isinstance(values, Mapping) else values  # the suite's check says what is wrong with others
    text = yaml.safe_dump(given, default_flow_style=True, sort_keys=False, width=10_000)
    return text.strip().removesuffix("...").strip()


def run(options: argparse.Namespace) -> Path:
    """
    Make the runs that are left, and the page.

    :param options: options of the comparison, see :func:`parse_arguments`
    :return: path of the page
    :raises ValueError: before the first run, if the environment, an algorithm or an argument is wrong; after the last one, if
        a run failed
    """
    runs = options.out / "runs"
    # The processes of runs must find the modules that this one finds, beside it
    os.environ["PYTHONPATH"] = os.pathsep.join([os.getcwd(), *filter(None, [os.environ.get("PYTHONPATH")])])
    specs = [spec for cell in cells_of(SUITE, yaml.safe_load(_as_yaml(options))) for spec in cell]
    _check_split(specs[0])
    check_runs(SUITE, specs)
    _check_steps(specs)
    jobs, finished = launch.jobs_of(specs, options.out / SUITE, runs)
    for job in jobs:
        check_unfinished(job.spec, runs)
    check_programs(job.spec for job in jobs)
    check_simulators(job.spec for job in jobs)
    _check_goals(specs[0])
    engine = launch.LocalEngine() if options.ray is None else launch.RayEngine(options.ray)
    runs.mkdir(parents=True, exist_ok=True)
    with locked(runs):  # another comparison would make this one's processes read another suite
        suite = write_suite(options)  # after all checks: a comparison that is refused leaves an earlier one as it was
        left = f"{counted(len(jobs), 'run')} of {options.steps:,} steps to do"
        print("\n".join([f"{left}, {finished} done; all is in {options.out}.", *about_changed_code(specs, runs)]), flush=True)
        launch.launch(jobs, options.jobs or engine.cpus, 1, engine, finished)
        if failed := [job for job in jobs if job.state == "failed"]:
            logs = "\n".join(f"  {job.log}: {job.reason}" for job in failed)
            raise ValueError(f"{counted(len(failed), 'run')} failed. The logs say why; then the same command goes on:\n{logs}")
        return write_results(options, specs, suite, runs)


def _check_steps(specs: Sequence[RunSpec]) -> None:
    for spec in specs:
        check_steps(spec.algorithm, spec.steps, first_gradient_step(spec))


def _check_split(spec: RunSpec) -> None:
    """Refuse an environment without the entries that every algorithm here reads, in words for who gave it by ``--env``."""
    if spec.environment is None or spec.overrides.get("role_keys"):
        return
    try:
        env = make_envs(spec, 1)
    except Exception:  # the check of the runs says what is wrong
        return
    env.close()
    check_split(spec.environment["id"], env.observation_space)


def _check_goals(spec: RunSpec) -> None:
    """Refuse goals as entries of their own: these are for ``HerReplayBuffer``, and no algorithm of a comparison reads them."""
    env = make_envs(spec, 1)
    entries = getattr(env.observation_space, "spaces", {})
    env.close()
    if DESIRED_GOAL in entries:
        raise ValueError(
            f'--env: the observation has the entry "{DESIRED_GOAL}", which no algorithm here reads, and without which none '
            "can do well. Put it into `partial`: --wrappers sb3_gac.envs:AppendDesiredGoal, around all others; of registered "
            "tasks, leave goal_entries out. There is no comparison with HerReplayBuffer."
        )


def write_results(options: argparse.Namespace, specs: Sequence[RunSpec], suite: Path, runs: Path) -> Path:
    """
    Aggregate finished runs, write the page, and print its conclusions.

    :param options: options of the comparison, see :func:`parse_arguments`
    :param specs: settings of the runs
    :param suite: path of the suite's file
    :param runs: directory of the finished runs
    :return: path of the page
    """
    results = options.out / "results"
    aggregate.main([str(suite), "--runs", str(runs), "--out", str(results)])
    tidy = read_tidy(file_of(results, "csv"))
    deployable = {spec.algorithm for spec in specs if reads_partial_alone(spec)}
    found = worth(tidy, untrained_returns(specs[0], options.out / "untrained.json"), deployable)
    path: Path = options.out / "index.html"
    write_atomically(path, page(tidy, found, command(options), file_of(results, "json"), options.steps))
    print("\n" + "\n".join([*recommendation(found, options.steps), "", *findings(found)]))
    return path


def untrained_returns(spec: RunSpec, path: Path) -> dict[str, np.ndarray]:
    """
    :param spec: settings of a run
    :param path: JSON file from which the returns are read; if there is none, or one of another environment, the episodes are
        run and the file is written
    :return: name of a policy without training -> returns of its episodes, on the environments of evaluations, shape (N,)
    """
    wrappers = spec.environment["wrappers"] if spec.environment else []
    what = {"environment": environment(spec), "wrappers": wrappers, "episodes": [UNTRAINED_EPISODES, spec.eval_episodes]}
    what |= code_of(spec)
    recorded = json.loads(json.dumps(what, default=str))
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):  # the second where a full disk has cut the file off
        known = {}
    if known.get("of") != recorded:
        known = {"of": recorded, "returns": _untrained_returns(spec)}
        write_atomically(path, json.dumps(known))
    return {name: np.array(returns) for name, returns in known["returns"].items()}


def _untrained_returns(spec: RunSpec) -> dict[str, list[float]]:
    env = make_envs(spec, spec.eval_episodes)
    returns: dict[str, Any] = {}
    for name, policy in untrained_policies(env).items():
        env.seed(EVAL_SEED)
        returns[name], _ = evaluate_policy(policy, env, UNTRAINED_EPISODES, return_episode_rewards=True)
    env.close()
    return returns


def main(description: str | None = None) -> None:
    """
    Entry point of the command line.

    :param description: text that ``--help`` shows above the options
    """
    options = parse_arguments(description)
    try:
        print(f"\nPage: {run(options)}")
    except (ValueError, OSError, InUseError, ImportError) as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
