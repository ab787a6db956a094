"""A launch says that the code of an environment of one's own has changed since runs were made."""

import sys
from dataclasses import replace

import pytest
import yaml

from benchmarks.own_code import about_changed_code, code_of
from benchmarks.suite import RunSpec

OWN = RunSpec("sac", "walk", None, 0, 60, 1, "small", 20, 1)
MODULE = """
import gymnasium


class Walk(gymnasium.Env):
    pass


class Cap(gymnasium.Wrapper):
    pass


gymnasium.register("Walk-v0", {entry_point})
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Function that writes files, and returns the digits of the code of an environment and its wrappers."""
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)

    def written(files, env_id, *wrappers):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        environment = {"id": env_id, "kwargs": {}, "wrappers": [{wrapper: {}} for wrapper in wrappers]}
        return code_of(replace(OWN, environment=environment))

    yield written
    for name in set(sys.modules) - before:
        if name.startswith("mine_"):
            del sys.modules[name]
    sys.modules.get("gymnasium").registry.pop("Walk-v0", None)


@pytest.mark.parametrize("env_id", ["mine_single:Walk", "mine_single:Walk-v0"])
def test_a_module_is_its_file_and_the_file_alone(own, tmp_path, env_id):
    module = MODULE.format(entry_point="Walk")
    first = own({"mine_single.py": module, "other.py": "1"}, env_id)
    assert list(first) == ["code of mine_single"]
    assert own({"other.py": "2"}, env_id) == first
    assert own({"mine_single.py": module + "\n# heavier"}, env_id) != first
    assert own({"mine_single.py": module}, env_id) == first


@pytest.mark.parametrize("marked", [True, False])
def test_a_package_is_all_its_code_and_models(own, marked):
    """A folder without ``__init__.py`` is a package too."""
    files = {"mine_robot/envs.py": MODULE.format(entry_point="'mine_robot.envs:Walk'"), "mine_robot/body/leg.xml": "<leg/>"}
    if marked:
        files["mine_robot/__init__.py"] = ""
    first = own(files, "mine_robot.envs:Walk-v0")
    assert list(first) == ["code of mine_robot"]
    assert own({"mine_robot/notes.txt": "1"}, "mine_robot.envs:Walk-v0") == first
    changed = own({"mine_robot/body/leg.xml": "<leg length='2'/>"}, "mine_robot.envs:Walk-v0")
    assert changed != first
    assert own({"mine_robot/rewards.py": "1"}, "mine_robot.envs:Walk-v0") not in (first, changed)


def test_wrappers_and_the_registered_class_have_code_too(own):
    files = {
        "mine_names.py": "import gymnasium\n\ngymnasium.register('Walk-v0', 'mine_world:Walk')",
        "mine_world.py": MODULE.replace("gymnasium.register", "print"),
        "mine_view.py": MODULE.replace("gymnasium.register", "print"),
    }
    files = {name: text.format(entry_point="1") for name, text in files.items()}
    found = own(files, "mine_names:Walk-v0", "mine_view:Cap", "sb3_gac.envs:SplitObservation")
    assert list(found) == ["code of mine_names", "code of mine_view", "code of mine_world"]
    assert own({"mine_view.py": "# gone"}, "mine_names:Walk-v0", "mine_view:Cap") == found | {
        "code of mine_view": own({}, "mine_names:Walk-v0", "mine_view:Cap")["code of mine_view"]
    }


def test_what_has_a_version_has_no_code_of_its_own():
    assert code_of(replace(OWN, task="Hopper", noise=0.1)) == {}
    environment = {"id": "Pendulum-v1", "kwargs": {}, "wrappers": [{"gymnasium.wrappers:ClipAction": {}}]}
    assert code_of(replace(OWN, environment=environment)) == {}


def test_a_sentence_says_which_runs_were_made_with_other_code(own, tmp_path):
    digits = own({"mine_single.py": MODULE.format(entry_point="Walk")}, "mine_single:Walk")["code of mine_single"]
    environment = {"id": "mine_single:Walk", "kwargs": {}, "wrappers": []}
    specs = [replace(OWN, seed=seed, environment=environment) for seed in range(5)]
    code = "code of mine_single"
    earlier = {"commit": "0", "versions": {code: "0"}}
    made = [({code: digits}, []), ({code: "0"}, []), ({}, []), ({code: digits}, [earlier])]  # the last seed has no run
    for spec, (versions, before) in zip(specs, made, strict=False):
        directory = spec.directory(tmp_path)
        directory.mkdir(parents=True)
        (directory / "config.yaml").write_text(yaml.safe_dump({"commit": "0", "versions": versions, "earlier": before}))
    (said,) = about_changed_code(specs, tmp_path)
    assert said.startswith(
        f"The {code} has changed since 2 of the runs in {tmp_path} were made, such as small-60/walk/sac/seed1."
    )
    assert about_changed_code([specs[0], specs[2], specs[4]], tmp_path) == [], "what was not recorded has not changed"
