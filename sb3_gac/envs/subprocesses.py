"""
The registered environments in processes that start from nothing, by "spawn" or "forkserver", as vectorised ones do.

Such a process has ``sb3_gac/*`` only if this package is imported in it.  Where the main module is a script, it is imported
again and does so; a notebook's or a console's is not, and gymnasium, since its version 1, asks no installed package for its
environments.  So whatever process is started by one that has this package is described in a way that takes it along.
"""

from multiprocessing import get_all_start_methods, get_context
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any


def take_along() -> None:
    """Processes that are started from now on import this package, and with it register its environments, before they run."""
    for method in {"spawn", "forkserver"} & set(get_all_start_methods()):
        ForkingPickler.register(get_context(method).Process, _description)  # type: ignore[attr-defined]


def _description(process: BaseProcess) -> tuple[Any, ...]:
    return _blank, (type(process),), vars(process)


def _blank(process_class: type[BaseProcess]) -> BaseProcess:
    """Named in the description, so that the new process imports this module to make sense of it."""
    return process_class.__new__(process_class)
