"""A suite's task may be any environment of gymnasium, with arguments and wrappers."""

import json
import sys
from pathlib import Path

import gymnasium as gym
import pandas as pd
import pytest
import yaml

import benchmarks.aggregate
import benchmarks.report
from benchmarks.aggregate import finished_runs
from benchmarks.engines import LocalEngine
from benchmarks.environments import environment, make_envs
from benchmarks.finished import is_finished, kind_of, name_of
from benchmarks.launch import jobs_left
from benchmarks.run import run
from benchmarks.suite import read_suite
from tests.benchmarks.helpers import SMALL_SUITE

MODULE = '''
import gymnasium as gym
import numpy as np


class Line(gym.Env):
    """The reward is what the environment was made with, the episode two steps long."""

    observation_space = gym.spaces.Box(-10.0, 10.0, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, difficulty=1):
        self.difficulty = difficulty

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.float32([0, self.difficulty]), {}

    def step(self, action):
        self.steps += 1
        return np.float32([self.steps, self.difficulty]), float(self.difficulty), self.steps == 2, False, {}


class Doubled(gym.RewardWrapper):
    def __init__(self, env, factor=2.0):
        super().__init__(env)
        self.factor = factor

    def reward(self, reward):
        return self.factor * reward


gym.register("Line-v0", entry_point=Line)
'''
SPLIT = {"sb3_gac.envs:SplitObservation": {"partial": [0], "privileged": [0, 1]}}
CELL = {"env": "MODULE:Line-v0", "algorithms": ["gac"], "seeds": [0]}
OWN = CELL | {"env_kwargs": {"difficulty": 3}, "wrappers": [SPLIT, "MODULE:Doubled"], "name": "my-line"}


@pytest.fixture
def suite(tmp_path, monkeypatch):
    """Writes a suite with the given cells, beside a module of one's own that nobody has imported."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    name = f"own_{abs(hash(tmp_path))}"
    (tmp_path / f"{name}.py").write_text(MODULE)

    def write(*cells, **changes):
        text = yaml.safe_dump({**SMALL_SUITE, "cells": list(cells), **changes}).replace("MODULE", name)
        (tmp_path / "own.yml").write_text(text)
        return tmp_path / "own.yml"

    yield write
    sys.modules.pop(name, None)
    gym.registry.pop("Line-v0", None)


def test_arguments_and_wrappers_are_those_of_the_cell(suite):
    (spec,) = read_suite(suite(OWN))
    env_id, kwargs = environment(spec)
    assert env_id.endswith(":Line-v0")
    assert kwargs == {"difficulty": 3}
    env = make_envs(spec, 2, 0)
    observation = env.reset()
    assert {key: value.tolist() for key, value in observation.items()} == {"partial": [[0]] * 2, "privileged": [[0, 3]] * 2}
    rewards = [env.step([env.action_space.sample()] * 2)[1].tolist() for _ in range(2)]
    assert rewards == [[6, 6]] * 2, "the wrapper's, that of the environment is 3"
    _, _, _, infos = env.step([env.action_space.sample()] * 2)
    _, _, _, infos = env.step([env.action_space.sample()] * 2)
    assert [info["episode"]["r"] for info in infos] == [12, 12], "as evaluations count them"


def test_directories_are_those_of_the_name(suite):
    (spec,) = read_suite(suite(OWN))
    assert name_of(spec) == "small-60/my-line/gac/seed0"
    assert kind_of(spec) == "gac, my-line"
    (spec,) = read_suite(suite(CELL))
    assert name_of(spec) == "small-60/Line-v0/gac/seed0", "without a name, that of the id"
    (spec,) = read_suite(suite(CELL | {"env": "MODULE:games/Line-v0"}))
    assert name_of(spec) == "small-60/games-Line-v0/gac/seed0"


def test_presets_have_nothing_for_a_task_that_only_has_the_same_name(suite):
    from benchmarks.config import resolve

    (own,) = read_suite(suite(OWN | {"name": "Ant"}))
    (ours,) = read_suite(suite({"task": "Ant", "noises": [0], "algorithms": ["gac"], "seeds": [0]}))
    assert resolve(ours)[1]["target_kl"] == 0.01
    assert "target_kl" not in resolve(own)[1]


def _main(monkeypatch, module, *arguments):
    monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, arguments)])
    module.main()


def test_from_suite_to_report_beside_a_task_with_noise(suite, tmp_path, monkeypatch, capsys):
    pendulum = {"task": "Pendulum", "noises": [0.1], "algorithms": ["gac"], "seeds": [0]}
    path = suite(OWN | {"algorithms": ["gac", "sac-asym"]}, pendulum)
    runs = tmp_path / "runs"
    jobs, _ = jobs_left(path, runs)
    jobs[0].directory.mkdir(parents=True)
    assert LocalEngine().run(jobs[0].command, jobs[0].log) == 0, jobs[0].log.read_text()
    for job in jobs[1:]:
        run(job.spec, runs)
    assert jobs_left(path, runs) == ([], 3)
    assert yaml.safe_load((jobs[0].directory / "config.yaml").read_text())["run"]["environment"]["kwargs"] == {"difficulty": 3}

    out = tmp_path / "out"
    _main(monkeypatch, benchmarks.aggregate, path, "--runs", runs, "--out", out)
    table = pd.read_csv(out.with_suffix(".csv"))
    assert table[table.task == "my-line"].noise.isna().all()
    assert (table[table.task == "my-line"].learner == 12).all(), "two steps, three each, doubled"
    results = json.loads(out.with_suffix(".json").read_text())
    cells = [(cell["task"], cell["noise"], cell["algorithm"]) for cell in results["cells"]]
    assert cells == [("my-line", None, "gac"), ("my-line", None, "sac-asym"), ("Pendulum", 0.1, "gac")]
    assert results["particulars"]["gac, my-line"]["environment"]["kwargs"] == {"difficulty": 3}
    assert "gac, Pendulum, noise 0.1" not in results["particulars"]
    assert [(cell["task"], cell["noise"]) for cell in results["compared"]["cells"]] == [("Pendulum", 0.1), ("my-line", None)]

    counted, missing, _ = finished_runs(path, tmp_path / "elsewhere", reuse=[out])
    assert [name_of(run.spec) for run in counted] == [name_of(job.spec) for job in jobs]
    assert not missing
    changed = suite(OWN | {"env_kwargs": {"difficulty": 4}, "algorithms": ["gac", "sac-asym"]}, pendulum)
    with pytest.raises(FileNotFoundError, match="2 runs are not finished"):
        finished_runs(changed, tmp_path / "elsewhere", reuse=[out])
    with pytest.raises(ValueError, match=r"other settings under \['environment'\]"):
        jobs_left(changed, runs)

    _main(monkeypatch, benchmarks.report, out)
    assert "| my-line |  | gac | 12.0 |" in capsys.readouterr().out
    page = out.with_suffix(".html").read_text()
    assert '"text": "my-line"' in page
    assert '"text": "Pendulum, noise 0.1"' in page
    assert "my-line, noise" not in page
    assert '"text":"not run yet"' not in page, "where a task has no noise, nothing is missing"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"envs": 1}, r"own.yml, cell 1: unknown keys \['envs'\]"),
        ({"noises": [0.1]}, r"own.yml, cell 1: unknown keys \['noises'\]"),
        ({"env": 3}, "own.yml, cell 1, env: must be an id.*got 3"),
        ({"name": "a/b"}, "own.yml, cell 1, name: must be a name of letters.*got 'a/b'"),
        ({"name": ".."}, "own.yml, cell 1, name: must be a name of letters.*got '..'"),
        ({"name": ""}, "own.yml, cell 1, name: must be"),
        ({"env_kwargs": [1]}, r"own.yml, cell 1, env_kwargs: must be a mapping of keyword arguments, got \[1\]"),
        ({"env_kwargs": {1: 2}}, "own.yml, cell 1, env_kwargs: must be"),
        ({"env_kwargs": {"difficulty": {"of": ["1e-3"]}}}, "cell 1, env_kwargs, difficulty, of, 0: YAML reads '1e-3' as text"),
        ({"wrappers": SPLIT}, "own.yml, cell 1, wrappers: must be a list"),
        ({"wrappers": ["SplitObservation"]}, "cell 1, wrappers: must be module:Class, alone or .* got"),
        ({"wrappers": [{**SPLIT, "MODULE:Doubled": {}}]}, "cell 1, wrappers: must be module:Class"),
        ({"wrappers": [{"MODULE:Doubled": [2]}]}, "cell 1, wrappers, own_.*:Doubled: must be a mapping of keyword"),
        ({"seeds": []}, "cell 1, seeds: must be a list"),
        ({"algorithms": "gac"}, "cell 1, algorithms: must be a list"),
    ],
)
def test_a_cell_that_means_nothing_is_refused(suite, change, message):
    with pytest.raises(ValueError, match=message):
        read_suite(suite(OWN | change))


def test_one_name_is_one_environment(suite):
    other = OWN | {"env_kwargs": {"difficulty": 4}, "algorithms": ["sac-asym"]}
    with pytest.raises(ValueError, match=r"own\.yml has two environments with the name 'my-line'"):
        read_suite(suite(OWN, other))
    assert len(read_suite(suite(OWN, other | {"name": "harder"}))) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"env": "no_such_module:Line-v0"}, "own.yml, my-line, gac: .*no_such_module"),
        ({"env": "MODULE:Lines-v0"}, "own.yml, my-line, gac: NameNotFound: .*Lines"),
        ({"env_kwargs": {"hardness": 2}}, "own.yml, my-line, gac: TypeError: .*hardness"),
        (
            {"wrappers": ["sb3_gac.envs:Splits"]},
            "own.yml, my-line, gac: ValueError: .*the module sb3_gac.envs has no 'Splits'",
        ),
        ({"wrappers": [{"sb3_gac.envs:SplitObservation": {"partial": [7]}}]}, "own.yml, my-line, gac: TypeError"),
        ({"wrappers": []}, "own.yml, my-line, gac: .*Dict"),
        ({"algorithms": ["gacc"]}, "own.yml: algorithm must be one of .*got 'gacc'"),
    ],
)
def test_what_does_not_fit_is_refused_before_the_first_run_of_the_suite(suite, tmp_path, change, message):
    fits = {"task": "Pendulum", "noises": [0.1], "algorithms": ["gac"], "seeds": [0]}
    with pytest.raises(ValueError, match=message):
        jobs_left(suite(fits, OWN | change), tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_one_launch_makes_each_environment_once_for_each_algorithm(suite, tmp_path, monkeypatch):
    tried = []
    monkeypatch.setattr("benchmarks.config.try_out", lambda where, spec: tried.append((where, spec.cell, spec.algorithm)))
    fits = {"task": "Pendulum", "noises": [0.1], "algorithms": ["gac"], "seeds": [0]}
    jobs_left(suite(fits, OWN | {"algorithms": ["gac", "sac"], "seeds": [0, 1]}), tmp_path)
    assert tried == [("own.yml", "my-line", "gac"), ("own.yml", "my-line", "sac")], "registered tasks are known to fit"


def test_a_suite_may_have_algorithms_of_its_own(suite, tmp_path):
    own = {"mine": {"class": "sb3_gac:AsymmetricSAC", "tau": 0.25}}
    path = suite(OWN | {"algorithms": ["mine"]}, algorithms=own)
    (job,), _ = jobs_left(path, tmp_path / "runs")
    configuration = run(job.spec, tmp_path / "runs") / "config.yaml"
    assert yaml.safe_load(configuration.read_text())["arguments"]["tau"] == 0.25
    own["mine"]["tau"] = 0.5
    with pytest.raises(ValueError, match=r"other settings under \['definition', 'arguments.tau'\]"):
        jobs_left(suite(OWN | {"algorithms": ["mine"]}, algorithms=own), tmp_path / "runs")


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ([1], "own.yml, algorithms: must be a mapping"),
        ({"gac": {"class": "gac"}}, r"own.yml, algorithms: hyperparams/algorithms.yml has \['gac'\] already"),
        ({"a b": {"class": "gac"}}, "own.yml, algorithms: must be names of letters.*got 'a b'"),
        ({"mine": "gac"}, "own.yml, algorithms, mine: must be a mapping, got 'gac'"),
        ({"mine": {"tau": 0.1}}, r"algorithm mine: .*missing keys \['class'\]"),
        ({"mine": {"class": "GAC"}}, "algorithm mine, class: must be one of .*'gac'.*got 'GAC'"),
        ({"mine": {"class": "no_such:Mine"}}, "algorithm mine, class: .*there is no module 'no_such'"),
    ],
)
def test_definitions_that_mean_nothing_are_refused(suite, tmp_path, own, message):
    with pytest.raises(ValueError, match=message):
        jobs_left(suite(OWN | {"algorithms": ["mine"]}, algorithms=own), tmp_path)


def test_runs_from_before_there_were_other_environments_are_finished(tmp_path):
    """Their configuration does not have what is new."""
    (spec,) = (spec for spec in read_suite(Path(__file__).parents[2] / "benchmarks/suites/smoke.yml")[:1])
    run_of = {
        "algorithm": "gac",
        "task": "InvertedDoublePendulum",
        "noise": 0.1,
        "seed": 0,
        "steps": 600,
        "envs": 2,
        "preset": "small",
        "eval_every": 200,
        "eval_episodes": 1,
        "overrides": spec.overrides,
    }
    directory = tmp_path / "small-600/InvertedDoublePendulum-noise0.1/gac/seed0"
    directory.mkdir(parents=True)
    (directory / "config.yaml").write_text(yaml.safe_dump({"run": run_of}))
    (directory / "evaluations.csv").touch()
    assert is_finished(spec, tmp_path)
