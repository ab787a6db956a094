"""Environments and wrappers that return ``partial`` and ``privileged``; importing this package registers ``sb3_gac/*``."""

import warnings
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from sb3_gac.envs.actions import FlattenMultiDiscrete
from sb3_gac.envs.camera import CameraImage, NoRenderingError
from sb3_gac.envs.disturbances import DroppedFrames, SensorDelay
from sb3_gac.envs.goals import AppendDesiredGoal
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.subprocesses import take_along
from sb3_gac.envs.suites import SUITES, register
from sb3_gac.envs.suites.humanoid_bench import make_humanoid_bench
from sb3_gac.envs.suites.mujoco import make_mujoco
from sb3_gac.envs.suites.pendulum import make_pendulum
from sb3_gac.envs.suites.pixels import make_pixels
from sb3_gac.envs.suites.popgym import make_popgym
from sb3_gac.envs.suites.robotics import make_robotics
from sb3_gac.envs.wrappers import History, PreviousAction, SensorNoise, SplitDictObservation, SplitObservation

if TYPE_CHECKING:
    from sb3_gac.envs.vector.base import BatchStep, BatchVecEnv
    from sb3_gac.envs.vector.envpool import EnvPoolVecEnv
    from sb3_gac.envs.vector.groups import GroupsVecEnv
    from sb3_gac.envs.vector.jax_env import JaxVecEnv
    from sb3_gac.envs.vector.registry import make_vec

take_along()
for _suite in SUITES:
    register(_suite)

#: Name -> module that defines it. These modules import SB3, and SB3 imports torch, which the other environments do without
_VECTOR = {
    "BatchStep": "sb3_gac.envs.vector.base",
    "BatchVecEnv": "sb3_gac.envs.vector.base",
    "EnvPoolVecEnv": "sb3_gac.envs.vector.envpool",
    "GroupsVecEnv": "sb3_gac.envs.vector.groups",
    "JaxVecEnv": "sb3_gac.envs.vector.jax_env",
    "make_vec": "sb3_gac.envs.vector.registry",
}
_FORMER = ("mujoco", "pendulum", "popgym")


def __getattr__(name: str) -> Any:
    """Import a vectorised environment when it is first used; names of earlier versions stay for one release."""
    if name in _VECTOR:
        return getattr(import_module(_VECTOR[name]), name)
    if name in _FORMER:
        return import_module(f"{__name__}.{name}")
    suite = name.removeprefix("register_")
    if suite == name or suite not in _FORMER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    warnings.warn(f'{__name__}.{name}() is sb3_gac.envs.suites.register("{suite}") now.', DeprecationWarning, stacklevel=2)
    return partial(register, suite)


__all__ = [
    "PARTIAL",
    "PRIVILEGED",
    "AppendDesiredGoal",
    "BatchStep",
    "BatchVecEnv",
    "CameraImage",
    "DroppedFrames",
    "EnvPoolVecEnv",
    "FlattenMultiDiscrete",
    "GroupsVecEnv",
    "History",
    "JaxVecEnv",
    "NoRenderingError",
    "PreviousAction",
    "SensorDelay",
    "SensorNoise",
    "SplitDictObservation",
    "SplitObservation",
    "make_humanoid_bench",
    "make_mujoco",
    "make_pendulum",
    "make_pixels",
    "make_popgym",
    "make_robotics",
    "make_vec",
]
