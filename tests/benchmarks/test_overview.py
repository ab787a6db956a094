"""What is seen of a launch in a terminal of any size while it goes on."""

import io
import json

import pytest
from rich.console import Console

from benchmarks.jobs import Clock, in_words, last_evaluation
from benchmarks.launch import table
from benchmarks.overview import COLUMNS, Overview, line
from tests.benchmarks.helpers import evaluated, jobs_in
from tests.benchmarks.terminal import Screen, output_in_terminal

SIZES = [(24, 100), (12, 100), (6, 100), (24, 50), (4, 100), (3, 100)]


class Time:
    """A clock that is set by hand, in seconds."""

    now = 0.0

    def __call__(self):
        return self.now


def _drawn(drawn, height, width=100):
    out = io.StringIO()
    Console(file=out, force_terminal=True, width=width, height=height, color_system=None).print(drawn)
    return out.getvalue().splitlines()


def _busy(directory):
    """A launch in its middle: 85 finished runs in two cells, three that run, one that failed."""
    jobs = jobs_in(directory, "failed", *["running"] * 2, *["finished"] * 80, "running", *["waiting"] * 200)
    for job in jobs:
        if job.state == "finished":
            evaluated(job, 1000, job.spec.seed / 4)
    evaluated(jobs[1], 500, 12.34)
    jobs[0].reason = "ValueError: bad joint"
    return jobs


@pytest.mark.parametrize(("height", "width"), [*SIZES, (40, 72), (24, 200)])
def test_whatever_the_terminal_has_room_for_running_runs_come_first(tmp_path, height, width):
    lines = _drawn(table(_busy(tmp_path)), height, width)
    assert len(lines) < height, "one line is the terminal's own"
    assert all(len(text) <= width for text in lines)
    assert lines[1].startswith("1 failed, 80 finished, 3 running, 200 waiting"[: width - 1])
    names, states = ["gac 1", "gac 2", "gac 83", "gac 0", "gac"], [*["running"] * 3, "failed", "80 finished"]
    runs = lines[2:] if height < 6 else lines[3:]
    room = min(height - 3 - (height >= 6), len(names))
    assert [states[index] in run and names[index] in run for index, run in enumerate(runs)] == [True] * room
    if height >= 6:
        assert [lines[2].find(name) >= 0 for name in COLUMNS] == [True] * 4


def test_finished_runs_are_a_count_with_their_returns_the_last_to_end_first(tmp_path):
    jobs = [*jobs_in(tmp_path, *["finished"] * 3), *jobs_in(tmp_path / "other", "finished", "finished")]
    for job, value, ended in zip(jobs, (1.0, 2.25, 3.5, 4.0, 5.0), (3.0, 9.0, 1.0, 2.0, 4.0), strict=True):
        evaluated(job, 1000, value)
        job.ended = ended
    for job in jobs[3:]:
        object.__setattr__(job.spec, "algorithm", "sac")
    (jobs[4].directory / "timing.json").unlink()
    _, _, _, first, second = _drawn(table(jobs), 24)
    assert first.split() == ["Ant-noise0.1", "gac", "3", "finished", "1,000", "1.0,", "2.2,", "3.5"]
    assert second.split() == ["Ant-noise0.1", "sac", "2", "finished", "1,000", "4.0,", "?"]


def test_the_rest_is_counted_and_why_a_run_failed_is_said(tmp_path):
    jobs = _busy(tmp_path)
    lines = _drawn(Overview(jobs, finished_before=7), 24, 120)
    assert lines[1] == "1 failed, 80 finished, 3 running, 200 waiting, 7 finished before"
    assert lines[3].split() == ["Ant-noise0.1", "gac", "1", "running", "500", "/", "1,000", "12.3"]
    assert lines[6].rstrip().endswith("ValueError: bad joint")
    assert _drawn(table(jobs), 6, 120)[1].endswith("200 waiting; 3 more lines in a higher terminal")
    assert _drawn(table(jobs), 8, 120)[1].endswith("200 waiting; 1 more line in a higher terminal")


def test_runs_are_told_apart_in_a_narrow_terminal(tmp_path):
    """The cell's name gives way, and not the algorithm, the seed or the return."""
    jobs = jobs_in(tmp_path, "running", "running")
    for job in jobs:
        object.__setattr__(job.spec, "task", "HandManipulateBlockRotateZTouch")
        job.directory = tmp_path / str(job.spec.seed)
        evaluated(job, 500, 1234.5)
    for width in (50, 79, 100):
        first, second = _drawn(table(jobs), 24, width)[3:]
        assert ("… gac 0 " if width < 100 else "noise0.1 gac 0 ") in first
        assert ("… gac 1 " if width < 100 else "noise0.1 gac 1 ") in second
        assert first.rstrip().endswith("1234.5")
        assert ("50%" in first) == (width < 80)


def test_progress_is_that_of_the_last_evaluation(tmp_path):
    (job,) = jobs_in(tmp_path, "running")
    assert last_evaluation(job) == (0, None)
    evaluated(job, 500, 12.34)
    assert last_evaluation(job) == (500, 12.34)
    for text in ("{", "[]", json.dumps({"steps": 500})):
        (job.directory / "timing.json").write_text(text)
        assert last_evaluation(job) == (0, None)


def test_time_left_is_that_of_all_steps_at_the_pace_so_far(tmp_path):
    jobs, time = jobs_in(tmp_path, "running", "running", "waiting", "waiting"), Time()
    evaluated(jobs[1], 400, 0.0)
    evaluated(jobs[2], 200, 0.0)  # by an earlier launch, as those above
    clock = Clock(jobs, time)
    assert clock.done_of_all() == (600, 4000)
    assert clock.seconds_left() is None, "nothing was made yet"
    time.now = 10.0
    evaluated(jobs[0], 100, 0.0)
    evaluated(jobs[1], 500, 0.0)
    assert clock.done_of_all() == (800, 4000)
    assert clock.seconds_left() == pytest.approx(3200 * 10 / 200), "200 steps in 10 seconds; 600 were made before"
    time.now = 30.0
    assert clock.seconds_left() == pytest.approx(3200 * 10 / 200 - 20), "it goes on between evaluations"
    jobs[0].state = "finished"
    time.now = 55.0
    assert clock.seconds_left() == pytest.approx(2300 * 55 / 1100), "a finished run has made all its steps"
    jobs[2].state = "failed"
    assert clock.done_of_all() == (1500, 3000), "what failed is not waited for"
    assert clock.seconds_left() == pytest.approx(1500 * 55 / 1100)
    time.now = 1e6
    assert clock.seconds_left() == 0.0


def test_the_bar_and_lines_tell_the_time_left(tmp_path):
    jobs, time = jobs_in(tmp_path, "running", "waiting"), Time()
    clock = Clock(jobs, time)
    overview = Overview(jobs, clock=clock)
    assert _drawn(overview, 24)[0].endswith(" 0%, 0 of 2,000 steps")
    assert line(jobs, jobs[0], clock).endswith("(0 finished, 1 running, 1 waiting)")
    time.now = 3600.0
    evaluated(jobs[0], 500, 0.0)
    assert _drawn(overview, 24)[0].endswith(" 25%, 500 of 2,000 steps, 3 h 00 min left")
    assert _drawn(overview, 24, 40)[0].endswith(" 25%, 3 h 00 min left"), "the shorter form"
    assert line(jobs, jobs[0], clock).endswith("1 waiting, 3 h 00 min left)")
    jobs[0].state = jobs[1].state = "failed"
    assert "100%" in _drawn(overview, 24)[0], "nothing is left"


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.4, "0 s"),
        (59.4, "59 s"),
        (90, "2 min"),
        (3570, "1 h 00 min"),
        (7500, "2 h 05 min"),
        (4e6, "1,111 h 07 min"),
    ],
)
def test_durations_are_said_as_people_do(seconds, words):
    assert in_words(seconds) == words


PROGRAM = """
import fcntl, pathlib, struct, sys, tempfile, termios
from rich.console import Console
from rich.live import Live
from benchmarks.overview import Overview
from tests.benchmarks.helpers import evaluated, jobs_in
for height, width in {sizes}:
    fcntl.ioctl(1, termios.TIOCSWINSZ, struct.pack("HHHH", height, width, 0, 0))
    jobs = jobs_in(pathlib.Path(tempfile.mkdtemp()), *["finished"] * 80, *["running"] * 3, *["waiting"] * 9)
    console = Console()
    assert console.is_interactive and console.size == (width, height), console.size
    with Live(Overview(jobs), console=console, auto_refresh=False) as live:
        for job in jobs[80:82]:
            live.refresh()
            job.state, job.ended = "finished", 1.0
            console.print("a line above that is longer than this terminal is wide: " + 9 * "wide " + "end")
            evaluated(jobs[82], 250, 7.0)
            live.refresh()
    print("END", flush=True)
"""


def test_a_real_terminal_shows_one_table_and_nothing_else_at_any_size():
    """What is drawn anew replaces what was there: nothing of the frames before is left, but the lines that stay above."""
    written = output_in_terminal(PROGRAM.format(sizes=SIZES), 24, 80)
    *frames, rest = written.split("END\r\n")
    assert (len(frames), rest) == (len(SIZES), "")
    for (height, width), frame in zip(SIZES, frames, strict=True):
        screen = Screen(height, width)
        screen.write(frame)
        assert screen.lines[-1].strip() == "" or height == 24, "the cursor's line"
        shown = [text.rstrip() for text in screen.lines if text.strip()]
        counts = [index for index, text in enumerate(shown) if text.startswith("82 finished, 1 running, 9 waiting"[:width])]
        assert len(counts) == 1, shown
        above, table_below = shown[: counts[0] - 1], shown[counts[0] + 1 :]
        assert "of 92,000 steps" in shown[counts[0] - 1] or width == 50
        assert all("wide" in text or "a line above" in text or text == "end" for text in above), above
        expected = ["running", "82 finished"][: height - 3 - (height >= 6)]
        body = table_below[height >= 6 :]
        assert [word in text for word, text in zip(expected, body, strict=True)] == [True] * len(expected), shown
