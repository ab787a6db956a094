"""Whether MuJoCo can draw here."""

import mujoco
import pytest

from sb3_gac.envs.camera import NoRenderingError, make_renderer


def needs_rendering() -> None:
    """Skip what needs OpenGL where there is none."""
    try:
        make_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8).close()
    except NoRenderingError as error:
        pytest.skip(str(error))
