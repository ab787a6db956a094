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
SPECS = read_suite(ROOT / "benchmarks/suites/signs.yml")
PAGE = (ROOT / "docs/signs.md").read_text()


def _rows(algorithm, seed, **last):
    """Two evaluations, the first before any gradient step."""
    first = {"timesteps": 1_000, "learner": -5.0, "guider": -5.0}
    common = {"task": "HalfCheetah-history4", "noise": 0.1, "algorithm": algorithm, "seed": seed}
    return [common | first, common | {"timesteps": 2_000, **last}]


@pytest.fixture
def tidy():
    last = {"learner": 10.4, "guider": 20.6, "kl": 0.5, "target_kl": 0.25, "kl_coef": 0.125, "learner_mean_abs": 3.456}
    of_two = {"gac": last, "gac-saturated": last | {"learner": -7.0, "learner_mean_abs": 9.0}}
    return pd.DataFrame([row for name, values in of_two.items() for seed in (20, 21) for row in _rows(name, seed, **values)])


def test_a_run_is_described_by_its_last_evaluation(tidy):
    assert signs.described(tidy, "gac") == (
        "gac: learner [10, 10], guider [21, 21], kl / target [2.0, 2.0], kl_coef [0.125, 0.125], learner_mean_abs [3.46, 3.46]"
    )


def test_each_panel_has_a_line_for_each_seed_and_policy(tidy, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(plt, "close", drawn.append)
    signs.draw(tidy, "gac-saturated", tmp_path / "saturated.png")
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


def test_the_pictures_are_of_what_the_results_have(tidy, tmp_path, monkeypatch, capsys):
    tidy.to_csv(tmp_path / "signs.csv", index=False)
    monkeypatch.setattr("sys.argv", ["signs", str(tmp_path / "signs")])
    signs.main()
    assert [path.name for path in tmp_path.glob("*.png")] == ["signs-saturated-actions.png"]
    assert "gac-saturated: learner [-7, -7]" in capsys.readouterr().out


def test_one_setting_is_wrong_in_each_sick_run_of_the_suite():
    assert {spec.algorithm for spec in SPECS} == {signs.HEALTHY, *signs.SICK}
    healthy = resolve(next(spec for spec in SPECS if spec.algorithm == signs.HEALTHY))[1]
    for algorithm in signs.SICK:
        arguments = resolve(next(spec for spec in SPECS if spec.algorithm == algorithm))[1]
        assert healthy.items() <= arguments.items()
        assert 1 <= len(arguments.keys() - healthy.keys()) <= 2


def test_the_page_shows_every_sick_run():
    shown = re.findall(r"\(\.\./benchmarks/results/(signs-[\w-]+)\.png\)", PAGE)
    assert sorted(shown) == sorted(f"signs-{what.replace(' ', '-').replace('_', '-')}" for what in signs.SICK.values())
