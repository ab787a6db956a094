"""Checks of the constructor arguments that all our off-policy algorithms have; see :mod:`sb3_gac.checks.values`."""

import inspect
import os
from collections.abc import Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
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

LARGEST_SEED = 2**32 - 1
SWITCHES = ("optimize_memory_usage", "compile", "mixed_precision")
#: Argument -> SB3's attribute, where it is called otherwise
KEPT_AS = {"policy": "policy_class", "stats_window_size": "_stats_window_size"}
#: What is handed on to classes that may be the user's own, with all arrays that they may take
HANDED_ON = ("policy_kwargs", "replay_buffer_kwargs")


class PlainSchedule(FloatSchedule):
    """A schedule of Python's numbers, whatever its function returns: numpy's, torch's, or arrays of one."""

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


def make_arguments_plain(model: OffPolicyAlgorithm) -> None:
    """
    Python's numbers in all arguments, see :func:`plain`.

    :param model: whose attributes are the arguments
    """
    for argument in constructor_arguments(type(model)):
        name = KEPT_AS.get(argument, argument)
        if name in vars(model):
            vars(model)[name] = plain(vars(model)[name], arrays=argument not in HANDED_ON)


def check_what_construction_needs(device: Any, verbose: Any) -> None:
    """
    What SB3's constructor uses before :func:`check_shared_arguments` can look at it.

    :raises ValueError: unless torch has such a device, and ``verbose`` is a number
    """
    check_integer("verbose", verbose, 0)
    try:
        th.device("cpu" if device == "auto" else device)
    except (RuntimeError, TypeError):
        raise ValueError(f'device must be "auto", "cpu", "cuda" or another of torch\'s, got {device!r}.') from None


def check_shared_arguments(model: OffPolicyAlgorithm) -> None:
    """
    Those that are checked nowhere else: roles, heads and coefficients check their own.

    :param model: whose attributes are the arguments, as they were given or as they were saved
    :raises ValueError: naming the argument, what is allowed and what it was
    """
    values = vars(model)
    check_schedule("learning_rate", model.learning_rate, may_be_zero=True)  # so rl_zoo3 loads models to play with
    check_integer("buffer_size", model.buffer_size, 1)
    check_not_negative("learning_starts", model.learning_starts)
    check_integer("batch_size", model.batch_size, 1)
    check_fraction("tau", model.tau)
    check_fraction("gamma", model.gamma)
    check_train_freq(model.train_freq, model.n_envs)
    check_integer("gradient_steps", model.gradient_steps, -1, remedy="-1 for as many as environment steps")
    check_integer("n_steps", model.n_steps, 1)
    check_integer("target_update_interval", values["target_update_interval"], 1)
    check_integer("stats_window_size", model._stats_window_size, 1)
    if model.seed is not None:
        check_integer("seed", model.seed, 0, LARGEST_SEED, remedy="or None")
    if values["max_grad_norm"] is not None:
        check_positive("max_grad_norm", values["max_grad_norm"], remedy="or None for no clipping")
    for name in SWITCHES:
        check_choice(name, values[name], (False, True))
    _check_replay_and_noise(model)
    for name in ("policy_kwargs", "replay_buffer_kwargs"):
        check_type(name, values[name], Mapping, "a dict or None")
    for name in ("lr_scales", "role_keys"):
        check_type(name, values[name], (Mapping, type(None)), "a dict of networks or None")
    check_type("tensorboard_log", model.tensorboard_log, (str, os.PathLike, type(None)), "a directory or None")


def check_train_freq(train_freq: Any, n_envs: int) -> None:
    """
    :param train_freq: as given, or as SB3 converts it
    :param n_envs: number of environments
    :raises ValueError: unless it is a number of steps, or (number, "step" | "episode")
    """
    allowed = 'train_freq must be an integer >= 1 or (integer >= 1, "step" or "episode")'
    pair = train_freq if isinstance(train_freq, tuple) else (train_freq, "step")
    frequency, unit = pair if len(pair) == 2 else (None, None)
    if not isinstance(frequency, int) or frequency < 1 or unit not in {"step", "episode", *TrainFrequencyUnit}:
        raise ValueError(f"{allowed}, got {train_freq!r}.")
    if unit in ("episode", TrainFrequencyUnit.EPISODE) and n_envs > 1:
        raise ValueError(f"{allowed}; episodes can be counted in one environment only, got {train_freq!r} for {n_envs}.")


def _check_replay_and_noise(model: OffPolicyAlgorithm) -> None:
    if model.action_noise is not None:
        check_type("action_noise", model.action_noise, ActionNoise, "an ActionNoise or None")
        if not isinstance(model.action_space, spaces.Box):
            raise ValueError("action_noise can be added to Box actions only: leave it out.")
    buffer_class = model.replay_buffer_class
    if buffer_class is None:
        return
    if not (isinstance(buffer_class, type) and issubclass(buffer_class, ReplayBuffer)):
        raise ValueError(f"replay_buffer_class must be DictReplayBuffer, a subclass of it or None, got {buffer_class!r}.")
    if buffer_class in (ReplayBuffer, NStepReplayBuffer):
        raise ValueError(
            f"replay_buffer_class={buffer_class.__name__} can't hold Dict observations: "
            "leave it out, or give DictReplayBuffer or a subclass."
        )
