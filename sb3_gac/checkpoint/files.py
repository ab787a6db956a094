"""
Checkpoints on disk: each a directory that is there whole or not at all, every file with its checksum, the last few kept.

::

    <root>/checkpoint-000007-step-000000050000/manifest.json   names, sizes and checksums of all that belongs to it
    <root>/checkpoint-000007-step-000000050000/...             what changes from one checkpoint to the next
    <root>/blocks/<checksum>                                   what they share: parts of the replay buffer

The latest one is the one that was written last, whatever its step: training may have been resumed from before a checkpoint
that turned out to be damaged.  A block is written once, whatever number of checkpoints it belongs to, and goes with the last
of them.
"""

import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

FORMAT = 1
_PREFIX, _TEMPORARY, _BLOCKS, _MANIFEST = "checkpoint-", ".writing", "blocks", "manifest.json"


class CheckpointError(ValueError):
    """A checkpoint that is incomplete or altered, or none where there should be one."""


def checksum(content: bytes) -> str:
    """SHA-256, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def write_durably(path: Path, content: bytes) -> None:
    """
    :param path: of a new file, which is on the disk when this returns
    :param content: of it
    """
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def sync_directory(path: Path) -> None:
    """
    :param path: whose entries are on the disk when this returns
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_block(root: Path, content: bytes) -> str:
    """
    :param root: of the checkpoints
    :param content: to be shared by checkpoints
    :return: its name, which is its checksum
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
    :param root: of the checkpoints
    :param name: of :func:`write_block`
    """
    return (root / _BLOCKS / name).exists()


def read_block(root: Path, name: str) -> bytes:
    """
    :param root: of the checkpoints
    :param name: of :func:`write_block`
    """
    return (root / _BLOCKS / name).read_bytes()


def write_checkpoint(root: Path, step: int, files: Mapping[str, bytes], blocks: Iterable[str], keep: int) -> Path:
    """
    :param root: of the checkpoints
    :param step: number of environment steps
    :param files: name -> content
    :param blocks: names of :func:`write_block` that belong to it
    :param keep: how many of the latest checkpoints stay
    :return: the checkpoint's directory; before this returns it is not there, and the ones before it are
    :raises OSError: if the disk is full; what was there before is as it was
    """
    root.mkdir(parents=True, exist_ok=True)
    earlier = checkpoints(root)
    number = int(earlier[0].name.split("-")[1]) + 1 if earlier else 1
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
    :param root: of the checkpoints
    :return: their directories, the one written last first
    """
    return sorted(root.glob(f"{_PREFIX}*"), reverse=True)


def step_of(checkpoint: Path) -> int:
    """
    :param checkpoint: one of :func:`checkpoints`
    :return: number of environment steps
    """
    return int(checkpoint.name.rpartition("-")[2])


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
    :raises CheckpointError: naming what is wrong
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
    :param directory: of one checkpoint
    :return: its files, name -> content, and the names of its blocks; all of them are as they were written
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
    :param root: of the checkpoints
    :return: directory and files of the latest one that is as it was written; a warning names those that are not
    :raises CheckpointError: if there is none
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
