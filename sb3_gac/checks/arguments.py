"""Checks of constructor arguments, one table for each class; see :mod:`sb3_gac.checks.values`."""

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
#: Argument -> SB3's attribute, where it is called otherwise
KEPT_AS = {"policy": "policy_class", "stats_window_size": "_stats_window_size"}
#: What is handed on to classes that may be the user's own, with all arrays that they may take
HANDED_ON = ("policy_kwargs", "replay_buffer_kwargs")


class PlainSchedule(FloatSchedule):
    """
    A schedule of Python's numbers, whatever its function returns: numpy's, torch's, or arrays of one.

    :param value: a number, a function of the progress that remains, or the text of one, see :mod:`sb3_gac.schedules`
    """

    def __init__(self, value: Any):
        super().__init__(as_schedule(value))

    def __call__(self, progress_remaining: float) -> float:
        """
        :param progress_remaining: from 1 to 0
        """
        return float(plain(self.value_schedule(progress_remaining), arrays=True))


def constructor_arguments(algorithm: type) -> list[str]:
    """
    :param algorithm: a class
    :return: names of the arguments that are kept with a model, as the attribute of that name or as :data:`KEPT_AS` says
    """
    return [name for name in constructor_parameters(algorithm) if name not in ("env", "device", "_init_setup_model")]


def constructor_parameters(kind: type) -> list[str]:
    """
    :param kind: a class
    :return: names of what it can be made with and, as long as it hands on what it does not know, of what its ancestors can
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
    Python's numbers in all arguments, see :func:`plain`.

    :param model: whose attributes are the arguments
    """
    for argument in constructor_arguments(type(model)):
        name = KEPT_AS.get(argument, argument)
        if name in vars(model):
            vars(model)[name] = plain(vars(model)[name], arrays=argument not in HANDED_ON)


def merged(kind: type, table: str) -> dict[str, Any]:
    """
    :param kind: a class
    :param table: name of a mapping that it and its ancestors may have, each with entries of its own
    :return: all entries, a class's over those of its ancestors
    """
    return {name: entry for ancestor in reversed(kind.__mro__) for name, entry in vars(ancestor).get(table, {}).items()}


def check_arguments(model: Any) -> None:
    """
    Each by the entry that ``argument_checks`` has for it.

    :param model: whose attributes are the arguments, as they were given or as they were saved
    :raises ValueError: naming the argument, what is allowed and what it was
    :raises AttributeError: naming the argument that is not there yet
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
    :param other: what may be given instead of what ``check`` allows
    :param check: of all else
    :param options: of ``check``
    """

    def checked(name: str, value: Any) -> None:
        if not (value is other or (isinstance(value, str) and value == other)):
            check(name, value, **options)

    return checked


def check_switch(name: str, value: Any) -> None:
    """
    :raises ValueError: unless it is true or false
    """
    check_choice(name, value, (False, True))


def check_compile(name: str, value: Any) -> None:
    """
    :raises ValueError: unless it is true, false or "auto"
    """
    if value not in (False, True, "auto"):
        raise ValueError(f'{name} must be True, False or "auto", got {value!r}.')


def check_device(name: str, value: Any) -> None:
    """
    :raises ValueError: unless torch has such a device
    """
    try:
        th.device("cpu" if value == "auto" else value)
    except (RuntimeError, TypeError):
        raise ValueError(f'{name} must be "auto", "cpu", "cuda" or another of torch\'s, got {value!r}.') from None


def check_train_freq(name: str, value: Any, n_envs: int = 1) -> None:
    """
    :param name: of the argument
    :param value: as given, or as SB3 converts it
    :param n_envs: number of environments
    :raises ValueError: unless it is a number of steps, or (number, "step" | "episode")
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
    :raises ValueError: unless it is a class of buffers that hold Dict observations, or ``None``
    """
    if value is None:
        return
    if not (isinstance(value, type) and issubclass(value, ReplayBuffer)):
        raise ValueError(f"{name} must be DictReplayBuffer, a subclass of it or None, got {value!r}.")
    if value in (ReplayBuffer, NStepReplayBuffer):
        raise ValueError(
            f"{name}={value.__name__} can't hold Dict observations: leave it out, or give DictReplayBuffer or a subclass."
        )


#: Of all algorithms' arguments; roles, heads and coefficients check their own, and what depends on others is checked with them
COMMON_CHECKS: Mapping[str, ArgumentCheck] = {
    "learning_rate": partial(check_schedule, may_be_zero=True),  # so rl_zoo3 loads models to play with
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
#: Of those that off-policy algorithms have besides
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
