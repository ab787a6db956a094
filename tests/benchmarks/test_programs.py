"""The benchmark programs, run as a user runs them, on a suite of seconds."""

import importlib
import itertools
import json
import math
import pickle
import re
import shutil
import signal
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.vec_env import VecNormalize

import benchmarks.config
import benchmarks.run
import sb3_gac.presets
from benchmarks.aggregate import finished_runs, origins
from benchmarks.checkpoint import SB3Checkpoints, checkpoints_of
from benchmarks.config import check_runs, read_algorithm, resolve
from benchmarks.environments import environment
from benchmarks.external import Program
from benchmarks.finished import (
    as_json,
    from_json,
    is_finished,
    kind_of,
    name_of,
    names_of,
    particulars_of,
    read_reused,
    settings_of,
)
from benchmarks.launch import jobs_left
from benchmarks.program import rows_as_text
from benchmarks.run import Stopwatch, run
from benchmarks.suite import RunSpec, made_with, read_suite
from benchmarks.yaml_checks import read_yaml
from sb3_gac import GAC, PRESETS, preset
from sb3_gac.checkpoint.lock import locked
from sb3_gac.checks.arguments import constructor_parameters
from sb3_gac.presets import instantiate, read_preset
from tests.helpers import Sampled, small_model

ROOT = Path(__file__).parents[2]
SMOKE = ROOT / "benchmarks" / "suites" / "smoke.yml"
SUITES = sorted(SMOKE.parent.glob("*.yml"))
CELL = {"task": "Hopper", "noises": [0.1], "algorithms": ["gac"], "seeds": [0]}


def _program(*arguments):
    return subprocess.run([sys.executable, "-m", *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """All runs of the smoke suite, through launch."""
    directory = tmp_path_factory.mktemp("runs")
    result = _program("benchmarks.launch", SMOKE, "--jobs", 2, "--runs", directory)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 were finished before, 4 now, 0 failed." in result.stdout
    return directory


@pytest.fixture(scope="module")
def made(runs, tmp_path_factory):
    """The results of these runs, through aggregate."""
    out = tmp_path_factory.mktemp("results") / "smoke"
    result = _program("benchmarks.aggregate", SMOKE, "--runs", runs, "--out", out)
    assert result.returncode == 0, result.stderr
    return out


@pytest.fixture
def program(monkeypatch, capsys):
    """Calls a program in this process: module, arguments, whether it ends with an error -> what it printed."""

    def call(module, *arguments, fails=False):
        monkeypatch.setattr(sys, "argv", [module, *map(str, arguments)])
        code = None
        try:
            importlib.import_module(module).main()
        except SystemExit as end:
            code = end.code
        assert bool(code) == fails
        return capsys.readouterr().out

    return call


def test_each_run_leaves_its_evaluations_configuration_and_model(runs):
    for spec in read_suite(SMOKE):
        directory = spec.directory(runs)
        evaluations = pd.read_csv(directory / "evaluations.csv")
        assert evaluations.timesteps.tolist() == [200, 400, 600]
        of_guider = {"guider", "kl", "target_kl", "kl_coef"}
        assert of_guider & set(evaluations.columns) == (of_guider if spec.algorithm.startswith("gac") else set())
        configuration = yaml.safe_load((directory / "config.yaml").read_text())
        assert configuration["run"] == asdict(spec)
        assert configuration["versions"]["torch"]
        model = read_algorithm(spec.algorithm)[0].load(directory / "model")
        assert (model.seed, model.num_timesteps, model.batch_size) == (spec.seed, 600, 16)
        assert not list(directory.glob("checkpoint*"))
        assert list((directory / "tensorboard").glob("events*"))
    gac, asym, gac_again, _ = (pd.read_csv(spec.directory(runs) / "evaluations.csv").learner for spec in read_suite(SMOKE))
    assert not gac.equals(asym)
    assert not gac.equals(gac_again), "the seed does something"


def test_a_finished_run_is_skipped_and_an_unfinished_one_done_again(runs, program):
    first, second = (spec.directory(runs) / "evaluations.csv" for spec in read_suite(SMOKE)[:2])
    before = first.read_text(), first.stat().st_mtime_ns
    wanted = second.read_text()
    second.unlink()
    assert program("benchmarks.launch", SMOKE, "--runs", runs, "--dry-run").count("benchmarks.run") == 1
    assert "3 were finished before, 1 now, 0 failed." in program("benchmarks.launch", SMOKE, "--runs", runs)
    assert (first.read_text(), first.stat().st_mtime_ns) == before
    assert second.read_text() == wanted, "the same seed gives the same run"


def test_results_are_aggregated_and_reported(runs, made):
    record = json.loads(made.with_suffix(".json").read_text())
    assert record["reference"] == "sac-asym"
    assert len(record["made_with"]) == 1
    assert record["mixed_runs"] == []
    options = f"--runs {runs}"
    assert record["command"] == (
        f"python -m benchmarks.launch benchmarks/suites/smoke.yml {options} && "
        f"python -m benchmarks.aggregate benchmarks/suites/smoke.yml {options} --out {made}"
    )
    assert [(cell["algorithm"], cell["seeds"]) for cell in record["cells"]] == [("gac", [0, 1]), ("sac-asym", [0, 1])]
    assert "guider_mean" in record["cells"][0]
    assert "guider_mean" not in record["cells"][1]
    assert len(pd.read_csv(made.with_suffix(".csv"))) == 12
    result = _program("benchmarks.report", made)
    assert result.returncode == 0, result.stderr
    assert "| InvertedDoublePendulum | 0.1 | sac-asym |" in result.stdout
    assert made.with_suffix(".png").stat().st_size > 10_000
    page = made.with_suffix(".html").read_text()
    assert "<title>smoke</title>" in page
    assert "sac-asym, seed 1" in page
    assert not re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="http', page), "nothing is loaded from elsewhere"


def test_a_missing_run_is_an_error_or_leaves_its_whole_cell_out(runs, tmp_path, program):
    with pytest.raises(FileNotFoundError, match="4 runs are not finished"):
        finished_runs(SMOKE, tmp_path)
    suite = yaml.safe_load(SMOKE.read_text())
    suite["cells"].append({**suite["cells"][0], "noises": [0.1, 0.2], "seeds": [2, 3]})
    path = tmp_path / "grown.yml"
    path.write_text(yaml.safe_dump(suite))
    with pytest.raises(FileNotFoundError, match="8 runs are not finished"):
        finished_runs(path, runs)
    program("benchmarks.aggregate", path, "--runs", runs, "--out", tmp_path / "grown", "--complete-cells")
    record = json.loads((tmp_path / "grown.json").read_text())
    assert len(record["still_to_run"]) == 8
    assert "small-600/InvertedDoublePendulum-noise0.2/gac/seed2" in record["still_to_run"]
    assert [cell["seeds"] for cell in record["cells"]] == [[0, 1], [0, 1]]


def test_runs_without_their_directories_count_by_the_results_that_they_went_into(runs, made, tmp_path, program):
    elsewhere, again = tmp_path / "elsewhere", tmp_path / "again"
    program("benchmarks.aggregate", SMOKE, "--runs", elsewhere, "--reuse-results", made, "--out", again)
    assert made.with_suffix(".csv").read_text() == again.with_suffix(".csv").read_text()
    record, record_again = (json.loads(path.with_suffix(".json").read_text()) for path in (made, again))
    assert record.pop("command") != record_again.pop("command")
    assert record_again == record
    names = [name_of(spec) for spec in read_suite(SMOKE)]
    assert list(record["runs"]) == names

    (elsewhere / names[0]).parent.mkdir(parents=True)
    shutil.copytree(runs / names[0], elsewhere / names[0])
    table = pd.read_csv(elsewhere / names[0] / "evaluations.csv")
    table.assign(learner=7.0).to_csv(elsewhere / names[0] / "evaluations.csv", index=False)
    counted, missing, _ = finished_runs(SMOKE, elsewhere, reuse=[made])
    assert [run.name for run in counted] == names
    assert not missing
    assert (counted[0].evaluations.learner == 7.0).all(), "a directory comes before what was made earlier"
    table = pd.read_csv(made.with_suffix(".csv"))
    table.assign(learner=8.0).to_csv(tmp_path / "later.csv", index=False)
    shutil.copy(made.with_suffix(".json"), tmp_path / "later.json")
    counted, *_ = finished_runs(SMOKE, elsewhere, reuse=[made, tmp_path / "later"])
    assert [run.evaluations.learner.iloc[0] for run in counted] == [7.0, 8.0, 8.0, 8.0], "the last of several counts"
    _, missing, _ = finished_runs(SMOKE, runs, True, [made], rerun=["gac"])
    assert not missing, "directories count in any case"
    with pytest.raises(FileNotFoundError, match=f"1 runs are not finished in .*{names[2]}"):
        finished_runs(SMOKE, elsewhere, reuse=[made], rerun=["gac"])


def test_launch_leaves_out_what_earlier_results_have(runs, made, tmp_path, program):
    printed = program("benchmarks.launch", SMOKE, "--runs", tmp_path / "elsewhere", "--reuse-results", made)
    assert "4 were finished before, 0 now, 0 failed." in printed
    jobs, finished = jobs_left(SMOKE, tmp_path / "elsewhere", [made], rerun=["gac"])
    assert finished == 2
    assert [job.spec.algorithm for job in jobs] == ["gac", "gac"]
    shutil.copytree(jobs[0].spec.directory(runs), jobs[0].directory)
    assert jobs_left(SMOKE, tmp_path / "elsewhere", [made], rerun=["gac"])[1] == 3, "a directory counts in any case"


@pytest.mark.parametrize("program", ["benchmarks.launch", "benchmarks.aggregate"])
def test_former_names_of_options_work_for_one_release_and_are_not_shown(program, capsys, monkeypatch):
    """They say what they are called now, where errors are said."""
    module = importlib.import_module(program)
    seen = {}
    reads = {"benchmarks.launch": "jobs_left", "benchmarks.aggregate": "finished_runs"}[program]
    monkeypatch.setattr(module, reads, lambda *args: seen.update(args=args) or sys.exit(7))
    options = [program, str(SMOKE), *(["--out", "there"] if program == "benchmarks.aggregate" else [])]
    for names, said in ((("--reuse-results", "--rerun"), False), (("--earlier", "--renewed"), True)):
        monkeypatch.setattr(sys, "argv", [*options, names[0], "one", "two", names[1], "gac"])
        with pytest.raises(SystemExit, match="7"):
            module.main()
        assert seen["args"][-2:] == ([Path("one"), Path("two")], ["gac"])
        error = capsys.readouterr().err
        assert ("DeprecationWarning: --earlier is --reuse-results now." in error) == said
        assert ("DeprecationWarning: --renewed is --rerun now." in error) == said
    monkeypatch.setattr(sys, "argv", [program, "--help"])
    with pytest.raises(SystemExit):
        module.main()
    printed = capsys.readouterr().out
    assert "--reuse-results" in printed
    assert "--rerun" in printed
    assert "--earlier" not in printed
    assert "--renewed" not in printed


def test_hours_are_those_of_the_runs_that_were_timed(runs):
    counted, *_ = finished_runs(SMOKE, runs)
    some = [run._replace(seconds=seconds) for run, seconds in zip(counted, (None, 1800.0, None, 5400.0), strict=True)]
    record = origins(some)
    assert (record["hours"], record["timed_runs"]) == (2.0, 2)
    assert record["seconds_per_run"] == {"median": 3600.0, "max": 5400.0}
    record = origins([run._replace(seconds=None) for run in counted])
    assert (record["hours"], record["timed_runs"], record["seconds_per_run"]) == (0, 0, {})


@pytest.mark.parametrize("change", [{"overrides": {"tau": 0.02}}, {"eval_episodes": 3}])
def test_earlier_runs_with_other_settings_do_not_count(made, tmp_path, change):
    suite = yaml.safe_load(SMOKE.read_text()) | change
    path = tmp_path / "changed.yml"
    path.write_text(yaml.safe_dump(suite))
    with pytest.raises(FileNotFoundError, match="4 runs are not finished"):
        finished_runs(path, tmp_path, reuse=[made])


def test_results_that_do_not_name_their_runs_are_refused(tmp_path):
    (tmp_path / "old.json").write_text("{}")
    with pytest.raises(ValueError, match="does not tell its runs apart"):
        finished_runs(SMOKE, tmp_path, reuse=[tmp_path / "old"])


def test_a_failing_run_is_named_with_its_log(tmp_path, program):
    suite = yaml.safe_load(SMOKE.read_text())
    suite["cells"] = [{"task": "InvertedDoublePendulum", "noises": [0.1], "algorithms": ["gac"], "seeds": [0]}]
    path = tmp_path / "broken.yml"
    path.write_text(yaml.safe_dump(suite))
    log = tmp_path / "small-600" / "InvertedDoublePendulum-noise0.1" / "gac" / "seed0" / "log.txt"
    log.parent.mkdir(parents=True)
    (log.parent / "config.yaml").write_text(
        "run: {}\narguments: {}\n"
    )  # of another run, which is not to be mixed with this one
    printed = program("benchmarks.launch", path, "--runs", tmp_path, "--retries", 1, fails=True)
    assert f"FAILED, see {log}" in printed.replace("\n", "")
    assert "holds an unfinished run with other settings under ['run', 'arguments']" in log.read_text()
    assert log.read_text().count("--- attempt") == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"step": 3}, r"suite.yml: unknown keys \['step'\]"),
        ({"steps": None}, r"missing keys \['steps'\]"),
        ({"steps": "1e5"}, r"suite.yml, steps: must be a whole number above 0, got '1e5'. YAML reads '1e5' as text"),
        ({"envs": 0}, r"suite.yml, envs: must be a whole number above 0, got 0"),
        ({"eval_episodes": True}, "suite.yml, eval_episodes: must be a whole number above 0, got True"),
        ({"eval_every": 2.5}, "suite.yml, eval_every: must be"),
        ({"eval_every": 601}, "eval_every must be from envs to steps.*eval_every 601, steps 600"),
        ({"eval_every": 1}, "eval_every must be from envs to steps"),
        ({"overrides": [1]}, r"suite.yml, overrides: must be a mapping, got \[1\]"),
        ({"cells": []}, "suite.yml, cells: must be a list of at least one cell"),
        ({"cells": {"task": "Ant"}}, "suite.yml, cells: must be a list"),
        ({"cells": ["Ant"]}, "suite.yml, cell 1: must be a mapping, got 'Ant'"),
        ({"cells": [CELL | {"seed": 1}]}, r"suite.yml, cell 1: unknown keys \['seed'\]"),
        ({"cells": [CELL | {"seeds": ["0"]}]}, "cell 1, seeds: must be whole numbers, each, got '0'"),
        ({"cells": [CELL | {"seeds": [-1]}]}, "cell 1, seeds: must be whole numbers, each, got -1"),
        ({"cells": [CELL | {"seeds": [0.5]}]}, "cell 1, seeds: must be whole numbers, each, got 0.5"),
        ({"cells": [CELL | {"noises": 0.1}]}, "cell 1, noises: must be a list of at least one of numbers, got 0.1"),
        ({"cells": [CELL | {"noises": ["1e-1"]}]}, "cell 1, noises: must be numbers, each, got '1e-1'. YAML reads"),
        ({"cells": [CELL | {"algorithms": "gac"}]}, "cell 1, algorithms: must be a list of at least one of names, got 'gac'"),
        ({"cells": [CELL | {"algorithms": [1]}]}, "cell 1, algorithms: must be names, each, got 1"),
        *(
            ({"cells": [CELL | {"task": task}]}, r"cell 1, task: must be the name of a task, as in Hopper, got")
            for task in (5, ["Hopper"], None)
        ),
        (
            {"cells": [CELL | {"noises": [0.1, float("inf")]}]},
            "cell 1, noises: must be numbers, each, got inf",
        ),
        ({"cells": [CELL | {"noises": [float("nan")]}]}, "cell 1, noises: .*got nan"),
        ({1: 2, "foo": 3}, r"suite.yml: unknown keys \['1', 'foo'\]"),
        ({True: 3, "foo": 3}, r"suite.yml: unknown keys \['True', 'foo'\]"),
    ],
)
def test_unknown_and_missing_keys_are_refused(tmp_path, change, message):
    suite = {**yaml.safe_load(SMOKE.read_text()), **change}
    suite = {key: value for key, value in suite.items() if value is not None}
    path = tmp_path / "suite.yml"
    path.write_text(yaml.safe_dump(suite))
    with pytest.raises(ValueError, match=message):
        read_suite(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cells": [CELL | {"algorithms": ["gac", "sac_asym"]}]}, r"algorithm must be one of \[.*'sac-asym'.*got 'sac_asym'"),
        ({"cells": [CELL | {"task": "Hoper"}]}, r"task must be one of .*'Hopper'.*got 'Hoper'"),
        ({"cells": [CELL, CELL | {"task": "popgym-AutoencodeEasy"}]}, "popgym-AutoencodeEasy has no sensor noise"),
        ({"overrides": {"lerning_rate": 1}}, r"gac: GAC has no arguments \['lerning_rate'\]; it has .*'learning_rate'"),
        ({"overrides": {"learning_rate": "1e-3"}}, "gac, learning_rate: YAML reads '1e-3' as text.*1.0e-3"),
        ({"overrides": {"policy": "MlpPolicy"}}, "gac: policy: must be one of .*'MultiInputPolicy'.*got 'MlpPolicy'"),
        ({"overrides": {"policy": ["x"]}}, r"gac: policy: must be one of .*got \['x'\]"),
        ({"overrides": {"policy_kwargs": "abc"}}, "gac: policy_kwargs: must be a mapping.*got 'abc'"),
        ({"overrides": {"policy_kwargs": [1]}}, r"gac: policy_kwargs: must be a mapping.*got \[1\]"),
        ({"overrides": {1: 2, "foo": 3}}, r"gac: GAC has no arguments \['1', 'foo'\]"),
        ({"overrides": {"seed": 33}}, "gac: seed is no argument of a suite: list seeds in the cell"),
        ({"overrides": {"device": "cuda"}}, "gac: device is no argument of a suite: all runs are made on the CPU"),
        (
            {
                "algorithms": {"mine": {"class": "gac", "normalize": {"clip_ob": 5.0}}},
                "cells": [CELL | {"algorithms": ["mine"]}],
            },
            "Hopper-noise0.1, mine: TypeError: .*clip_ob",
        ),
        ({"overrides": {"batch_size": 0}}, "Hopper-noise0.1, gac: batch_size must be .*got 0"),
        ({"overrides": {"buffer_size": -1}}, "gac: buffer_size must be .*got -1"),
        ({"overrides": {"learning_rate": "fast"}}, "gac: learning_rate must be .*'fast' is no schedule"),
        ({"cells": [CELL | {"task": "Hopper-v5"}]}, "task must be the name 'Hopper', got 'Hopper-v5'"),
        (
            {"overrides": {"policy_kwargs": {"net_archs": [8]}}},
            r"policy_kwargs: GACPolicy has no arguments .*it has .*'net_arch'",
        ),
        (
            {"overrides": {"policy_kwargs": {"net_arch": {"pi": ["8"]}}}},
            "policy_kwargs, net_arch, pi, 0: YAML reads '8' as text",
        ),
    ],
)
def test_what_no_run_could_be_made_with_is_refused_before_the_first_one(tmp_path, change, message):
    path = tmp_path / "typo.yml"
    path.write_text(yaml.safe_dump(yaml.safe_load(SMOKE.read_text()) | {"cells": [CELL]} | change))
    with pytest.raises(ValueError, match=f"^typo.yml: .*{message}"):
        jobs_left(path, tmp_path)


def test_launch_says_what_is_wrong_with_a_suite_in_one_line(tmp_path):
    path = tmp_path / "typo.yml"
    path.write_text(yaml.safe_dump(yaml.safe_load(SMOKE.read_text()) | {"cells": [CELL | {"task": "Hoper"}]}))
    result = _program("benchmarks.launch", path, "--dry-run")
    assert (result.returncode, result.stdout) == (1, "")
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith("typo.yml: task must be one of")


@pytest.mark.parametrize(
    ("text", "key", "line"),
    [
        ("steps: 10\ncells: []\nenvs: 1\ncells: []\n", "cells", 4),
        ("overrides: {tau: 0.1}\ncells:\n- {task: Hopper, seeds: [0], task: Ant}\n", "task", 3),
        ("overrides: {policy_kwargs: {net_arch: [8], n: 1, net_arch: [4]}}\n", "net_arch", 1),
    ],
)
def test_a_key_that_comes_twice_is_refused_with_its_line(text, key, line, tmp_path):
    """YAML's own loader keeps the last one alone, and half of a suite is gone."""
    path = tmp_path / "twice.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"twice.yml is not YAML: the key '{key}' comes twice(.|\n)*line {line},"):
        read_suite(path)


def test_a_key_may_replace_a_merged_one(tmp_path):
    (tmp_path / "merged.yml").write_text("base: &base {a: 1, b: 2}\nother: {<<: *base, a: 3}\n")
    assert read_yaml(tmp_path / "merged.yml")["other"] == {"a": 3, "b": 2}


@pytest.mark.parametrize("suite", SUITES, ids=[path.stem for path in SUITES])
def test_every_suite_there_is_can_be_launched(suite, tmp_path):
    check_runs(suite.name, read_suite(suite))


def test_a_cell_is_all_combinations(tmp_path):
    path = tmp_path / "suite.yml"
    cells = [CELL | {"noises": [0.1, 0.05], "algorithms": ["gac", "sac"], "seeds": [3, 1]}]
    path.write_text(yaml.safe_dump(yaml.safe_load(SMOKE.read_text()) | {"envs": 7, "cells": cells}))
    order = [(seed, algorithm) for seed in (3, 1) for algorithm in ("gac", "sac")]
    specs = read_suite(path)
    assert [(spec.noise, spec.seed, spec.algorithm) for spec in specs] == [
        (noise, *of) for noise in (0.1, 0.05) for of in order
    ]
    assert {(spec.envs, spec.steps, spec.eval_every, spec.eval_episodes) for spec in specs} == {(7, 600, 200, 1)}
    assert all(spec.overrides == yaml.safe_load(SMOKE.read_text())["overrides"] for spec in specs)


def test_directories_tell_runs_apart():
    spec = RunSpec("gac", "Ant", 0.1, 7, 1000, 4, "small", 500, 1)
    assert str(spec.directory(Path("runs"))) == "runs/small-1000/Ant-noise0.1/gac/seed7"
    changes = ({"algorithm": "sac"}, {"task": "Hopper"}, {"noise": 0.05}, {"seed": 8}, {"steps": 2000}, {"preset": "sb3"})
    assert len({replace(spec, **change).directory(Path()) for change in ({}, *changes)}) == 1 + len(changes)


def test_arguments_of_a_class_are_over_those_of_its_ancestors(tmp_path, monkeypatch):
    arguments = {
        "all": {"tau": 0.1, "gamma": 0.1, "batch_size": 1},
        "gac_share": {"tau": 0.3},
        "gac": {"tau": 0.2, "gamma": 0.2},
    }
    (tmp_path / "layers.yml").write_text(yaml.safe_dump({"run": {"envs": 4}, "arguments": arguments}))
    monkeypatch.setattr(sb3_gac.presets, "DIRECTORY", tmp_path)
    _, arguments = resolve(RunSpec("gac-share", "Ant", 0.1, 7, 1000, 4, "layers", 500, 1))
    assert (arguments["tau"], arguments["gamma"], arguments["batch_size"]) == (0.3, 0.2, 1)


FIGURE = ROOT / "benchmarks/suites/first-figure.yml"
RESULTS = ROOT / "benchmarks/results/first-figure"


def test_launch_leaves_out_what_committed_results_have(tmp_path):
    specs, recorded = read_suite(FIGURE), json.loads(RESULTS.with_suffix(".json").read_text())["runs"]
    jobs, finished = jobs_left(FIGURE, tmp_path, [RESULTS])
    assert [name_of(job.spec) for job in jobs] == [name_of(spec) for spec in specs if name_of(spec) not in recorded]
    assert finished == len(recorded)
    jobs, finished = jobs_left(FIGURE, tmp_path, [RESULTS], rerun=["gac"])
    assert finished == len([name for name in recorded if "/gac/" not in name])


@pytest.mark.parametrize("change", [{"eval_episodes": 4}, {"overrides": {"tau": 0.02}}, {"steps": 99_000}, {}])
def test_committed_results_count_for_the_same_settings_alone(tmp_path, change):
    path = tmp_path / "suite.yml"
    path.write_text(yaml.safe_dump(yaml.safe_load(FIGURE.read_text()) | change))
    _, finished = jobs_left(path, tmp_path, [RESULTS])
    assert (finished > 0) == (not change)


def test_committed_results_count_for_the_same_arguments_alone(tmp_path):
    """Those that a preset has now, though the suite is as it was."""
    shutil.copy(RESULTS.with_suffix(".csv"), tmp_path / "results.csv")
    results = json.loads(RESULTS.with_suffix(".json").read_text())
    changed = next(iter(results["arguments"]))
    results["arguments"][changed] = {**results["arguments"][changed], "tau": 0.4321}
    (tmp_path / "results.json").write_text(json.dumps(results))
    before, after = (
        [name_of(job.spec) for job in jobs_left(FIGURE, tmp_path, [path])[0]] for path in (RESULTS, tmp_path / "results")
    )
    again = {name_of(spec) for spec in read_suite(FIGURE) if kind_of(spec) == changed}
    assert set(after) == set(before) | again
    assert again - set(before)


def test_what_is_missing_altogether_is_an_error_in_any_case(tmp_path):
    with pytest.raises(FileNotFoundError, match="4 runs are not finished"):
        finished_runs(SMOKE, tmp_path, complete_cells=True)


def test_a_run_listed_twice_is_refused(tmp_path):
    suite = yaml.safe_load(SMOKE.read_text())
    suite["cells"].append({**suite["cells"][0], "seeds": [1, 2]})
    path = tmp_path / "suite.yml"
    path.write_text(yaml.safe_dump(suite))
    with pytest.raises(ValueError, match=r"more than once: \['small-600/InvertedDoublePendulum-noise0.1/gac/seed1', "):
        read_suite(path)


def test_unknown_algorithms_presets_and_arguments_are_refused():
    spec = RunSpec("gac", "Ant", 0.1, 7, 1000, 4, "small", 500, 1)
    with pytest.raises(ValueError, match="algorithm must be one of"):
        read_algorithm("ppo")
    with pytest.raises(ValueError, match="preset must be one of"):
        read_preset("large")
    with pytest.raises(ValueError, match=r"GAC has no arguments \['taau'\]"):
        resolve(replace(spec, overrides={"taau": 0.01}))
    with pytest.raises(ValueError, match="activation_fn must name a class"):
        instantiate({"policy_kwargs": {"activation_fn": "__import__('os').getcwd()"}})


def test_arguments_are_layered():
    """Preset, then suite, then algorithm."""
    overrides = {"tau": 0.01, "guider": "residual", "policy_kwargs": {"activation_fn": "ReLU"}}
    spec = RunSpec("gac-independent", "Ant", 0.1, 7, 1000, 4, "small", 500, 1, overrides)
    algorithm_class, arguments = resolve(spec)
    assert algorithm_class is GAC
    assert (arguments["batch_size"], arguments["tau"], arguments["guider"]) == (128, 0.01, "independent")
    assert arguments["buffer_size"] == 1000, "as many as there are steps"
    assert arguments["policy_kwargs"] == {"net_arch": [128, 128], "activation_fn": "ReLU"}
    assert instantiate(arguments)["policy_kwargs"]["activation_fn"] is th.nn.ReLU


@pytest.mark.parametrize(
    ("task", "noise", "target_kl"),
    [("Ant", 0.0, 0.01), ("Ant", 0.3, 0.001), ("HalfCheetah", 0.2, 0.001), ("InvertedDoublePendulum", 0.1, 0.001)],
)
def test_the_papers_preset_has_the_papers_values(task, noise, target_kl):
    _, arguments = resolve(RunSpec("gac-independent", task, noise, 0, 2_000_000, 128, "paper", 1, 1))
    assert arguments["target_kl"] == target_kl
    assert (arguments["batch_size"], arguments["gradient_steps"], arguments["buffer_size"]) == (512, 64, 1_000_000)
    _, of_sac = resolve(RunSpec("sac-asym", task, noise, 0, 2_000_000, 128, "paper", 1, 1))
    assert set(arguments) - set(of_sac) == {"guider", "learner_entropy", "target_kl"}


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2, 0.3])
@pytest.mark.parametrize(("algorithm", "name"), [("gac", "gac"), ("gac-share", "gac_share"), ("sac-asym", "asymmetric_sac")])
def test_a_run_has_the_arguments_of_the_preset_that_everybody_reads(noise, algorithm, name):
    for of_preset in PRESETS:
        for task in ("Ant", "HalfCheetah", "InvertedDoublePendulum", "Hopper"):
            _, arguments = resolve(RunSpec(algorithm, task, noise, 0, 2_000_000, 128, of_preset, 500, 1))
            wanted = {"buffer_size": 1_000_000, **preset(of_preset, algorithm=name, task=task, noise=noise)}
            assert instantiate(arguments) == wanted, (of_preset, task)


def test_table_4_has_the_papers_values():
    spec = RunSpec("gac", "popgym-RepeatPreviousEasy", 0.0, 0, 10**7, 1, "paper-popgym", 1, 1)
    _, arguments = resolve(spec)
    assert (arguments["policy"], arguments["batch_size"], arguments["target_kl"]) == ("MultiInputGruPolicy", 32, 0.05)
    env_id, env_kwargs = environment(spec)
    model = GAC(env=gym.make(env_id, **env_kwargs), **{**instantiate(arguments), "buffer_size": 1_000, "device": "cpu"})
    assert model.target_entropy == pytest.approx(0.9 * np.log(4))
    for network in (model.policy.guider, model.policy.learner, model.policy.guider_critic):
        layers = [layer.weight.shape[-1] for layer in network.memory.hidden if hasattr(layer, "weight")]
        assert (layers, network.memory.hidden_size, network.net_arch) == ([256, 256], 256, [256])


def test_tasks_without_sensor_noise_have_none():
    spec = RunSpec("gac", "popgym-BattleshipEasy", 0.0, 0, 1, 1, "small-memory", 1, 1)
    assert environment(spec) == ("sb3_gac/popgym-BattleshipEasy-v0", {})
    assert environment(replace(spec, task="Ant", noise=0.2)) == ("sb3_gac/Ant-v5", {"noise_std": 0.2})
    robot = replace(spec, task="Go1Getup", noise=0.0, preset="playground")
    assert environment(robot) == ("sb3_gac/Go1Getup-v0", {"noise_std": 0.0})
    with pytest.raises(ValueError, match="has no sensor noise"):
        environment(replace(spec, noise=0.1))
    with pytest.raises(ValueError, match="task must be one of the registered"):
        environment(replace(spec, task="popgym-Chess"))


PIXELS = spaces.Dict(partial=spaces.Box(0, 255, (3, 36, 36), np.uint8), privileged=spaces.Box(-1, 1, (2,), np.float32))


def test_every_algorithm_fits_every_preset():
    algorithms = set(yaml.safe_load((ROOT / "benchmarks/hyperparams/algorithms.yml").read_text()))
    for preset_name in PRESETS:
        for algorithm in algorithms if preset_name == "sb3" else algorithms - {"sb3-sac"}:
            algorithm_class, arguments = resolve(RunSpec(algorithm, "Ant", 0.1, 0, 1000, 4, preset_name, 500, 1))
            if issubclass(algorithm_class, Program):
                continue
            env = Sampled(PIXELS) if preset_name == "pixels" else gym.make("sb3_gac/InvertedDoublePendulum-v5")
            settings = {"policy": "MultiInputPolicy", **instantiate(arguments), "device": "cpu"}
            small = {"buffer_size": 1_000} if "buffer_size" in constructor_parameters(algorithm_class) else {}
            algorithm_class(env=env, **settings | small)


KILLS = 3  # of each program, spread over what it does


@pytest.mark.parametrize("program", ["benchmarks.run", "benchmarks.launch"])
def test_what_is_killed_at_any_moment_is_finished_by_the_same_command(runs, tmp_path, program):
    """kill -9 before, between and after checkpoints; what is there stays readable, and in the end all runs are finished."""
    specs = read_suite(SMOKE)[:1] if program == "benchmarks.run" else read_suite(SMOKE)
    arguments = ["--suite", SMOKE, "--index", 0] if program == "benchmarks.run" else [SMOKE, "--jobs", 2]
    command = [sys.executable, "-m", program, *map(str, arguments), "--runs", str(tmp_path)]
    moments = itertools.cycle(np.random.default_rng(0).permutation(np.linspace(3.0, 10.0, KILLS)))
    kills = 0
    while kills < KILLS:
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            assert process.wait(next(moments)) == 0
            _assert_finished_as(specs, tmp_path, runs)
            shutil.rmtree(tmp_path / "small-600")  # and from the start again
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills += 1
            _assert_readable(tmp_path)
    assert subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode == 0
    _assert_finished_as(specs, tmp_path, runs)


def _assert_readable(directory):
    for path in directory.rglob("*.json"):
        json.loads(path.read_text())
    for path in directory.rglob("config.yaml"):
        assert "run" in yaml.safe_load(path.read_text())
    for path in directory.rglob("evaluations.csv"):
        assert pd.read_csv(path).timesteps.tolist() == [200, 400, 600]


def _assert_finished_as(specs, directory, undisturbed):
    _assert_readable(directory)
    for spec in specs:
        assert is_finished(spec, directory)
        read_algorithm(spec.algorithm)[0].load(spec.directory(directory) / "model")
        files, expected = (
            {path.name for path in spec.directory(root).iterdir()} - {"log.txt"} for root in (directory, undisturbed)
        )
        assert files == expected


class _Killed(Stopwatch):
    """Ends the process's run after its second checkpoint."""

    def _on_step(self):
        if self.num_timesteps == 500:
            raise KeyboardInterrupt
        return super()._on_step()


@pytest.mark.parametrize("algorithm", ["gac", "sac-asym", "sb3-sac", "gpo-penalty"])
def test_a_run_goes_on_from_its_checkpoint(tmp_path, monkeypatch, algorithm):
    """Ours end as if they had never been interrupted, to the bit."""
    spec = replace(read_suite(SMOKE)[0], algorithm=algorithm)
    if algorithm == "sb3-sac":
        small = {"learning_starts": 100, "batch_size": 16, "policy_kwargs": {"net_arch": [16]}}
        spec = replace(spec, preset="sb3", overrides=small)
    if algorithm == "gpo-penalty":  # on observations that are normalised
        spec = read_suite(SMOKE.with_name("smoke-gpo.yml"))[1]
    directory, undisturbed = spec.directory(tmp_path), spec.directory(tmp_path / "undisturbed")
    with monkeypatch.context() as context:
        context.setattr(benchmarks.run, "Stopwatch", _Killed)
        context.setattr(benchmarks.run, "provenance", lambda: {"commit": "old", "versions": {"torch": "2"}})
        with pytest.raises(KeyboardInterrupt):
            run(spec, tmp_path)
    monkeypatch.setattr(benchmarks.run, "provenance", lambda: {"commit": "new", "versions": {"torch": "2"}})
    stopped = json.loads((directory / "timing.json").read_text())
    assert stopped["steps"] == 400
    run(spec, tmp_path)
    finished = json.loads((directory / "timing.json").read_text())
    assert finished["steps"] == 600
    assert finished["seconds"] > stopped["seconds"]
    origins = made_with(yaml.safe_load((directory / "config.yaml").read_text()))
    assert [origin["commit"] for origin in origins] == ["old", "new"]
    assert read_algorithm(algorithm)[0].load(directory / "model").num_timesteps == 600
    run(spec, tmp_path / "undisturbed")
    found, expected = (pd.read_csv(path / "evaluations.csv") for path in (directory, undisturbed))
    assert found.timesteps.tolist() == [200, 400, 600]
    assert found.learner[:2].tolist() == expected.learner[:2].tolist(), "taken over, not made again"
    if algorithm != "sb3-sac":
        pd.testing.assert_frame_equal(found, expected, check_exact=True)
        resumed, model = (read_algorithm(algorithm)[0].load(path / "model") for path in (directory, undisturbed))
        assert all(th.equal(p, q) for p, q in zip(resumed.policy.parameters(), model.policy.parameters(), strict=True))
    assert {path.name for path in directory.iterdir()} == {path.name for path in undisturbed.iterdir()}


@pytest.mark.parametrize(("kind", "own"), [("SAC", {"learning_starts": 100, "batch_size": 16}), ("PPO", {"n_steps": 50})])
def test_the_statistics_of_sb3s_runs_go_on_too(tmp_path, monkeypatch, kind, own):
    small = {"policy_kwargs": {"net_arch": [4]}, **own}
    definition = {"class": f"stable_baselines3:{kind}", "normalize": {"norm_reward": True}}
    spec = replace(read_suite(SMOKE)[0], algorithm="mine", preset="sb3", overrides=small, definition=definition)
    with monkeypatch.context() as context:
        context.setattr(benchmarks.run, "Stopwatch", _Killed)
        with pytest.raises(KeyboardInterrupt):
            run(spec, tmp_path)
    found, expected = (
        pickle.loads((run(spec, root) / "vecnormalize.pkl").read_bytes()) for root in (tmp_path, tmp_path / "undisturbed")
    )
    assert found.ret_rms.count == expected.ret_rms.count, "one return of each of 600 steps"
    assert found.obs_rms["partial"].count == expected.obs_rms["partial"].count + spec.envs, "one more reset"


def test_a_checkpoint_without_the_statistics_of_its_normalisation_is_refused(tmp_path):
    env, checkpoints = VecNormalize(sb3_gac.envs.make_vec("sb3_gac/Pendulum-v1", 1)), SB3Checkpoints(tmp_path)
    checkpoints._save(PPO("MultiInputPolicy", env, n_steps=8).learn(8), {"history": []})
    (tmp_path / "checkpoint" / "vecnormalize.pkl").unlink()
    with pytest.raises(ValueError, match=r"lacks vecnormalize.pkl, .*: remove it, and the run begins again"):
        checkpoints.resume(PPO, {}, env, 0)


def test_a_column_that_later_evaluations_lack_stays_in_the_file():
    rows = [{"timesteps": 1, "learner": 0.5, "kl": 0.25}, {"timesteps": 2, "learner": 1.5}]
    assert rows_as_text(rows).splitlines() == ["timesteps,learner,kl", "1,0.5,0.25", "2,1.5,nan"]


class _Noted:
    """In the place of one of SB3's algorithms: notes where it was loaded from, and which seed it got."""

    num_timesteps = 200

    @classmethod
    def load(cls, path, **kwargs):
        model = cls()
        model.path = path
        return model

    def load_replay_buffer(self, path):
        self.buffer_path = path

    def set_random_seed(self, seed):
        self.seed = seed


def test_sb3s_runs_go_on_from_the_newest_checkpoint_with_numbers_that_were_not_drawn(tmp_path):
    checkpoints = SB3Checkpoints(tmp_path)
    assert checkpoints.resume(_Noted, {}, None, 3) is None
    seeds = []
    for name, history in (("checkpoint.old", [{"timesteps": 1}]), ("checkpoint", [{"timesteps": 2}])):
        (tmp_path / name).mkdir()
        (tmp_path / name / "history.json").write_text(json.dumps(history))
        model, found = checkpoints.resume(_Noted, {}, None, 3)
        assert (found, model.path, model.buffer_path) == (
            {"history": history},
            tmp_path / name / "model",
            tmp_path / name / "replay_buffer.pkl",
        )
        seeds.append(model.seed)
    assert seeds[0] == seeds[1]
    for seed, steps in ((3, 400), (4, 200)):
        model, _ = checkpoints.resume(type("Other", (_Noted,), {"num_timesteps": steps}), {}, None, seed)
        seeds.append(model.seed)
    assert len(set(seeds[1:])) == 3, "other numbers for another seed, and at another step"
    assert not {0, 3, 4} & set(seeds), "nor those that the run began with"


def test_sb3s_on_policy_algorithms_have_checkpoints_without_a_buffer(tmp_path):
    env, checkpoints = sb3_gac.envs.make_pendulum(), SB3Checkpoints(tmp_path)
    checkpoints._save(PPO("MultiInputPolicy", env, n_steps=8).learn(8), {"history": [{"timesteps": 8, "learner": 1.0}]})
    model, state = checkpoints.resume(PPO, {}, env, 0)
    assert (model.num_timesteps, state["history"][0]["learner"]) == (8, 1.0)


def test_a_run_leaves_signals_to_the_process(tmp_path):
    """Told to end, it ends at once: a checkpoint between evaluations would shift those to come."""
    seen, before = [], [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    callback = checkpoints_of(GAC, tmp_path).callback(SimpleNamespace(checkpoint_state=dict), 1_000)
    watch = ConvertCallback(lambda *_: seen.append([signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT)]) or True)
    small_model().learn(2, callback=[callback, watch])
    assert seen == [before, before]


@pytest.mark.parametrize(("resumed", "seconds"), [(True, 130.0), (False, 30.0)])
def test_seconds_are_those_of_the_processes_that_made_a_run(resumed, seconds, tmp_path, monkeypatch):
    path = tmp_path / "timing.json"
    path.write_text(json.dumps({"seconds": 100.0, "steps": 5, "learner": 0.0}))
    clock = iter((1_000.0, 1_030.0))
    monkeypatch.setattr(benchmarks.run, "time", SimpleNamespace(time=lambda: next(clock)))
    watch = Stopwatch(path, SimpleNamespace(history=[{"learner": 2.5}]), resumed)
    watch.model = SimpleNamespace(num_timesteps=10)
    watch.write()
    assert json.loads(path.read_text()) == {"seconds": seconds, "steps": 10, "learner": 2.5}


@pytest.mark.parametrize(("steps", "size"), [(600, 1_000), (5_000, 5_000), (10**7, 10**6)])
def test_a_buffer_holds_the_run_within_bounds(steps, size):
    assert resolve(replace(read_suite(SMOKE)[0], steps=steps))[1]["buffer_size"] == size


def test_what_is_left_of_a_finished_run_is_not_gone_on_with(tmp_path, monkeypatch):
    spec = read_suite(SMOKE)[0]
    for commit in ("old", "new"):
        monkeypatch.setattr(benchmarks.run, "provenance", lambda commit=commit: {"commit": commit, "versions": {"torch": "2"}})
        run(spec, tmp_path)
        origins = made_with(yaml.safe_load((spec.directory(tmp_path) / "config.yaml").read_text()))
        assert [origin["commit"] for origin in origins] == [commit], "from the start again, nothing of the old one is left"
        (spec.directory(tmp_path) / "evaluations.csv").unlink()


def test_two_runs_are_never_mixed(tmp_path):
    spec = read_suite(SMOKE)[0]
    directory = spec.directory(tmp_path)
    directory.mkdir(parents=True)
    with locked(directory), pytest.raises(RuntimeError, match="Another process is running"):
        run(spec, tmp_path)
    configuration = {"run": asdict(spec), "arguments": {**resolve(spec)[1], "tau": 0.5}}
    (directory / "config.yaml").write_text(yaml.safe_dump(configuration))
    with pytest.raises(ValueError, match=r"unfinished run with other settings under \['arguments'\]"):
        run(spec, tmp_path)


def test_a_finished_run_with_other_settings_is_neither_skipped_nor_counted(tmp_path):
    spec = read_suite(SMOKE)[0]
    directory = spec.directory(tmp_path)
    directory.mkdir(parents=True)
    (directory / "evaluations.csv").write_text("done")
    (directory / "config.yaml").write_text(yaml.safe_dump({"run": asdict(spec)}))
    assert run(spec, tmp_path) == directory
    assert (directory / "evaluations.csv").read_text() == "done", "left alone"
    (directory / "config.yaml").write_text(yaml.safe_dump({"run": {**asdict(spec), "eval_episodes": 7}}))
    for program in (lambda: run(spec, tmp_path), lambda: jobs_left(SMOKE, tmp_path), lambda: finished_runs(SMOKE, tmp_path)):
        with pytest.raises(ValueError, match=r"under \['eval_episodes'\]: remove it, .* \(--runs, or --out of a comparison\)"):
            program()


def test_a_run_from_before_it_could_say_how_it_is_evaluated_was_evaluated_by_its_likeliest_actions(tmp_path):
    """Whether it is finished, has results, or goes on."""
    spec = replace(read_suite(SMOKE)[0])
    directory = spec.directory(tmp_path)
    directory.mkdir(parents=True)
    before = {key: value for key, value in asdict(spec).items() if key != "eval_deterministic"}
    (directory / "config.yaml").write_text(yaml.safe_dump({"run": before, "arguments": resolve(spec)[1]}))
    (directory / "evaluations.csv").write_text("done")
    assert is_finished(spec, tmp_path)
    with pytest.raises(ValueError, match=r"other settings under \['eval_deterministic'\]"):
        is_finished(replace(spec, eval_deterministic=False), tmp_path)
    (directory / "evaluations.csv").unlink()
    with pytest.raises(ValueError, match=r"unfinished run with other settings under \['run'\]"):
        run(replace(spec, eval_deterministic=False), tmp_path)
    run(replace(spec), tmp_path)
    assert yaml.safe_load((directory / "config.yaml").read_text())["run"]["eval_deterministic"] is True


def test_a_run_may_be_evaluated_by_samples(tmp_path):
    path = tmp_path / "sampled.yml"
    path.write_text(yaml.safe_dump(yaml.safe_load(SMOKE.read_text()) | {"eval_deterministic": False, "cells": [CELL]}))
    spec = replace(read_suite(path)[0], task="InvertedDoublePendulum", algorithm="sac-asym", steps=200, eval_every=200)
    likeliest, sampled = (
        pd.read_csv(run(one, tmp_path / str(one.eval_deterministic)) / "evaluations.csv")
        for one in (replace(spec, eval_deterministic=True), spec)
    )
    assert likeliest.timesteps.tolist() == sampled.timesteps.tolist() == [200]
    assert likeliest.learner.tolist() != sampled.learner.tolist()
    path.write_text(yaml.safe_dump(yaml.safe_load(SMOKE.read_text()) | {"eval_deterministic": 0}))
    with pytest.raises(ValueError, match=r"sampled.yml, eval_deterministic: must be true or false, got 0"):
        read_suite(path)


def _results_of(suite, path, change):
    """Results that all runs of a suite went into, as nobody has made them, with other arguments."""
    specs = read_suite(suite)
    rows = [{**names_of(spec), "timesteps": 1, "learner": 1.0} for spec in specs]
    pd.DataFrame(rows).to_csv(path.with_suffix(".csv"), index=False)
    record = {
        "settings": settings_of(specs[0]),
        "arguments": {kind_of(spec): change(spec, resolve(spec)[1]) for spec in specs},
        "particulars": {kind_of(spec): found for spec in specs if (found := particulars_of(spec))},
        "runs": {name_of(spec): {"seconds": 1.0, "made_with": [0]} for spec in specs},
        "made_with": [{"commit": "0"}],
        "cpus": 1,
    }
    path.with_suffix(".json").write_text(json.dumps(as_json(record), allow_nan=False))
    return specs


def test_infinite_arguments_are_kept_in_results_and_read_again(tmp_path):
    """JSON has no such numbers; the paper's recipe by Brax clips observations to infinity, which is to clip nothing."""
    suite = ROOT / "benchmarks/suites/brax-choices.yml"
    specs = _results_of(suite, tmp_path / "made", lambda spec, arguments: arguments)
    assert '"clip_obs": ".inf"' in (tmp_path / "made.json").read_text()
    assert len(read_reused([tmp_path / "made"], specs, ())) == len(specs)
    assert from_json(as_json({"a": [-math.inf, 1.5, "text"], "b": None})) == {"a": [-math.inf, 1.5, "text"], "b": None}


STDS = ROOT / "benchmarks/suites/guider-std.yml"


def _former(arguments):
    return {"std_of" if name == "shared_std" else name: value for name, value in arguments.items()}


def test_results_with_former_names_of_arguments_count(tmp_path):
    """Those that are committed too, and what is made of them has the present names."""
    specs = _results_of(STDS, tmp_path / "made", lambda spec, arguments: _former(arguments))
    recorded = json.loads((tmp_path / "made.json").read_text())["arguments"]
    assert any("std_of" in arguments for arguments in recorded.values()), "or nothing was tested"
    counted, missing, _ = finished_runs(STDS, tmp_path, reuse=[tmp_path / "made"])
    assert not missing
    assert [run.arguments for run in counted] == [resolve(spec)[1] for spec in specs]

    _results_of(STDS, tmp_path / "other", lambda spec, arguments: _former(arguments) | {"std_of": "learner"})
    assert not read_reused([tmp_path / "other"], specs, ()), "another value is another one by whatever name"
    committed = ROOT / "benchmarks/results/guider-std"
    made = [name for name in json.loads(committed.with_suffix(".json").read_text())["runs"] if "gac-guider-std" in name]
    assert made
    assert set(made) <= set(read_reused([committed], specs, ()))


@pytest.mark.filterwarnings("ignore:.*std_of:FutureWarning")
@pytest.mark.parametrize("where", ["overrides", "own", "policy_kwargs"])
def test_a_suite_with_former_names_of_arguments_is_read_and_says_what_they_are_now(where, tmp_path):
    """Its results are those of the same suite with present names, and the reverse."""
    suite = yaml.safe_load(SMOKE.read_text())
    cells = [suite["cells"][0] | {"algorithms": ["mine"]}]
    paths = {}
    for name in ("std_of", "shared_std"):
        given = {"policy_kwargs": {name: "guider"}} if where == "policy_kwargs" else {name: "guider"}
        mine = {"class": "gac", **(given if where == "own" else {})}
        overrides = {} if where == "own" else given
        (tmp_path / name).mkdir()
        paths[name] = tmp_path / name / "suite.yml"
        paths[name].write_text(yaml.safe_dump(suite | {"cells": cells, "algorithms": {"mine": mine}, "overrides": overrides}))
    with pytest.warns(FutureWarning, match='"std_of" is "shared_std" now'):
        former = [resolve(spec)[1] for spec in read_suite(paths["std_of"])]
    assert former == [resolve(spec)[1] for spec in read_suite(paths["shared_std"])]
    assert "guider" in str(former[0])
    for name, other in (("std_of", "shared_std"), ("shared_std", "std_of")):
        specs = _results_of(paths[name], tmp_path / name / "made", lambda spec, arguments: arguments)
        assert len(read_reused([tmp_path / name / "made"], read_suite(paths[other]), ())) == len(specs)


@pytest.mark.parametrize(("value", "goes_on"), [("guider", True), ("learner", False)])
def test_a_run_that_was_begun_with_former_names_of_arguments_goes_on(value, goes_on, tmp_path):
    path, settings = tmp_path / "config.yaml", {"steps": 1, "overrides": {"tau": 0.1, "shared_std": "guider"}}
    now = {"run": settings, "arguments": {"tau": 0.1, "shared_std": "guider"}}
    before = {"run": settings | {"overrides": {"tau": 0.1, "std_of": value}}, "arguments": {"tau": 0.1, "std_of": value}}
    path.write_text(yaml.safe_dump(before | {"commit": "0"}))
    with nullcontext() if goes_on else pytest.raises(ValueError, match=r"other settings under \['run', 'arguments'\]"):
        benchmarks.run._refuse_other_settings(path, GAC, now)


def test_an_argument_by_both_names_in_one_place_is_refused(tmp_path):
    cells = [CELL | {"algorithms": ["mine"]}]
    suite = {"steps": 1, "envs": 1, "preset": "small", "eval_every": 1, "eval_episodes": 1, "cells": cells}
    suite["algorithms"] = {"mine": {"class": "gac", "std_of": "guider", "shared_std": "guider"}}
    (tmp_path / "suite.yml").write_text(yaml.safe_dump(suite))
    with pytest.raises(ValueError, match='mine: GAC got "shared_std" twice'):
        resolve(read_suite(tmp_path / "suite.yml")[0])
