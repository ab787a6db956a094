"""Environments and wrappers that return ``partial`` and ``privileged``; importing it registers ``sb3_gac/*``."""

from sb3_gac.envs.actions import FlattenMultiDiscrete
from sb3_gac.envs.mujoco import make_mujoco, register_mujoco
from sb3_gac.envs.pendulum import make_pendulum, register_pendulum
from sb3_gac.envs.popgym import make_popgym, register_popgym
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.subprocesses import take_along
from sb3_gac.envs.wrappers import History, PreviousAction, SensorNoise, SplitDictObservation, SplitObservation

take_along()
register_mujoco()
register_pendulum()
register_popgym()

__all__ = [
    "PARTIAL",
    "PRIVILEGED",
    "FlattenMultiDiscrete",
    "History",
    "PreviousAction",
    "SensorNoise",
    "SplitDictObservation",
    "SplitObservation",
    "make_mujoco",
    "make_pendulum",
    "make_popgym",
    "register_mujoco",
    "register_pendulum",
    "register_popgym",
]
