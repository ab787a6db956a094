"""
The registered environments, suite by suite: one table.

A suite is a module with ``ENVIRONMENTS``, from ids to what ``gymnasium.register`` takes.  It imports its simulator when an
environment is made, and says with :func:`~sb3_gac.envs.suites.extras.import_extra` how to install it.  Beside gymnasium's own
arguments there may be

``vec_entry_point``
    in the place of ``entry_point``, where the simulator steps many environments at once: ``module:function``, which takes
    ``n_envs`` and the ``kwargs``, and returns SB3's ``VecEnv``.  ``gymnasium.make`` makes one environment of it.
``shapes``
    of the entries and of the actions, ``{"partial": (48,), "privileged": (123,), "action": (12,)}``, so that they are known
    without the simulator.
``whole_state``
    whether the privileged entry has all that ``partial`` shows, so that critics need nothing else; by default, what the suite
    says.
"""

from collections.abc import Callable, Mapping
from difflib import SequenceMatcher
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import gymnasium as gym

from sb3_gac.envs.suites.extras import missing_extra


class Suite(NamedTuple):
    """
    Environments that belong together.

    :param module: has them
    :param sensor_noise: whether they take ``noise_std``, and, if an environment does not say otherwise, their privileged entry
        has the whole state
    :param history: whether they take ``history``, a number of observations that ``partial`` then has
    :param extra: of this package, with which their simulator is installed; ``None`` where it always is, or no index has it
    :param simulator: module that it is then found by, by default of the extra's name
    :param preset: with which ``python -m sb3_gac.train`` trains on them
    :param noise_std: with which it does, 0 where sensors are noisy without
    """

    module: str
    sensor_noise: bool = False
    history: bool = False
    extra: str | None = None
    simulator: str | None = None
    preset: str = "small"
    noise_std: float = 0.1

    @property
    def environments(self) -> Mapping[str, Mapping[str, Any]]:
        """Id -> arguments of ``gymnasium.register``."""
        found: Mapping[str, Mapping[str, Any]] = import_module(self.module).ENVIRONMENTS
        return found

    @property
    def is_installed(self) -> bool:
        """Whether its simulator is there; it is not imported."""
        module = self.simulator or self.extra
        return module is None or find_spec(module) is not None

    def how_to_install(self, user: str) -> str:
        """
        :param user: what can't be made without the simulator, such as a task
        :return: a sentence that says what is missing
        """
        if self.extra is None:
            return f"{user} needs {self.simulator}, which no package index has: docs/environments.md says how to install it."
        return str(missing_extra(user, self.simulator or self.extra, self.extra))

    def shows_whole_state(self, env_id: str) -> bool:
        """
        :param env_id: of one of its environments
        :return: whether the privileged entry has all that ``partial`` shows
        """
        return bool(self.environments[env_id].get("whole_state", self.sensor_noise))


_NAMESPACE = "sb3_gac/"
#: Arguments of an environment that are this package's, not gymnasium's
_OWN = ("vec_entry_point", "shapes", "whole_state")
_SINGLE = "sb3_gac.envs.vector.single:make_single"

SUITES = {
    "mujoco": Suite("sb3_gac.envs.suites.mujoco", sensor_noise=True, history=True),
    "pendulum": Suite("sb3_gac.envs.suites.pendulum", sensor_noise=True, history=True),
    "pixels": Suite("sb3_gac.envs.suites.pixels", preset="pixels"),
    "tiger_door": Suite("sb3_gac.envs.suites.tiger_door", noise_std=0.0),
    "popgym": Suite("sb3_gac.envs.suites.popgym", extra="popgym"),
    "playground": Suite(
        "sb3_gac.envs.suites.playground", sensor_noise=True, extra="envpool", preset="playground", noise_std=0.0
    ),
    "humanoid_bench": Suite(
        "sb3_gac.envs.suites.humanoid_bench", sensor_noise=True, history=True, simulator="humanoid_bench", noise_std=0.0
    ),
    "brax": Suite("sb3_gac.envs.suites.brax", sensor_noise=True, extra="brax"),
    "robotics": Suite("sb3_gac.envs.suites.robotics", sensor_noise=True, history=True, preset="robotics", noise_std=0.0),
}


def register(suite: str) -> None:
    """
    :param suite: a key of ``SUITES``, whose environments gymnasium is to know
    """
    for env_id, arguments in SUITES[suite].environments.items():
        of_gymnasium = {name: value for name, value in arguments.items() if name not in _OWN}
        if "vec_entry_point" in arguments:
            of_gymnasium |= {"entry_point": _SINGLE, "kwargs": {"env_id": env_id}}
        gym.register(env_id, **of_gymnasium)


def suite_of(env_id: str) -> str | None:
    """
    :param env_id: of an environment
    :return: the suite that has it, ``None`` if it is none of this package's
    """
    return next((name for name, suite in SUITES.items() if env_id in suite.environments), None)


def env_id_of(task: str) -> str:
    """
    :param task: a task's name, or an id, see :func:`task_named`
    :return: the id of the task's environment
    :raises ValueError: naming the nearest tasks, if there is none
    """
    return registered_tasks()[task_named(task)]


def registered_tasks() -> dict[str, str]:
    """
    :return: task -> id of its environment, of this package's suites and of whatever else is registered as ``sb3_gac/...``
    """
    of_suites = [env_id for suite in SUITES.values() for env_id in suite.environments]
    others = [env_id for env_id in gym.registry if env_id.startswith(_NAMESPACE)]
    return {task_of(env_id): env_id for env_id in (*others, *of_suites)}


def task_named(name: str) -> str:
    """
    :param name: a task's name, or the id of its environment: ``HalfCheetah``, ``HalfCheetah-v5``,
        ``sb3_gac/HalfCheetah-v5``, or, after a module that registers it, ``sb3_gac:sb3_gac/HalfCheetah-v5``
    :return: the task's name, ``HalfCheetah``
    :raises ValueError: naming the nearest tasks, if there is none
    """
    ids = registered_tasks()
    plain = name.rpartition(":")[2].removeprefix(_NAMESPACE)
    named = {**{env_id.removeprefix(_NAMESPACE): task for task, env_id in ids.items()}, **{task: task for task in ids}}
    if plain not in named:
        nearest = sorted(ids, key=lambda task: _likeness(task.casefold(), plain.casefold()), reverse=True)[:3]
        raise ValueError(
            f"task must be one of the registered sb3_gac/<task>-v<version>, which python -m sb3_gac.envs lists; the nearest "
            f"are {nearest}, got {name!r}."
        )
    return named[plain]


def _likeness(one: str, other: str) -> tuple[bool, float]:
    """More for names that are alike, most for those of which one holds the other."""
    return one in other or other in one, SequenceMatcher(None, one, other).ratio()


def is_batched(env_id: str) -> bool:
    """
    :param env_id: of an environment
    :return: whether it is of a suite whose simulator steps many environments at once
    """
    suite = suite_of(env_id)
    return suite is not None and "vec_entry_point" in SUITES[suite].environments[env_id]


def batch_factory(env_id: str) -> tuple[Callable[..., Any], dict[str, Any]]:
    """
    :param env_id: of an environment that :func:`is_batched`
    :return: what makes vectorised environments, given ``n_envs``, and the task's keyword arguments of it
    :raises ValueError: if its simulator steps one environment at a time
    """
    if not is_batched(env_id):
        raise ValueError(f"env_id must be of a suite whose simulator steps a batch, got {env_id!r}.")
    arguments = SUITES[suite_of(env_id) or ""].environments[env_id]
    module, _, function = arguments["vec_entry_point"].partition(":")
    return getattr(import_module(module), function), dict(arguments.get("kwargs", {}))


def task_of(env_id: str) -> str:
    """
    :param env_id: ``sb3_gac/<task>-v<version>``
    :return: the task, as presets and benchmarks name it
    """
    return env_id.removeprefix(_NAMESPACE).rpartition("-v")[0]


def shows_whole_state(task: str) -> bool:
    """
    :param task: see :func:`task_of`
    :return: whether its privileged entry has all that ``partial`` shows; of a task that is none of this package's, ``True``
    """
    suite = suite_of(env_id := registered_tasks().get(task, ""))
    return suite is None or SUITES[suite].shows_whole_state(env_id)
