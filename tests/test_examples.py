"""The examples run, each from its file, and are short."""

import importlib.util
import os
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
STEPS = {"memory": 1_000}  # its episodes have 200, in four environments
WORDS = {
    "goals": "of 10 goals reached",
    "memory": "return -",
    "own_simulator": "the robot does [",
    "teacher": "trained on, it returns",
}


def _run(path, *arguments):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.main(*arguments)


@pytest.mark.parametrize("path", [path for path in EXAMPLES if path.stem != "images"], ids=lambda path: path.stem)
def test_an_example_runs(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    _run(path, STEPS.get(path.stem, 120))
    assert WORDS[path.stem] in capsys.readouterr().out


def test_the_example_with_images_runs(monkeypatch, capsys):
    if os.environ.get("MUJOCO_GL") != "egl":
        pytest.skip("renders by EGL: MUJOCO_GL=egl")
    _run(next(path for path in EXAMPLES if path.stem == "images"), 60)
    assert "from images alone" in capsys.readouterr().out


def test_examples_are_short():
    lengths = {path.name: len(path.read_text().splitlines()) for path in EXAMPLES}
    assert len(lengths) == 5
    assert max(lengths.values()) < 60, lengths
