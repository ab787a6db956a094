"""Cells whose policies see several observations."""

from dataclasses import asdict

import pytest
import yaml

from benchmarks.config import check_runs
from benchmarks.environments import environment, make_envs
from benchmarks.finished import is_finished, kind_of, names_of, particulars_of, settings_of
from benchmarks.suite import read_suite
from tests.benchmarks.helpers import SMALL_SUITE

PLAIN = {"task": "Pendulum", "noises": [0.1], "algorithms": ["sac-asym"], "seeds": [0]}


def _read(tmp_path, *cells):
    path = tmp_path / "history.yml"
    path.write_text(yaml.safe_dump({**SMALL_SUITE, "cells": list(cells)}))
    return read_suite(path)


def test_cells_with_and_without_a_history_are_two_everywhere(tmp_path):
    plain, remembering = _read(tmp_path, PLAIN, {**PLAIN, "history": 4})
    check_runs("here", [plain, remembering])
    assert environment(plain) == ("sb3_gac/Pendulum-v1", {"noise_std": 0.1})
    assert environment(remembering) == ("sb3_gac/Pendulum-v1", {"noise_std": 0.1, "history": 4})
    sizes = [make_envs(spec, 1).observation_space["partial"].shape[0] for spec in (plain, remembering)]
    assert sizes == [2, 4 * 2 + 3 * 1]
    assert plain.directory(tmp_path) != remembering.directory(tmp_path)
    assert "Pendulum-history4-noise0.1" in str(remembering.directory(tmp_path))
    assert [names_of(spec)["task"] for spec in (plain, remembering)] == ["Pendulum", "Pendulum-history4"]
    assert kind_of(plain) != kind_of(remembering)
    assert settings_of(plain) == settings_of(remembering)
    assert particulars_of(remembering) == {"history": 4}
    assert particulars_of(plain) == {}


def test_a_run_that_was_made_before_there_were_histories_counts(tmp_path):
    (spec,) = _read(tmp_path, PLAIN)
    directory = spec.directory(tmp_path)
    directory.mkdir(parents=True)
    (directory / "evaluations.csv").touch()
    before = {key: value for key, value in asdict(spec).items() if key != "history"}
    (directory / "config.yaml").write_text(yaml.safe_dump({"run": before}))
    assert is_finished(spec, tmp_path)


@pytest.mark.parametrize("history", [1, 0, -2, 1.5, "4", True, None])
def test_a_history_that_is_none_is_named(tmp_path, history):
    with pytest.raises(ValueError, match=r"history\.yml, cell 1, history: must be a whole number above 1"):
        _read(tmp_path, {**PLAIN, "history": history})


def test_a_task_that_takes_none_is_named(tmp_path):
    specs = _read(tmp_path, {**PLAIN, "task": "popgym-BattleshipEasy", "noises": [0], "history": 4})
    with pytest.raises(ValueError, match="popgym-BattleshipEasy takes no history"):
        check_runs("here", specs)
