"""The code of docs/extending.md, run as it stands there, but for shorter trainings."""

import re
import sys
from pathlib import Path

import pytest
import yaml

from benchmarks.suite import needed_runs, read_definitions, read_suite
from sb3_gac.algorithms import algorithm_class
from sb3_gac.presets import read_preset

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/extending.md").read_text()
PYTHON = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
YAML = dict(re.findall(r"```yaml\n# (\S+)\n(.*?)```", PAGE, re.DOTALL))
NAMED = re.compile(r"# (\S+\.py)\n(.*)", re.DOTALL)
SHORTER = {"20_000": "150", "10_000": "150", "1_000": "210"}


def _named():
    """File -> blocks of the page that are (parts of) it."""
    parts = {}
    for match in filter(None, map(NAMED.match, PYTHON)):
        parts.setdefault(match[1], []).append(match[2])
    return parts


def _shorter(block):
    return re.sub(r"\b[0-9]+_[0-9_]+\b", lambda number: SHORTER[number.group()], block)


@pytest.fixture
def beside_the_file(tmp_path, monkeypatch):
    """Where the page's own modules and suite are."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("imitation", "softer"):
        monkeypatch.delitem(sys.modules, name, raising=False)
        (module,) = _named()[f"{name}.py"]
        (tmp_path / f"{name}.py").write_text(module)
    (tmp_path / "imitation.yml").write_text(YAML["imitation.yml"])
    return tmp_path


def test_what_a_user_types_runs(beside_the_file, monkeypatch):
    """All blocks one after the other, with small networks and warm-ups."""
    import imitation

    from sb3_gac import AsymmetricSAC

    small = {"learning_starts": 20, "batch_size": 8, "buffer_size": 500, "device": "cpu", "gradient_steps": 1}
    for cls in (imitation.Imitation, AsymmetricSAC):
        init = cls.__init__

        def shorter(self, *args, init=init, **kwargs):
            init(self, *args, **{**small, "policy_kwargs": {"net_arch": [8]}, **kwargs})

        shorter.__signature__ = init.__signature__
        monkeypatch.setattr(cls, "__init__", shorter)
    names = {}
    blocks = [block for block in PYTHON if not NAMED.match(block)]
    assert len(blocks) >= 3
    for number, block in enumerate(blocks):
        exec(compile(_shorter(block), f"extending.md, block {number}", "exec"), names)
    assert names["action"].shape == (1,)
    assert names["softer"].logger.name_to_value["train/weight"] == pytest.approx(0.5, abs=0.05)


def test_what_is_shown_of_the_packages_files_is_there():
    shown = {path: parts for path, parts in _named().items() if "/" in path}
    assert {Path(path).stem for path in shown} == {"tgrl", "cosil", "comparing"}
    assert sum(map(len, shown.values())) >= 12
    for path, parts in shown.items():
        source = (ROOT / path).read_text()
        assert [part for part in parts if part not in source] == [], path


def test_the_suite_is_one_and_orders_the_teachers(beside_the_file):
    specs = read_suite(beside_the_file / "imitation.yml")
    assert [spec.algorithm for spec in specs] == ["imitation", "dagger", "sac-asym"] * 3
    (teacher,) = needed_runs(specs[0]).values()
    assert (teacher.algorithm, teacher.steps) == ("sac-full", 20_000)
    assert algorithm_class(specs[0].definition["class"]).__name__ == "Imitation"


def test_what_is_shown_of_the_tables_is_so(tmp_path, monkeypatch):
    shown = yaml.safe_load(YAML["algorithms.yml"])
    assert shown.items() <= read_definitions().items()
    (tmp_path / "shown.yml").write_text(YAML["preset"])
    monkeypatch.setattr("sb3_gac.presets.DIRECTORY", tmp_path)
    assert read_preset("shown").arguments["tgrl"] == {"teacher_coef": 0.5}


def test_every_file_and_command_that_is_named_is_there():
    for path in re.findall(r"`((?:sb3_gac|tests|benchmarks|docs)/[\w./-]+\.(?:py|yml|md))`", PAGE):
        assert (ROOT / path).exists(), path
    for program in re.findall(r"python -m (\S+)", PAGE):
        assert (ROOT / f"{program.replace('.', '/')}.py").exists(), program
