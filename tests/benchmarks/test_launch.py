"""How runs are launched: every attempt, start, end and failure is told, and whatever goes wrong is one run's failure."""

import io
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from rich.console import Console

import benchmarks.run
from benchmarks import launch
from benchmarks.config import check_simulators
from benchmarks.engines import run_process
from benchmarks.finished import name_of
from benchmarks.jobs import Clock, count, reason_in
from benchmarks.launch import launch_one
from benchmarks.overview import line
from benchmarks.suite import RunSpec, read_suite
from sb3_gac.envs.suites import SUITES
from tests.benchmarks.helpers import evaluated, jobs_in

ROOT = Path(__file__).parents[2]
SMOKE = ROOT / "benchmarks" / "suites" / "smoke.yml"
NAME = "small-1000/Ant-noise0.1/gac/seed0"


class _Engine:
    """
    :param ends: of its processes, one after the other: a status, or an error that the engine raises; each leaves a traceback
    """

    def __init__(self, *ends):
        self._ends = iter(ends)

    def run(self, command, log):
        end = next(self._ends)
        if isinstance(end, Exception):
            raise end
        with log.open("a") as file:
            file.write("--- attempt: python -m something\n" + (TRACEBACK if end else "all is well\n"))
        return end


TRACEBACK = """Traceback (most recent call last):
  File "first.py", line 1, in <module>
KeyError: 'of another'

During handling of the above exception, another exception occurred:

Traceback (most recent call last):
  File "second.py", line 7, in f
    raise ValueError("bad joint")
ValueError: bad joint: mend it
    and look again
"""


@pytest.mark.parametrize(
    ("ends", "retries", "state"),
    [
        ([0], 1, "finished"),
        ([1, 0], 1, "finished"),
        ([1, 1], 1, "failed"),
        ([1], 0, "failed"),
        ([OSError("no node"), 1], 1, "failed"),
        ([OSError("no node"), 0], 1, "finished"),
    ],
)
def test_every_change_of_state_and_every_failure_is_a_line_in_a_log(tmp_path, ends, retries, state):
    jobs, lines = jobs_in(tmp_path, "waiting", "waiting"), []
    clock = Clock(jobs, lambda: 0.0)
    launch_one(jobs[0], retries, _Engine(*ends), lambda job: lines.append(line(jobs, job, clock)))
    said = ["OSError: no node" if isinstance(end, OSError) else "ValueError: bad joint: mend it" for end in ends]
    running, ended = (f"{NAME}: running (0 finished, 1 running, 1 waiting)", f"{NAME}: {state}")
    again = [f"{NAME}: tried again: {reason} (0 finished, 1 running, 1 waiting)" for reason in said[: len(ends) - 1]]
    counts = "(1 finished, 0 running, 1 waiting)" if state == "finished" else "(1 failed, 0 finished, 0 running, 1 waiting)"
    assert lines == [running, *again, f"{ended}: {said[-1]} {counts}" if state == "failed" else f"{ended} {counts}"]
    evaluated(jobs[0], 1000, 7)
    assert line(jobs, jobs[0], clock).startswith(f"{NAME}: {state}, 1,000 / 1,000 steps, return 7.0")


def test_an_engine_that_raises_fails_its_run_and_no_other(tmp_path, capsys):
    """Nor does a run whose directory can't be made."""
    jobs = jobs_in(tmp_path, "waiting", "waiting", "waiting")
    jobs[2].directory.parent.mkdir(parents=True)
    jobs[2].directory.touch()
    launch.launch(jobs, 1, 0, _Engine(RuntimeError("the cluster is gone"), 0))
    assert [job.state for job in jobs] == ["failed", "finished", "failed"]
    assert f"{NAME}: failed: RuntimeError: the cluster is gone (1 failed" in capsys.readouterr().out
    assert jobs[2].reason.startswith("FileExistsError: ")


def _log(tmp_path, code):
    """Status and log of a real process, after another attempt."""
    log = tmp_path / "log.txt"
    log.write_text(f"--- attempt: earlier\n{TRACEBACK}")
    return log, run_process([sys.executable, "-c", code], log)


def test_a_process_has_the_folder_of_who_starts_it_and_finds_the_benchmarks(tmp_path, monkeypatch):
    """Environments may have relative paths."""
    (tmp_path / "robot.txt").touch()
    monkeypatch.chdir(tmp_path)
    log, status = _log(tmp_path, "import benchmarks.run; open('robot.txt')")
    assert status == 0, log.read_text()


@pytest.mark.parametrize(
    ("index", "changes", "said"),
    [
        (0, {"task": "Elsewhere", "environment": {"id": "Pendulum-v1"}}, "in place of {name} it has "),
        (0, {"eval_episodes": 99}, "{name} has other settings or arguments now"),
        (0, {"overrides": {"compile": True}}, "{name} has other settings or arguments now"),
        (0, {"definition": {"class": "gac", "normalize": {"clip_obs": 7.0}}}, "{name} has other settings or arguments now"),
        (1000, {}, "{name} was run 1000, and there are "),
    ],
)
def test_a_run_that_the_suite_has_no_longer_in_its_place_is_not_made(tmp_path, monkeypatch, index, changes, said):
    monkeypatch.setattr(benchmarks.run, "run", lambda *_, **__: pytest.fail("another run was made"))
    spec = replace(read_suite(SMOKE)[0], **changes)
    monkeypatch.setattr(sys, "argv", launch.run_command(SMOKE, index, tmp_path, spec)[2:])
    with pytest.raises(SystemExit) as end:
        benchmarks.run.main()
    assert f"has changed since the launch began: {said.format(name=name_of(spec))}" in str(end.value)


def test_the_run_that_a_launch_expects_is_made(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(benchmarks.run, "run", lambda spec, *_, **__: made.append(spec))
    spec = read_suite(SMOKE)[1]
    monkeypatch.setattr(sys, "argv", launch.run_command(SMOKE, 1, tmp_path, spec)[2:])
    benchmarks.run.main()
    assert made == [spec]


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("print(1); raise ValueError('bad joint\\nof the arm')", "ValueError: bad joint"),
        ("def f():\n try:\n  1/0\n except ZeroDivisionError:\n  raise KeyError('knee')\nf()", "KeyError: 'knee'"),
        ("raise ValueError", "ValueError"),
        ("import sys; sys.exit('the task is unknown')", "the task is unknown (exit status 1)"),
        ("import os; os._exit(3)", "exit status 3, and no output"),
        ("import os, signal; print(1, flush=True); os.kill(os.getpid(), signal.SIGKILL)", "killed by SIGKILL, as when"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "killed by SIGSEGV"),
        ("print('x' * 200_000); raise ValueError('at last')", "ValueError: at last"),
    ],
)
def test_the_reason_is_that_of_the_last_attempt(tmp_path, code, reason):
    found = reason_in(*_log(tmp_path, code))
    assert found.startswith(reason)
    assert reason.endswith("as when") or found == reason


def test_the_reason_of_a_run_without_a_log_is_its_status(tmp_path):
    assert reason_in(tmp_path / "log.txt", 9) == "exit status 9, and no output"


def test_what_failed_is_named_at_the_end_with_its_reason(tmp_path, monkeypatch, capsys):
    engine = _Engine(1, 0, 0, 0)
    engine.cpus = 1
    monkeypatch.setattr(launch, "LocalEngine", lambda: engine)
    monkeypatch.setattr(sys, "argv", ["launch", str(SMOKE), "--runs", str(tmp_path), "--retries", "0"])
    with pytest.raises(SystemExit) as end:
        launch.main()
    first, *_, last = said = capsys.readouterr().out.splitlines()
    assert end.value.code == 1
    assert first == "smoke.yml: 0 finished before, 4 left to run, 2,400 environment steps, 1 at once."
    directory = tmp_path / "small-600/InvertedDoublePendulum-noise0.1/gac/seed0"
    assert said[-2] == f"{directory}: FAILED, see {directory / 'log.txt'}: ValueError: bad joint: mend it"
    assert last == "0 were finished before, 3 now, 1 failed."


def test_states_that_there_are_are_counted(tmp_path):
    assert count(jobs_in(tmp_path, "waiting", "running", "running")) == "0 finished, 2 running, 1 waiting"
    assert count(jobs_in(tmp_path, "failed")) == "1 failed, 0 finished, 0 running, 0 waiting"


class _Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_has_a_table_and_lines_of_failures_alone(tmp_path, monkeypatch):
    out = _Terminal()
    console = Console(file=out, force_terminal=True, width=100, height=24)
    monkeypatch.setattr(launch, "Console", lambda: console)
    launch.launch(jobs_in(tmp_path, "waiting", "waiting"), 1, 1, _Engine(1, 0, 0), finished_before=3)
    assert "2 finished, 0 running, 0 waiting, 3 finished before" in out.getvalue()
    assert "seed0: tried again: ValueError: bad joint" in out.getvalue()
    assert "seed0: running" not in out.getvalue()


def test_what_only_claims_to_be_a_terminal_has_lines(tmp_path, monkeypatch, capsys):
    """As where FORCE_COLOR is set and output goes to a file."""
    out = io.StringIO()
    monkeypatch.setattr(launch, "Console", lambda: Console(file=out, force_terminal=True))
    launch.launch(jobs_in(tmp_path, "waiting"), 1, 0, _Engine(0))
    assert out.getvalue() == ""
    assert f"{NAME}: finished (1 finished" in capsys.readouterr().out


@pytest.mark.parametrize("options", [["--jobs", "0"], ["--jobs", "two"], ["--retries", "-1"]])
def test_numbers_that_launch_nothing_are_refused(options, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["launch", str(SMOKE), "--runs", str(tmp_path), *options])
    with pytest.raises(SystemExit) as end:
        launch.main()
    assert end.value.code == 2
    assert f"argument {options[0]}: " in capsys.readouterr().err


@pytest.mark.parametrize("text", [None, "cells: [", "steps: {"])
def test_a_suite_that_is_no_yaml_file_is_one_message(text, tmp_path, monkeypatch):
    path = tmp_path / "broken.yml"
    if text is not None:
        path.write_text(text)
    monkeypatch.setattr(sys, "argv", ["launch", str(path), "--runs", str(tmp_path), "--dry-run"])
    with pytest.raises(SystemExit, match=r"broken\.yml"):
        launch.main()


def test_ctrl_c_while_the_suite_is_checked_is_one_line(tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(launch, "jobs_left", interrupted)
    monkeypatch.setattr(sys, "argv", ["launch", str(SMOKE)])
    with pytest.raises(SystemExit) as stop:
        launch.main()
    assert (stop.value.code, capsys.readouterr().err) == (130, "Stopped before the first run.\n")


@pytest.mark.parametrize("index", [-1, 4])
def test_an_index_beyond_the_suite_is_one_message(index, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["run", "--suite", str(SMOKE), f"--index={index}"])
    with pytest.raises(SystemExit, match=f"--index: .*smoke.yml has runs from 0 to 3, got {index}"):
        benchmarks.run.main()


def test_a_dry_run_counts(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["launch", str(SMOKE), "--runs", str(tmp_path), "--dry-run"])
    launch.main()
    *commands, last = capsys.readouterr().out.splitlines()
    assert [" -m benchmarks.run --suite " in command for command in commands] == [True] * 4
    assert last == "# 0 finished, 4 left to run, 2,400 environment steps.", "a comment, for a shell that is given all of it"


def test_a_simulator_that_is_missing_is_told_before_the_first_run(monkeypatch):
    spec = RunSpec("gac", "popgym-RepeatPreviousEasy", 0.0, 0, 1000, 4, "small", 500, 1)
    gone = {"popgym": SUITES["popgym"]._replace(simulator="no_such_module")}
    monkeypatch.setattr("benchmarks.config.SUITES", {**SUITES, **gone})
    with pytest.raises(ValueError, match=r"popgym-RepeatPreviousEasy needs no_such_module, .*sb3_gac\[popgym\]"):
        check_simulators([spec])
    check_simulators([RunSpec("gac", "Ant", 0.0, 0, 1000, 4, "small", 500, 1)])


def test_a_piped_launch_tells_at_once_and_ends_with_its_runs_on_ctrl_c(tmp_path):
    """The runs are killed with it, and the same command goes on; no run is started any more."""
    suite = yaml.safe_load(SMOKE.read_text()) | {"steps": 10**6}
    (tmp_path / "long.yml").write_text(yaml.safe_dump(suite))
    command = [sys.executable, "-m", "benchmarks.launch", tmp_path / "long.yml", "--jobs", "1", "--runs", tmp_path / "runs"]
    restored = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler)}
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, **restored) as process:
        assert "4 left to run" in process.stdout.readline()
        first = process.stdout.readline()
        assert first == (
            "small-1000000/InvertedDoublePendulum-noise0.1/gac/seed0: running (0 finished, 1 running, 3 waiting)\n"
        ), "while it goes on"
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
    assert process.returncode == 130
    assert "The same command goes on from the runs' checkpoints." in rest
    assert "seed1" not in rest
    deadline = time.monotonic() + 20  # a killed process takes a moment to go
    while [path for path in Path("/proc").glob("[0-9]*/cmdline") if str(tmp_path).encode() in _read(path)]:
        assert time.monotonic() < deadline, "a run outlives its launch"
        time.sleep(0.1)


def _read(path):
    try:
        return path.read_bytes()
    except OSError:  # it has ended
        return os.fsencode("")


@pytest.mark.parametrize(("arguments", "at_once", "retries"), [([], 5, 1), (["--jobs", "2", "--retries", "4"], 2, 4)])
@pytest.mark.parametrize("state", ["finished", "failed"])
def test_the_command_line_counts(arguments, at_once, retries, state, tmp_path, monkeypatch, capsys):
    launched = []

    def launches(jobs, *options):
        launched.append((len(jobs), *options[:-1]))
        for job in jobs:
            job.state = "finished"
        jobs[0].state = state

    engine = SimpleNamespace(cpus=5)
    monkeypatch.setattr(launch, "launch", launches)
    monkeypatch.setattr(launch, "LocalEngine", lambda: engine)
    monkeypatch.setattr(sys, "argv", ["launch", str(SMOKE), "--runs", str(tmp_path), *arguments])
    with pytest.raises(SystemExit) as end:
        launch.main()
    assert launched == [(4, at_once, retries, engine)]
    assert bool(end.value.code) == (state == "failed")
    n_failed = int(state == "failed")
    assert f"0 were finished before, {4 - n_failed} now, {n_failed} failed." in capsys.readouterr().out
