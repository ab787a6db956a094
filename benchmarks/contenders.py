"""Timing in alternation: whatever else the machine does falls on all contenders alike, and their ratios stand."""

import multiprocessing
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

import torch as th

Timer = Callable[[int], float]
"""Number of repetitions -> seconds each."""


def timer(step: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> Timer:
    """
    :param step: what to time, in this process
    :param clock: in seconds; ``time.process_time`` leaves out what other programs take, for steps of one thread
    """

    def seconds(repetitions: int) -> float:
        step()  # what the others left in the caches is not this one's
        start = clock()
        for _ in range(repetitions):
            step()
        return (clock() - start) / repetitions

    return seconds


@contextmanager
def process_timers(
    make: Callable[..., Callable[[], Any]],
    arguments: dict[str, tuple],
    threads: int,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[dict[str, Timer]]:
    """
    Contenders in processes of their own: the threads of one, which wait busily for more work, take no time from another.

    :param make: of a module, makes a step from arguments
    :param arguments: name -> arguments
    :param threads: torch's, in each process
    :param clock: see :func:`timer`
    :return: name -> timer, for as long as the context lasts
    """
    context = multiprocessing.get_context("spawn")
    connections: dict[str, Connection] = {}
    processes = []
    for name, values in arguments.items():
        connections[name], theirs = context.Pipe()
        processes.append(context.Process(target=_serve, args=(theirs, make, values, threads, clock), daemon=True))
        processes[-1].start()
        theirs.close()

    def remote(connection: Connection) -> Timer:
        def seconds(repetitions: int) -> float:
            connection.send(repetitions)
            return connection.recv()

        return seconds

    try:
        for connection in connections.values():
            connection.recv()  # ready
        yield {name: remote(connection) for name, connection in connections.items()}
    finally:
        for connection in connections.values():
            connection.close()  # ends its process
        for process in processes:
            process.join()  # what is timed next has the machine to itself


def _serve(
    connection: Connection,
    make: Callable[..., Callable[[], Any]],
    arguments: tuple,
    threads: int,
    clock: Callable[[], float],
) -> None:
    th.set_num_threads(threads)
    seconds = timer(make(*arguments), clock)
    connection.send("ready")
    try:
        while True:
            connection.send(seconds(connection.recv()))
    except (EOFError, BrokenPipeError):
        return


def alternate(timers: dict[str, Timer], repetitions: int, rounds: int) -> dict[str, list[float]]:
    """
    :param timers: name -> timer
    :param repetitions: per measurement
    :param rounds: measurements of each
    :return: name -> seconds, one number per round
    """
    seconds: dict[str, list[float]] = {name: [] for name in timers}
    for _ in range(rounds + 1):  # the first warms up
        for name, one in timers.items():
            seconds[name].append(one(repetitions))
    return {name: values[1:] for name, values in seconds.items()}
