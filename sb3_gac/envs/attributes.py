"""The attributes of a MuJoCo environment in Python, such as a commanded speed, a counter or the last action."""

from collections import deque
from collections.abc import Mapping
from copy import deepcopy
from enum import Enum, auto
from inspect import isclass, ismodule, isroutine
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.env_checker import data_equivalence

_SINGLE = (type(None), bool, int, float, str)
_CONTAINERS = (dict, list, tuple, deque)
_TOOLS = ("gymnasium", "gymnasium_robotics")  # packages whose spaces, renderers and mazes don't change
#: Attributes that are kept in another way, and those that say how to draw
_LEFT_OUT = ("_np_random", "_ezpickle_args", "_ezpickle_kwargs", "metadata")
_OWN = "_sb3_gac_"  # beginning of the names of what this package writes into environments
_DRAWN = ("goal",)  # attributes that may be properties
_DRAWING = ("render_mode", "width", "height", "camera_id", "camera_name")


def attributes_of(env: gym.Env) -> tuple[dict[str, Any], list[str]]:
    """
    Copy the attributes that a checkpoint can hold.

    :param env: MuJoCo environment without wrappers
    :return: name -> copied value; and names of the attributes that may be part of the state, but can't be held
    """
    drawn = [name for name in _DRAWN if hasattr(env, name)]
    names = [name for name in {**vars(env), **dict.fromkeys(drawn)} if not name.startswith(_OWN)]
    names = [name for name in names if name not in (*_LEFT_OUT, *_DRAWING)]
    kinds = {name: _kind(getattr(env, name), env) for name in names}
    state = {name: getattr(env, name) for name, kind in kinds.items() if kind is _Kind.HELD}
    return deepcopy(state), [name for name, kind in kinds.items() if kind is _Kind.UNKNOWN]


def arguments_of(env: gym.Env) -> dict[str, Any] | None:
    """
    :param env: environment without wrappers
    :return: keyword arguments that ``gymnasium.make`` made it with, as far as a checkpoint can hold them; ``None`` if it was
        made in another way
    """
    if env.spec is None:
        return None
    return deepcopy({name: value for name, value in env.spec.kwargs.items() if _kind(value, env) is _Kind.HELD})


def restore_attributes(env: gym.Env, attributes: Mapping[str, Any], arguments: Mapping[str, Any] | None) -> None:
    """
    Set the attributes, except for arguments that the environment was made with and the checkpoint's was not.

    :param env: environment without wrappers
    :param attributes: attributes, from :func:`attributes_of`
    :param arguments: what :func:`arguments_of` returned for the checkpoint's environment
    """
    now = arguments_of(env)
    given = {} if now is None or arguments is None else {**arguments, **now}
    others = [name for name in given if not data_equivalence((arguments or {}).get(name), (now or {}).get(name), exact=True)]
    for name, value in attributes.items():
        if name.lstrip("_") not in others:
            setattr(env, name, value)


class _Kind(Enum):
    """What a checkpoint can do with a value."""

    HELD = auto()
    #: It does not change, or belongs to MuJoCo, whose state is kept apart
    NOT_NEEDED = auto()
    #: It may change, and can't be held
    UNKNOWN = auto()


def _kind(value: Any, env: Any) -> _Kind:
    if type(value) in _CONTAINERS:
        return _kind_of_parts(value, env)
    if isinstance(value, np.random.Generator):  # two names for one generator would become two generators
        return _Kind.UNKNOWN if value is env._np_random else _Kind.HELD
    if isinstance(value, np.ndarray) and _is_view(value):
        return _Kind.NOT_NEEDED
    if isinstance(value, np.ndarray):
        return _Kind.UNKNOWN if value.dtype == object else _Kind.HELD
    if type(value) in _SINGLE or isinstance(value, np.generic):
        return _Kind.HELD
    return _Kind.NOT_NEEDED if _is_fixed(value, env) else _Kind.UNKNOWN


def _kind_of_parts(value: Any, env: Any) -> _Kind:
    """The kind of all parts of a container; one whose parts differ, or whose keys JSON can't hold, is unknown."""
    parts = value.values() if isinstance(value, dict) else value
    kinds = {_kind(part, env) for part in parts} or {_Kind.HELD}
    has_names = not isinstance(value, dict) or all(isinstance(key, str) for key in value)
    return kinds.pop() if len(kinds) == 1 and has_names else _Kind.UNKNOWN


def _is_view(array: np.ndarray) -> bool:
    """Whether an array lies in the memory of MuJoCo's model or data: a copy would no longer follow them."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return type(base).__name__ == "PyCapsule"


def _is_fixed(value: Any, env: Any) -> bool:
    """Whether a value is code, a space or a renderer, or one of MuJoCo's objects that has no state beside ``env.data``."""
    package = type(value).__module__.partition(".")[0]
    if package == "mujoco":
        return type(value).__name__ != "MjData" or value is env.data
    is_same = not isinstance(value, gym.Env) or getattr(value, "data", None) is env.data  # some environments keep another's
    return (package in _TOOLS and is_same) or isclass(value) or ismodule(value) or isroutine(value)
