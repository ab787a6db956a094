"""The pictures of sick runs: what they are drawn from, and that the page shows them."""

import re
from pathlib import Path

import pandas as pd
import pytest
from matplotlib import pyplot as plt

from benchmarks import signs
from benchmarks.config import resolve
from benchmarks.suite import read_suite

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks/results"
SPECS = read_suite(ROOT / "benchmarks/suites/signs.yml")
PAGE = (ROOT / "docs/signs.md").read_text()
LAST = {"learner": 10.4, "guider": 20.6, "kl": 0.5, "target_kl": 0.25, "kl_coef": 0.125, "learner_mean_abs": 3.456}


def _evaluations(runs, seed, **last):
    """Two of them, the first before any gradient step."""
    common = {"task": runs.task, "noise": runs.noise, "algorithm": runs.algorithm, "seed": seed}
    return [common | {"timesteps": 1_000, "learner": -5.0, "guider": -5.0}, common | {"timesteps": 2_000, **last}]


@pytest.fixture
def healthy():
    return pd.DataFrame([row for seed in (20, 21) for row in _evaluations(signs.HEALTHY, seed, **LAST)])


@pytest.fixture
def sick():
    runs = signs.PICTURES["saturated-actions"].sick
    last = LAST | {"learner": -7.0, "learner_mean_abs": 9.0}
    return pd.DataFrame([row for seed in (20, 21) for row in _evaluations(runs, seed, **last)])


def test_runs_are_described_by_their_last_evaluations(healthy):
    assert signs.described(healthy) == (
        "learner [10, 10], guider [21, 21], kl / target [2.0, 2.0], kl_coef [0.125, 0.125], learner_mean_abs [3.46, 3.46]"
    )


def test_each_panel_has_a_line_for_each_seed_and_policy(healthy, sick, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(plt, "close", drawn.append)
    signs.draw("saturated actions", healthy, sick, tmp_path / "saturated.png")
    (figure,) = drawn
    returns, ratio, kl_coef, mean_abs = figure.axes
    assert (tmp_path / "saturated.png").stat().st_size > 0
    assert [line.get_linestyle() for line in returns.lines] == ["-", "--"] * 4
    assert [line.get_ydata()[-1] for line in returns.lines] == [10.4, 20.6] * 2 + [-7.0, 20.6] * 2
    assert [line.get_ydata()[-1] for line in ratio.lines[:4]] == [2.0] * 4
    assert [line.get_ydata()[-1] for line in kl_coef.lines] == [0.125] * 4
    assert [line.get_ydata()[-1] for line in mean_abs.lines] == [3.456] * 2 + [9.0] * 2
    assert [text.get_text() for text in returns.get_legend().get_texts()] == ["healthy", "saturated actions"]
    monkeypatch.undo()
    plt.close(figure)


def test_what_there_are_results_of_is_drawn_and_what_is_missing_is_named(healthy, sick, tmp_path, monkeypatch, capsys):
    pd.concat([healthy, sick]).to_csv(tmp_path / "signs.csv", index=False)
    monkeypatch.setattr("sys.argv", ["signs", str(tmp_path)])
    signs.main()
    assert [path.name for path in tmp_path.glob("*.png")] == ["signs-saturated-actions.png"]
    said = capsys.readouterr().out
    assert "saturated-actions: sick: learner [-7, -7]" in said
    assert "guider-far: not drawn, runs of the suites halfcheetah and independent are missing" in said


def test_one_setting_is_wrong_in_each_sick_run_of_the_suite():
    drawn = {runs.algorithm for picture in signs.PICTURES.values() for runs in picture[1:] if runs.results == "signs"}
    assert {spec.algorithm for spec in SPECS} == drawn
    assert {(spec.title, spec.noise) for spec in SPECS} == {signs.PENDULUM}
    arguments = {spec.algorithm: resolve(spec)[1] for spec in SPECS}
    healthy = arguments.pop(signs.HEALTHY.algorithm)
    for sick in arguments.values():
        assert healthy.items() <= sick.items()
        assert 1 <= len(sick.keys() - healthy.keys()) <= 2


def test_the_page_shows_every_picture_whose_results_are_there():
    there = {name for name, picture in signs.PICTURES.items() if not any(runs.read(RESULTS).empty for runs in picture[1:])}
    assert "guider-far" in there
    assert set(re.findall(r"\(\.\./benchmarks/results/signs-([\w-]+)\.png\)", PAGE)) == there
