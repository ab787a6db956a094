"""Ctrl-C in the main job: one line, no traceback, whenever it comes."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sb3_gac import stopping
from sb3_gac.stopping import command, started_as

ROOT = Path(__file__).parents[2]
PACKAGES = {"sb3_gac.envs": "sb3_gac.envs.__main__", "sb3_gac.deploy": "sb3_gac.deploy.__main__"}


@pytest.mark.parametrize(
    ("words", "start"),
    [
        (["python", "-m", "sb3_gac.train", "--steps", "3"], ["python", "-m", "sb3_gac.train"]),
        (["/bin/python", "-u", "-m", "sb3_gac.train"], ["/bin/python", "-u", "-m", "sb3_gac.train"]),
        (["/bin/python", "/venv/bin/sb3-gac", "train", "--steps", "3"], ["sb3-gac", "train"]),
        (["/bin/python", "-u", "-m", "sb3_gac", "train", "--steps", "3"], ["/bin/python", "-u", "-m", "sb3_gac", "train"]),
        (["python", "-m", "sb3_gac", "evaluate", "train"], None),
        (["python", "/venv/bin/sb3-gac", "evaluate", "train"], None),
        (["python", "-m", "pytest", "sb3_gac.train"], None),
        (["python", "-c", "import sb3_gac.train"], None),
    ],
)
def test_the_main_job_is_told_from_other_programs(words, start, monkeypatch):
    assert started_as(words) == start
    monkeypatch.setattr(sys, "orig_argv", words)
    assert command("--resume", "a b") == f"{' '.join(start or ['python', '-m', 'sb3_gac.train'])} --resume 'a b'"


@pytest.mark.parametrize(
    ("program", "handled"),
    [
        (["python", "-m", "sb3_gac.train"], True),
        (["python", "-m", "sb3_gac.evaluate", "model.zip"], True),
        (["python", "-m", "sb3_gac.envs"], True),
        (["python", "/venv/bin/sb3-gac", "evaluate"], True),
        (["python", "mine.py"], False),
        (["python", "-m", "mine", "-m", "sb3_gac.train.py"], False),
    ],
)
def test_no_other_program_has_its_handler_changed(program, handled, monkeypatch):
    monkeypatch.setattr(sys, "orig_argv", program)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        stopping.take_over()
        assert (signal.getsignal(signal.SIGINT) is stopping.end_at_once) == handled
        with stopping.StoppedInALine():
            is_main_job = started_as(program) is not None
            assert (signal.getsignal(signal.SIGINT) is stopping.end_at_once) == is_main_job, "after the imports"
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        stopping.take_over()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN, "in the background it is ignored, and stays so"
    finally:
        signal.signal(signal.SIGINT, before)


def _interrupted(tmp_path, program, *options, module="sb3_gac.train"):
    """
    :param program: code that is run before the main job's package is imported, with ``interrupt()``
    """
    prelude = f"import os, signal, sys\nsys.orig_argv = ['python', '-m', {module!r}]\nsys.path.insert(0, {str(ROOT)!r})\n"
    prelude += "def interrupt(*args, **kwargs):\n    os.kill(os.getpid(), signal.SIGINT)\n"
    start = f"\nfrom {PACKAGES.get(module, module)} import main\nmain({list(options)!r})"
    return subprocess.run(
        [sys.executable, "-c", prelude + program + start], cwd=tmp_path, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("module", ["sb3_gac.train", "sb3_gac.evaluate", "sb3_gac.envs", "sb3_gac.deploy"])
def test_while_other_libraries_are_imported(module, tmp_path):
    finder = "class Finder:\n    def find_spec(name, *args):\n        if name == 'gymnasium':\n            interrupt()\n"
    finder += "sys.meta_path.insert(0, Finder)\n"
    ended = _interrupted(tmp_path, finder, module=module)
    assert ended.returncode == 130
    assert ended.stderr == f"\nStopped before anything was written. To start again: python -m {module}\n"
    assert list(tmp_path.iterdir()) == []


def test_while_results_are_written(tmp_path):
    interrupts = "import sb3_gac.training.job as job\njob.draw_learning_curve = interrupt\n"
    options = ["--env", "tests.training.test_options:make_own", "--steps", "40", "--episodes", "1"]
    options += ["--overrides", "{learning_starts: 20}"]
    ended = _interrupted(tmp_path, interrupts, *options)
    assert ended.returncode == 130
    (directory,) = (tmp_path / "runs").iterdir()
    resume = f"python -m sb3_gac.train --resume runs/{directory.name}"
    assert ended.stderr == f"\nStopped; 40 of 40 steps are saved. To go on: {resume}\n"
    assert "40 of 40 steps: learner" in ended.stdout, "what was printed before is there"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a terminal of its own")
def test_in_a_terminal(tmp_path):
    """What a person sees: a bar, and after Ctrl-C what is being done and then how to go on, on 80 columns."""
    import fcntl
    import pty
    import select
    import struct
    import termios

    arguments = ["--env", "tests.training.test_options:make_own", "--steps", "100000", "--episodes", "1"]
    child, terminal = pty.fork()
    if child == 0:
        os.chdir(tmp_path)
        os.environ["PYTHONPATH"] = str(ROOT)
        os.execv(sys.executable, [sys.executable, "-m", "sb3_gac.train", *arguments])
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    shown, pressed, deadline = b"", False, time.time() + 240
    while select.select([terminal], [], [], max(deadline - time.time(), 0))[0]:
        try:
            shown += os.read(terminal, 4096)
        except OSError:  # it has ended
            break
        if not pressed and b"/100,000" in shown:
            pressed = bool(os.write(terminal, b"\x03"))
    else:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 130
    lines = re.split(r"[\r\n]+", shown.decode().strip())
    assert max(len(line) for line in lines if "/100,000" in line) < 82, "and ^C"
    assert re.match(
        rf"Stopped; \d+ of 100,000 steps are saved\. To go on: {re.escape(sys.executable)} -m sb3_gac\.train", lines[-1]
    )
    assert not any("Traceback" in line for line in lines)
