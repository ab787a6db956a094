"""What is seen of a launch while it goes on: in a terminal of any height, and in a log."""

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from rich.console import Console

from benchmarks import launch
from benchmarks.launch import Job, count, launch_one, print_line, progress, table
from benchmarks.suite import RunSpec

ROOT = Path(__file__).parents[2]
SMOKE = ROOT / "benchmarks" / "suites" / "smoke.yml"


def _jobs(directory, *states):
    """With seeds from 0 on, one in each state."""
    specs = [RunSpec("gac", "Ant", 0.1, seed, 1000, 4, "small", 500, 1) for seed in range(len(states))]
    return [Job(spec, spec.directory(directory), [], state) for spec, state in zip(specs, states, strict=True)]


def _drawn(jobs, height, width=100):
    out = io.StringIO()
    Console(file=out, force_terminal=True, width=width, height=height, color_system=None).print(table(jobs))
    return out.getvalue().splitlines()


@pytest.mark.parametrize("height", [12, 24, 40])
@pytest.mark.parametrize("width", [72, 100])
def test_whatever_the_terminal_has_room_for_running_and_failed_runs_come_first(tmp_path, height, width):
    jobs = _jobs(tmp_path, "failed", *["running"] * 2, *["finished"] * 80, "running", *["waiting"] * 200)
    lines = _drawn(jobs, height, width)
    assert len(lines) < height, "one line is the terminal's own"
    runs = [line.strip("│ ").split("│") for line in lines[3:-2]]
    assert len(runs) == height - 6
    states = [run[4].strip() for run in runs]
    assert states == ["finished"] * (height - 10) + ["failed"] + ["running"] * 3
    seeds = [int(run[3]) for run in runs]
    assert seeds == [*range(83 - (height - 10), 83), 0, 1, 2, 83], "of those that finished, the last"
    hidden = 84 - (height - 6)
    assert lines[-1].startswith(f"1 failed, 80 finished, 3 running, 200 waiting; {hidden} of them not shown"[:width])


def test_where_there_is_room_everything_is_shown_but_what_waits(tmp_path):
    lines = _drawn(_jobs(tmp_path, "finished", "running", "waiting"), 24)
    assert len(lines) == 7
    assert lines[-1] == "1 finished, 1 running, 1 waiting"


def test_more_running_runs_than_rows_show_the_last(tmp_path):
    lines = _drawn(_jobs(tmp_path, *["running"] * 30, "finished"), 16)
    assert [line.split("│")[4].strip() for line in lines[3:-2]] == [str(seed) for seed in range(20, 30)]


def test_progress_is_that_of_the_last_evaluation(tmp_path):
    waiting, running, finished = _jobs(tmp_path, "waiting", "running", "finished")
    assert [progress(job) for job in (waiting, running, finished)] == [("", ""), ("0 / 1000", ""), ("", "")]
    for job in (running, finished):
        job.directory.mkdir(parents=True)
        (job.directory / "timing.json").write_text(json.dumps({"steps": 500, "learner": 12.34, "seconds": 1}))
        assert progress(job) == ("500 / 1000", "12.3")
    (running.directory / "timing.json").write_text("{")
    assert progress(running) == ("0 / 1000", "")


class _Engine:
    """
    :param statuses: of its processes, one after the other
    """

    def __init__(self, *statuses):
        self._statuses = iter(statuses)

    def run(self, command, log):
        return next(self._statuses)


@pytest.mark.parametrize(
    ("statuses", "retries", "state"),
    [([0], 1, "finished"), ([1, 0], 1, "finished"), ([1, 1], 1, "failed"), ([1], 0, "failed")],
)
def test_every_change_of_state_is_a_line_in_a_log(tmp_path, capsys, statuses, retries, state):
    jobs = _jobs(tmp_path, "waiting", "waiting")
    launch_one(jobs[0], retries, _Engine(*statuses), lambda job: print_line(jobs, job))
    name = "small-1000/Ant-noise0.1/gac/seed0"
    ended = "1 finished, 0 running, 1 waiting" if state == "finished" else "1 failed, 0 finished, 0 running, 1 waiting"
    assert capsys.readouterr().out.splitlines() == [
        f"{name}: running (0 finished, 1 running, 1 waiting)",
        f"{name}: {state} ({ended})",
    ]
    (jobs[0].directory / "timing.json").write_text(json.dumps({"steps": 1000, "learner": 7}))
    print_line(jobs, jobs[0])
    assert f"{name}: {state}, 1000 / 1000 steps, return 7.0 (" in capsys.readouterr().out


def test_states_that_there_are_are_counted(tmp_path):
    assert count(_jobs(tmp_path, "waiting", "running", "running")) == "0 finished, 2 running, 1 waiting"
    assert count(_jobs(tmp_path, "failed")) == "1 failed, 0 finished, 0 running, 0 waiting"


def test_a_terminal_has_a_table_and_no_lines(tmp_path, monkeypatch):
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=100, height=24)
    monkeypatch.setattr(launch, "Console", lambda: console)
    launch.launch(_jobs(tmp_path, "waiting", "waiting"), 1, 0, _Engine(0, 0))
    assert "2 finished, 0 running, 0 waiting" in out.getvalue()
    assert "seed0: running" not in out.getvalue()


def test_a_piped_launch_tells_at_once_and_ends_with_its_runs_on_ctrl_c(tmp_path):
    """The runs are killed with it, and the same command goes on; no run is started any more."""
    suite = yaml.safe_load(SMOKE.read_text()) | {"steps": 10**6}
    (tmp_path / "long.yml").write_text(yaml.safe_dump(suite))
    command = [sys.executable, "-m", "benchmarks.launch", tmp_path / "long.yml", "--jobs", "1", "--runs", tmp_path / "runs"]
    restored = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler)}
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, **restored) as process:
        first = process.stdout.readline()
        assert first == (
            "small-1000000/InvertedDoublePendulum-noise0.1/gac/seed0: running (0 finished, 1 running, 3 waiting)\n"
        ), "while it goes on"
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
    assert process.returncode == 130
    assert "The same command goes on from the runs' checkpoints." in rest
    assert "seed1" not in rest
    assert not [path for path in Path("/proc").glob("[0-9]*/cmdline") if str(tmp_path).encode() in _read(path)]


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
        launched.append((len(jobs), *options))
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
