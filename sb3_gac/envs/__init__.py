"""Environments and wrappers that return ``partial`` and ``privileged``; importing it registers ``sb3_gac/*``."""

from sb3_gac.envs.mujoco import make_mujoco, register_mujoco
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.wrappers import FlattenMultiDiscrete, History, SensorNoise, SplitDictObservation, SplitObservation

register_mujoco()

__all__ = [
    "PARTIAL",
    "PRIVILEGED",
    "FlattenMultiDiscrete",
    "History",
    "SensorNoise",
    "SplitDictObservation",
    "SplitObservation",
    "make_mujoco",
    "register_mujoco",
]
