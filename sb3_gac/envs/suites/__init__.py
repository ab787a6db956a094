"""
The registered environments, suite by suite: one table.

A suite is a module with ``ENVIRONMENTS``, from ids to what ``gymnasium.register`` takes.  It imports its simulator when an
environment is made, and says with :func:`~sb3_gac.envs.suites.extras.import_extra` how to install it.
"""

from collections.abc import Mapping
from importlib import import_module
from typing import Any, NamedTuple

import gymnasium as gym


class Suite(NamedTuple):
    """
    Environments that belong together.

    :param module: has them
    :param sensor_noise: whether they take ``noise_std``, and their privileged entry is the whole state
    :param extra: of this package, with which their simulator is installed; ``None`` where it always is
    """

    module: str
    sensor_noise: bool = False
    extra: str | None = None

    @property
    def environments(self) -> Mapping[str, Mapping[str, Any]]:
        """Id -> arguments of ``gymnasium.register``."""
        found: Mapping[str, Mapping[str, Any]] = import_module(self.module).ENVIRONMENTS
        return found


SUITES = {
    "mujoco": Suite("sb3_gac.envs.suites.mujoco", sensor_noise=True),
    "pixels": Suite("sb3_gac.envs.suites.pixels"),
    "pendulum": Suite("sb3_gac.envs.suites.pendulum", sensor_noise=True),
    "popgym": Suite("sb3_gac.envs.suites.popgym", extra="popgym"),
}


def register(suite: str) -> None:
    """
    :param suite: a key of ``SUITES``, whose environments gymnasium is to know
    """
    for env_id, arguments in SUITES[suite].environments.items():
        gym.register(env_id, **arguments)


def suite_of(env_id: str) -> str | None:
    """
    :param env_id: of an environment
    :return: the suite that has it, ``None`` if it is none of this package's
    """
    return next((name for name, suite in SUITES.items() if env_id in suite.environments), None)


def task_of(env_id: str) -> str:
    """
    :param env_id: ``sb3_gac/<task>-v<version>``
    :return: the task, as presets and benchmarks name it
    """
    return env_id.removeprefix("sb3_gac/").rpartition("-v")[0]
