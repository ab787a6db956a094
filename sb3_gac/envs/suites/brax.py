"""
The paper's five tasks in Brax, with the paper's backend ``spring``, split as in its Table 7.

=======================  ====================================================  =======  =====================
task                     Brax's observation                                    partial  privileged="velocity"
=======================  ====================================================  =======  =====================
brax-HalfCheetah         q[1:] 8, qd 9                                         8        9
brax-Ant                 q[2:] 13, qd 14                                       13       14
brax-Humanoid(Standup)   q[2:] 22, qd 23, inertia 110, velocity 66, torque 23  155      89 = qd 23, velocity 66
brax-InvertedDouble\\     x, sin 2, cos 2, qd 3 (clipped to +-10)               5        3
Pendulum
=======================  ====================================================  =======  =====================

``privileged="state"`` is the whole clean state: the velocities, and the components of ``partial`` without noise.  Episodes are
truncated after 1,000 steps, and actions are in [-1, 1].  All environments are stepped together::

    env = sb3_gac.envs.make_vec("sb3_gac/brax-HalfCheetah-v0", n_envs=128, noise_std=0.1)
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.suites.extras import import_extra
from sb3_gac.envs.suites.layout import TaskLayout, positions_first, visible_in

if TYPE_CHECKING:
    from sb3_gac.envs.vector.jax_env import JaxVecEnv

EXTRA = "brax"
TIME_LIMIT = 1000


def _humanoid(name: str) -> TaskLayout:
    """The layout q[2:] 0:22, qd 22:45, inertia 45:155 and velocity 155:221 about the centre of mass, torques 221:244."""
    return TaskLayout(name, (*range(22), *range(45, 155), *range(221, 244)), (*range(22, 45), *range(155, 221)))


#: Task -> layout of Brax's observation, with Brax's name of the task
TASKS: dict[str, TaskLayout] = {
    "InvertedDoublePendulum": positions_first("inverted_double_pendulum", 5, 3),
    "HalfCheetah": positions_first("halfcheetah", 8, 9),
    "Ant": positions_first("ant", 13, 14),
    "Humanoid": _humanoid("humanoid"),
    "HumanoidStandup": _humanoid("humanoidstandup"),
}
_ACTIONS = {"InvertedDoublePendulum": 1, "HalfCheetah": 6, "Ant": 8, "Humanoid": 17, "HumanoidStandup": 17}


def make_brax(
    task: str,
    n_envs: int = 1,
    noise_std: float | Sequence[float] = 0.1,
    privileged: str = "state",
    backend: str = "spring",
    time_limit: int = TIME_LIMIT,
    **kwargs: Any,
) -> "JaxVecEnv":
    """
    Build environments that Brax steps together.

    :param task: name of the task, a key of ``TASKS``
    :param n_envs: number of environments side by side
    :param noise_std: standard deviation of the noise on ``partial``, in the observation's own units; 0 for none
    :param privileged: "state" for the whole clean state, "velocity" for velocities alone
    :param backend: physics of Brax: "spring" as in the paper, "positional", "generalized" or "mjx"
    :param time_limit: number of steps after which an episode is truncated
    :param kwargs: keyword arguments of Brax's environment, except those that change its observation, with which the first
        reset raises a ``ValueError``
    :return: vectorised environments
    :raises ValueError: if ``task`` or ``privileged`` is unknown, or ``noise_std`` is negative
    :raises ImportError: if Brax is not installed; the message says how to install it
    """
    if task not in TASKS:
        raise ValueError(f"task must be one of {sorted(TASKS)}, got {task!r}.")
    layout = TASKS[task]
    visible = visible_in(layout, privileged)
    envs = import_extra("brax.envs", EXTRA, f"brax-{task}")
    from sb3_gac.envs.vector.jax_env import JaxVecEnv

    env = envs.get_environment(layout.env_id, backend=backend, **kwargs)
    return JaxVecEnv(
        env,
        n_envs,
        EXTRA,
        observation_space=spaces.Box(-np.inf, np.inf, (layout.size,), np.float32),
        action_space=spaces.Box(-1.0, 1.0, (_ACTIONS[task],), np.float32),
        partial=layout.partial,
        privileged=visible,
        time_limit=time_limit,
        noise_std=noise_std,
    )


#: Id -> arguments of its registration; the vectorised environments count the time limits
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    f"sb3_gac/brax-{task}-v0": {
        "vec_entry_point": f"{__name__}:make_brax",
        "kwargs": {"task": task},
        "shapes": {
            PARTIAL: (len(layout.partial),),
            PRIVILEGED: (len(visible_in(layout, "state")),),
            "action": (_ACTIONS[task],),
        },
    }
    for task, layout in TASKS.items()
}
