"""
Two branches of a gradient step at once, on the CPU.

The networks of this package are small: one matrix product of theirs does not fill two cores, but guider and learner, each
with critics of its own, are independent of each other for most of a step.  A worker thread takes one branch, the calling
thread the other, each with half of torch's threads.  (Python's lock is free during every product.)  Results are those of
the two branches one after the other.
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
    """A thread beside the calling one, which does what it is handed in order, with as many of torch's threads as that has."""

    def __init__(self) -> None:
        self._handed: list[Future] = []

    def submit(self, task: Callable[[], Any]) -> None:
        """
        :param task: shares nothing that either thread changes before :meth:`wait`; random numbers must be drawn before. It is
            left out if one before it has failed
        """
        before, threads = tuple(self._handed), th.get_num_threads()

        def run() -> None:
            if all(future.exception() is None for future in before):
                if th.get_num_threads() != threads:  # torch counts its threads per calling thread
                    th.set_num_threads(threads)
                task()

        self._handed.append(_thread().submit(run))

    def wait(self) -> None:
        """Until all is done. An error of the first task that failed is raised."""
        handed, self._handed = self._handed, []
        errors = [future.exception() for future in handed]
        for error in errors:
            if error is not None:
                raise error


@contextmanager
def worker(enabled: bool) -> Iterator[Worker | None]:
    """
    A second thread that has half of torch's threads, for as long as the context lasts.

    :param enabled: whether to; otherwise there is none
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
        _thread().submit(int).result()  # after an error in this thread: the other one must not go on alone
        th.set_num_threads(threads)


def has_side_effects(module: nn.Module) -> bool:
    """Whether a forward pass draws random numbers or changes statistics: then branches must keep their order."""
    return any(isinstance(part, (_DropoutNd, _BatchNorm)) for part in module.modules())
