"""Figure, page and tables, of the committed results and of made-up ones; test_page.py opens a page in a browser."""

import json
import re
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.aggregate import summarise_cells
from benchmarks.report import interactive, main, palette

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
COMMITTED = sorted(path.stem for path in RESULTS.glob("*.csv"))


def _tidy(algorithms, guider=False):
    rows = [
        {"task": task, "noise": 0.1, "algorithm": name, "seed": seed, "timesteps": steps, "learner": steps * (1.0 + seed)}
        for task in ("Ant", "Hopper")
        for name in algorithms
        for seed in (0, 1)
        for steps in (1000, 2000)
    ]
    tidy = pd.DataFrame(rows)
    return tidy.assign(guider=tidy.learner + 5, kl=0.01, target_kl=0.01) if guider else tidy


@pytest.mark.parametrize("name", COMMITTED)
def test_every_committed_result_can_be_reported(name, tmp_path, monkeypatch, capsys):
    for suffix in (".csv", ".json"):
        shutil.copy(RESULTS / f"{name}{suffix}", tmp_path)
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path / name)])
    main()
    page = (tmp_path / f"{name}.html").read_text()
    assert "python -m benchmarks.launch" in page
    assert not re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="http', page), "nothing is loaded from elsewhere"
    assert "| gac |" in capsys.readouterr().out


@pytest.mark.parametrize("name", COMMITTED)
def test_committed_scores_are_those_of_the_committed_evaluations(name):
    tidy, results = pd.read_csv(RESULTS / f"{name}.csv"), json.loads((RESULTS / f"{name}.json").read_text())
    again = summarise_cells(tidy, results["reference"])
    for name in ("task", "noise", "algorithm", "seeds", "final", "final_mean", "steps_to_reference"):
        assert [cell[name] for cell in again] == [cell[name] for cell in results["cells"]], name


def test_the_page_draws_seeds_band_mean_and_guider():
    names = [line.name for line in interactive(_tidy(["gac"], guider=True)).data]
    assert names == 2 * ["gac, seed 0", "gac, seed 1", "gac, 95% of the mean", "gac", "gac, guider"]
    figure = interactive(_tidy(["sac"]))
    assert "sac, guider" not in [line.name for line in figure.data]
    band, *_ = [line for line in figure.data if line.fill == "toself"]
    error = 1.96 * 1000 * 0.5**0.5 / 2**0.5
    assert list(band.y) == pytest.approx([1500 + error, 3000 + 2 * error, 3000 - 2 * error, 1500 - error])
    assert [line.name for line in figure.data if line.showlegend] == ["sac"], "once for all cells"


def test_algorithms_beyond_the_eighth_are_drawn_in_colors_of_their_own():
    algorithms = [f"algorithm {index}" for index in range(12)]
    assert len(set(palette(algorithms).values())) == 12
    names = {line.name for line in interactive(_tidy(algorithms)).data}
    assert set(algorithms) <= names
