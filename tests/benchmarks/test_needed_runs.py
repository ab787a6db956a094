"""An algorithm that starts from another run's model: that run comes first, and its steps count."""

import json
import sys
import threading
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import benchmarks.aggregate
import benchmarks.launch
import benchmarks.report
import benchmarks.run
from benchmarks.aggregate import finished_runs
from benchmarks.config import fingerprint
from benchmarks.finished import name_of
from benchmarks.jobs import Job, count
from benchmarks.launch import in_order, jobs_left, launch, run_command
from benchmarks.run import run
from benchmarks.suite import RunSpec, needed_runs, needed_steps, read_suite
from sb3_gac import AsymmetricSAC
from tests.benchmarks.helpers import SMALL_SUITE


class Taught(AsymmetricSAC):
    """Begins with its teacher's actor."""

    def __init__(self, *arguments, teacher=None, **options):
        self.teacher = teacher
        super().__init__(*arguments, **options)
        if isinstance(teacher, str):
            self.steps_of_teacher = AsymmetricSAC.load(teacher).num_timesteps


class Fails(AsymmetricSAC):
    """As a run does whose machine is out of memory."""

    def learn(self, *arguments, **options):
        raise MemoryError


OWN = {
    "taught": {"class": f"{__name__}:Taught", "needs": {"teacher": {"algorithm": "sac-full", "steps": 40}}},
    "twice": {"class": f"{__name__}:Taught", "needs": {"teacher": {"algorithm": "taught", "steps": 30}}},
    "failing": {"class": f"{__name__}:Fails"},
    "bereft": {"class": f"{__name__}:Taught", "needs": {"teacher": {"algorithm": "failing"}}},
    "orphaned": {"class": f"{__name__}:Taught", "needs": {"teacher": {"algorithm": "bereft"}}},
}
SUITE = SMALL_SUITE | {"algorithms": OWN}
CELL = {"task": "Pendulum", "noises": [0.1], "algorithms": ["taught"], "seeds": [0]}


def _suite(directory, *cells, **changes):
    path = directory / "taught.yml"
    path.write_text(yaml.safe_dump({**SUITE, "cells": list(cells), **changes}))
    return path


class InThisProcess:
    """An engine that notes what it ran."""

    def __init__(self):
        self.ran = []

    def run(self, command, log):
        self.ran.append(command)
        with pytest.MonkeyPatch.context() as context:
            context.setattr(sys, "argv", command[2:])
            try:
                benchmarks.run.main()
            except MemoryError:
                return 1
        return 0


def _names(jobs):
    return [name_of(job.spec).replace("Pendulum-noise0.1/", "") for job in jobs]


def test_a_needed_run_is_the_same_run_but_for_algorithm_and_steps(tmp_path):
    (spec,) = read_suite(_suite(tmp_path, CELL | {"seeds": [7]}))
    ((argument, needed),) = needed_runs(spec).items()
    assert argument == "teacher"
    assert (needed.algorithm, needed.steps, needed.needs) == ("sac-full", 40, None)
    same = ("task", "noise", "seed", "envs", "preset", "eval_every", "eval_episodes", "overrides")
    assert all(getattr(needed, name) == getattr(spec, name) for name in same)


def test_steps_of_all_that_comes_before_count_once(tmp_path):
    specs = read_suite(_suite(tmp_path, CELL | {"algorithms": ["sac-full", "taught", "twice"]}))
    assert [needed_steps(spec) for spec in specs] == [0, 40, 30 + 40]
    needs = {argument: {"algorithm": "sac-full", "steps": 40} for argument in ("teacher", "judge")}
    both = RunSpec("x", "Pendulum", 0.1, 0, 60, 2, "small", 20, 1, needs=needs)
    assert needed_steps(both) == 40, "one run, for two arguments"


def test_without_steps_a_needed_run_has_as_many_as_the_one_that_needs_it_and_a_cell_may_say_otherwise(tmp_path):
    own = {"taught": {"class": f"{__name__}:Taught", "needs": {"teacher": {"algorithm": "sac-full"}}}}
    for needs, expected in (({}, ("sac-full", 60)), ({"steps": 20}, ("sac-full", 20)), ({"algorithm": "sac"}, ("sac", 60))):
        cell = CELL | {"needs": {"taught": {"teacher": needs}}}
        (spec,) = read_suite(_suite(tmp_path, cell, algorithms=own))
        needed = needed_runs(spec)["teacher"]
        assert (needed.algorithm, needed.steps) == expected


def test_jobs_are_in_the_suites_order_after_those_that_they_need_each_once(tmp_path):
    cell = CELL | {"algorithms": ["sac-asym", "taught", "twice"], "seeds": [0, 1]}
    jobs, finished = jobs_left(_suite(tmp_path, cell, {**CELL, "algorithms": ["gac"]}), tmp_path)
    assert finished == 0
    of_a_seed = ["small-60/sac-asym", "small-40/sac-full", "small-60/taught", "small-30/taught", "small-60/twice"]
    assert _names(jobs) == [f"{name}/seed{seed}" for seed in (0, 1) for name in of_a_seed] + ["small-60/gac/seed0"]
    assert _names(jobs[3].needs) == ["small-40/sac-full/seed0"]
    assert jobs[2].needs == jobs[3].needs == [jobs[1]], "the same job"
    assert jobs[2].needs[0] is jobs[3].needs[0]


@given(st.data())
def test_one_at_a_time_jobs_start_in_their_order_but_for_those_whose_needs_failed(data):
    jobs = [_job(0)]
    for seed in range(1, data.draw(st.integers(1, 8))):
        jobs.append(_job(seed, [jobs[i] for i in data.draw(st.sets(st.integers(0, seed - 1), max_size=2))]))
    fail = data.draw(st.sets(st.integers(0, 7)))
    started, told = _started(jobs, 1, fail)
    hopeless: set[int] = set()
    for job in jobs:
        if any(other.spec.seed in fail | hopeless for other in job.needs):
            hopeless.add(job.spec.seed)
    assert started == [[job.spec.seed] for job in jobs if job.spec.seed not in hopeless]
    assert sorted(told) == sorted(hopeless), "each once"


def test_a_job_that_waits_leaves_its_place_to_the_next_and_there_is_room_for_no_more():
    first = _job(0)
    jobs = [first, _job(1, [first]), _job(2), _job(3), _job(4)]
    assert _started(jobs, 2) == ([[0, 2], [1, 3], [4]], [])


def _job(seed, needs=()):
    return Job(RunSpec("x", "Pendulum", 0.1, seed, 60, 2, "small", 20, 1), Path(), [], needs=list(needs))


def _started(jobs, at_once, fail=()):
    """The seeds of the jobs that start together, in order, when all of them end together; and of those that do not start."""
    told, rounds, together = [], [], []

    def submit(job):
        together.append(job)
        future = Future()
        if len(together) == min(at_once, sum(other.state == "waiting" and other.is_ready for other in jobs)):
            rounds.append([other.spec.seed for other in together])
            for other in together:
                other.state = "failed" if other.spec.seed in fail else "finished"
            together.clear()
        future.set_result(None)
        return future

    assert len(list(in_order(jobs, at_once, submit, lambda job: told.append(job.spec.seed)))) == sum(map(len, rounds))
    return rounds, told


def test_a_needed_run_that_the_suite_has_is_that_one(tmp_path):
    path = _suite(tmp_path, CELL | {"algorithms": ["taught", "sac-full"]}, steps=40)
    jobs, _ = jobs_left(path, tmp_path)
    assert _names(jobs) == ["small-40/sac-full/seed0", "small-40/taught/seed0"]


@pytest.fixture(scope="module")
def launched(tmp_path_factory):
    """Suite, runs and commands of a launch that went well."""
    root = tmp_path_factory.mktemp("needed")
    path, engine = _suite(root, CELL | {"algorithms": ["taught", "sac-asym"]}), InThisProcess()
    jobs, _ = jobs_left(path, root / "runs")
    launch(jobs, 1, 0, engine)
    assert [job.state for job in jobs] == ["finished"] * 3
    return path, root / "runs", engine.ran


def test_launch_runs_what_is_needed_and_hands_on_its_model(launched):
    path, runs, commands = launched
    teacher, student, other = needed_runs(read_suite(path)[0])["teacher"], *read_suite(path)
    assert commands == [
        run_command(path, 0, runs, teacher, ["teacher"]),
        run_command(path, 0, runs, student),
        run_command(path, 1, runs, other),
    ]
    directory = runs / "small-60/Pendulum-noise0.1/taught/seed0"
    model = Taught.load(directory / "model")
    assert model.teacher == str(runs / "small-40/Pendulum-noise0.1/sac-full/seed0/model.zip")
    assert model.steps_of_teacher == 40
    configuration = yaml.safe_load((directory / "config.yaml").read_text())
    assert configuration["run"]["needs"] == OWN["taught"]["needs"]
    assert "teacher" not in configuration["arguments"], "whose place may change"


def test_what_is_finished_is_not_run_again(launched, tmp_path):
    path, runs, _ = launched
    assert jobs_left(path, runs) == ([], 2)
    more = _suite(tmp_path, CELL | {"algorithms": ["taught", "twice"]})
    jobs, finished = jobs_left(more, runs)
    assert (finished, _names(jobs)) == (1, ["small-30/taught/seed0", "small-60/twice/seed0"])
    assert jobs[0].needs == []


def test_a_change_of_what_is_needed_is_another_setting(launched, tmp_path):
    _, runs, _ = launched
    other = _suite(tmp_path, CELL | {"needs": {"taught": {"teacher": {"steps": 20}}}})
    with pytest.raises(ValueError, match=r"other settings under \['needs'\]"):
        jobs_left(other, runs)


def test_steps_of_needed_runs_are_told_apart_and_counted(launched, tmp_path, monkeypatch, capsys):
    path, runs, _ = launched
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["aggregate", str(path), "--runs", str(runs), "--out", str(out)])
    benchmarks.aggregate.main()
    table = pd.read_csv(out.with_suffix(".csv"))
    steps = {name: (of.timesteps.tolist(), of.needed_steps.tolist()) for name, of in table.groupby("algorithm")}
    assert steps == {"taught": ([20, 40, 60], [40] * 3), "sac-asym": ([20, 40, 60], [0] * 3)}
    results = json.loads(out.with_suffix(".json").read_text())
    assert [cell.get("needed_steps") for cell in results["cells"]] == [40, None]
    assert results["particulars"]["taught, Pendulum, noise 0.1"]["needs"] == OWN["taught"]["needs"]
    counted, *_ = finished_runs(path, tmp_path, reuse=[out])
    assert [run.evaluations.columns.tolist().count("needed_steps") for run in counted] == [0, 0], "it is added again"
    pd.testing.assert_frame_equal(benchmarks.aggregate.collect(counted), table, check_dtype=False, check_like=True)

    drawn = []
    monkeypatch.setattr(benchmarks.report, "draw", lambda tidy, paths, to_run: drawn.append(tidy))
    for options in ([], ["--own-steps"]):
        monkeypatch.setattr(sys, "argv", ["report", str(out), *options])
        benchmarks.report.main()
    shifted, own = ({name: of.timesteps.tolist() for name, of in tidy.groupby("algorithm")} for tidy in drawn)
    assert shifted == {"taught": [60, 80, 100], "sac-asym": [20, 40, 60]}
    assert own == {"taught": [20, 40, 60], "sac-asym": [20, 40, 60]}
    labels = [benchmarks.report.steps_label(tidy) for tidy in drawn]
    assert labels == ["environment steps, with those of needed runs", "environment steps"]
    assert "| taught, after 40 steps of needed runs |" in capsys.readouterr().out


def test_steps_to_the_reference_are_those_of_needed_runs_too():
    rows = pd.DataFrame({"timesteps": [20, 40], "learner": [1.0, 5.0], "needed_steps": [100, 100]})
    assert benchmarks.aggregate.steps_to(rows, 5.0) == 140
    assert benchmarks.aggregate.steps_to(rows.drop(columns="needed_steps"), 5.0) == 40
    assert benchmarks.aggregate.steps_to(rows, 6.0) is None


def test_results_without_needed_runs_have_no_column_for_them():
    run_of = benchmarks.aggregate.FinishedRun(
        RunSpec("gac", "Pendulum", 0.1, 0, 60, 2, "small", 20, 1), pd.DataFrame({"timesteps": [20]}), {}, [], None, 1
    )
    assert list(benchmarks.aggregate.collect([run_of])) == ["task", "noise", "algorithm", "seed", "timesteps"]


def test_what_a_failed_run_was_needed_for_is_not_started_and_says_why(tmp_path, capsys, monkeypatch):
    path, engine = _suite(tmp_path, CELL | {"algorithms": ["orphaned", "sac-asym"]}), InThisProcess()
    monkeypatch.setattr(benchmarks.launch, "LocalEngine", lambda: engine)
    engine.cpus = 1
    monkeypatch.setattr(sys, "argv", ["launch", str(path), "--runs", str(tmp_path / "runs"), "--retries", "1"])
    with pytest.raises(SystemExit) as end:
        benchmarks.launch.main()
    assert end.value.code == 1
    failing, bereft, orphaned = (f"small-60/Pendulum-noise0.1/{name}/seed0" for name in ("failing", "bereft", "orphaned"))
    first, second = read_suite(path)
    innermost = needed_runs(needed_runs(first)["teacher"])["teacher"]
    assert name_of(innermost) == failing
    runs = ["--runs", str(tmp_path / "runs"), "--expect"]
    assert [command[command.index("--index") + 1 :] for command in engine.ran] == [
        ["0", *runs, failing, fingerprint(innermost), "--needed", "teacher", "teacher"],
        ["0", *runs, failing, fingerprint(innermost), "--needed", "teacher", "teacher"],
        ["1", *runs, "small-60/Pendulum-noise0.1/sac-asym/seed0", fingerprint(second)],
    ]
    said = capsys.readouterr().out
    assert f"{bereft}: not started, for it needs {failing}, which failed (" in said
    assert f"{tmp_path / 'runs' / failing}: FAILED, see " in said
    assert f"{tmp_path / 'runs' / bereft}: NOT STARTED, for it needs {failing}, which failed\n" in said
    assert f"{tmp_path / 'runs' / orphaned}: NOT STARTED, for it needs {bereft}, which was not started\n" in said
    assert "0 were finished before, 1 now, 1 failed, 2 not started." in said


@pytest.fixture
def three(tmp_path):
    """Jobs, of which the second needs the first."""
    spec = RunSpec("gac", "Pendulum", 0.1, 0, 60, 2, "small", 20, 1)
    jobs = [Job(spec, tmp_path / name, [name]) for name in ("teacher", "student", "other")]
    jobs[1].needs = [jobs[0]]
    return jobs


def test_one_at_a_time_a_launch_keeps_the_order(three):
    started = []

    class Engine:
        def run(self, command, log):
            started.append(command[0])
            return 0

    launch(three, 1, 0, Engine())
    assert started == ["teacher", "student", "other"]
    three[1].state = "not started"
    assert count(three) == "1 not started, 2 finished, 0 running, 0 waiting"


def test_a_job_waits_until_what_it_needs_has_ended_though_there_is_room(three):
    started, ended = {name: threading.Event() for name in ("teacher", "student", "other")}, []

    class Engine:
        def run(self, command, log):
            started[command[0]].set()
            if command[0] == "teacher":
                started["student"].wait(0.5)  # in which it is not to happen
            ended.append(command[0])
            return 0

    launch(three, 2, 0, Engine())
    assert ended == ["other", "teacher", "student"]


@pytest.mark.parametrize(
    ("index", "needed", "message"),
    [
        (0, ["nosuch"], r"--needed: taught needs no run as 'nosuch'; it needs runs as \['teacher'\]\."),
        (0, ["teacher", "nosuch"], r"--needed: sac-full needs no run as 'nosuch'; it needs no other run\."),
        (1, ["teacher"], r"--needed: sac-asym needs no run as 'teacher'; it needs no other run\."),
    ],
)
def test_a_needed_run_that_there_is_not_is_named(index, needed, message, tmp_path, monkeypatch):
    path = _suite(tmp_path, CELL | {"algorithms": ["taught", "sac-asym"]})
    words = ["run", "--suite", str(path), "--index", str(index), "--runs", str(tmp_path / "runs"), "--needed", *needed]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit, match=message):
        benchmarks.run.main()
    assert not (tmp_path / "runs").exists()


def test_a_run_by_itself_says_what_it_needs(tmp_path):
    (spec,) = read_suite(_suite(tmp_path, CELL))
    needed = tmp_path / "small-40/Pendulum-noise0.1/sac-full/seed0"
    with pytest.raises(ValueError, match=f"{needed} is needed, and not finished: run it first"):
        run(spec, tmp_path)
    assert not spec.directory(tmp_path).exists()
    run(needed_runs(spec)["teacher"], tmp_path)
    (needed / "model.zip").unlink()
    for program in (lambda: run(spec, tmp_path), lambda: jobs_left(tmp_path / "taught.yml", tmp_path)):
        with pytest.raises(ValueError, match=r"model\.zip is needed, and gone: remove"):
            program()


@pytest.mark.parametrize(
    ("needs", "message"),
    [
        ([1], r"cell 1, taught, needs: must be a mapping from arguments to runs, got \[1\]"),
        ({"teacher": "sac-full"}, "cell 1, taught, needs, teacher: must be a mapping, with algorithm and steps"),
        ({"teacher": {"steps": 40}}, r"cell 1, taught, needs, teacher: .*missing keys \['algorithm'\]"),
        ({"teacher": {"algorithm": "sac-full", "noise": 0}}, r"needs, teacher: unknown keys \['noise'\]"),
        ({"teacher": {"algorithm": "ppo"}}, "needs, teacher, algorithm: must be one of .*'sac-full'.*got 'ppo'"),
        (
            {"teacher": {"algorithm": "sac-full", "steps": 19}},
            "teacher, steps: must be a whole number from eval_every, 20, on",
        ),
        ({"teacher": {"algorithm": "sac-full", "steps": "1e6"}}, "teacher, steps: must be .* YAML reads '1e6' as text"),
        ({"teacher": {"algorithm": "taught"}}, "cell 1, taught: taught needs taught, and so on for ever"),
        ({"master": {"algorithm": "sac-full"}}, r"taught: Taught has no arguments \['master'\]"),
        ({"tau": {"algorithm": "sac-full"}}, r"taught: \['tau'\] are what it needs, and among its arguments too"),
    ],
)
def test_needs_that_mean_nothing_are_refused(tmp_path, needs, message):
    own = {"taught": {"class": f"{__name__}:Taught", "needs": needs}}
    with pytest.raises(ValueError, match=f"^taught.yml.*{message}"):
        jobs_left(_suite(tmp_path, CELL, algorithms=own), tmp_path)


def test_a_run_that_would_be_needed_in_two_ways_is_refused(tmp_path):
    changed = {"needs": {"taught": {"teacher": {"steps": 20}}}}
    path = _suite(tmp_path, CELL | {"algorithms": ["taught", "twice"]} | changed, steps=30)
    with pytest.raises(ValueError, match=r"taught.yml: small-30/Pendulum-noise0.1/taught/seed0 is needed in two ways"):
        read_suite(path)


def test_a_cell_changes_the_needs_of_its_own_algorithms_alone(tmp_path):
    with pytest.raises(ValueError, match=r"cell 1, needs: the cell has no algorithms \['twice'\]; it has \['taught'\]"):
        read_suite(_suite(tmp_path, CELL | {"needs": {"twice": {"teacher": {"steps": 20}}}}))


def test_what_is_needed_is_tried_out_first_and_what_needs_it_only_in_its_environment(tmp_path, monkeypatch):
    """An algorithm can't be made without what it needs."""
    tried = []
    monkeypatch.setattr("benchmarks.config.try_out", lambda where, spec: tried.append((spec.algorithm, spec.needs is None)))
    cell = {"env": "sb3_gac/Pendulum-v1", "algorithms": ["taught"], "seeds": [0]}
    jobs, _ = jobs_left(_suite(tmp_path, cell), tmp_path)
    assert tried == [("sac-full", True), ("taught", False)]
    monkeypatch.undo()
    assert len(jobs_left(_suite(tmp_path, cell), tmp_path)[0]) == len(jobs)
    assert np.all([job.spec.environment == {"id": "sb3_gac/Pendulum-v1", "kwargs": {}, "wrappers": []} for job in jobs])
    assert Path(jobs[0].directory).parts[-3] == "sb3_gac-Pendulum-v1"


def test_a_run_may_learn_from_what_another_one_has_recorded(tmp_path):
    own = {"yoked": {"class": "asymmetric_sac", "needs": {"recording": {"algorithm": "gac"}}}}
    suite = _suite(tmp_path, CELL | {"algorithms": ["yoked"]}, algorithms=own)
    jobs, _ = jobs_left(suite, tmp_path / "runs")
    assert [job.spec.algorithm for job in jobs] == ["gac", "yoked"]
    for job in jobs:
        run(job.spec, tmp_path / "runs")
    recorded, taken = (np.load(job.directory / "recording.npz") for job in jobs)
    for name in ("actions", "rewards"):
        np.testing.assert_array_equal(recorded[name], taken[name])
    assert len(recorded["actions"]) * jobs[0].spec.envs == jobs[0].spec.steps
    (jobs[0].directory / "recording.npz").unlink()
    (jobs[1].directory / "evaluations.csv").unlink()
    with pytest.raises(ValueError, match=r"recording.npz is needed, and gone: remove .*gac/seed0, and run it again"):
        jobs_left(suite, tmp_path / "runs")
