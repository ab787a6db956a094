"""
A table of the registered environments, suite by suite.

A suite is a module with ``ENVIRONMENTS``, a mapping from ids to the arguments of ``gymnasium.register``.  The module imports
its simulator when an environment is made, by :func:`~sb3_gac.envs.suites.extras.import_extra`, which says how to install a
missing one.  Beside gymnasium's own arguments there may be

``vec_entry_point``
    ``module:function``, in the place of ``entry_point``, where the simulator steps many environments at once.  The function
    takes ``n_envs`` and the ``kwargs``, and returns SB3's ``VecEnv``.  ``gymnasium.make`` makes one environment of it.
``shapes``
    shapes of the entries and of the actions, such as ``{"partial": (48,), "privileged": (123,), "action": (12,)}``, which are
    then known without the simulator.
``whole_state``
    whether the privileged entry has all that ``partial`` shows, so that critics need no other entry; by default, the suite's
    ``sensor_noise``.
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

    :param module: path of the module that has the environments
    :param sensor_noise: whether the environments take ``noise_std``; also whether their privileged entry has the whole state,
        unless an environment says otherwise
    :param history: whether the environments take ``history``, the number of observations that ``partial`` then has
    :param extra: extra of this package that installs the simulator; ``None`` if it is always installed, or no index has it
    :param simulator: name of the module that tells whether the simulator is installed, by default the extra's name
    :param preset: name of the preset with which ``python -m sb3_gac.train`` trains on the environments
    :param noise_std: standard deviation of the sensor noise in ``python -m sb3_gac.train`` if none is given
    :param privileged: values that the environments' argument ``privileged`` may have, the default first; empty if they have
        no such argument
    :param own_noise: name of the simulator's argument for the level of sensor noise of its own, which ``noise_std`` comes on
        top of, and which 0 leaves out; ``None`` if the simulator has no such noise
    """

    module: str
    sensor_noise: bool = False
    history: bool = False
    extra: str | None = None
    simulator: str | None = None
    preset: str = "small"
    noise_std: float = 0.1
    privileged: tuple[str, ...] = ()
    own_noise: str | None = None

    @property
    def environments(self) -> Mapping[str, Mapping[str, Any]]:
        """Id -> arguments of ``gymnasium.register``."""
        found: Mapping[str, Mapping[str, Any]] = import_module(self.module).ENVIRONMENTS
        return found

    @property
    def is_installed(self) -> bool:
        """Whether the simulator is installed; it is not imported to find out."""
        module = self.simulator or self.extra
        return module is None or find_spec(module) is not None

    def how_to_install(self, user: str) -> str:
        """
        :param user: name of what can't be made without the simulator, such as a task
        :return: sentence that says what is missing and how to install it
        """
        if self.extra is None:
            return f"{user} needs {self.simulator}, which no package index has: docs/environments.md says how to install it."
        return str(missing_extra(user, self.simulator or self.extra, self.extra))

    def shows_whole_state(self, env_id: str) -> bool:
        """
        :param env_id: id of one of the suite's environments
        :return: whether the environment's privileged entry has all that ``partial`` shows
        """
        return bool(self.environments[without_module(env_id)].get("whole_state", self.sensor_noise))


_NAMESPACE = "sb3_gac/"
#: Least likeness of names that a message calls near
_NEAR = (False, 0.7)
#: Arguments of an environment that are for this package, not for gymnasium
_OWN = ("vec_entry_point", "shapes", "whole_state")
#: Arguments of environments that are stepped one at a time -> value that changes nothing
_ONE_AT_A_TIME: dict[str, Any] = {"history": 1, "delay": 0, "drop": 0.0}
_CLEAN, _HIDDEN = ("state", "velocity"), ("hidden", "state")
_SINGLE = "sb3_gac.envs.vector.single:make_single"

SUITES = {
    "mujoco": Suite("sb3_gac.envs.suites.mujoco", sensor_noise=True, history=True, privileged=_CLEAN),
    "pendulum": Suite("sb3_gac.envs.suites.pendulum", sensor_noise=True, history=True, privileged=_CLEAN),
    "pixels": Suite("sb3_gac.envs.suites.pixels", preset="pixels", privileged=_CLEAN),
    "tiger_door": Suite("sb3_gac.envs.suites.tiger_door", noise_std=0.0),
    "popgym": Suite("sb3_gac.envs.suites.popgym", extra="popgym"),
    "playground": Suite(
        "sb3_gac.envs.suites.playground",
        sensor_noise=True,
        extra="envpool",
        preset="playground",
        noise_std=0.0,
        own_noise="noise_level",
    ),
    "humanoid_bench": Suite(
        "sb3_gac.envs.suites.humanoid_bench",
        sensor_noise=True,
        history=True,
        simulator="humanoid_bench",
        noise_std=0.0,
        privileged=_HIDDEN,
    ),
    "brax": Suite("sb3_gac.envs.suites.brax", sensor_noise=True, extra="brax", privileged=_CLEAN),
    "robotics": Suite(
        "sb3_gac.envs.suites.robotics", sensor_noise=True, history=True, preset="robotics", noise_std=0.0, privileged=_HIDDEN
    ),
}


def register(suite: str) -> None:
    """
    Register a suite's environments with gymnasium.

    :param suite: name of the suite, a key of ``SUITES``
    """
    for env_id, arguments in SUITES[suite].environments.items():
        of_gymnasium = {name: value for name, value in arguments.items() if name not in _OWN}
        if "vec_entry_point" in arguments:
            of_gymnasium |= {"entry_point": _SINGLE, "kwargs": {"env_id": env_id}}
        gym.register(env_id, **of_gymnasium)


def suite_of(env_id: str) -> str | None:
    """
    Find the suite that has an environment.

    :param env_id: id of an environment, alone or after a module that registers it, as in ``sb3_gac:sb3_gac/HalfCheetah-v5``
    :return: name of the suite that has the environment, ``None`` if no suite of this package has it
    """
    plain = without_module(env_id)
    return next((name for name, suite in SUITES.items() if plain in suite.environments), None)


def registered_id(env_id: str) -> str:
    """
    Find the id under which an environment is in this package's suites.

    :param env_id: id of an environment, alone or after a module that registers it
    :return: id without the module if a suite of this package has the environment, otherwise the id as it is
    """
    return env_id if suite_of(env_id) is None else without_module(env_id)


def without_module(env_id: str) -> str:
    """
    :param env_id: id of an environment, alone or after a module that registers it and a colon
    :return: id alone
    """
    return env_id.rpartition(":")[2]


def env_id_of(task: str) -> str:
    """
    Find the id of a task's environment.

    :param task: name of a task, or id of its environment, in any form that :func:`task_named` takes
    :return: id of the task's environment
    :raises ValueError: if there is no such task; the message names the nearest ones
    """
    return registered_tasks()[task_named(task)]


def registered_tasks() -> dict[str, str]:
    """
    :return: task -> id of its environment, for this package's suites and all else that is registered as ``sb3_gac/...``
    """
    of_suites = [env_id for suite in SUITES.values() for env_id in suite.environments]
    others = [env_id for env_id in gym.registry if env_id.startswith(_NAMESPACE)]
    return {task_of(env_id): env_id for env_id in (*others, *of_suites)}


def task_named(name: str) -> str:
    """
    Find a task by its name or by the id of its environment.

    :param name: name of a task, or id of its environment: ``HalfCheetah``, ``HalfCheetah-v5``, ``sb3_gac/HalfCheetah-v5``, or,
        after a module that registers the environment, ``sb3_gac:sb3_gac/HalfCheetah-v5``
    :return: name of the task, such as ``HalfCheetah``
    :raises ValueError: if there is no such task; the message names the nearest ones
    """
    ids = registered_tasks()
    plain = without_module(name).removeprefix(_NAMESPACE)
    named = {**{env_id.removeprefix(_NAMESPACE): task for task, env_id in ids.items()}, **{task: task for task in ids}}
    if plain not in named:
        likeness = {task: _likeness(task.casefold(), plain.casefold()) for task in ids}
        near = [task for task in sorted(ids, key=likeness.__getitem__, reverse=True) if likeness[task] >= _NEAR][:3]
        nearest = f"; the nearest are {near}" if near else ""
        raise ValueError(
            f"task must be one of the registered sb3_gac/<task>-v<version>, which python -m sb3_gac.envs lists{nearest}, got "
            f"{name!r}. For an environment of your own, leave task out."
        )
    return named[plain]


def _likeness(one: str, other: str) -> tuple[bool, float]:
    """Likeness of two names: larger for names that are more alike, largest where one contains the other."""
    return one in other or other in one, SequenceMatcher(None, one, other).ratio()


def is_batched(env_id: str) -> bool:
    """
    :param env_id: id of an environment
    :return: whether its simulator steps many environments at once
    """
    suite = suite_of(env_id)
    return suite is not None and "vec_entry_point" in SUITES[suite].environments[without_module(env_id)]


def batch_factory(env_id: str) -> tuple[Callable[..., Any], dict[str, Any]]:
    """
    Find the function that makes an environment's vectorised form.

    :param env_id: id of an environment for which :func:`is_batched` is true
    :return: function that makes vectorised environments, given ``n_envs``, and the task's keyword arguments for it
    :raises ValueError: if its simulator steps one environment at a time
    """
    if not is_batched(env_id):
        raise ValueError(f"env_id must be of a suite whose simulator steps a batch, got {env_id!r}.")
    arguments = SUITES[suite_of(env_id) or ""].environments[without_module(env_id)]
    module, _, function = arguments["vec_entry_point"].partition(":")
    return getattr(import_module(module), function), dict(arguments.get("kwargs", {}))


def make_batch(env_id: str, n_envs: int, **kwargs: Any) -> Any:
    """
    Make an environment's vectorised form.

    :param env_id: id of an environment for which :func:`is_batched` is true
    :param n_envs: number of environments
    :param kwargs: keyword arguments of the environment
    :return: vectorised environments
    :raises ValueError: if a history, delays or losses are asked for, which such environments do not have
    """
    factory, of_task = batch_factory(env_id)
    for name, none in _ONE_AT_A_TIME.items():
        if kwargs.pop(name, none) != none:
            raise ValueError(
                f"{name} is for environments that are stepped one at a time, and {env_id} is one simulator of many."
            )
    return factory(n_envs=n_envs, **of_task | kwargs)


def task_of(env_id: str) -> str:
    """
    :param env_id: id of the form ``sb3_gac/<task>-v<version>``, alone or after a module that registers it
    :return: name of the task, as presets and benchmarks have it
    """
    return without_module(env_id).removeprefix(_NAMESPACE).rpartition("-v")[0]


def shows_whole_state(task: str) -> bool:
    """
    :param task: name of a task, as :func:`task_of` returns it
    :return: whether the task's privileged entry has all that ``partial`` shows; ``True`` if no suite has the task
    """
    suite = suite_of(env_id := registered_tasks().get(task, ""))
    return suite is None or SUITES[suite].shows_whole_state(env_id)
