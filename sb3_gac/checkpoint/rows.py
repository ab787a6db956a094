"""Rows of a replay buffer written in blocks, each a file; only blocks that have changed are written again."""

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
        """Number of rows added so far."""

    @property
    def filling(self) -> object:
        """An object that is another one once rows have changed in another way than by adding further ones."""

    @property
    def n_rows(self) -> int:
        """Number of rows that the buffer holds when it is full."""

    def rows_by_name(self) -> Mapping[str, np.ndarray]:
        """Name -> array of shape (n_rows, ...), for all that a row consists of."""


class SavedBlocks(NamedTuple):
    """
    The blocks of a buffer's rows that were written last.

    :param root: folder of all checkpoints of a run
    :param filling: the buffer's :attr:`Ring.filling` by then
    :param n_added: number of rows that had been added to the buffer by then
    :param names: names of the blocks, in the order of the rows
    """

    root: Path
    filling: object
    n_added: int
    names: list[str]


def write_rows(buffer: Ring, root: Path, before: SavedBlocks | None) -> SavedBlocks:
    """
    Write the blocks of rows that have changed since they were last written to the same folder.

    :param buffer: buffer whose rows are written
    :param root: folder of all checkpoints of a run
    :param before: blocks that were written last, to this folder or another; ``None`` if none were
    :return: blocks of all rows, as they are now
    :raises OSError: if the blocks can't be written
    """
    arrays, n_rows = buffer.rows_by_name(), buffer.n_rows
    per_block = _rows_per_block(arrays)
    n_filled = min(buffer.n_added + 1, n_rows)
    names = [""] * -(-n_filled // per_block)
    changed = np.arange(len(names))
    is_known = before is not None and before.root == root and before.filling is buffer.filling
    if before is not None and is_known and buffer.n_added - before.n_added < n_rows - 2:
        names[: len(before.names)] = before.names
        # The step before may have been cut, and the newest next observation is in the row of the next step
        written = np.arange(max(before.n_added - 1, 0), buffer.n_added + 1) % n_rows // per_block
        changed = np.union1d(written, [block for block, name in enumerate(names) if not has_block(root, name)])
    for block in changed.astype(int).tolist():
        rows = slice(block * per_block, min((block + 1) * per_block, n_filled))
        names[block] = write_block(root, b"".join(array[rows].tobytes() for array in arrays.values()))
    return SavedBlocks(root, buffer.filling, buffer.n_added, names)


def read_rows(buffer: Ring, root: Path, names: list[str]) -> SavedBlocks:
    """
    Put a buffer's rows back.

    :param buffer: buffer to fill, whose ``n_added`` is already that of the written buffer
    :param root: folder of all checkpoints of a run
    :param names: names of the blocks, in the order of the rows
    :return: blocks of all rows, for the next call of :func:`write_rows`
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
    return SavedBlocks(root, buffer.filling, buffer.n_added, names)


def _rows_per_block(arrays: Mapping[str, np.ndarray]) -> int:
    return max(1, BLOCK_BYTES // sum(array[0].nbytes for array in arrays.values()))
