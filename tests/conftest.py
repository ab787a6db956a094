"""Ctrl-C works in tests: a job that a script's shell runs in the background ignores it, and so would whatever tests start."""

import contextlib
import signal

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    with contextlib.suppress(ValueError):  # only the main thread may
        signal.signal(signal.SIGINT, signal.default_int_handler)
