"""Checks of constructor arguments, in a table for each class; see :mod:`sb3_gac.checks.values`."""

import inspect
import os
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeAlias

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import TrainFrequencyUnit
from stable_baselines3.common.utils import FloatSchedule

from sb3_gac.checks.values import (
    check_choice,
    check_fraction,
    check_integer,
    check_not_negative,
    check_positive,
    check_schedule,
    check_type,
    plain,
)
from sb3_gac.schedules import as_schedule

ArgumentCheck: TypeAlias = Callable[..., None]
"""Takes an argument's name and its value; raises a ValueError that says what is allowed."""

LARGEST_SEED = 2**32 - 1
#: Argument -> SB3's attribute for it, where the names differ
KEPT_AS = {"policy": "policy_class", "stats_window_size": "_stats_window_size"}
#: Arguments that are handed on to classes that may be the user's own, so that arrays in them stay arrays
HANDED_ON = ("policy_kwargs", "replay_buffer_kwargs")


class PlainSchedule(FloatSchedule):
    """
    A schedule whose values are Python's numbers, even if its function returns numpy's or torch's, or arrays of one number.

    :param value: number, function of the fraction of training that remains, or text of a schedule, see
        :mod:`sb3_gac.schedules`
    """

    def __init__(self, value: Any):
        super().__init__(as_schedule(value))

    def __call__(self, progress_remaining: float) -> float:
        """
        The schedule's value at a moment of training.

        :param progress_remaining: fraction of training that remains, from 1 to 0
        :return: value
        """
        return float(plain(self.value_schedule(progress_remaining), arrays=True))


def constructor_arguments(algorithm: type) -> list[str]:
    """
    The constructor arguments of an algorithm that are kept with a model.

    :param algorithm: class of the algorithm
    :return: names of the arguments, each kept as the attribute of that name or of the name in :data:`KEPT_AS`
    """
    return [name for name in constructor_parameters(algorithm) if name not in ("env", "device", "_init_setup_model")]


def constructor_parameters(kind: type) -> list[str]:
    """
    The names of all arguments that a class can be made with.

    :param kind: class
    :return: names of its constructor's arguments and, as far as constructors hand on further ones, of its ancestors'
    """
    names: dict[str, None] = {}
    for ancestor in kind.__mro__:
        if "__init__" in vars(ancestor):
            parameters = inspect.signature(vars(ancestor)["__init__"]).parameters.values()
            kinds = {parameter.kind for parameter in parameters}
            hands_on = {inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL}
            names |= {parameter.name: None for parameter in parameters if parameter.kind not in hands_on}
            if inspect.Parameter.VAR_KEYWORD not in kinds:
                break
    return [name for name in names if name != "self"]


def make_arguments_plain(model: BaseAlgorithm) -> None:
    """
    Replace numbers of other libraries in all arguments by Python's numbers, see :func:`plain`.

    :param model: model whose attributes are the arguments
    """
    for argument in constructor_arguments(type(model)):
        name = KEPT_AS.get(argument, argument)
        if name in vars(model):
            vars(model)[name] = plain(vars(model)[name], arrays=argument not in HANDED_ON)


def merged(kind: type, table: str) -> dict[str, Any]:
    """
    A table whose entries are spread over a class and its ancestors.

    :param kind: class
    :param table: name of the attribute that is a mapping, of the class or of an ancestor
    :return: all entries, where those of a class take the place of its ancestors'
    """
    return {name: entry for ancestor in reversed(kind.__mro__) for name, entry in vars(ancestor).get(table, {}).items()}


def check_arguments(model: Any) -> None:
    """
    Check each argument by its entry in ``argument_checks``.

    :param model: model whose attributes are the arguments, as they were given or saved
    :raises ValueError: naming the argument, the values that are allowed, and the value that it has
    :raises AttributeError: naming the argument that the model does not have yet
    """
    for argument, check in merged(type(model), "argument_checks").items():
        name = KEPT_AS.get(argument, argument)
        if not hasattr(model, name):
            raise AttributeError(
                f"{type(model).__name__} has no attribute {name!r} to check: its constructor is to set it before it calls "
                "super().__init__(), which sets everything up."
            )
        check(argument, getattr(model, name))


def unless(other: Any, check: ArgumentCheck, **options: Any) -> ArgumentCheck:
    """
    A check that allows one more value.

    :param other: value that is allowed besides those that ``check`` allows
    :param check: check of all other values
    :param options: keyword arguments of ``check``
    :return: check of an argument
    """

    def checked(name: str, value: Any) -> None:
        if not (value is other or (isinstance(value, str) and value == other)):
            check(name, value, **options)

    return checked


def check_switch(name: str, value: Any) -> None:
    """
    Check an argument that is true or false.

    :param name: name of the argument
    :param value: value of the argument
    :raises ValueError: unless the value is true or false
    """
    check_choice(name, value, (False, True))


def check_compile(name: str, value: Any) -> None:
    """
    Check the argument ``compile``.

    :param name: name of the argument
    :param value: value of the argument
    :raises ValueError: unless the value is true, false or "auto"
    """
    if value not in (False, True, "auto"):
        raise ValueError(f'{name} must be True, False or "auto", got {value!r}.')


def check_device(name: str, value: Any) -> None:
    """
    Check the argument ``device``.

    :param name: name of the argument
    :param value: value of the argument
    :raises ValueError: unless the value is "auto" or names one of torch's devices
    """
    try:
        th.device("cpu" if value == "auto" else value)
    except (RuntimeError, TypeError):
        raise ValueError(f'{name} must be "auto", "cpu", "cuda" or another device of torch, got {value!r}.') from None


def check_train_freq(name: str, value: Any, n_envs: int = 1) -> None:
    """
    Check the argument ``train_freq``.

    :param name: name of the argument
    :param value: value of the argument, as it was given or as SB3 converts it
    :param n_envs: number of environments
    :raises ValueError: unless the value is a number of steps, or (number, "step" | "episode"), where episodes go with a single
        environment
    """
    allowed = f'{name} must be an integer >= 1 or (integer >= 1, "step" or "episode")'
    pair = value if isinstance(value, tuple) else (value, "step")
    frequency, unit = pair if len(pair) == 2 else (None, None)
    if not isinstance(frequency, int) or frequency < 1 or unit not in {"step", "episode", *TrainFrequencyUnit}:
        raise ValueError(f"{allowed}, got {value!r}.")
    if unit in ("episode", TrainFrequencyUnit.EPISODE) and n_envs > 1:
        raise ValueError(f"{allowed}; episodes can be counted in one environment only, got {value!r} for {n_envs}.")


def check_replay_buffer_class(name: str, value: Any) -> None:
    """
    Check the argument ``replay_buffer_class``.

    :param name: name of the argument
    :param value: value of the argument
    :raises ValueError: unless the value is a class of buffers that hold Dict observations, or ``None``
    """
    if value is None:
        return
    if not (isinstance(value, type) and issubclass(value, ReplayBuffer)):
        in_python = " A name can't stand for a class: train in Python with the class itself, as docs/goals.md does for HER."
        advice = in_python if isinstance(value, str) else ""
        raise ValueError(f"{name} must be DictReplayBuffer, a subclass of it or None, got {value!r}.{advice}")
    if value in (ReplayBuffer, NStepReplayBuffer):
        raise ValueError(
            f"{name}={value.__name__} can't hold Dict observations: leave it out, or give DictReplayBuffer or a subclass."
        )


#: Checks of the arguments that all algorithms have; roles, heads and coefficients check further ones, and combinations
COMMON_CHECKS: Mapping[str, ArgumentCheck] = {
    "learning_rate": partial(check_schedule, may_be_zero=True),  # rl_zoo3 loads models with 0 to play them
    "gamma": check_fraction,
    "max_grad_norm": unless(None, check_positive, remedy="or None for no clipping"),
    "lr_scales": partial(check_type, types=(Mapping, type(None)), expected="a dict of networks or None"),
    "role_keys": partial(check_type, types=(Mapping, type(None)), expected="a dict of networks or None"),
    "compile": check_compile,
    "mixed_precision": check_switch,
    "stats_window_size": partial(check_integer, low=1),
    "tensorboard_log": partial(check_type, types=(str, os.PathLike, type(None)), expected="a directory or None"),
    "policy_kwargs": partial(check_type, types=Mapping, expected="a dict or None"),
    "verbose": partial(check_integer, low=0),
    "seed": unless(None, check_integer, low=0, high=LARGEST_SEED, remedy="or None"),
    "device": check_device,
}
#: Checks of the further arguments of off-policy algorithms
OFF_POLICY_CHECKS: Mapping[str, ArgumentCheck] = {
    "buffer_size": partial(check_integer, low=1),
    "learning_starts": check_not_negative,
    "batch_size": partial(check_integer, low=1),
    "tau": check_fraction,
    "train_freq": check_train_freq,
    "gradient_steps": partial(check_integer, low=-1, remedy="-1 for as many as environment steps"),
    "action_noise": partial(check_type, types=(ActionNoise, type(None)), expected="an ActionNoise or None"),
    "replay_buffer_class": check_replay_buffer_class,
    "replay_buffer_kwargs": partial(check_type, types=Mapping, expected="a dict or None"),
    "optimize_memory_usage": check_switch,
    "n_steps": partial(check_integer, low=1),
    "target_update_interval": partial(check_integer, low=1),
    "policy_delay": partial(check_integer, low=1),
    "update_every": partial(check_type, types=(Mapping, type(None)), expected="a dict of networks or None"),
    "behaviour": partial(check_type, types=(str, Mapping, type(None)), expected="a policy's name, a dict of shares or None"),
    "behaviour_per": partial(check_choice, choices=("episode", "environment")),
    "recording": partial(check_type, types=(str, os.PathLike, type(None)), expected="a path or None"),
    "random_shift": partial(check_integer, low=0),
}
