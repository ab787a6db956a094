"""Who may import whom."""

import ast
import re
from pathlib import Path

import pytest

import sb3_gac

ROOT = Path(sb3_gac.__file__).parents[1]
BASELINES = sorted({path.stem for path in (ROOT / "sb3_gac/baselines").glob("[!_]*")})
#: Room -> rooms that it may import
ROOMS = {
    "math": "math",
    "checks": "checks|schedules|names",
    "optim": "optim|math|checks",
    "networks": "networks|math|checks",
    "replay": "replay|checks",
    "checkpoint": "checkpoint|envs",
    "base": "algorithms|base|math|checks|schedules|names|optim|networks|replay|checkpoint|envs",
    "deploy": "deploy|base|checks|networks|envs|learner|version|stopping|command_line",
    "evaluation": "evaluation|algorithms|base|envs|learner|training\\.environments",
}
DRAWING = "page|intervals|bootstrap|tidy"
FORBIDDEN = {
    **{f"sb3_gac/{room}/**/*.py": rf"sb3_gac(?!\.({allowed})\b)" for room, allowed in ROOMS.items()},
    **{
        f"sb3_gac/envs/{path}.py": r"torch\b|stable_baselines3|sb3_gac(?!\.(envs|command_line)\b)"
        for path in ("*", "suites/**/*")
    },
    "sb3_gac/envs/vector/**/*.py": r"sb3_gac(?!\.envs\b)",
    **{
        f"sb3_gac/baselines/{pattern.format(name)}": rf"sb3_gac(?!\.({ROOMS['base']}|version|baselines\.{name})\b)"
        for name in BASELINES
        for pattern in ("{}.py", "{}/**/*.py")
    },
    **{f"sb3_gac/{path}.py": r"mujoco\b" for path in ("evaluate", "evaluation/*")},  # before MUJOCO_GL is set
    "sb3_gac/__main__.py": r"torch\b|gymnasium\b|stable_baselines3|sb3_gac(?!\.(stopping|version)\b)",
    "sb3_gac/tabular/**/*.py": r"torch\b|gymnasium\b|stable_baselines3|sb3_gac(?!\.tabular\b)",
    "sb3_gac/schedules.py": r"torch\b|gymnasium\b|stable_baselines3|sb3_gac\b",
    "sb3_gac/algorithms.py": r"torch\b|gymnasium\b|stable_baselines3|sb3_gac(?!\.names\b)",
    "sb3_gac/names.py": r"torch\b|gymnasium\b|stable_baselines3|sb3_gac\b",
    "sb3_gac/presets/**/*.py": r"gymnasium\b|stable_baselines3|sb3_gac(?!\.(algorithms|envs\.suites|names|presets)\b)",
    "sb3_gac/learner.py": r"torch\b|gymnasium\b|stable_baselines3|sb3_gac\b",
    "benchmarks/aggregate.py": r"torch\b|sb3_gac\b",
    **{f"benchmarks/{path}.py": rf"torch\b|sb3_gac\b|benchmarks(?!\.({DRAWING})\b)" for path in ("report", "page/**/*")},
    **{f"benchmarks/{name}.py": r"torch\b|sb3_gac\b|benchmarks\b" for name in ("intervals", "bootstrap", "tidy")},
    "benchmarks/**/*.py": r"sb3_gac\.(.*\.)?_(?!_)",
}


def _imports(source):
    """Dotted names of all that is imported, functions' own imports included."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module or ''}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("pattern", FORBIDDEN)
def test_imports_nothing_forbidden(pattern):
    for path in ROOT.glob(pattern):
        found = [name for name in _imports(path.read_text()) if re.match(rf"\.|{FORBIDDEN[pattern]}", name)]
        assert not found, f"{path.relative_to(ROOT)} imports {found}"


def test_finds_every_kind_of_import():
    source = (
        "import torch.nn, os\nfrom sb3_gac import GAC as G\ndef f():\n    from sb3_gac.gac import gac\n    from . import a"
    )
    assert list(_imports(source)) == ["torch.nn", "os", "sb3_gac.GAC", "sb3_gac.gac.gac", "..a"]
    assert all(list(ROOT.glob(pattern)) for pattern in FORBIDDEN if "baselines" not in pattern and "benchmarks" not in pattern)
