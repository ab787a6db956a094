"""Images of a MuJoCo camera in place of an observation's entry."""

from copy import copy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_gac.envs.arguments import check_count
from sb3_gac.envs.spaces import PARTIAL
from sb3_gac.envs.state import LOOKS, arrays_of
from sb3_gac.envs.wrappers import EntryWrapper

#: Facets of a drawn capsule, around it and along it; MuJoCo's own 28 and 16 look the same in images of 64 pixels
SLICES, STACKS = 12, 6
REFLECTANCE = "mat_reflectance"
HOW_TO_RENDER = (
    "On Linux without a screen: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri, and set the environment variable "
    "MUJOCO_GL=egl before Python starts; MUJOCO_GL=osmesa with libosmesa6 does without EGL."
)


class NoRenderingError(RuntimeError):
    """There is no OpenGL that MuJoCo can draw with."""


class CameraImage(EntryWrapper):
    """
    Replace one entry by a camera's image, uint8 of shape (3, size, size).

    The image has no shadows, reflections or smooth edges, which makes drawing in software tens of times faster. The
    environment's own ``render`` keeps them. Drawing begins with the first reset. Each image shows the colours, sizes, lights
    and cameras that the environment's model has then; textures, meshes and heights of a terrain (``hfield_data``) stay as they
    were at first, also where a reset draws others.

    :param env: one of gymnasium's MuJoCo environments, with a Dict observation
    :param size: height and width of the image, in pixels
    :param camera: name of the camera in MuJoCo's model
    :param key: key of the entry that the image replaces
    :raises ValueError: if the environment has no such camera or no MuJoCo, or ``size`` is no positive integer
    """

    makes_anew = True

    def __init__(self, env: gym.Env, size: int = 64, camera: str = "track", key: str = PARTIAL):
        super().__init__(env, key)
        model: Any = getattr(env.unwrapped, "model", None)
        if type(model).__name__ != "MjModel":
            raise ValueError(f"CameraImage needs an environment of gymnasium's MuJoCo, but got {env.unwrapped}.")
        cameras = [name for number in range(model.ncam) if (name := model.camera(number).name)]
        if not cameras:
            raise ValueError(f"camera={camera!r}, but the model of {env.unwrapped} has no camera: add one to its XML file.")
        if camera not in cameras:
            raise ValueError(f"camera must be one of {cameras}, got {camera!r}.")
        self._size, self._camera = check_count("size", size, of_what="in pixels"), camera
        self._renderer: Any = None
        self._model: Any = None
        self._looks: list[tuple[np.ndarray, np.ndarray]] = []
        self._set_entry_space(spaces.Box(0, 255, (3, self._size, self._size), np.uint8))

    def close(self) -> None:
        """Close the camera's renderer and the environment."""
        self._close_renderer()
        super().close()

    def _close_renderer(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave the renderer out: a copy, such as one in another process, makes its own."""
        return {**vars(self), "_renderer": None, "_model": None, "_looks": []}

    def _first(self, value: np.ndarray, seed: int | None) -> np.ndarray:
        return self._image()

    def _next(self, value: np.ndarray, action: Any, reward: Any) -> np.ndarray:
        return self._image()

    def _image(self) -> np.ndarray:
        simulator: Any = self.env.unwrapped
        if self._renderer is None or simulator.model is not self._model:  # a reset may make another robot
            self._close_renderer()
            self._model = simulator.model
            self._renderer = make_renderer(simulator.model, self._size)
            copied = arrays_of(self._renderer.model, LOOKS)
            looks = arrays_of(simulator.model, LOOKS)
            self._looks = [(copied[name], array) for name, array in looks.items() if name != REFLECTANCE]
        for drawn, own in self._looks:  # which the environment may have changed, as a reset does that draws colours
            drawn[...] = own
        self._renderer.update_scene(simulator.data, camera=self._camera)
        return np.ascontiguousarray(self._renderer.render().transpose(2, 0, 1))


def make_renderer(model: Any, size: int) -> Any:
    """
    Make a renderer for a camera's images.

    :param model: MuJoCo's model (``MjModel``); a copy of it is drawn, and the model stays as it is
    :param size: height and width of the image, in pixels
    :return: MuJoCo's renderer, with settings that are fast in software
    :raises NoRenderingError: if MuJoCo can't draw here; the message says what to install and to set
    """
    import mujoco

    fast = copy(model)
    fast.vis.quality.shadowsize = 0
    fast.vis.quality.offsamples = 0
    fast.vis.quality.numslices, fast.vis.quality.numstacks = SLICES, STACKS
    fast.vis.global_.offwidth = fast.vis.global_.offheight = size
    getattr(fast, REFLECTANCE)[:] = 0
    try:
        return mujoco.Renderer(fast, size, size)
    except Exception as error:
        raise no_rendering(error) from error


def no_rendering(error: Exception) -> NoRenderingError:
    """
    Make the error that says how to enable rendering.

    :param error: error that MuJoCo raised; its type depends on the part of OpenGL that is missing
    :return: error whose message says how to enable rendering
    """
    return NoRenderingError(f"MuJoCo can't draw images here ({type(error).__name__}: {error}). {HOW_TO_RENDER}")
