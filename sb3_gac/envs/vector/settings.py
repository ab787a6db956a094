"""Attributes of environments, which SB3's vectorised environments set on the layers that have them."""

import warnings
from functools import partial
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

#: Setting of this package's wrappers -> argument of registered tasks by which they are made with the wrapper
_MADE_BY = {"noise_std": "noise_std", "steps": "delay", "probability": "drop"}


def reach_layers(env: VecEnv) -> None:
    """
    Have ``set_attr`` set attributes of environments where they count, such as ``noise_std`` of ``SensorNoise``.

    SB3 sets attributes on the outermost wrapper, ``Monitor`` in most cases, where they do nothing.

    :param env: vectorised environments, of which SB3's own are changed in place
    """
    base = env.unwrapped
    if isinstance(base, (DummyVecEnv, SubprocVecEnv)):
        vars(base)["set_attr"] = partial(_set_on_layers, base)


def _set_on_layers(env: VecEnv, attr_name: str, value: Any, indices: Any = None) -> None:
    """
    Set an attribute on the layers that have it.

    :param env: vectorised environments
    :param attr_name: name of the attribute
    :param value: value of the attribute
    :param indices: indices of the environments; ``None`` for all
    :raises ValueError: if the attribute is a setting of this package's wrappers, and an environment has no such wrapper
    """
    if not all(env.env_method("has_wrapper_attr", attr_name, indices=indices)):
        if attr_name in _MADE_BY:
            raise ValueError(
                f"{attr_name} can't be set, since no wrapper of an environment has it: put the wrapper around it, "
                f"or make a registered task with {_MADE_BY[attr_name]} above 0."
            )
        warnings.warn(f"No layer of the environments has {attr_name!r}: it is set, but nothing may read it.", stacklevel=2)
    env.env_method("set_wrapper_attr", attr_name, value, indices=indices)
