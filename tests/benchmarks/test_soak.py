"""The soak, for seconds instead of an hour."""

import json
import subprocess
import sys

from benchmarks.soak import losses


def test_steps_lost_by_hand():
    lines = ["start,0,1", "step,50,1", "step,100,1", "start,60,1", "step,90,1", "start,90,1", "start,90,1"]
    assert losses(lines) == [40, 0, 0]


def test_killed_training_ends_where_undisturbed_training_does(tmp_path):
    out = tmp_path / "report.json"
    options = ["--minutes", "0", "--kills", "3", "--interval", "100", "--pause", "0.5", "2", "--seed", "7", "--out", str(out)]
    subprocess.run(
        [sys.executable, "-m", "benchmarks.soak", str(tmp_path / "soak"), *options], check=True, capture_output=True
    )
    report = json.loads(out.read_text())
    assert report["kills"] == {"SIGKILL": 2, "SIGTERM": 1}, "the seed's"
    assert report["steps"] > 100
    assert report["steps_lost"]["largest"] <= 100 + 2  # both environments' step under way
    assert report["same_as_undisturbed"]
