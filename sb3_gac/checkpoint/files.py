"""
Checkpoints on disk: each is a folder that is there whole or not at all, with a checksum of every file. The latest are kept.

::

    <root>/checkpoint-000007-step-000000050000/manifest.json   names, sizes and checksums of the checkpoint's files
    <root>/checkpoint-000007-step-000000050000/...             files that change from one checkpoint to the next
    <root>/blocks/<checksum>                                   blocks, parts of the replay buffer that checkpoints share

The latest checkpoint is the one that was written last, whatever its step: training may have been resumed from a checkpoint
before one that turned out to be damaged.  A block is written once, however many checkpoints it belongs to, and is removed
with the last of them.
"""

import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

FORMAT = 1
_PREFIX, _TEMPORARY, _BLOCKS, _MANIFEST = "checkpoint-", ".writing", "blocks", "manifest.json"
_NAME = re.compile(rf"{_PREFIX}\d{{6,}}-step-\d{{12,}}")


class CheckpointError(ValueError):
    """A checkpoint is incomplete, altered or missing."""


def checksum(content: bytes) -> str:
    """
    The SHA-256 checksum of bytes.

    :param content: bytes
    :return: checksum in hexadecimal digits
    """
    return hashlib.sha256(content).hexdigest()


def write_durably(path: Path, content: bytes) -> None:
    """
    Write a file, and return once it is on the disk.

    :param path: path of the file
    :param content: content of the file
    """
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def sync_directory(path: Path) -> None:
    """
    Return once the entries of a folder are on the disk.

    :param path: path of the folder
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_block(root: Path, content: bytes) -> str:
    """
    Write a block, unless it is there already.

    :param root: folder of all checkpoints of a run
    :param content: content of the block, which checkpoints may share
    :return: name of the block, which is its checksum
    """
    name = checksum(content)
    path = root / _BLOCKS / name
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(_TEMPORARY)
        write_durably(temporary, content)
        temporary.replace(path)
    return name


def has_block(root: Path, name: str) -> bool:
    """
    Whether a block is there.

    :param root: folder of all checkpoints of a run
    :param name: name of the block, from :func:`write_block`
    """
    return (root / _BLOCKS / name).exists()


def read_block(root: Path, name: str) -> bytes:
    """
    Read a block.

    :param root: folder of all checkpoints of a run
    :param name: name of the block, from :func:`write_block`
    :return: content of the block
    """
    return (root / _BLOCKS / name).read_bytes()


def write_checkpoint(root: Path, step: int, files: Mapping[str, bytes], blocks: Iterable[str], keep: int) -> Path:
    """
    Write a checkpoint, and remove those that are no longer to be kept.

    The checkpoint's folder appears once all its files are on the disk, and only then are earlier checkpoints removed.

    :param root: folder of all checkpoints of a run
    :param step: number of environment steps
    :param files: name -> content of the checkpoint's files
    :param blocks: names of the blocks that belong to the checkpoint, from :func:`write_block`
    :param keep: number of checkpoints to keep, the latest ones
    :return: folder of the checkpoint
    :raises OSError: if the disk is full; earlier checkpoints are as they were
    """
    root.mkdir(parents=True, exist_ok=True)
    earlier = checkpoints(root)
    number = _numbers(earlier[0])[0] + 1 if earlier else 1
    final, temporary = root / f"{_PREFIX}{number:06d}-step-{step:012d}", root / _TEMPORARY
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        for name, content in files.items():
            write_durably(temporary / name, content)
        sums = {name: {"bytes": len(content), "sha256": checksum(content)} for name, content in files.items()}
        body = json.dumps({"format": FORMAT, "step": step, "files": sums, "blocks": sorted(set(blocks))}, sort_keys=True)
        write_durably(temporary / _MANIFEST, json.dumps({"body": body, "sha256": checksum(body.encode())}).encode())
        sync_directory(temporary)
        if (root / _BLOCKS).exists():
            sync_directory(root / _BLOCKS)
    except OSError:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    temporary.rename(final)
    sync_directory(root)
    _prune(root, keep)
    return final


def checkpoints(root: Path) -> list[Path]:
    """
    The checkpoints of a run, whole or not.  Folders with other names, such as a user's copies, are left alone.

    :param root: folder of all checkpoints of the run
    :return: folders of the checkpoints, the one written last first
    """
    return sorted((path for path in root.glob(f"{_PREFIX}*") if _NAME.fullmatch(path.name)), key=_numbers, reverse=True)


def step_of(checkpoint: Path) -> int:
    """
    The step of a checkpoint.

    :param checkpoint: folder of the checkpoint, one of :func:`checkpoints`
    :return: number of environment steps
    """
    return _numbers(checkpoint)[1]


def _numbers(checkpoint: Path) -> tuple[int, int]:
    """The number and the step of a checkpoint, one of :func:`checkpoints`."""
    _, number, _, step = checkpoint.name.split("-")
    return int(number), int(step)


def _prune(root: Path, keep: int) -> None:
    kept, gone = checkpoints(root)[:keep], checkpoints(root)[keep:]
    used: set[str] = set()
    for directory in kept:
        try:
            used |= set(_manifest(directory)["blocks"])
        except CheckpointError:
            return  # better too many blocks than one too few
    for directory in gone:
        shutil.rmtree(directory, ignore_errors=True)
    for block in (root / _BLOCKS).glob("*"):
        if block.name not in used:
            block.unlink(missing_ok=True)


def _manifest(directory: Path) -> dict[str, Any]:
    """
    :param directory: folder of one checkpoint
    :return: content of the checkpoint's manifest
    :raises CheckpointError: naming what is wrong with it
    """
    path = directory / _MANIFEST
    try:
        sealed = json.loads(path.read_bytes())
        body, seal = sealed["body"], sealed["sha256"]
        if checksum(body.encode()) != seal:
            raise CheckpointError(f"{path} was altered")
        manifest = json.loads(body)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise error if isinstance(error, CheckpointError) else CheckpointError(f"{path} cannot be read: {error}") from error
    if manifest["format"] != FORMAT:
        raise CheckpointError(f"{path} has format {manifest['format']}, and this version of sb3_gac reads {FORMAT}")
    return manifest


def read_checkpoint(directory: Path) -> tuple[dict[str, bytes], list[str]]:
    """
    Read a checkpoint and compare all its files and blocks with their checksums.

    :param directory: folder of the checkpoint
    :return: name -> content of its files, and the names of its blocks
    :raises CheckpointError: naming the file that is missing, incomplete or altered
    """
    manifest = _manifest(directory)
    files = {name: _checked(directory / name, entry["sha256"]) for name, entry in manifest["files"].items()}
    for name in manifest["blocks"]:
        _checked(directory.parent / _BLOCKS / name, name)
    return files, manifest["blocks"]


def _checked(path: Path, expected: str) -> bytes:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error
    if checksum(content) != expected:
        raise CheckpointError(f"{path} is incomplete or was altered")
    return content


def latest_whole(root: Path) -> tuple[Path, dict[str, bytes]]:
    """
    The latest checkpoint that is as it was written; a warning names later ones that are not.

    :param root: folder of all checkpoints of a run
    :return: folder of the checkpoint, and name -> content of its files
    :raises CheckpointError: if there is no such checkpoint
    """
    refused = []
    for directory in checkpoints(root):
        try:
            files, _ = read_checkpoint(directory)
        except CheckpointError as error:
            refused.append(str(error))
            continue
        if refused:
            warnings.warn(f"Resuming from {directory}; later checkpoints are damaged: {'; '.join(refused)}.", stacklevel=3)
        return directory, files
    raise CheckpointError(f"There is no whole checkpoint in {root}: {'; '.join(refused) or 'it has none at all'}.")
