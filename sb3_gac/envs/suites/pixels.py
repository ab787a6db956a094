"""
MuJoCo locomotion from pixels: the last frames of a camera that follows the robot, and privileged the simulator's state.

``partial`` is uint8, channels first, (3 * frames, size, size), the oldest frame first; at an episode's start the first frame
repeats.  ``privileged`` is the clean state of :mod:`sb3_gac.envs.suites.mujoco`, as is what a step does.  MuJoCo draws with
OpenGL, see :data:`sb3_gac.envs.camera.HOW_TO_RENDER`.
"""

from typing import Any

import gymnasium as gym

from sb3_gac.envs.camera import CameraImage, no_rendering
from sb3_gac.envs.disturbances import delayed_and_dropped
from sb3_gac.envs.suites.mujoco import make_mujoco
from sb3_gac.envs.wrappers import History

TASKS = ("Ant", "HalfCheetah", "Hopper", "Humanoid", "Swimmer", "Walker2d")


def make_pixels(
    task: str,
    frames: int = 3,
    size: int = 64,
    camera: str = "track",
    privileged: str = "state",
    noise_std: float = 0.0,
    delay: int = 0,
    drop: float = 0.0,
    **kwargs: Any,
) -> gym.Env:
    """
    Build a task without its time limit, which ``gymnasium.make("sb3_gac/<task>Pixels-v5")`` adds.

    :param task: one of ``TASKS``
    :param frames: that ``partial`` has
    :param size: pixels of each side
    :param camera: its name in the model
    :param privileged: "state" for the whole clean state, "velocity" for velocities alone
    :param noise_std: 0: grey levels have no use for it
    :param delay: steps by which frames are late
    :param drop: probability that a frame is lost, and the last one shown again
    :param kwargs: of the gymnasium environment, but for those that change its observation
    :raises ValueError: if an argument is none of these, or ``noise_std`` is not 0, or ``delay`` or ``drop`` wrong
    :raises NoRenderingError: at the first reset, if there is no OpenGL to draw with
    """
    if task not in TASKS:
        raise ValueError(f"task must be one of {list(TASKS)}, got {task!r}.")
    if noise_std:
        raise ValueError(
            f"noise_std must be 0 for images, got {noise_std!r}: it is in the units of positions, and noise that is drawn for "
            "each pixel by itself hides nothing from an encoder, which averages over many."
        )
    try:
        import mujoco  # noqa: F401  # which looks for OpenGL at once, where MUJOCO_GL says of which kind
    except Exception as error:
        raise no_rendering(error) from error
    env = make_mujoco(task, noise_std=0.0, privileged=privileged, **kwargs)
    return History(delayed_and_dropped(CameraImage(env, size, camera), delay, drop), length=frames)


#: Id -> how gymnasium makes it, with its time limit of 1,000 steps
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    f"sb3_gac/{task}Pixels-v5": {
        "entry_point": f"{__name__}:make_pixels",
        "max_episode_steps": 1000,
        "kwargs": {"task": task},
        "whole_state": True,
    }
    for task in TASKS
}
