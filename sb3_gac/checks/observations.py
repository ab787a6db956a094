"""What environments return, against their spaces: a fault names the entry and the environment."""

from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_gac.checks.values import entries_of, fault_of, index_bounds, is_finite

GO_ON = "learn(..., reset_num_timesteps=False) goes on from a reset environment"


class InvalidStepError(ValueError):
    """An observation, a reward or an action does not fit its space or is not finite."""


class Entry(NamedTuple):
    """
    What is to be known of an entry in every step.

    :param space: of one environment's
    :param shape: of that space
    :param dtype: of that space
    :param bounds: see :func:`index_bounds`
    """

    space: spaces.Space
    shape: tuple[int, ...] | None
    dtype: Any
    bounds: tuple[Any, Any] | None

    @classmethod
    def of(cls, space: spaces.Space) -> "Entry":
        """
        :param space: of one environment's
        """
        return cls(space, space.shape, space.dtype, index_bounds(space))


REWARD = Entry.of(spaces.Box(-np.inf, np.inf, (), np.float32))


def entries_in(space: spaces.Space) -> dict[str, Entry]:
    """Those of an observation's entries that are single arrays."""
    entries = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
    return {key: Entry.of(entry) for key, entry in entries.items() if entry.shape is not None}


def check_observation(observation: Any, expected: dict[str, Entry]) -> None:
    """
    One look at each entry of all environments together.

    :param observation: of all environments
    :param expected: its entries
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
    :param observation: of one environment
    :param expected: its entries
    :param index: of the environment
    :param what: the entries' kind, for the message
    :raises InvalidStepError: naming the entry and the environment
    """
    entries = entries_of(observation)
    for key, entry in expected.items():
        fault = fault_of(entries[key], entry.space) if key in entries else "is missing"
        if fault is not None:
            raise InvalidStepError(_message(f'{what} "{key}"', index, fault))


def check_rows(name: str, rows: Any, entry: Entry) -> None:
    """
    One look at all environments together; at each by itself only if something may be wrong.

    :param name: for the message
    :param rows: one for each environment
    :param entry: what each is to be
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
    """Whether the type is the expected one, or one whose numbers a floating-point entry takes as they are."""
    return given == expected or (expected.kind == "f" and given.kind in "biuf")


def _message(name: str, index: int, fault: str) -> str:
    return (
        f"{name} of environment {index} {fault}; it was not stored. Check the environment's simulation and its wrappers; "
        f"{GO_ON}."
    )
