"""
Ctrl-C ends the main job with one line that says how to go on, and with no traceback, from its first import on.

An exception, which Python raises by default, may come in the middle of another library's import, of a destructor or of a
callback, and be swallowed or be shown as something else there.  This module comes before all others, and imports next to
nothing.
"""

import os
import signal
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType

MODULE, SCRIPT = "sb3_gac.train", ("sb3-gac", "train")
INTERRUPTED = 128 + signal.SIGINT


def started_as(words: Sequence[str]) -> list[str] | None:
    """
    :param words: of a process's command line, as it was given
    :return: those that start the main job, without its options; ``None`` if the process is another program
    """
    for number, (word, following) in enumerate(pairwise(words)):
        if (word, following) == ("-m", MODULE):
            return list(words[: number + 2])
        if (os.path.basename(word).removesuffix(".exe"), following) == SCRIPT:
            return list(SCRIPT)
    return None


def command(*options: str) -> str:
    """
    :param options: of the main job
    :return: what to type for it, in the words with which this process was started
    """
    return joined([*(started_as(sys.orig_argv) or ["python", "-m", MODULE]), *options])


def joined(words: Sequence[str]) -> str:
    """
    :param words: of a command
    :return: the command, as a shell takes it
    """
    import shlex

    return shlex.join(words)


def _before_anything_was_written() -> str:
    return f"Stopped before anything was written. To start again: {joined(sys.orig_argv)}"


_last_words: Callable[[], str] = _before_anything_was_written


def when_stopped_say(last_words: Callable[[], str]) -> None:
    """
    :param last_words: returns what is to be said from now on if the program is stopped
    """
    global _last_words
    _last_words = last_words


def last_words() -> str:
    """How to go on, in one line."""
    return _last_words()


def end_at_once(number: int, frame: "FrameType | None") -> None:
    """The handler of Ctrl-C: nothing else of the program runs after it, in whatever library it was."""
    signal.signal(number, signal.SIG_IGN)
    try:  # noqa: SIM105  # contextlib is not imported yet
        sys.stdout.flush()
    except (OSError, RuntimeError):  # it is being flushed
        pass
    os.write(2, f"\n{last_words()}\n".encode())
    os._exit(128 + number)


def take_over() -> None:
    """In a process that was started for the main job, unless Ctrl-C means something else there."""
    if started_as(sys.orig_argv) is not None and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end_at_once)
