"""Checks of what users and environments hand in; each error names the culprit and the remedy."""

from collections.abc import Mapping
from typing import Any

import numpy as np


class UnsupportedActionSpaceError(AssertionError, ValueError):
    """The algorithm can't act in this action space. SB3 raises AssertionError here, so this is one as well."""


def check_positive(name: str, value: Any, remedy: str = "", bound: str = "> 0") -> None:
    """
    :raises ValueError: unless ``value`` is a finite number > 0; the message says ``bound``
    """
    try:
        positive = 0 < float(value) < float("inf")
    except (TypeError, ValueError):
        positive = False
    if not positive:
        raise ValueError(f"{name} must be a number {bound}{', ' + remedy if remedy else ''}, got {value!r}.")


def check_not_negative(name: str, value: Any, remedy: str = "") -> None:
    """
    :raises ValueError: unless ``value`` is a finite number >= 0
    """
    if value != 0:
        check_positive(name, value, remedy, bound=">= 0")


def check_choice(name: str, value: Any, choices: Any) -> None:
    """
    :raises ValueError: unless ``value`` is one of ``choices``
    """
    if value not in choices:
        raise ValueError(f"{name} must be one of {sorted(choices)}, got {value!r}.")


def check_finite_observation(entries: Any, what: str = "The observation's entry") -> None:
    """
    :param entries: name -> values with one row per environment
    :param what: the entries' kind, for the message
    :raises ValueError: if a value is NaN or infinite
    """
    for name, values in entries.items():
        finite = np.isfinite(values)
        if not finite.all():
            row = int(np.argwhere(~finite)[0][0])
            raise ValueError(
                f'{what} "{name}" of environment {row} holds NaN or infinite values; it was not stored. '
                "Check the environment's simulation and its wrappers; learn(..., reset_num_timesteps=False) goes on "
                "from a reset environment."
            )


def check_terminal_observations(dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
    """
    :param dones: shape (n_envs,)
    :param infos: one per environment; where done, "terminal_observation" is the episode's last observation
    :raises ValueError: if a value of it is NaN or infinite
    """
    for index in np.flatnonzero(dones):
        terminal = infos[index].get("terminal_observation")
        if isinstance(terminal, Mapping):
            for name, values in terminal.items():
                if not np.isfinite(values).all():
                    raise ValueError(
                        f'The last observation\'s entry "{name}" of environment {index} holds NaN or infinite values; '
                        "it was not stored. Check the environment's simulation and its wrappers."
                    )
