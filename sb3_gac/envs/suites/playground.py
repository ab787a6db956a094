"""
MuJoCo Playground: robots and hands whose designers separated the robot's senses from knowledge for training alone.

``partial`` is the task's ``state``, with the task's own sensor noise, and ``privileged`` its ``privileged_state``, which
begins with ``state`` to the bit: critics on ``privileged`` alone lose nothing.  EnvPool (extra ``envpool``) simulates the
tasks with C MuJoCo on the CPU.  With ``backend="mjx"`` Playground itself simulates them (extra ``playground``), on
accelerators.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.suites.extras import import_extra


class Robot(NamedTuple):
    """
    The sizes of a task.

    :param actions: number of an action's components, each in [-1, 1]
    :param partial: size of ``state``
    :param privileged: size of ``privileged_state``
    :param time_limit: number of steps after which an episode is truncated
    """

    actions: int
    partial: int
    privileged: int
    time_limit: int = 1000


TASKS = {
    "Go1JoystickFlatTerrain": Robot(12, 48, 123),
    "Go1JoystickRoughTerrain": Robot(12, 48, 123),
    "Go1Getup": Robot(12, 42, 91, 300),
    "Go1Handstand": Robot(12, 45, 94, 500),
    "Go1Footstand": Robot(12, 45, 94, 500),
    "SpotFlatTerrainJoystick": Robot(12, 81, 167),
    "BerkeleyHumanoidJoystickFlatTerrain": Robot(12, 52, 114),
    "BerkeleyHumanoidJoystickRoughTerrain": Robot(12, 52, 114),
    "T1JoystickFlatTerrain": Robot(23, 85, 180),
    "T1JoystickRoughTerrain": Robot(23, 85, 180),
    "G1JoystickFlatTerrain": Robot(29, 103, 216),
    "G1JoystickRoughTerrain": Robot(29, 103, 216),
    "ApolloJoystickFlatTerrain": Robot(32, 112, 224),
    "LeapCubeReorient": Robot(16, 57, 128),
    "LeapCubeRotateZAxis": Robot(16, 32, 105, 500),
    "AeroCubeRotateZAxis": Robot(7, 14, 81, 500),
}


def make_playground(task: str, n_envs: int = 1, backend: str = "envpool", **kwargs: Any) -> Any:
    """
    Build vectorised environments of a task; ``sb3_gac.envs.make_vec("sb3_gac/<task>-v0")`` does so by id.

    :param task: name of the task, a key of ``TASKS``
    :param n_envs: number of environments
    :param backend: simulator: "envpool" on the CPU, or "mjx", which is Playground itself, on JAX's default device
    :param kwargs: ``noise_std``, ``time_limit``, and further keyword arguments of the backend: those of
        :class:`sb3_gac.envs.EnvPoolVecEnv`, such as ``num_threads`` and the task's ``noise_level``, or of :func:`make_mjx`
    :return: vectorised environments
    :raises ValueError: if the task or the backend is unknown
    :raises ImportError: if the simulator is not installed; the message says how to install it
    """
    if task not in TASKS:
        raise ValueError(f"task must be one of {sorted(TASKS)}, got {task!r}.")
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {sorted(BACKENDS)}, got {backend!r}.")
    return BACKENDS[backend](task, n_envs, **_SPLIT | kwargs)


def _make_envpool(task: str, n_envs: int, **kwargs: Any) -> Any:
    import_extra("envpool", "envpool", f"sb3_gac/{task}-v0")  # before the imports of SB3 and torch, which take seconds
    from sb3_gac.envs.vector.envpool import EnvPoolVecEnv

    return EnvPoolVecEnv(f"MuJoCoPlayground/{task}-v1", n_envs, **kwargs)


def make_mjx(
    task: str,
    n_envs: int = 1,
    noise_level: float | None = None,
    impl: str | None = None,
    config: Mapping[str, Any] | None = None,
    **options: Any,
) -> Any:
    """
    Build vectorised environments of a task by Playground itself, which fetches its robots when it is first used.

    :param task: name of the task, a key of ``TASKS``
    :param n_envs: number of environments
    :param noise_level: level of the task's own sensor noise, 0 for none, ``None`` for the task's own level
    :param impl: implementation of MJX, "jax" or "warp"; ``None`` for "jax" on the CPU and the task's own elsewhere
    :param config: changes to Playground's configuration, dotted name -> value, such as ``{"pert_config.enable": True}``
    :param options: keyword arguments for :class:`~sb3_gac.envs.vector.base.BatchVecEnv`
    :return: vectorised environments
    :raises ImportError: if Playground is not installed; the message says how to install it
    """
    environment = f'sb3_gac/{task}-v0 with backend="mjx"'
    jax, playground = (import_extra(name, "playground", environment) for name in ("jax", "mujoco_playground"))
    from sb3_gac.envs.vector.jax_env import JaxVecEnv

    settings = playground.registry.get_default_config(task)
    if "impl" in settings and (impl is not None or jax.default_backend() == "cpu"):
        settings.impl = impl or "jax"
    if noise_level is not None:
        settings.noise_config.level = float(noise_level)
    env = playground.registry.load(task, config=settings, config_overrides=dict(config or {}))
    robot = TASKS[task]
    sizes = {"state": robot.partial, "privileged_state": robot.privileged}
    defaults = {
        "observation_space": spaces.Dict({key: spaces.Box(-np.inf, np.inf, (size,)) for key, size in sizes.items()}),
        "action_space": spaces.Box(-1.0, 1.0, (robot.actions,)),
        "time_limit": robot.time_limit,
    }
    return JaxVecEnv(env, n_envs, "playground", **defaults | _SPLIT | options)


_SPLIT = {"partial": ["state"], "privileged": ["privileged_state"]}
BACKENDS: dict[str, Callable[..., Any]] = {"envpool": _make_envpool, "mjx": make_mjx}

#: Id -> arguments of its registration; the vectorised environments count the time limits
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    f"sb3_gac/{task}-v0": {
        "vec_entry_point": f"{__name__}:make_playground",
        "kwargs": {"task": task},
        "shapes": {PARTIAL: (robot.partial,), PRIVILEGED: (robot.privileged,), "action": (robot.actions,)},
    }
    for task, robot in TASKS.items()
}
