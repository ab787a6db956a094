"""
MuJoCo Playground: robots and hands whose designers drew the line between what a robot senses and what only training knows.

``partial`` is the task's ``state``, with the noise of sensors that the task has itself, and ``privileged`` its
``privileged_state``, which begins with ``state`` to the bit: critics on ``privileged`` alone lose nothing.  EnvPool (extra
``envpool``) simulates them, with C MuJoCo on the CPU.
"""

from typing import Any, NamedTuple

from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.suites.extras import import_extra


class Robot(NamedTuple):
    """
    A task.

    :param actions: number of them, each in [-1, 1]
    :param partial: size of ``state``
    :param privileged: size of ``privileged_state``
    :param time_limit: steps of an episode
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


def make_playground(task: str, n_envs: int = 1, **kwargs: Any) -> Any:
    """
    Build vectorised environments of a task; ``sb3_gac.envs.make_vec("sb3_gac/<task>-v0")`` does so by id.

    :param task: a key of ``TASKS``
    :param n_envs: number of environments
    :param kwargs: of :class:`sb3_gac.envs.EnvPoolVecEnv`: ``noise_std``, ``time_limit``, ``num_threads`` and the task's own,
        such as ``noise_level``
    :raises ValueError: if the task is unknown
    :raises ImportError: if EnvPool is not installed, saying how to
    """
    if task not in TASKS:
        raise ValueError(f"task must be one of {sorted(TASKS)}, got {task!r}.")
    import_extra("envpool", "envpool", f"sb3_gac/{task}-v0")  # before SB3 and torch, which take seconds
    from sb3_gac.envs.vector.envpool import EnvPoolVecEnv

    split = {"partial": ["state"], "privileged": ["privileged_state"]}
    return EnvPoolVecEnv(f"MuJoCoPlayground/{task}-v1", n_envs, **split | kwargs)


#: Id -> how gymnasium makes it; time limits are counted by the vectorised environments
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    f"sb3_gac/{task}-v0": {
        "vec_entry_point": f"{__name__}:make_playground",
        "kwargs": {"task": task},
        "shapes": {PARTIAL: (robot.partial,), PRIVILEGED: (robot.privileged,), "action": (robot.actions,)},
    }
    for task, robot in TASKS.items()
}
