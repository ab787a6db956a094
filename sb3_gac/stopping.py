"""
Ctrl-C in the main job: from the first import on, it ends the program with one line that says how to go on.  It ends the
other programs with one line as well.

By default Python raises an exception, which may come in the middle of another library's import, of a destructor or of a
callback, where it is swallowed or turned into another error.  This module is imported before all others, and imports
almost nothing.
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
#: Words that start the main job in a process of Python
_OF_PYTHON = (("-m", MODULE), ("-m", "sb3_gac", "train"))
#: Modules of other programs, whose functions ``main`` end with :class:`StoppedInALine`; ``envs``, which opens nothing, is
#: ended at once at any time
_OTHERS = ("sb3_gac", "sb3_gac.evaluate", "sb3_gac.deploy", "sb3_gac.compare", "sb3_gac.zoo", "sb3_gac.envs")
INTERRUPTED = 128 + signal.SIGINT


def started_as(words: Sequence[str]) -> list[str] | None:
    """
    The part of a command line that starts the main job.

    :param words: words of a process's command line
    :return: words that start the main job, without its options; ``None`` if the process is another program
    """
    for number, word in enumerate(words):
        for start in _OF_PYTHON:
            if tuple(words[number : number + len(start)]) == start:
                return list(words[: number + len(start)])
        if (os.path.basename(word).removesuffix(".exe"), *words[number + 1 : number + 2]) == SCRIPT:
            return list(SCRIPT)
    return None


def command(*options: str) -> str:
    """
    :param options: options of the main job
    :return: command for a shell that starts the main job with these options, in the way in which this process was started
    """
    return joined([*(started_as(sys.orig_argv) or ["python", "-m", MODULE]), *options])


def joined(words: Sequence[str]) -> str:
    """
    :param words: words of a command
    :return: the command as text for a shell
    """
    import shlex

    return shlex.join(words)


def _before_anything_was_written() -> str:
    return f"Stopped before anything was written. To start again: {joined(sys.orig_argv)}"


_last_words: Callable[[], str] = _before_anything_was_written


def when_stopped_say(last_words: Callable[[], str]) -> None:
    """
    Set the message for Ctrl-C.

    :param last_words: function that returns the message, in one line
    """
    global _last_words
    _last_words = last_words


def last_words() -> str:
    """The message for Ctrl-C, one line that says how to go on."""
    return _last_words()


def end_at_once(number: int, frame: "FrameType | None") -> None:
    """Handle Ctrl-C: print the message and end the process at once, so that no other code of the program runs."""
    signal.signal(number, signal.SIG_IGN)
    try:  # noqa: SIM105  # contextlib is not imported yet
        sys.stdout.flush()
    except (OSError, RuntimeError):  # the stream is being flushed already
        pass
    os.write(2, f"\n{last_words()}\n".encode())
    os._exit(128 + number)


def take_over() -> None:
    """Handle Ctrl-C from now on, in a process of one of this package's programs that does not handle it otherwise."""
    is_ours = started_as(sys.orig_argv) is not None or _is_other(sys.orig_argv)
    if is_ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end_at_once)


def _is_other(words: Sequence[str]) -> bool:
    started = [following for word, following in pairwise(words) if word == "-m"]
    scripts = [os.path.basename(word).removesuffix(".exe") for word in words[:2]]
    return SCRIPT[0] in scripts or bool(started and started[0] in _OTHERS)


class StoppedInALine:
    """
    A context around a program other than the main job, in which Ctrl-C ends the program with one line, not with a traceback.

    At its start, imports are over, and Ctrl-C raises Python's exception again, so that the program can close what it opened.
    """

    def __enter__(self) -> None:
        if started_as(sys.orig_argv) is None and signal.getsignal(signal.SIGINT) is end_at_once:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def __exit__(self, kind: type[BaseException] | None, *others: object) -> None:
        if kind is not None and issubclass(kind, KeyboardInterrupt):
            sys.stderr.write("\nStopped.\n")
            sys.exit(INTERRUPTED)
