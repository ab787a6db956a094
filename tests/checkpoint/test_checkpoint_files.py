"""Checkpoints on disk: whole or not at all, altered ones refused by name, the last few kept."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from sb3_gac.checkpoint.files import (
    CheckpointError,
    checkpoints,
    latest_whole,
    read_block,
    read_checkpoint,
    step_of,
    write_block,
    write_checkpoint,
)


def _write(root, step, text=b"files", block=b"block", keep=2):
    return write_checkpoint(root, step, {"state": text, "other": b"x"}, [write_block(root, block)], keep)


def test_what_was_written_is_read(tmp_path):
    path = _write(tmp_path, 7)
    files, (name,) = read_checkpoint(path)
    assert files == {"state": b"files", "other": b"x"}
    assert read_block(tmp_path, name) == b"block"
    assert latest_whole(tmp_path) == (path, files)


def test_the_last_ones_are_kept_with_their_blocks(tmp_path):
    for step, block in [(10, b"a"), (20, b"b"), (1_000_000, b"b"), (2_000_000, b"c")]:
        _write(tmp_path, step, block=block)
    assert [step_of(path) for path in checkpoints(tmp_path)] == [2_000_000, 1_000_000]
    assert sorted(path.read_bytes() for path in (tmp_path / "blocks").iterdir()) == [b"b", b"c"]


def test_what_was_written_last_stays_though_a_damaged_one_has_more_steps(tmp_path):
    """Resumed from before a damaged checkpoint, the next one must not be taken for an old one and thrown away."""
    _write(tmp_path, 10, text=b"before")
    _truncate(_write(tmp_path, 200) / "state")
    after = _write(tmp_path, 50, text=b"after", keep=1)
    assert checkpoints(tmp_path) == [after]
    assert latest_whole(tmp_path)[1]["state"] == b"after"


def test_folders_of_other_names_are_no_checkpoints(tmp_path):
    """Copies that a user keeps beside the checkpoints end no training, do not count among those to keep, and stay."""
    first = _write(tmp_path, 10)
    copies = [tmp_path / name for name in ("checkpoint-best", f"{first.name}-keep", f"checkpoint-x-{first.name}")]
    for copy in copies:
        shutil.copytree(first, copy)
    kept = [_write(tmp_path, step) for step in (20, 30)]
    assert checkpoints(tmp_path) == kept[::-1]
    assert latest_whole(tmp_path)[0] == kept[-1]
    assert all(copy.is_dir() for copy in copies)
    assert not first.exists()


def test_checkpoints_are_in_the_order_of_their_numbers_however_large(tmp_path):
    (tmp_path / "checkpoint-999999-step-000000000010").mkdir(parents=True)
    for step in (20, 10**12):
        _write(tmp_path, step)
    assert [path.name for path in checkpoints(tmp_path)] == [
        "checkpoint-1000001-step-1000000000000",
        "checkpoint-1000000-step-000000000020",
    ]


def test_a_block_is_written_once(tmp_path):
    name = write_block(tmp_path, b"a")
    written = (tmp_path / "blocks" / name).stat().st_mtime_ns
    time.sleep(0.01)
    assert write_block(tmp_path, b"a") == name
    assert (tmp_path / "blocks" / name).stat().st_mtime_ns == written


def _truncate(path):
    path.write_bytes(path.read_bytes()[:-1])


def _alter(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [_truncate, _alter, os.unlink], ids=["truncated", "altered", "missing"])
@pytest.mark.parametrize("name", ["state", "manifest.json", "block"])
def test_a_damaged_checkpoint_is_refused_by_name_and_the_one_before_it_used(name, damage, tmp_path):
    before = _write(tmp_path, 1, text=b"before", block=b"shared")
    after = _write(tmp_path, 2, text=b"after", block=b"of its own")
    path = after / name
    if name == "block":
        (path,) = (path for path in (tmp_path / "blocks").iterdir() if path.read_bytes() == b"of its own")
    damage(path)
    with pytest.warns(UserWarning, match=f"Resuming from .*{before.name}; later checkpoints are damaged: .*{path.name}"):
        assert latest_whole(tmp_path)[1]["state"] == b"before"


def test_a_manifest_that_was_altered_with_its_files_is_refused(tmp_path):
    path = _write(tmp_path, 1) / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["body"] = manifest["body"].replace('"step": 1', '"step": 2')
    path.write_text(json.dumps(manifest))
    with pytest.raises(CheckpointError, match=r"no whole checkpoint in .*manifest.json was altered"):
        latest_whole(tmp_path)


def test_none_at_all(tmp_path):
    with pytest.raises(CheckpointError, match="it has none at all"):
        latest_whole(tmp_path / "nothing")


FILLED_DISK = """
import resource, signal, sys
from pathlib import Path
from sb3_gac.checkpoint.files import write_block, write_checkpoint
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))  # what the kernel then answers is what it answers on a full disk
root = Path(sys.argv[1])
for attempt in (lambda: write_block(root, bytes(20_000)), lambda: write_checkpoint(root, 2, {"state": bytes(20_000)}, [], 1)):
    try:
        attempt()
    except OSError as error:
        print("OSError", error.errno)
"""


def test_a_write_that_fails_leaves_what_was_there(tmp_path):
    before = _write(tmp_path, 1)
    result = subprocess.run([sys.executable, "-c", FILLED_DISK, tmp_path], capture_output=True, text=True, check=True)
    assert result.stdout.count("OSError") == 2, result.stdout
    assert latest_whole(tmp_path)[0] == before
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


WRITER = """
import sys
from pathlib import Path
from sb3_gac.checkpoint.files import write_block, write_checkpoint
root = Path(sys.argv[1])
for step in range(1, 10**9):
    content = str(step).encode() * 2_000
    write_checkpoint(root, step, {"state": content}, [write_block(root, content[::-1])], 2)
    print(step, flush=True)
"""


@pytest.mark.parametrize("delay", [0.0, 0.013, 0.03, 0.055])
def test_killed_at_any_moment_the_last_finished_one_is_there(delay, tmp_path):
    with subprocess.Popen([sys.executable, "-c", WRITER, tmp_path], stdout=subprocess.PIPE, text=True) as process:
        process.stdout.readline()
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        finished = [1, *(int(line) for line in process.stdout)]
    path, files = latest_whole(tmp_path)
    step = step_of(path)
    assert step in (finished[-1], finished[-1] + 1)
    assert files["state"] == str(step).encode() * 2_000


def test_where_it_is_not_known_what_belongs_to_a_checkpoint_nothing_is_thrown_away(tmp_path):
    _write(tmp_path, 1, block=b"a")
    _truncate(_write(tmp_path, 2, block=b"b") / "manifest.json")
    _write(tmp_path, 3, block=b"c")
    assert sorted(path.read_bytes() for path in (tmp_path / "blocks").iterdir()) == [b"a", b"b", b"c"]
    _write(tmp_path, 4, block=b"d")  # the damaged one is gone, and with it what is not known
    assert [step_of(path) for path in checkpoints(tmp_path)] == [4, 3]
    assert sorted(path.read_bytes() for path in (tmp_path / "blocks").iterdir()) == [b"c", b"d"]
