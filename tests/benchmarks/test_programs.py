"""The benchmark programs, run as a user runs them, on a suite of seconds."""

import json
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import yaml

from benchmarks.report import collect, summarise
from benchmarks.run import build_arguments, run
from benchmarks.suite import RunSpec, read_algorithm, read_suite
from sb3_gac import GAC

ROOT = Path(__file__).parents[2]
SMOKE = ROOT / "benchmarks" / "suites" / "smoke.yml"


def _program(*arguments):
    return subprocess.run([sys.executable, "-m", *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """All runs of the smoke suite, through launch."""
    directory = tmp_path_factory.mktemp("runs")
    result = _program("benchmarks.launch", SMOKE, "--jobs", 2, "--runs", directory)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 were finished before, 4 now, 0 failed." in result.stdout
    return directory


def test_each_run_leaves_its_evaluations_configuration_and_model(runs):
    for spec in read_suite(SMOKE):
        directory = spec.directory(runs)
        evaluations = pd.read_csv(directory / "evaluations.csv")
        assert evaluations.timesteps.tolist() == [200, 400, 600]
        assert {"learner", "guider", "kl", "target_kl", "kl_coef"} <= set(evaluations.columns)
        configuration = yaml.safe_load((directory / "config.yaml").read_text())
        assert configuration["run"]["seed"] == spec.seed
        assert configuration["versions"]["torch"]
        GAC.load(directory / "model")


def test_a_finished_run_is_skipped_and_an_unfinished_one_done_again(runs):
    first, second = (spec.directory(runs) / "evaluations.csv" for spec in read_suite(SMOKE)[:2])
    before = first.read_text(), first.stat().st_mtime_ns
    wanted = second.read_text()
    second.unlink()
    dry = _program("benchmarks.launch", SMOKE, "--runs", runs, "--dry-run")
    assert dry.stdout.count("benchmarks.run") == 1
    result = _program("benchmarks.launch", SMOKE, "--runs", runs)
    assert "3 were finished before, 1 now, 0 failed." in result.stdout
    assert (first.read_text(), first.stat().st_mtime_ns) == before
    assert second.read_text() == wanted, "the same seed gives the same run"


def test_report_writes_table_figure_and_origin(runs, tmp_path):
    result = _program("benchmarks.report", SMOKE, "--runs", runs, "--out", tmp_path / "smoke")
    assert result.returncode == 0, result.stderr
    assert "| InvertedDoublePendulum | 0.1 | gac |" in result.stdout
    record = json.loads((tmp_path / "smoke.json").read_text())
    assert record["command"] == "python -m benchmarks.launch benchmarks/suites/smoke.yml"
    assert len(record["summary"]) == 2
    assert (tmp_path / "smoke.png").stat().st_size > 10_000
    assert len(pd.read_csv(tmp_path / "smoke.csv")) == 12


def test_a_missing_run_is_an_error(runs, tmp_path):
    with pytest.raises(FileNotFoundError, match="4 runs are not finished"):
        collect(SMOKE, tmp_path)


def test_summary_by_hand():
    rows = [
        {
            "task": "T",
            "noise": 0.1,
            "algorithm": "gac",
            "seed": seed,
            "timesteps": steps,
            "learner": value,
            "guider": value + 1,
        }
        | {"kl": kl, "target_kl": 0.01}
        for seed, steps, value, kl in [(1, 4000, 0, 0.5), (1, 8000, 30, 0.011), (0, 4000, 4, 0.5), (0, 8000, 10, 0.008)]
    ]
    (summary,) = summarise(pd.DataFrame(rows))
    assert summary["learner"] == [10, 30]
    assert (summary["learner_mean"], summary["guider_mean"], summary["learner_mean_over_training"]) == (20, 21, 11)
    assert (summary["kl_over_target_min"], summary["kl_over_target_max"]) == (0.8, 1.1)


def test_a_failing_run_is_named_with_its_log(tmp_path):
    suite = yaml.safe_load(SMOKE.read_text())
    suite["cells"] = [{"task": "NoSuchTask", "noises": [0.1], "algorithms": ["gac"], "seeds": [0]}]
    path = tmp_path / "broken.yml"
    path.write_text(yaml.safe_dump(suite))
    result = _program("benchmarks.launch", path, "--runs", tmp_path)
    assert result.returncode == 1
    assert "FAILED, see" in result.stdout
    assert "NoSuchTask" in (tmp_path / "NoSuchTask-noise0.1" / "gac" / "seed0" / "log.txt").read_text()


@pytest.mark.parametrize(
    ("change", "message"),
    [({"step": 3}, r"unknown keys \['step'\]"), ({"steps": None}, r"missing keys \['steps'\]")],
)
def test_unknown_and_missing_keys_are_refused(tmp_path, change, message):
    suite = {**yaml.safe_load(SMOKE.read_text()), **change}
    suite = {key: value for key, value in suite.items() if value is not None}
    path = tmp_path / "suite.yml"
    path.write_text(yaml.safe_dump(suite))
    with pytest.raises(ValueError, match=message):
        read_suite(path)


def test_unknown_algorithms_are_refused():
    with pytest.raises(ValueError, match="algorithm must be one of"):
        read_algorithm("sac")


def test_arguments_are_layered():
    """Preset, then suite, then algorithm."""
    spec = RunSpec("gac-independent", "Ant", 0.1, 7, 1000, 4, "small", 500, 1, {"tau": 0.01, "guider": "residual"})
    algorithm_class, arguments = build_arguments(spec)
    assert algorithm_class is GAC
    assert (arguments["batch_size"], arguments["tau"], arguments["guider"], arguments["seed"]) == (128, 0.01, "independent", 7)


def test_run_leaves_a_finished_directory_alone(tmp_path):
    spec = read_suite(SMOKE)[0]
    spec.directory(tmp_path).mkdir(parents=True)
    (spec.directory(tmp_path) / "evaluations.csv").write_text("done")
    run(spec, tmp_path)
    assert (spec.directory(tmp_path) / "evaluations.csv").read_text() == "done"
