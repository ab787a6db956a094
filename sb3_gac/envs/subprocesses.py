"""
Registration of the environments in the new processes of vectorised ones, which start by "spawn" or "forkserver".

Such a process knows ``sb3_gac/*`` only if this package is imported in it.  Where the main module is a script, the new process
imports that script again, and this package with it.  The main module of a notebook or a console is not imported again, and
since its version 1 gymnasium asks no installed package for environments.  So this module changes how processes are pickled:
the pickled description of a process names a function of this module, and to unpickle it imports this package.
"""

import os
from multiprocessing import get_all_start_methods, get_context
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any


def take_along() -> None:
    """Have all processes that are started from now on import this package first, and so register its environments."""
    for method in {"spawn", "forkserver"} & set(get_all_start_methods()):
        ForkingPickler.register(get_context(method).Process, _description)  # type: ignore[attr-defined]


def _description(process: BaseProcess) -> tuple[Any, ...]:
    return _blank, (type(process),), vars(process)


def _blank(process_class: type[BaseProcess]) -> BaseProcess:
    """Make an empty process; the description names this function, so the new process imports this module to read it."""
    return process_class.__new__(process_class)


def usable_processors() -> int:
    """Number of processors that this process may use, which a cluster or a container may have limited."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
