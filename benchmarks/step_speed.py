"""Gradient steps of all algorithms beside those of SB3's SAC: by threads, sizes, and kind of network."""

import time
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch as th

from benchmarks.contenders import alternate, median_ratio, process_timers
from benchmarks.models import (
    CONTENDERS,
    SIZES,
    make_baseline_step,
    make_recurrent_step,
    make_step,
    matmul_rate,
    recurrent_step_flops,
    step_flops,
)

GROWTH_CONTENDERS = ("sac", "gac", "gac-compiled")
#: Gradient steps in a block, and blocks of each contender
BLOCK, ROUNDS = 10, 9
GROWTH = [  # batch, width, size of the privileged entry
    *((batch, 256, 17) for batch in (64, 1024, 4096)),
    *((256, width, 17) for width in (64, 512, 1024)),
    *((256, 256, privileged) for privileged in (9, 376, 1508)),
]


def compare_steps(
    names: Iterable[str], sizes: tuple[int, int, int], batch: int, width: int, threads: int, rounds: int
) -> dict[str, float]:
    """
    :param names: contenders, keys of ``CONTENDERS``, with "sac" among them
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param batch: batch size
    :param width: units of each of the two hidden layers
    :param threads: number of torch's threads
    :param rounds: number of blocks of each contender
    :return: gradient steps per second of SB3's SAC; the rate of each other contender as a multiple of SAC's, "_over_sac"; and
        the rates of GAC's contenders as shares of the limit, "_share_of_limit"
    """
    repetitions = max(1, min(BLOCK, BLOCK * 256**3 // (batch * width**2)))
    with process_timers(make_step, {name: (name, sizes, batch, width) for name in names}, threads) as timers:
        seconds = alternate(timers, repetitions, rounds)
    th.set_num_threads(threads)
    limit = matmul_rate(batch, width) / step_flops(sizes, batch, width)
    others = [name for name in seconds if name != "sac"]
    guided = [name for name in others if name.startswith("gac")]
    return {
        "sac_per_second": round(1 / float(np.median(seconds["sac"])), 1),
        **{f"{name}_over_sac": round(median_ratio(seconds["sac"], seconds[name]), 3) for name in others},
        **{f"{name}_share_of_limit": round(1 / float(np.median(seconds[name])) / limit, 3) for name in guided},
    }


def compare_baselines(
    names: Iterable[str], sizes: tuple[int, int, int], batch: int, width: int, rounds: int
) -> list[dict[str, Any]]:
    """
    Measure gradient steps with one thread, in processor time.

    :param names: algorithms, keys of ``BASELINES``, with "sac" among them
    :param sizes: sizes of the entries ``partial`` and ``privileged``, and of an action
    :param batch: batch size
    :param width: units of each of the two hidden layers
    :param rounds: number of blocks of each contender
    :return: one row for each algorithm, compiled and not: milliseconds of a gradient step, and its rate as a multiple of the
        rate of SB3's SAC
    """
    arguments = {(name, compiled): (name, sizes, batch, width, compiled) for name in names for compiled in (False, True)}
    del arguments["sac", True]
    by_key = {f"{name}, {compiled}": values for (name, compiled), values in arguments.items()}
    with process_timers(make_baseline_step, by_key, 1, time.process_time) as timers:
        seconds = alternate(timers, BLOCK, rounds)
    sac = seconds["sac, False"]
    return [
        {
            "algorithm": name,
            "compiled": compiled,
            "milliseconds": round(1e3 * float(np.median(own := seconds[f"{name}, {compiled}"])), 2),
            "over_sac": round(median_ratio(sac, own), 2),
        }
        for name, compiled in arguments
    ]


def compare_recurrent(batch: int, width: int, threads: int, rounds: int) -> dict[str, float]:
    """
    Measure gradient steps of GAC with GRUs, on the sizes of RepeatPreviousEasy.

    :param batch: episodes in a batch
    :param width: units of every layer
    :param threads: number of torch's threads
    :param rounds: number of blocks of each contender
    :return: gradient steps per second, their rate as a multiple of the rate with a Python loop over time, their rate as a
        share of the limit, and the share of their time that sampling takes
    """
    arguments = {name: (name, (8, 5, 4), 51, batch, width) for name in ("ours", "looped", "sampling")}
    with process_timers(make_recurrent_step, arguments, threads) as timers:
        seconds = alternate(timers, repetitions=2, rounds=rounds)
    th.set_num_threads(threads)
    limit = matmul_rate(batch * 52, width) / recurrent_step_flops((8, 5, 4), 51, batch, width)
    return {
        "ours_per_second": round(1 / float(np.median(seconds["ours"])), 2),
        "ours_over_looped": round(median_ratio(seconds["looped"], seconds["ours"]), 2),
        "share_of_limit": round(1 / float(np.median(seconds["ours"])) / limit, 3),
        "sampling_share": round(median_ratio(seconds["sampling"], seconds["ours"]), 3),
    }


def tabulate_steps(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """
    Tabulate gradient steps: those of HalfCheetah's sizes with one thread, those of all sizes with more.

    :param threads: numbers of torch's threads
    :param quick: whether to measure one size, in few rounds
    :return: one row for each setting
    """
    rows = []
    for count in threads:
        several = count > 1 and not quick
        for task in SIZES if several else ("HalfCheetah",):
            for batch in (256, 512) if several else (256,):
                row = {"task": task, "threads": count, "batch": batch, "width": 256}
                rows.append(row | compare_steps(CONTENDERS, SIZES[task], batch, 256, count, 3 if quick else ROUNDS))
    return rows


def tabulate_growth(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """
    Tabulate gradient steps by batch size, width and size of the entry ``privileged``.

    :param threads: numbers of torch's threads, of which the last is used
    :param quick: whether to measure one setting alone
    :return: one row for each setting
    """
    rows = []
    for batch, width, privileged in GROWTH[:1] if quick else GROWTH:
        row = {"threads": threads[-1], "batch": batch, "width": width, "privileged": privileged}
        rows.append(row | compare_steps(GROWTH_CONTENDERS, (8, privileged, 6), batch, width, threads[-1], rounds=3))
    return rows


def tabulate_recurrent(threads: list[int], quick: bool) -> list[dict[str, Any]]:
    """
    Tabulate gradient steps of GAC with GRUs on whole episodes.

    :param threads: numbers of torch's threads
    :param quick: whether to measure one small width, in few rounds
    :return: one row for each number of threads and width
    """
    widths = (16,) if quick else (64, 256)
    rows = [(count, width) for count in threads for width in widths]
    return [
        {"threads": count, "episodes": 16, "width": width} | compare_recurrent(16, width, count, 2 if quick else 5)
        for count, width in rows
    ]
