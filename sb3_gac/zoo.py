"""
rl_zoo3 with the algorithms of this package::

    python -m sb3_gac.zoo train --algo gac --env sb3_gac/HalfCheetah-v5 --env-kwargs noise_std:0.1
    python -m sb3_gac.zoo train --algo gac --env sb3_gac/HalfCheetah-v5 -optimize --n-trials 50
    python -m sb3_gac.zoo enjoy --algo gac --env sb3_gac/HalfCheetah-v5 --folder logs
    python -m sb3_gac.zoo record_video --algo gac --env sb3_gac/HalfCheetah-v5 --folder logs

All options are rl_zoo3's, and rl_zoo3's own algorithms work as well (``--algo ppo``).  The algorithms of this package, all
of :mod:`sb3_gac.algorithms`, have the arguments of the preset ``small`` unless ``--conf-file`` names a file with others.
"""

import argparse
import runpy
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from sb3_gac.algorithms import ALGORITHMS, algorithm_class, name_of
from sb3_gac.command_line import Parser
from sb3_gac.envs.suites import SUITES
from sb3_gac.envs.suites.extras import missing_extra
from sb3_gac.presets import merge, read_preset
from sb3_gac.stopping import StoppedInALine

try:
    import optuna
    from rl_zoo3 import hyperparams_opt, utils
    from rl_zoo3.enjoy import enjoy
    from rl_zoo3.train import train
except ImportError as error:
    raise missing_extra("sb3_gac.zoo", error.name or "rl_zoo3", "zoo") from error

PRESET, N_TIMESTEPS = "small", 100_000
_NET_ARCHS = {"small": [128, 128], "medium": [256, 256], "large": [400, 300]}


def hyperparameters(name: str, privileged: str | None = None) -> dict[str, dict[str, Any]]:
    """
    The hyperparameters of an algorithm in rl_zoo3's form, from the preset ``small``.

    :param name: name of the algorithm
    :param privileged: value of the environment's argument ``privileged``; ``None`` for its default
    :return: environment id or "default" -> hyperparameters; ``role_keys`` are only in those of registered tasks whose
        privileged entry is the whole state
    """
    preset = read_preset(PRESET)
    arguments: dict[str, Any] = {"n_envs": preset.envs, "n_timesteps": N_TIMESTEPS, "policy": "MultiInputPolicy"}
    for layer in preset.layers(algorithm_class(name), None, 0.0):
        arguments = merge(arguments, layer)
    default = {key: value for key, value in arguments.items() if key != "role_keys"}
    with_whole_state = [
        env_id
        for suite in SUITES.values()
        for env_id in suite.environments
        if suite.shows_whole_state(env_id) and privileged in (None, *suite.privileged[:1])
    ]
    return {"default": default, **dict.fromkeys(with_whole_state, arguments)}


def sample(name: str, trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample the arguments for one trial of ``-optimize``: those of all algorithms, and those of the algorithm and its ancestors.

    :param name: name of the algorithm
    :param trial: Optuna's trial
    :param n_actions: number of actions, an argument of rl_zoo3's samplers that has no effect here
    :param n_envs: number of environments, without effect here
    :param additional_args: further arguments of rl_zoo3's samplers, without effect here
    :return: arguments of the algorithm
    """
    families = {"all", *map(name_of, algorithm_class(name).__mro__)}
    suggested = [suggest(trial) for family, suggest in SUGGESTIONS.items() if family in families]
    return convert({argument: value for arguments in suggested for argument, value in arguments.items()})


def _suggest_shared(trial: optuna.Trial) -> dict[str, Any]:
    return {
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 1e-3, 0.05, log=True),
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 6, 9),
        "net_arch": trial.suggest_categorical("net_arch", list(_NET_ARCHS)),
    }


def _suggest_off_policy(trial: optuna.Trial) -> dict[str, Any]:
    return {"tau": trial.suggest_float("tau", 1e-3, 0.05, log=True)}


def _suggest_entropy(trial: optuna.Trial) -> dict[str, Any]:
    return {"target_entropy": trial.suggest_categorical("target_entropy", ["auto", "sac"])}


def _suggest_on_policy(trial: optuna.Trial) -> dict[str, Any]:
    return {
        "n_epochs": trial.suggest_int("n_epochs", 2, 10),
        "gae_lambda": trial.suggest_float("gae_lambda", 0.9, 0.99),
        "clip_range": trial.suggest_categorical("clip_range", [0.1, 0.2, 0.3]),
        "ent_coef": trial.suggest_float("ent_coef", 1e-4, 0.03, log=True),
    }


def _suggest_distance(trial: optuna.Trial) -> dict[str, Any]:
    """Sample how far the student may be from its teacher."""
    return {
        "target_divergence": trial.suggest_float("target_divergence", 0.05, 10.0, log=True),
        "teacher_coef_learning_rate": trial.suggest_float("teacher_coef_learning_rate", 3e-4, 3e-2, log=True),
    }


def _suggest_gpo(trial: optuna.Trial) -> dict[str, Any]:
    return {"learner_rl_coef": trial.suggest_float("learner_rl_coef", 0.0, 3.0)}


def _suggest_gpo_clip(trial: optuna.Trial) -> dict[str, Any]:
    return {"delta": trial.suggest_float("delta", 0.05, 0.4)}


def _suggest_gpo_penalty(trial: optuna.Trial) -> dict[str, Any]:
    return {"target_kl": trial.suggest_float("target_kl", 3e-4, 0.1, log=True)}


def _suggest_guidance(trial: optuna.Trial) -> dict[str, Any]:
    """Sample how far the guider may be from the learner."""
    return {
        **_suggest_entropy(trial),
        "target_kl": trial.suggest_float("target_kl", 3e-4, 0.1, log=True),
        "kl_coef_learning_rate": trial.suggest_float("kl_coef_learning_rate", 3e-4, 3e-2, log=True),
    }


def _suggest_bounds(trial: optuna.Trial) -> dict[str, Any]:
    """Sample how far a step of the policy may go."""
    return {
        "target_improvement": trial.suggest_float("target_improvement", 0.01, 1.0, log=True),
        "target_kl": trial.suggest_float("target_kl", 1e-3, 0.1, log=True),
        "target_std_kl": trial.suggest_float("target_std_kl", 1e-6, 1e-3, log=True),
    }


#: "all", or name of a family or algorithm (which covers its subclasses) -> function that samples arguments
SUGGESTIONS: dict[str, Callable[[optuna.Trial], dict[str, Any]]] = {
    "all": _suggest_shared,
    "off_policy": _suggest_off_policy,
    "on_policy": _suggest_on_policy,
    "gac": _suggest_guidance,
    "asymmetric_mpo": _suggest_bounds,
    "asymmetric_sac": _suggest_entropy,
    "cosil": _suggest_distance,
    "tgrl": _suggest_entropy,
    "gpo": _suggest_gpo,
    "gpo_clip": _suggest_gpo_clip,
    "gpo_penalty": _suggest_gpo_penalty,
}


def convert(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: values in the form in which a trial stores them
    :return: arguments of the algorithm
    """
    arguments = dict(sampled_params)
    arguments["gamma"] = 1 - arguments.pop("one_minus_gamma")
    arguments["batch_size"] = 2 ** arguments.pop("batch_size_pow")
    arguments["policy_kwargs"] = {"net_arch": _NET_ARCHS[arguments.pop("net_arch")]}
    return arguments


def register() -> None:
    """Make the algorithms known to rl_zoo3."""
    utils.ALGOS.update({name: algorithm_class(name) for name in ALGORITHMS})
    hyperparams_opt.HYPERPARAMS_SAMPLER.update({name: partial(sample, name) for name in ALGORITHMS})
    hyperparams_opt.HYPERPARAMS_CONVERTER.update(dict.fromkeys(ALGORITHMS, convert))


def record_video() -> None:
    """Run rl_zoo3's script, which has no function to call."""
    runpy.run_module("rl_zoo3.record_video", run_name="__main__")


SCRIPTS: dict[str, Callable[[], None]] = {"train": train, "enjoy": enjoy, "record_video": record_video}


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Run the command line.

    :param arguments: name of a script and its options; ``None`` for those of the process
    """
    parser = Parser("sb3_gac.zoo", __doc__)
    parser.add_argument("script", choices=list(SCRIPTS))
    own, options = parser.parse_known_args(list(sys.argv[1:] if arguments is None else arguments)[:1])
    options = list(sys.argv[2:] if arguments is None else arguments[1:])
    register()
    with StoppedInALine(), TemporaryDirectory() as directory:
        if own.script == "train":
            _check_teacher(options)
            options = with_hyperparameters(options, Path(directory))
        sys.argv = [f"{sys.argv[0]} {own.script}", *options]
        SCRIPTS[own.script]()


def _check_teacher(options: Sequence[str]) -> None:
    known = _known(options)
    has_one = known.algo in ALGORITHMS and "teacher" in algorithm_class(known.algo).frozen_arguments  # type: ignore[attr-defined]
    if has_one and known.conf_file is None and not any(word.startswith("teacher:") for word in options):
        sys.exit(
            f"--algo {known.algo}: it learns from a teacher, a model that was trained before. Train one, such as with --algo "
            "gac, and give -params teacher:\"'logs/gac/<its directory>/<its file>.zip'\"."
        )


def _known(options: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo")
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("--env")  # which would be taken for the beginning of the next
    parser.add_argument("--env-kwargs", nargs="+", action=utils.StoreDict, default={})
    return parser.parse_known_args(list(options))[0]


def with_hyperparameters(options: list[str], directory: Path) -> list[str]:
    """
    Add a file of hyperparameters to the options, unless they name one.

    :param options: options of rl_zoo3's ``train``
    :param directory: directory for the file, which rl_zoo3 reads, and saves with the model
    :return: options with ``--conf-file`` added, if they name an algorithm of this package and no such file
    """
    known = _known(options)
    if known.conf_file is not None or known.algo not in ALGORITHMS:
        return options
    path = directory / f"{known.algo}.yml"
    path.write_text(
        yaml.safe_dump(hyperparameters(known.algo, known.env_kwargs.get("privileged")), sort_keys=False), encoding="utf-8"
    )
    return [*options, "--conf-file", str(path)]


if __name__ == "__main__":
    main()
