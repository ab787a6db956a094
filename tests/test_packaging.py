"""What an installation brings: extras that are named where they are missing, and a path that type checkers can follow."""

import configparser
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
EXPORT = """
import sb3_gac
env = sb3_gac.envs.make_pendulum()
model = sb3_gac.GAC("MultiInputPolicy", env, buffer_size=10, policy_kwargs={"net_arch": [4]})
sb3_gac.export_learner(model, "never-written.onnx")
"""
RUNS_BENCHMARKS = r"python -m (benchmarks|sb3_gac\.compare)"
PARTS = {  # extra -> what of it is needed, and what needs it
    "zoo": (["rl_zoo3", "optuna"], "import sb3_gac.zoo"),
    "export": (["onnx"], EXPORT),
    "export, not onnx": (["onnxruntime"], EXPORT),
    "export, learner": (["onnxruntime"], "import sb3_gac.learner"),
    "video": (["moviepy"], "from sb3_gac.evaluation.video import check_can_film; check_can_film(None, 'x')"),
    "popgym": (["popgym"], "import gymnasium; gymnasium.make('sb3_gac:sb3_gac/popgym-AutoencodeEasy-v0')"),
    "envpool": (["envpool"], "import gymnasium; gymnasium.make('sb3_gac:sb3_gac/Go1Getup-v0')"),
    "brax": (["jax", "brax"], "import gymnasium; gymnasium.make('sb3_gac:sb3_gac/brax-Ant-v0')"),
    "playground": (["jax"], "import gymnasium; gymnasium.make('sb3_gac:sb3_gac/Go1Getup-v0', backend='mjx')"),
    "benchmarks": (["pandas", "plotly"], "import benchmarks.launch"),
    "benchmarks, report": (["plotly"], "import benchmarks.report"),
    "benchmarks, aggregate": (["rliable"], "import benchmarks.aggregate"),
    "benchmarks, run": (["tensorboard"], "import benchmarks.run"),
    "dreamer": (["sheeprl", "omegaconf"], "import benchmarks.dreamer"),
    "ray": (["ray"], "from benchmarks.engines import RayEngine; RayEngine('auto')"),
}


@pytest.mark.parametrize("part", PARTS)
def test_what_is_not_installed_is_named_with_its_extra(part, tmp_path):
    modules, program = PARTS[part]
    hide = f"import sys; sys.modules.update(dict.fromkeys({modules!r})); sys.path.insert(0, {str(ROOT)!r})\n"
    result = subprocess.run([sys.executable, "-c", hide + program], cwd=tmp_path, capture_output=True, text=True, check=False)
    message = result.stderr.strip().splitlines()[-1]
    assert message.startswith("ImportError: ")
    assert f"[{part.split(',')[0]}]" in message
    assert any(name.lower() in message.lower() for name in modules)
    assert list(tmp_path.iterdir()) == []


def test_extras_bring_what_their_parts_need():
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    for part, (modules, _) in PARTS.items():
        lines = parser["options.extras_require"][part.split(",")[0]].split("\n")
        names = {Requirement(line).name for line in lines if line}
        assert set(modules) - {"optuna", "omegaconf"} <= names, "which come with rl_zoo3 and sheeprl"


def test_a_block_of_commands_installs_all_that_it_runs():
    """In the docs: what runs the benchmarks needs their extra, also where it is about another one."""
    pages = [path.read_text() for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))]
    blocks = [block for page in pages for block in re.findall(r"^```\w*\n(.*?)^```", page, re.DOTALL | re.MULTILINE)]
    installed = {block: re.findall(r'pip install -e "\.\[([\w,]+)\]"', block) for block in blocks}
    running = {block: extras for block, extras in installed.items() if extras and re.search(RUNS_BENCHMARKS, block)}
    assert len(running) >= 2
    assert [block for block, extras in running.items() if "benchmarks" not in ",".join(extras).split(",")] == []


@pytest.fixture
def checkout(tmp_path):
    """A copy of what is built, in which building leaves its files."""
    pytest.importorskip("setuptools", minversion="77")
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE", "MANIFEST.in", "CHANGELOG.md", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    for name in ("sb3_gac", "benchmarks/page"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def _build(checkout, kind):
    """Without the isolation of ``python -m build``, which would ask a package index."""
    build = f"from setuptools.build_meta import build_{kind} as build; print(build('.'))"
    subprocess.run([sys.executable, "-c", build], cwd=checkout, capture_output=True, check=True)


def test_a_wheel_has_the_package_whole_and_nothing_else(checkout):
    _build(checkout, "wheel")
    (wheel,) = checkout.glob("*.whl")
    with zipfile.ZipFile(wheel) as contents:
        names = {name for name in contents.namelist() if ".dist-info/" not in name}
        (scripts,) = [contents.read(name).decode() for name in contents.namelist() if name.endswith("entry_points.txt")]
    there = {str(path.relative_to(checkout)) for path in (checkout / "sb3_gac").rglob("*") if path.is_file()}
    assert names == there
    assert {"sb3_gac/py.typed", "sb3_gac/presets/small.yml", "sb3_gac/envs/suites/mujoco.py"} <= names
    assert "sb3-gac = sb3_gac.__main__:main" in scripts


def test_an_sdist_has_what_a_wheel_is_built_of(checkout):
    _build(checkout, "sdist")
    (sdist,) = checkout.glob("*.tar.gz")
    with tarfile.open(sdist) as contents:
        names = {name.partition("/")[2] for name in contents.getnames()}
    there = {str(path.relative_to(checkout)) for path in (checkout / "sb3_gac").rglob("*") if path.is_file()}
    assert there <= names
    assert {"setup.cfg", "pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "constraints.txt"} <= names


def test_an_editable_installation_is_a_path_that_type_checkers_follow(checkout):
    """An import hook, the default, is followed by nothing but Python."""
    _build(checkout, "editable")
    (wheel,) = checkout.glob("*.whl")
    with zipfile.ZipFile(wheel) as contents:
        (pth,) = [name for name in contents.namelist() if name.endswith(".pth")]
        assert contents.read(pth).decode().split() == [str(checkout)]


def test_every_file_of_arguments_in_the_package_is_shipped():
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    patterns = parser["options.package_data"]["sb3_gac"].split()
    shipped = {path for pattern in patterns for path in (ROOT / "sb3_gac").glob(pattern)}
    there = set((ROOT / "sb3_gac").rglob("*.yml"))
    assert there
    assert there <= shipped
