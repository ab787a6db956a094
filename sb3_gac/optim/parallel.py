"""
Two branches of a gradient step at once, on the CPU.

The networks of this package are small: one matrix product of theirs does not fill two cores, but guider and learner, each
with critics of its own, are independent of each other for most of a step.  A worker thread takes one branch, the calling
thread the other, each with half of torch's threads.  (Python's lock is free during every product.)  Results are those of
the two branches one after the other.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any, TypeVar

import torch as th
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.dropout import _DropoutNd

T = TypeVar("T")


@cache
def _worker() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="sb3_gac")


def _with_threads(task: Callable[[], T], threads: int) -> T:
    """torch counts its threads per calling thread."""
    if th.get_num_threads() != threads:
        th.set_num_threads(threads)
    return task()


def run_side_by_side(tasks: Sequence[Callable[[], Any]]) -> list[Any]:
    """
    :param tasks: two that share nothing that either changes; random numbers must be drawn before
    :return: their results, in order; an error in either is raised
    """
    first, second = tasks
    future = _worker().submit(_with_threads, second, th.get_num_threads())
    try:
        result = first()
    finally:
        exception = future.exception()  # waits: the worker must not go on alone
    if exception is not None:
        raise exception
    return [result, future.result()]


def has_side_effects(module: nn.Module) -> bool:
    """Whether a forward pass draws random numbers or changes statistics: then branches must keep their order."""
    return any(isinstance(part, (_DropoutNd, _BatchNorm)) for part in module.modules())


@contextmanager
def halved_threads(enabled: bool) -> Iterator[None]:
    """
    Leave half of torch's threads to the worker, for as long as the context lasts.

    :param enabled: whether to
    """
    threads = th.get_num_threads()
    if enabled:
        th.set_num_threads(max(threads // 2, 1))
    try:
        yield
    finally:
        if enabled:
            th.set_num_threads(threads)
