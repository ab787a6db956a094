"""
MuJoCo locomotion with noisy positions: gymnasium's v5 tasks, split as in the paper's Table 7 where v5 allows it.

=======================  ====================================================  =======  ========================
task                     v5 observation                                        partial  privileged="velocity"
=======================  ====================================================  =======  ========================
HalfCheetah              qpos[1:] 8, qvel 9                                    8        9
Ant                      qpos[2:] 13, qvel 14 (no contact forces)              13       14
Humanoid(Standup)        qpos 22, qvel 23, cinert 130, cvel 78, actuator 17    169      101 = qvel, cvel
InvertedDoublePendulum   x, sin 2, cos 2, qvel 3 (constraint force dropped)    5        3
Hopper                   qpos[1:] 5, qvel 6 (clipped to +-10)                  5        6
Walker2d                 qpos[1:] 8, qvel 9 (clipped to +-10)                  8        9
Swimmer                  qpos[2:] 3, qvel 5                                    3        5
=======================  ====================================================  =======  ========================

``privileged="state"`` is the whole clean state: the velocities, and the components of ``partial`` without noise.  The tasks
are equivalents of the paper's Brax tasks, not reproductions: time step and control ranges are gymnasium's.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym

from sb3_gac.envs.suites.layout import TaskLayout, make_task, positions_first


def _humanoid(env_id: str) -> TaskLayout:
    """The layout qpos 0:22, qvel 22:45, cinert 45:175, cvel 175:253, qfrc_actuator 253:270, without contact forces."""
    partial = (*range(22), *range(45, 175), *range(253, 270))
    velocity = (*range(22, 45), *range(175, 253))
    return TaskLayout(env_id, partial, velocity, {"include_cfrc_ext_in_observation": False})


#: Warning about one of gymnasium's XML files, which users of a task can't change
_DEPRECATED = "compiler attribute 'settotalmass' is deprecated"


TASKS: dict[str, TaskLayout] = {
    "HalfCheetah": positions_first("HalfCheetah-v5", 8, 9),
    "Ant": positions_first("Ant-v5", 13, 14, include_cfrc_ext_in_observation=False),
    "Humanoid": _humanoid("Humanoid-v5"),
    "HumanoidStandup": _humanoid("HumanoidStandup-v5"),
    "InvertedDoublePendulum": positions_first("InvertedDoublePendulum-v5", 5, 3, n_unused=1),
    "Hopper": positions_first("Hopper-v5", 5, 6),
    "Walker2d": positions_first("Walker2d-v5", 8, 9),
    "Swimmer": positions_first("Swimmer-v5", 3, 5),
}


def make_mujoco(
    task: str,
    noise_std: float = 0.1,
    privileged: str = "state",
    history: int = 1,
    delay: int = 0,
    drop: float = 0.0,
    **kwargs: Any,
) -> gym.Env:
    """
    Build a task without its time limit, which ``gymnasium.make("sb3_gac/<task>-v5")`` adds.

    :param task: name of the task, a key of ``TASKS``
    :param noise_std: standard deviation of the noise on ``partial``, in the observation's own units; 0 for none
    :param privileged: "state" for the whole clean state, "velocity" for velocities alone
    :param history: number of noisy observations in ``partial``, the newest last, followed by the actions between them
    :param delay: number of steps by which ``partial`` is late
    :param drop: probability that an observation of ``partial`` is lost, and the last one shown again
    :param kwargs: keyword arguments of gymnasium's environment, except those that change its observation
    :return: environment with ``partial`` and ``privileged``
    :raises ValueError: if the task is unknown, another argument is wrong, or ``kwargs`` change the observation
    """
    if task not in TASKS:
        raise ValueError(f"task must be one of {sorted(TASKS)}, got {task!r}.")
    misplacing = sorted(name for name in kwargs if name.endswith("_observation"))
    if misplacing:
        raise ValueError(f"{misplacing} would change the observation, which is split by position: leave them out.")
    with _without_deprecation():
        return make_task(TASKS[task], noise_std, privileged, history, delay, drop, **kwargs)


@contextmanager
def _without_deprecation() -> Iterator[None]:
    """
    Silence the warning :data:`_DEPRECATED`, which MuJoCo would write to stderr and to a file in the working directory.

    All other warnings of MuJoCo go to the handler that was set before, or, where there was none, to Python's warnings.
    """
    import mujoco

    before = mujoco.get_mju_user_warning()

    def handle(message: str) -> None:
        if _DEPRECATED in message:
            return
        if before is None:
            warnings.warn(f"MuJoCo: {message}", stacklevel=2)
        else:
            before(message)

    mujoco.set_mju_user_warning(handle)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


#: Id -> arguments of its registration, with its time limit of 1,000 steps
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    f"sb3_gac/{task}-v5": {
        "entry_point": f"{__name__}:make_mujoco",
        "max_episode_steps": 1000,
        "kwargs": {"task": task},
    }
    for task in TASKS
}
