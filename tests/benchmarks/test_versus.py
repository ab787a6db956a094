"""The comparison of two checkouts' speed: what it refuses, and the command that it records."""

import json
from pathlib import Path

import pytest

from benchmarks import versus
from benchmarks.versus import command, main


def test_what_is_no_checkout_is_named(tmp_path):
    for path in (tmp_path / "nosuch", tmp_path):
        with pytest.raises(SystemExit, match=f"{path} is no checkout of this repository, since it has no sb3_gac"):
            main([str(path)])


@pytest.mark.parametrize(
    "words",
    [["../before/", "--pairs", "3"], ["--pairs", "3", "../before/"], ["--threads", "1", "--pairs", "3", "../before/"]],
)
def test_the_recorded_command_has_the_checkouts_name_wherever_it_stands(words):
    expected = [word if word != "../before/" else "before" for word in words]
    assert command(words, Path("../before")) == " ".join(["python -m benchmarks.versus", *expected])


def test_a_record_has_the_command_and_the_other_commit(tmp_path, monkeypatch):
    checkout, out = tmp_path / "before", tmp_path / "versus.json"
    (checkout / "sb3_gac").mkdir(parents=True)
    (checkout / "sb3_gac/__init__.py").touch()
    monkeypatch.setattr(versus, "compare", lambda *_: {"ratio": 1.0})
    monkeypatch.setattr(versus, "provenance", lambda: {"commit": "here"})
    monkeypatch.setattr(versus, "commit", lambda package: f"of {package.parent.name}")
    main(["--threads", "1", "--pairs", "1", "--out", str(out), "--compiled", "0", "--algorithms", "GAC", "--", str(checkout)])
    record = json.loads(out.read_text())
    assert record["command"].endswith("--algorithms GAC -- before")
    assert (record["there"], record["commit"], len(record["rows"])) == ("of before", "here", 3)
