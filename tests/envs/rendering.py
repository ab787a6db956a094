"""Whether MuJoCo can draw here; to be imported before MuJoCo is."""

import ctypes.util
import os

import pytest

if "MUJOCO_GL" not in os.environ and ctypes.util.find_library("EGL"):
    os.environ["MUJOCO_GL"] = "egl"


def needs_rendering() -> None:
    """Skip what needs OpenGL where there is none."""
    import mujoco

    from sb3_gac.envs.camera import NoRenderingError, make_renderer

    try:
        make_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8).close()
    except NoRenderingError as error:
        pytest.skip(str(error))
