"""
Two branches of a gradient step that run at the same time, on the CPU.

The networks of this package are small, so that one matrix product does not fill two cores. For most of a step, guider and
learner, each with critics of its own, are independent of each other.  A worker thread takes one branch and the calling
thread the other, each with half of torch's threads.  (Python's lock is free during every product.)  The results are the same
as when one branch runs after the other.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch as th
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.dropout import _DropoutNd


@cache
def _thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="sb3_gac")


class Worker:
    """A second thread that runs its tasks in order, with as many of torch's threads as the calling thread has."""

    def __init__(self) -> None:
        self._handed: list[Future] = []

    def submit(self, task: Callable[[], Any]) -> None:
        """
        Hand a task to the second thread, which skips it if an earlier task has failed.

        :param task: function without arguments that, until :meth:`wait`, reads nothing that the calling thread changes,
            changes nothing that the calling thread reads, and draws no random numbers
        """
        before, threads = tuple(self._handed), th.get_num_threads()

        def run() -> None:
            if all(future.exception() is None for future in before):
                if th.get_num_threads() != threads:  # torch counts its threads per calling thread
                    th.set_num_threads(threads)
                task()

        self._handed.append(_thread().submit(run))

    def wait(self) -> None:
        """Wait until all tasks are done, and raise the error of the first task that failed."""
        handed, self._handed = self._handed, []
        errors = [future.exception() for future in handed]
        for error in errors:
            if error is not None:
                raise error


@contextmanager
def worker(enabled: bool) -> Iterator[Worker | None]:
    """
    A second thread for as long as the context lasts; each of the two threads has half of torch's threads.

    :param enabled: whether there is a second thread; if not, the context's value is ``None``
    """
    if not enabled:
        yield None
        return
    threads, beside = th.get_num_threads(), Worker()
    th.set_num_threads(max(threads // 2, 1))
    try:
        yield beside
        beside.wait()
    finally:
        _thread().submit(int).result()  # after an error here, the second thread must not go on alone
        th.set_num_threads(threads)


def has_side_effects(module: nn.Module) -> bool:
    """Whether a forward pass draws random numbers or changes statistics, so that branches must keep their order."""
    return any(isinstance(part, (_DropoutNd, _BatchNorm)) for part in module.modules())
