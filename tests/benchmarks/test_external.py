"""An algorithm that is a program of its own: what it is told, what is read of it, and what its run leaves."""

import json
import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import yaml

import benchmarks.aggregate
import benchmarks.bootstrap
import benchmarks.launch
import benchmarks.report
from benchmarks.checkpoint import write_atomically
from benchmarks.config import check_programs, check_runs, resolve
from benchmarks.environments import EVAL_SEED, make_envs
from benchmarks.external import Program, evaluation_times, request_of
from benchmarks.finished import is_finished
from benchmarks.program import Request
from benchmarks.random_actions import RandomPolicy
from benchmarks.run import run
from benchmarks.suite import HERE, RunSpec, made_with, read_suite
from sb3_gac import SeededEvalCallback
from tests.benchmarks.helpers import SMALL_SUITE
from tests.helpers import small_model

SPEC = RunSpec("random-actions", "InvertedDoublePendulum", 0.1, 3, 60, 2, "small", 20, 2)
#: Notes each start, evaluates what is missing, and fails where its arguments say so
PROGRAM = """
import json, pathlib, sys
path = pathlib.Path(sys.argv[-1])
asked = json.loads(path.read_text())
arguments, rows = asked["arguments"], path.parent / "checkpoint" / "evaluations.csv"
starts = path.parent / "starts.txt"
starts.write_text((starts.read_text() if starts.exists() else "") + " ".join(sys.argv[1:-1]) + ".")
lines = rows.read_text().splitlines() if rows.exists() else [arguments.get("head", "timesteps,learner,loss")]
for timesteps in asked["evaluations"][len(lines) - 1 : arguments.get("evaluations")]:
    lines.append(f"{timesteps},{timesteps + asked['run']['seed']},0.5")
    rows.with_suffix(".new").write_text("\\n".join(lines) + "\\n")
    rows.with_suffix(".new").replace(rows)
    if timesteps == arguments.get("dies_at") and len(starts.read_text()) == 1:
        sys.exit(3)
"""


@pytest.fixture
def spec(tmp_path):
    """Of a run by ``PROGRAM``, with the arguments that are given."""
    (tmp_path / "program.py").write_text(PROGRAM)

    def of(words=(), **arguments):
        command = ["python", str(tmp_path / "program.py"), *words]
        definition = {"class": "benchmarks.external:Program", "command": command, "arguments": arguments}
        return replace(SPEC, algorithm="mine", definition=definition)

    return of


def test_a_program_is_asked_once_and_its_run_is_like_any_other(spec, tmp_path):
    asked = spec(["first", "second"])
    directory = run(asked, tmp_path / "runs")
    assert (directory / "starts.txt").read_text() == "first second."
    table = pd.read_csv(directory / "evaluations.csv")
    assert table.to_dict("list") == {"timesteps": [20, 40, 60], "learner": [23, 43, 63], "loss": [0.5] * 3}
    configuration = yaml.safe_load((directory / "config.yaml").read_text())
    assert configuration["run"] == json.loads(json.dumps(vars(asked)))
    assert configuration["arguments"]["command"][2:] == ["first", "second"]
    assert {"commit", "versions", "cpus", "earlier"} <= set(configuration)
    timing = json.loads((directory / "timing.json").read_text())
    assert (timing["steps"], timing["learner"]) == (60, 63)
    files = {path.name for path in directory.iterdir()}
    assert files == {"starts.txt", "evaluations.csv", "config.yaml", "timing.json", "request.json", "lock"}
    run(asked, tmp_path / "runs")
    assert (directory / "starts.txt").read_text() == "first second.", "a finished run is skipped"


def test_a_program_that_ends_early_goes_on_with_what_it_has(spec, tmp_path, monkeypatch):
    asked = spec(dies_at=40)
    monkeypatch.setattr("benchmarks.run.provenance", lambda: {"commit": "old", "versions": {}, "cpus": 1})
    with pytest.raises(RuntimeError, match=r"program\.py.* ended with status 3"):
        run(asked, tmp_path)
    directory = asked.directory(tmp_path)
    assert not is_finished(asked, tmp_path)
    timing = json.loads((directory / "timing.json").read_text())
    assert timing["steps"] == 40
    write_atomically(directory / "timing.json", json.dumps(timing | {"seconds": 1e6}))
    monkeypatch.setattr("benchmarks.run.provenance", lambda: {"commit": "new", "versions": {}, "cpus": 1})
    run(asked, tmp_path)
    assert (directory / "starts.txt").read_text() == ".."
    assert pd.read_csv(directory / "evaluations.csv").timesteps.tolist() == [20, 40, 60]
    assert json.loads((directory / "timing.json").read_text())["seconds"] > 1e6, "those of the first process count"
    origins = made_with(yaml.safe_load((directory / "config.yaml").read_text()))
    assert [origin["commit"] for origin in origins] == ["old", "new"]


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"evaluations": 2}, RuntimeError, r"ended with evaluations at \[20, 40\] steps, not at \[20, 40, 60\]"),
        ({"evaluations": 0}, RuntimeError, r"ended with evaluations at \[\] steps"),
        ({"head": "steps,learner,loss"}, ValueError, r"evaluations\.csv: each row must have .*timesteps and learner"),
        ({"head": "timesteps,return,loss"}, ValueError, r"evaluations\.csv: each row must have .*timesteps and learner"),
    ],
)
def test_a_program_without_all_of_its_evaluations_has_not_finished(spec, tmp_path, arguments, error, message):
    with pytest.raises(error, match=message):
        run(spec(**arguments), tmp_path)
    assert not is_finished(spec(**arguments), tmp_path)


@pytest.mark.parametrize(
    ("steps", "envs", "every", "times"),
    [(60, 2, 20, [20, 40, 60]), (61, 2, 21, [20, 40, 60]), (7, 4, 4, [4, 8]), (7, 1, 4, [4]), (9, 4, 6, [4, 8, 12])],
)
def test_evaluations_are_when_those_of_all_algorithms_are(steps, envs, every, times):
    spec = replace(SPEC, steps=steps, envs=envs, eval_every=every)
    assert evaluation_times(spec) == times
    model, eval_env = small_model(make_envs(spec, envs)), make_envs(spec, 1)
    callback = SeededEvalCallback(eval_env, eval_freq=every // envs, n_eval_episodes=1, verbose=0)
    model.learn(steps, callback=callback)
    assert [row["timesteps"] for row in callback.history] == times


def _request(spec, directory):
    (directory / "checkpoint").mkdir()
    (directory / "request.json").write_text(json.dumps(request_of(spec, {})))
    return Request(directory / "request.json")


def test_evaluations_are_as_those_of_all_algorithms_are(tmp_path):
    request = _request(SPEC, tmp_path)
    policy = RandomPolicy(request.make_env().action_space, 0)
    first = request.evaluate(20, policy)

    model = small_model(make_envs(SPEC, 2))
    model.predict = RandomPolicy(request.make_env().action_space, 0).predict
    evaluation = SeededEvalCallback(make_envs(SPEC, 2), eval_seed=EVAL_SEED, eval_freq=1, n_eval_episodes=2, verbose=0)
    model.learn(2, callback=evaluation)
    assert first == evaluation.history[0]["learner"]
    assert request.evaluate(40, policy) != first, "other actions"
    assert (
        Request(request.path).rows
        == request.rows
        == [
            {"timesteps": 20, "learner": first},
            {"timesteps": 40, "learner": request.rows[1]["learner"]},
        ]
    )
    request.go_on_from(39)
    assert [row["timesteps"] for row in request.rows] == [20]


def test_random_actions_return_what_random_actions_return(tmp_path):
    """Worked out in a loop of its own, one environment at a time would draw other actions: both at once."""
    directory = run(replace(SPEC, steps=20), tmp_path)
    (row,) = pd.read_csv(directory / "evaluations.csv").to_dict("records")
    envs = [gym.make("sb3_gac/InvertedDoublePendulum-v5", noise_std=0.1) for _ in range(2)]
    for index, env in enumerate(envs):
        env.reset(seed=EVAL_SEED + index)
    actions, returns, alive = envs[0].action_space, [0.0, 0.0], [True, True]
    actions.seed(SPEC.seed)
    while any(alive):
        for index, action in enumerate([actions.sample() for _ in envs]):
            if alive[index]:
                _, reward, terminated, truncated, _ = envs[index].step(action)
                returns[index] += float(reward)
                alive[index] = not (terminated or truncated)
    assert row == {"timesteps": 20, "learner": pytest.approx(np.mean(returns), rel=1e-6)}


def test_launch_aggregate_and_report_read_a_programs_run_like_others(spec, tmp_path, monkeypatch, capsys):
    definition = spec().definition
    cell = {"task": "InvertedDoublePendulum", "noises": [0.1], "algorithms": ["mine", "sac-asym"], "seeds": [0]}
    path = tmp_path / "suite.yml"
    path.write_text(yaml.safe_dump(SMALL_SUITE | {"algorithms": {"mine": definition}, "cells": [cell]}))
    runs, out = tmp_path / "runs", tmp_path / "out"
    for one in read_suite(path):
        run(one, runs)
    assert benchmarks.launch.jobs_left(path, runs) == ([], 2)
    monkeypatch.setattr(sys, "argv", ["aggregate", str(path), "--runs", str(runs), "--out", str(out)])
    monkeypatch.setattr(benchmarks.bootstrap, "REPETITIONS", 10)
    benchmarks.aggregate.main()
    monkeypatch.setattr(sys, "argv", ["report", str(out)])
    benchmarks.report.main()
    assert "| InvertedDoublePendulum | 0.1 | mine | 60.0 | 60.0 |  |" in capsys.readouterr().out
    results = json.loads(out.with_suffix(".json").read_text())
    assert results["arguments"]["mine, InvertedDoublePendulum, noise 0.1"]["command"] == definition["command"]
    made, *_ = benchmarks.aggregate.finished_runs(path, tmp_path / "nowhere", reuse=[out])
    assert [one.spec.algorithm for one in made] == ["mine", "sac-asym"], "results stand for runs that are gone"


def test_the_presets_and_the_suites_arguments_are_not_a_programs():
    own = {"command": ["python", "-m", "benchmarks.random_actions"]}
    assert resolve(replace(SPEC, overrides={"batch_size": 3})) == (Program, own)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"command": []}, "mine: command: must be a list of words"),
        ({"command": "python -m mine"}, "mine: command: must be a list of words"),
        ({"command": ["python", 3]}, "mine: command and packages: must be lists of text"),
        ({"python": 3}, "mine: python: must be the name of an environment variable"),
        ({"packages": "torch"}, "mine: packages: must be a list of names"),
        ({"arguments": [1]}, "mine: arguments: must be a mapping"),
        ({"arguments": {"lr": "1e-3"}}, "mine, arguments, lr: YAML reads '1e-3' as text"),
        ({"batch_size": 3}, r"mine: Program has no arguments \['batch_size'\]"),
        ({"normalize": {}}, "mine: a program normalises by itself"),
    ],
)
def test_a_definition_that_means_nothing_is_refused(spec, change, message):
    asked = spec()
    with pytest.raises(ValueError, match=f"suite.yml: {message}"):
        check_runs("suite.yml", [replace(asked, definition=asked.definition | change)])


def test_a_definition_without_a_command_and_one_that_needs_a_run_are_refused(spec):
    asked = spec()
    without = {key: value for key, value in asked.definition.items() if key != "command"}
    with pytest.raises(ValueError, match=r"mine: .*missing .*'command'"):
        resolve(replace(asked, definition=without))
    with pytest.raises(ValueError, match=r"mine: Program has no arguments \['teacher'\]"):
        resolve(replace(asked, needs={"teacher": {"algorithm": "sac", "steps": 20}}))


def test_what_a_program_needs_is_recorded_or_named(spec, tmp_path, monkeypatch):
    asked = spec()
    having = replace(asked, definition=asked.definition | {"packages": ["pyyaml"], "python": "MY_PYTHON"})
    directory = run(having, tmp_path)
    versions = yaml.safe_load((directory / "config.yaml").read_text())["versions"]
    assert versions["pyyaml"] == yaml.__version__
    lacking = replace(asked, definition=asked.definition | {"packages": ["pyyaml", "no-such-package"], "python": "MY_PYTHON"})
    with pytest.raises(ValueError, match=rf"mine: this interpreter, {sys.executable}, lacks \['no-such-package'\].*MY_PYTHON"):
        check_programs([lacking])
    monkeypatch.setenv("MY_PYTHON", str(tmp_path / "python"))
    with pytest.raises(ValueError, match=r"mine: the interpreter that MY_PYTHON names, .*python, can't be run"):
        check_programs([having])
    monkeypatch.setenv("MY_PYTHON", sys.executable)
    assert Program(["python", "-m", "mine"], python="MY_PYTHON").command == [sys.executable, "-m", "mine"]
    assert Program(["./mine"]).command == ["./mine"]


def test_launch_refuses_what_a_program_lacks_before_the_first_run(tmp_path, monkeypatch):
    path = tmp_path / "suite.yml"
    cell = {"task": "InvertedDoublePendulum", "noises": [0.1], "algorithms": ["mine"], "seeds": [0]}
    mine = {"class": "benchmarks.external:Program", "command": ["python"], "packages": ["no-such-package"]}
    path.write_text(yaml.safe_dump(SMALL_SUITE | {"algorithms": {"mine": mine}, "cells": [cell]}))
    monkeypatch.setattr(sys, "argv", ["launch", str(path), "--runs", str(tmp_path / "runs")])
    with pytest.raises(SystemExit, match=r"mine: .*lacks \['no-such-package'\]"):
        benchmarks.launch.main()
    assert not (tmp_path / "runs").exists()


def test_a_program_finds_the_checkout_and_the_modules_of_its_environment(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    asked = request_of(SPEC, {"size": 1})
    assert str(tmp_path) in asked["path"]
    assert not [place for place in asked["path"] if "site-packages" in place], "another interpreter has its own"
    assert asked["environment"] == {"id": "sb3_gac/InvertedDoublePendulum-v5", "kwargs": {"noise_std": 0.1}, "wrappers": []}
    assert asked["arguments"] == {"size": 1}
    assert (HERE / "random_actions.py").exists()
