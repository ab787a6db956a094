"""A run's directory for one process alone."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None  # type: ignore[assignment]


class InUseError(RuntimeError):
    """Another process has the directory."""


@contextmanager
def locked(directory: Path, file: str = "lock") -> Iterator[None]:
    """
    Keep a run's directory for this process alone, as long as the context lasts.

    The system gives the lock back when the process ends, however it ends.  Where the system or the file system has no locks,
    the directory is not kept.

    :param directory: directory of the run
    :param file: name of the file in the directory that carries the lock; it is made if there is none, and is left as it is
    :raises InUseError: if another process is making the run
    """
    with (directory / file).open("a", encoding="utf-8") as held:
        if fcntl is not None:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InUseError(f"Another process is running {directory}.") from None
            except OSError:  # the file system has no locks
                pass
        try:
            yield
        finally:
            if fcntl is not None:
                with suppress(OSError):
                    fcntl.flock(held, fcntl.LOCK_UN)  # processes that were forked meanwhile have the file open as well
