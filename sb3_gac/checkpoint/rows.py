"""Rows of a replay buffer in blocks, each a file, of which only those that have changed are written again."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from sb3_gac.checkpoint.files import has_block, read_block, write_block

BLOCK_BYTES = 4 << 20


class Ring(Protocol):
    """A buffer whose newest row takes the place of its oldest one."""

    @property
    def n_added(self) -> int:
        """Rows added so far."""

    @property
    def n_rows(self) -> int:
        """Rows that it holds when it is full."""

    def rows_by_name(self) -> Mapping[str, np.ndarray]:
        """What each row consists of, (n_rows, ...) each."""


class SavedBlocks(NamedTuple):
    """
    What a buffer's rows were when they were last written.

    :param root: of the checkpoints
    :param n_added: rows added by then
    :param names: of the blocks, in the order of the rows
    """

    root: Path
    n_added: int
    names: list[str]


def write_rows(buffer: Ring, root: Path, before: SavedBlocks | None) -> SavedBlocks:
    """
    Write the blocks of rows that have changed since they were last written there.

    :param buffer: whose rows they are
    :param root: of the checkpoints
    :param before: what was written last, wherever that was
    :raises OSError: if they can't be written
    """
    arrays, n_rows = buffer.rows_by_name(), buffer.n_rows
    per_block = _rows_per_block(arrays)
    n_filled = min(buffer.n_added + 1, n_rows)
    names = [""] * -(-n_filled // per_block)
    changed = np.arange(len(names))
    if before is not None and before.root == root and buffer.n_added - before.n_added < n_rows - 2:
        names[: len(before.names)] = before.names
        # The step before may have been cut, and the newest next observation stands where a step to come will be
        written = np.arange(max(before.n_added - 1, 0), buffer.n_added + 1) % n_rows // per_block
        changed = np.union1d(written, [block for block, name in enumerate(names) if not has_block(root, name)])
    for block in changed.astype(int).tolist():
        rows = slice(block * per_block, min((block + 1) * per_block, n_filled))
        names[block] = write_block(root, b"".join(array[rows].tobytes() for array in arrays.values()))
    return SavedBlocks(root, buffer.n_added, names)


def read_rows(buffer: Ring, root: Path, names: list[str]) -> SavedBlocks:
    """
    Put a buffer's rows back.

    :param buffer: which counts as many rows as were written
    :param root: of the checkpoints
    :param names: of the blocks
    """
    arrays = buffer.rows_by_name()
    per_block, n_filled = _rows_per_block(arrays), min(buffer.n_added + 1, buffer.n_rows)
    for block, name in enumerate(names):
        content, start = memoryview(read_block(root, name)), 0
        rows = slice(block * per_block, min((block + 1) * per_block, n_filled))
        for array in arrays.values():
            part = array[rows]
            part[...] = np.frombuffer(content[start : start + part.nbytes], dtype=array.dtype).reshape(part.shape)
            start += part.nbytes
    return SavedBlocks(root, buffer.n_added, names)


def _rows_per_block(arrays: Mapping[str, np.ndarray]) -> int:
    return max(1, BLOCK_BYTES // sum(array[0].nbytes for array in arrays.values()))
