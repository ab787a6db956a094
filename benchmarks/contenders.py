"""Timing in alternation: other work of the machine slows all contenders alike, so that the ratios of their times hold."""

import multiprocessing
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch as th

Timer = Callable[[int], float]
"""Number of repetitions -> seconds each."""


def timer(step: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> Timer:
    """
    :param step: function to time, in this process
    :param clock: function that returns the time in seconds; ``time.process_time`` leaves out the time of other programs, and
        is meant for steps with one thread
    :return: timer of the function
    """

    def seconds(repetitions: int) -> float:
        step()  # the caches hold the data of the other contenders
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
    Contenders in processes of their own: the threads of one contender, which wait busily for work, take no time from another.

    :param make: function at the top level of a module that makes a contender's step from its arguments
    :param arguments: name of a contender -> arguments of ``make``
    :param threads: number of torch's threads in each process
    :param clock: function that returns the time in seconds, see :func:`timer`
    :return: name of a contender -> timer, which can be used as long as the context lasts
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
            connection.recv()  # wait until the contender is ready
        yield {name: remote(connection) for name, connection in connections.items()}
    finally:
        for connection in connections.values():
            connection.close()  # ends its process
        for process in processes:
            process.join()  # so that the next measurement has the machine to itself


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
    :param timers: name of a contender -> timer
    :param repetitions: number of repetitions of each measurement
    :param rounds: number of measurements of each contender
    :return: name of a contender -> seconds of one repetition, one number for each round
    """
    seconds: dict[str, list[float]] = {name: [] for name in timers}
    for _ in range(rounds + 1):  # the first round warms up
        for name, one in timers.items():
            seconds[name].append(one(repetitions))
    return {name: values[1:] for name, values in seconds.items()}


def median_ratio(numerators: list[float], denominators: list[float]) -> float:
    """
    :param numerators: seconds of one contender, one number for each block
    :param denominators: seconds of another contender in the same blocks
    :return: median over the blocks of the ratio of the two
    """
    return float(np.median(np.array(numerators) / np.array(denominators)))
