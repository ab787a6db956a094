"""
MuJoCo locomotion from pixels: ``partial`` is the last frames of a camera that follows the robot.

``partial`` is uint8, channels first, (3 * frames, size, size), the oldest frame first; at an episode's start the first frame
repeats.  ``privileged`` is the clean state, as in :mod:`sb3_gac.envs.suites.mujoco`, and the dynamics are the same.  MuJoCo
draws with OpenGL; :data:`sb3_gac.envs.camera.HOW_TO_RENDER` says how to enable it.
"""

from typing import Any

import gymnasium as gym
import numpy as np

from sb3_gac.envs.arguments import check_count
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

    :param task: name of the task, one of ``TASKS``
    :param frames: number of frames in ``partial``
    :param size: height and width of a frame, in pixels
    :param camera: name of the camera in MuJoCo's model
    :param privileged: "state" for the whole clean state, "velocity" for velocities alone
    :param noise_std: standard deviation of sensor noise, which must be 0 for images
    :param delay: number of steps by which frames are late
    :param drop: probability that a frame is lost, and the last one shown again
    :param kwargs: keyword arguments of gymnasium's environment, except those that change its observation
    :return: environment with ``partial`` and ``privileged``
    :raises ValueError: if the task is unknown, ``noise_std`` is not 0, or another argument is wrong
    :raises NoRenderingError: if there is no OpenGL to draw with, here or at the first reset
    """
    if task not in TASKS:
        raise ValueError(f"task must be one of {list(TASKS)}, got {task!r}.")
    if np.any(noise_std):
        raise ValueError(
            f"noise_std must be 0 for images, got {noise_std!r}: it is in the units of positions, and noise that is drawn for "
            "each pixel by itself hides nothing from an encoder, which averages over many."
        )
    if kwargs.pop("history", 1) != 1:
        raise ValueError("history is for vectors, beneath the camera: the number of images in partial is the argument frames.")
    frames = check_count("frames", frames)
    try:
        import mujoco  # noqa: F401  # looks for OpenGL at once, where MUJOCO_GL says of which kind
    except Exception as error:
        raise no_rendering(error) from error
    env = make_mujoco(task, noise_std=0.0, privileged=privileged, **kwargs)
    return History(delayed_and_dropped(CameraImage(env, size, camera), delay, drop), length=frames)


#: Id -> arguments of its registration, with its time limit of 1,000 steps
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    f"sb3_gac/{task}Pixels-v5": {
        "entry_point": f"{__name__}:make_pixels",
        "max_episode_steps": 1000,
        "kwargs": {"task": task},
        "whole_state": True,
    }
    for task in TASKS
}
