"""
Ctrl-C works in tests: a job that a script's shell runs in the background ignores it, and so would whatever tests start.

MuJoCo draws with EGL where that is installed; it looks for that when it is imported.
"""

import contextlib
import ctypes.util
import os
import signal

import pytest
import torch as th

if ctypes.util.find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    with contextlib.suppress(ValueError):  # only the main thread may
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def set_threads():
    """Torch's function of that purpose; the number of threads is restored after the test."""
    before = th.get_num_threads()
    yield th.set_num_threads
    th.set_num_threads(before)
