"""A table of all registered environments: their shapes, their installation and their speed."""

import time
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.suites import SUITES, Suite

UNKNOWN = "?"


class Row(NamedTuple):
    """
    An environment in the table.

    :param env_id: id of the environment
    :param suite: name of the suite that has the environment
    :param partial: shape of the entry ``partial``, such as "48" or "3x64x64"; "?" if it is not known
    :param privileged: shape of the entry ``privileged``, in the same form
    :param actions: shape of an action, such as "12", or number of choices, such as "4 choices"; "?" if it is not known
    :param installed: "yes", or how to install the simulator
    """

    env_id: str
    suite: str
    partial: str
    privileged: str
    actions: str
    installed: str


def rows(matching: str = "") -> Iterator[Row]:
    """
    List the registered environments.

    :param matching: text that ids must contain, in small or capital letters; the empty text for all environments
    :return: rows, suite by suite; an environment whose shapes are not recorded is made, if its simulator is installed
    """
    for name, suite in SUITES.items():
        for env_id, arguments in suite.environments.items():
            if matching.casefold() in env_id.casefold():
                installed = "yes" if suite.is_installed else _how_to_install(suite)
                yield Row(env_id, name, *_shapes(env_id, suite, arguments.get("shapes")), installed)


def _how_to_install(suite: Suite) -> str:
    return "by hand, docs/environments.md" if suite.extra is None else f'pip install -e ".[{suite.extra}]"'


def _shapes(env_id: str, suite: Suite, known: Any) -> tuple[str, str, str]:
    if known is not None:
        partial, privileged, action = (_in_words(known[name]) for name in (PARTIAL, PRIVILEGED, "action"))
        return partial, privileged, action
    if not suite.is_installed:
        return UNKNOWN, UNKNOWN, UNKNOWN
    env = gym.make(env_id)
    space, actions = env.observation_space, env.action_space
    env.close()
    assert isinstance(space, spaces.Dict)
    return _in_words(space[PARTIAL].shape), _in_words(space[PRIVILEGED].shape), _actions_in_words(actions)


def _in_words(shape: Sequence[int] | None) -> str:
    return UNKNOWN if shape is None else "x".join(map(str, shape))


def _actions_in_words(space: spaces.Space) -> str:
    return f"{space.n} choices" if isinstance(space, spaces.Discrete) else _in_words(space.shape)


def steps_per_second(env_id: str, n_envs: int, seconds: float = 1.0) -> float:
    """
    Measure the speed of an environment.

    :param env_id: id of a registered environment
    :param n_envs: number of environments side by side
    :param seconds: duration of the measurement in seconds, after a tenth of it to warm up
    :return: steps per second of all environments together, with random actions
    """
    from sb3_gac.envs.vector.registry import make_vec  # imports SB3, and SB3 imports torch

    env = make_vec(env_id, n_envs, seed=0)
    try:
        env.reset()
        actions = np.stack([env.action_space.sample() for _ in range(n_envs)])
        for duration in (seconds / 10, seconds):
            n_steps, started = 0, time.perf_counter()
            while time.perf_counter() < started + duration:
                env.step(actions)
                n_steps += n_envs
        return n_steps / (time.perf_counter() - started)
    finally:
        env.close()


def by_suite(header: Sequence[str], lines: Sequence[Sequence[str]], whole: bool) -> str:
    """
    Lay out the table for a terminal: suite by suite, without the columns that are the same in all of a suite's rows.

    :param header: names of the columns: those of :class:`Row`, and perhaps further ones
    :param lines: rows, suite by suite
    :param whole: whether suites that are not installed are shown with their environments, not in a line each
    :return: for each suite a line with its name, and its environments in columns
    """
    suite, installed = Row._fields.index("suite"), Row._fields.index("installed")
    parts = []
    for (name, state), of_suite in groupby(lines, key=lambda line: (line[suite], line[installed])):
        rows_of_suite = list(of_suite)
        is_here = state == "yes"
        heading = name if is_here else f"{name}: {len(rows_of_suite)} environments, not installed: {state}"
        shorter = [[cell for at, cell in enumerate(line) if at not in (suite, installed)] for line in [header, *rows_of_suite]]
        widths = [max(map(len, column)) for column in zip(*shorter, strict=True)]
        table = "\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in shorter)
        parts.append(f"{heading}\n{table}\n" if is_here or whole else heading)
    return "\n".join(parts)


def in_columns(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """
    Lay out a table with columns of equal width.

    :param header: names of the columns
    :param lines: rows, each with as many cells as there are columns
    :return: table in Markdown
    """
    widths = [max(map(len, column)) for column in zip(header, *lines, strict=True)]
    rule = ["-" * width for width in widths]
    return "\n".join(
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |"
        for line in (header, rule, *lines)
    )
