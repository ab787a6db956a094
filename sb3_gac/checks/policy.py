"""Checks of ``policy_kwargs`` and ``replay_buffer_kwargs``, which are handed on to the policy's class and the buffer's."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_gac.checks.arguments import ArgumentCheck, check_switch, constructor_parameters
from sb3_gac.checks.values import check_integer, check_type
from sb3_gac.names import meant


def _check_makes(name: str, value: Any, what: str) -> None:
    if not callable(value):
        raise ValueError(f"{name} must be a class of {what}, got {value!r}.")


def _check_extractor_class(name: str, value: Any) -> None:
    for one in value.values() if isinstance(value, Mapping) else [value]:
        if not (isinstance(one, type) and issubclass(one, BaseFeaturesExtractor)):
            raise ValueError(f"{name} must be a subclass of BaseFeaturesExtractor, or role -> such a class, got {one!r}.")


def _check_sizes(name: str, value: Any) -> None:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise ValueError(f"{name} must be a list of layer sizes, got {value!r}.")
    for size in value:
        check_integer(name, size, 1)


def _check_optimizer_kwargs(name: str, value: Any) -> None:
    check_type(name, value, (Mapping, type(None)), "a dict or None")
    if "lr" in (value or {}):
        raise ValueError(f"{name} must not have lr, which is the algorithm's learning_rate, times its lr_scales.")


_KWARGS = partial(check_type, types=(Mapping, type(None)), expected="a dict or None")
#: Argument of a policy class -> its check
POLICY_CHECKS: Mapping[str, ArgumentCheck] = {
    "activation_fn": partial(_check_makes, what="torch's modules, such as torch.nn.SiLU"),
    "features_extractor_class": _check_extractor_class,
    "features_extractor_kwargs": _KWARGS,
    "share_features_extractor": check_switch,
    "normalize_images": check_switch,
    "optimizer_class": partial(_check_makes, what="torch's optimisers, such as torch.optim.Adam"),
    "optimizer_kwargs": _check_optimizer_kwargs,
    "rnn_net_arch": _check_sizes,
}


def check_policy_kwargs(given: Mapping[str, Any]) -> None:
    """
    Check each of a policy's arguments by itself.

    :param given: name -> argument; those that are not in :data:`POLICY_CHECKS` are checked where they are used
    :raises ValueError: naming the argument, and what is allowed
    """
    for name, check in POLICY_CHECKS.items():
        if name in given:
            check(name, given[name])


def check_taken(argument: str, kind: type, given: Mapping[str, Any]) -> None:
    """
    Check that a class takes all arguments that are handed on to it.

    :param argument: argument of the algorithm that holds them, ``policy_kwargs`` or ``replay_buffer_kwargs``
    :param kind: class of the policy or of the replay buffer; its first three arguments are the algorithm's to give
    :param given: name -> argument
    :raises TypeError: naming the first argument that the class does not take, and the one that may be meant
    """
    known = constructor_parameters(kind)
    for name in given:
        if name not in known:
            takes = f"it takes {', '.join(known[3:])}.{meant(name, known, nearness=0.6)}"
            raise TypeError(f'{argument} has "{name}", which is no argument of {kind.__name__}: {takes}')
