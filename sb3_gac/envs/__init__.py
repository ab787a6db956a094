"""Environments and wrappers that return ``partial`` and ``privileged``; importing it registers ``sb3_gac/*``."""

import warnings
from functools import partial
from importlib import import_module
from typing import Any

from sb3_gac.envs.actions import FlattenMultiDiscrete
from sb3_gac.envs.camera import CameraImage, NoRenderingError
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.subprocesses import take_along
from sb3_gac.envs.suites import SUITES, register
from sb3_gac.envs.suites.mujoco import make_mujoco
from sb3_gac.envs.suites.pendulum import make_pendulum
from sb3_gac.envs.suites.pixels import make_pixels
from sb3_gac.envs.suites.popgym import make_popgym
from sb3_gac.envs.wrappers import History, PreviousAction, SensorNoise, SplitDictObservation, SplitObservation

take_along()
for _suite in SUITES:
    register(_suite)

_FORMER = ("mujoco", "pendulum", "popgym")


def __getattr__(name: str) -> Any:
    """Names of earlier versions, for one release."""
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
    "CameraImage",
    "FlattenMultiDiscrete",
    "History",
    "NoRenderingError",
    "PreviousAction",
    "SensorNoise",
    "SplitDictObservation",
    "SplitObservation",
    "make_mujoco",
    "make_pendulum",
    "make_pixels",
    "make_popgym",
]
