"""Checks of values that environments return against their spaces; an error names the entry and the environment."""

from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_gac.checks.spaces import entries_of, fault_of, index_bounds, is_finite

GO_ON = "learn(..., reset_num_timesteps=False) goes on from a reset environment"


class InvalidStepError(ValueError):
    """An observation, a reward or an action does not fit its space or is not finite."""


class Entry(NamedTuple):
    """
    Properties of an observation entry that the check of each step needs.

    :param space: space of the entry in one environment
    :param shape: shape of that space
    :param dtype: type of that space's numbers
    :param bounds: smallest and largest value of a discrete kind of space, else ``None``, see :func:`index_bounds`
    """

    space: spaces.Space
    shape: tuple[int, ...] | None
    dtype: Any
    bounds: tuple[Any, Any] | None

    @classmethod
    def of(cls, space: spaces.Space) -> "Entry":
        """
        Look up the properties of an entry.

        :param space: space of the entry in one environment
        :return: properties of the entry
        """
        return cls(space, space.shape, space.dtype, index_bounds(space))


REWARD = Entry.of(spaces.Box(-np.inf, np.inf, (), np.float32))


def entries_in(space: spaces.Space) -> dict[str, Entry]:
    """
    The entries of observations that are single arrays.

    :param space: observation space; one that is no Dict has one entry, "observation"
    :return: name -> properties of the entry
    """
    entries = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
    return {key: Entry.of(entry) for key, entry in entries.items() if entry.shape is not None}


def check_observation(observation: Any, expected: dict[str, Entry]) -> None:
    """
    Check an observation of all environments, each entry at once.

    :param observation: observations of all environments together
    :param expected: name -> properties of the entries that there must be
    :raises InvalidStepError: naming the entry and the environment
    """
    entries = entries_of(observation)
    for key, entry in expected.items():
        if key not in entries:
            raise InvalidStepError(
                f'The observation\'s entry "{key}" is missing, of all environments; nothing was stored. They returned '
                f"{list(entries)}. Check the wrappers around them; {GO_ON}."
            )
        check_rows(f'The observation\'s entry "{key}"', entries[key], entry)


def check_entries(observation: Any, expected: dict[str, Entry], index: int, what: str = "The observation's entry") -> None:
    """
    Check an observation of one environment.

    :param observation: observation of the environment
    :param expected: name -> properties of the entries that there must be
    :param index: index of the environment
    :param what: subject of the message, before the entry's name
    :raises InvalidStepError: naming the entry and the environment
    """
    entries = entries_of(observation)
    for key, entry in expected.items():
        fault = fault_of(entries[key], entry.space) if key in entries else "is missing"
        if fault is not None:
            raise InvalidStepError(_message(f'{what} "{key}"', index, fault))


def check_rows(name: str, rows: Any, entry: Entry) -> None:
    """
    Check an entry, or the reward, of all environments at once, and each by itself only if something may be wrong.

    :param name: name of the entry, for the message
    :param rows: value of each environment, shape (n_envs, ...)
    :param entry: properties that each value must have
    :raises InvalidStepError: naming the environment
    """
    bounds = entry.bounds
    if (
        isinstance(rows, np.ndarray)
        and rows.shape[1:] == entry.shape
        and _comes_in(rows.dtype, entry.dtype)
        and is_finite(rows, entry.dtype)
        and (bounds is None or ((rows >= bounds[0]) & (rows <= bounds[1])).all())
    ):
        return
    for index, row in enumerate(rows):
        fault = fault_of(row, entry.space)
        if fault is not None:
            raise InvalidStepError(_message(name, index, fault))


def _comes_in(given: Any, expected: Any) -> bool:
    """Whether a type is the expected one, or one whose numbers a floating-point entry takes as they are."""
    return given == expected or (expected.kind == "f" and given.kind in "biuf")


def _message(name: str, index: int, fault: str) -> str:
    return (
        f"{name} of environment {index} {fault}; it was not stored. Check the environment's simulation and its wrappers; "
        f"{GO_ON}."
    )
