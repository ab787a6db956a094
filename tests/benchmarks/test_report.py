"""Figure, page and tables, of the committed results and of made-up ones; test_page.py opens a page in a browser."""

import json
import math
import os
import re
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest
from matplotlib.figure import Figure

import benchmarks.bootstrap
from benchmarks.aggregate import compare, summarise_cells
from benchmarks.finished import read_results
from benchmarks.headroom import read_together
from benchmarks.page.cells import palette
from benchmarks.page.digits import with_all_digits
from benchmarks.page.document import normalised_returns
from benchmarks.page.plots import plots
from benchmarks.page.tables import returns_table
from benchmarks.report import cells_table, draw, interactive, main
from benchmarks.tidy import normalised_scores, number, read_tidy, run_scores

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
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
    monkeypatch.setattr(benchmarks.bootstrap, "REPETITIONS", 10)
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path / name), "--formats", "png"])
    main()
    page = (tmp_path / f"{name}.html").read_text()
    assert "python -m benchmarks.launch" in page
    assert not re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="http', page), "nothing is loaded from elsewhere"
    results = json.loads((RESULTS / f"{name}.json").read_text())
    runs = os.path.relpath(ROOT / "benchmarks" / "runs", tmp_path)
    assert all(f'<a href="{runs}/{run}">{run}</a>' in page for run in results["runs"]), "links lead from the page to the runs"
    first = results["cells"][0]
    noise = "" if first["noise"] is None else f"{first['noise']:g}"
    row = re.escape(f"| {first['task']} | {noise} | {first['algorithm']}") + r"(, after [\d,]+ steps of needed runs)? \|"
    assert re.search(row, capsys.readouterr().out)


def test_the_figure_comes_in_all_formats(tmp_path, monkeypatch):
    for suffix in (".csv", ".json"):
        shutil.copy(RESULTS / f"std{suffix}", tmp_path)
    monkeypatch.setattr(benchmarks.bootstrap, "REPETITIONS", 10)
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path / "std")])
    main()
    made = {path.suffix: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(made) == {".csv", ".json", ".html", ".png", ".pdf", ".svg"}
    assert made[".pdf"].startswith(b"%PDF")
    assert b"<svg" in made[".svg"]


def test_a_figure_of_one_cell_names_all_of_its_algorithms(tmp_path, monkeypatch):
    """However long their names are, no line of the legend is wider than the figure."""
    legends, make = [], Figure.legend
    monkeypatch.setattr(Figure, "legend", lambda *args, **kwargs: legends.append(make(*args, **kwargs)) or legends[-1])
    names = [f"guided-actor-critic-with-option-{number}" for number in range(7)]
    tidy = _tidy(names)
    draw(tidy[tidy.task == "Ant"], [tmp_path / "figure.png"])
    *tried, kept = legends
    assert tried, "all names in a line would be wider"
    assert kept.get_window_extent().width <= kept.figure.bbox.width
    assert [text.get_text() for text in kept.get_texts()] == names


@pytest.mark.parametrize(("seeds", "lines"), [(25, 2 * 25 + 2), (26, 2)])
def test_runs_are_drawn_where_they_can_be_followed(seeds, lines, tmp_path, monkeypatch):
    drawn, make = [], Figure.savefig
    monkeypatch.setattr(
        Figure,
        "savefig",
        lambda figure, *args, **kwargs: (make(figure, *args, **kwargs), drawn.append(len(figure.axes[0].get_lines()))),
    )
    one = _tidy(["sac", "sac-asym"])
    one = one[(one.task == "Ant") & (one.noise == one.noise.min()) & (one.seed == 0)]
    draw(pd.concat([one.assign(seed=seed) for seed in range(seeds)]), [tmp_path / "figure.png"])
    assert drawn == [lines]


def test_a_legend_of_many_rows_makes_the_figure_higher(tmp_path, monkeypatch):
    heights, make = [], Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, *args, **kwargs: (make(figure, *args, **kwargs), heights.append(_heights(figure)))
    )
    for count in (1, 16):
        tidy = _tidy([f"guided-actor-critic-with-a-very-long-name-{number}" for number in range(count)])
        draw(tidy[tidy.task == "Ant"], [tmp_path / "figure.png"])
    (figure, panel), (higher, same) = heights
    assert figure == 3.0
    assert higher > 1.5 * figure
    assert same == pytest.approx(panel, abs=0.15)


def _heights(figure):
    """Inches of a figure, and of its panel."""
    return figure.get_figheight(), figure.axes[0].get_window_extent().height / figure.dpi


def test_a_target_that_is_no_number_gives_no_plot_of_the_kl():
    tidy = _tidy(["gac"], guider=True).assign(target_kl=math.nan)
    nothing = normalised_returns({"cells": [], "compared": {"cells": [], "algorithms": []}})
    assert "KL" not in [one.name for one in plots(tidy, {}, nothing)]


def test_results_that_are_gone_are_said_in_a_line(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path / "gone")])
    with pytest.raises(SystemExit, match=r"No such file .*gone\.csv"):
        main()


@pytest.mark.parametrize("name", COMMITTED)
def test_committed_scores_are_those_of_the_committed_evaluations(name, monkeypatch):
    monkeypatch.setattr(benchmarks.bootstrap, "REPETITIONS", 10)
    tidy, results = read_tidy(RESULTS / f"{name}.csv"), json.loads((RESULTS / f"{name}.json").read_text())
    made = {"cells": summarise_cells(tidy, results["reference"]), **compare(tidy)}
    assert _points(made) == _rounded(_points(results))


def _rounded(value):
    """Numbers with a digit after the point: as many as the results have that were aggregated first."""
    if isinstance(value, dict):
        return {key: _rounded(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(map(_rounded, value))
    return pytest.approx(value, abs=0.0501) if isinstance(value, float) else value


def _points(results):
    """All scores, without the ends of their intervals."""
    cells = [{**cell, "final_iqm": cell["final_iqm"][0], "area_iqm": cell["area_iqm"][0]} for cell in results["cells"]]
    estimates = (results["normalised_iqm"], results["probability_of_improvement"])
    return cells, results["compared"], [{name: point for name, (point, *_) in estimate.items()} for estimate in estimates]


def test_the_page_draws_seeds_band_mean_and_guider():
    names = [line.name for line in interactive(_tidy(["gac"], guider=True)).data]
    assert names == 2 * ["gac, seed 0", "gac, seed 1", "gac, 95% of the mean", "gac", "gac, guider"]
    figure = interactive(_tidy(["sac"]))
    assert "sac, guider" not in [line.name for line in figure.data]
    band, *_ = [line for line in figure.data if line.fill == "toself"]
    error = 12.7062 * 1000 * 0.5**0.5 / 2**0.5  # Student's t, one degree of freedom
    assert list(band.y) == pytest.approx([1500 + error, 3000 + 2 * error, 3000 - 2 * error, 1500 - error], rel=1e-4)
    assert [line.name for line in figure.data if line.showlegend] == ["sac"], "once for all cells"
    figure = interactive(pd.concat([_tidy(["gac", "gac-gru"], guider=True), _tidy(["sac"])]))
    named = [(line.name, line.line.dash) for line in figure.data if line.showlegend]
    dashed = [("gac", None), ("gac, guider", "dash"), ("gac-gru", None), ("gac-gru, guider", "dash"), ("sac", None)]
    assert named == dashed, "what dashes are is read off the legend"


def test_axes_have_names_and_cells_without_runs_say_so():
    tidy = pd.concat([_tidy(["gac"]), _tidy(["gac"]).query("task == 'Hopper'").assign(noise=0.3)])
    figure = interactive(tidy)
    axes = [(axis.title.text, axis.visible) for axis in (*figure.select_xaxes(), *figure.select_yaxes())]
    shown, hidden = (None, False)
    empty = [shown, shown, hidden, shown]  # Ant and Hopper at 0.1, Ant and Hopper at 0.3
    assert axes == [("environment steps", is_shown) for is_shown in empty] + [("return", is_shown) for is_shown in empty]
    (words,) = [note for note in figure.layout.annotations if note.text == "not run yet"]
    left, right = figure.layout.xaxis3.domain
    below, above = figure.layout.yaxis3.domain
    assert (words.xref, words.yref) == ("paper", "paper")
    assert (left < words.x < right, below < words.y < above) == (True, True)


def test_a_cell_that_no_suite_has_is_no_cell_still_to_run():
    tidy = pd.concat([_tidy(["gac"]), _tidy(["gac"]).query("task == 'Hopper'").assign(noise=0.3)])
    awaited = ["small-5/Ant-noise0.3/gac/seed0"]
    for to_run, said in ((awaited, ["not run yet"]), ([], []), (["small-5/Ant-noise0.2/gac/seed0"], [])):
        notes = [note.text for note in interactive(tidy, to_run=to_run).layout.annotations]
        assert [text for text in notes if text == "not run yet"] == said
        assert ("Ant, noise 0.3" in notes) == bool(said), "nor has it a title"


def test_algorithms_beyond_the_eighth_are_drawn_in_colors_of_their_own():
    algorithms = [f"algorithm {index}" for index in range(12)]
    assert len(set(palette(algorithms).values())) == 12
    names = {line.name for line in interactive(_tidy(algorithms)).data}
    assert set(algorithms) <= names


@pytest.mark.parametrize(("name", "shown"), [("tiger-door", ""), ("popgym", "-0.34"), ("halfcheetah", "")])
def test_small_returns_keep_their_digits(name, shown, monkeypatch):
    """Those too that were aggregated with one digit after the point."""
    monkeypatch.setattr(benchmarks.bootstrap, "REPETITIONS", 10)
    tidy, results = read_tidy(RESULTS / f"{name}.csv"), json.loads((RESULTS / f"{name}.json").read_text())
    exact = with_all_digits(results, tidy)
    scores = run_scores(tidy)
    ends = {key: group.sort_values("seed").final.tolist() for key, group in scores.groupby(["task", "noise", "algorithm"])}
    for cell in exact["cells"]:
        assert cell["final"] == ends[cell["task"], cell["noise"], cell["algorithm"]]
    drawn = sorted(normalised_returns(exact).normalised)
    names = exact["compared"]["algorithms"]
    wanted = normalised_scores(tidy)
    assert drawn == pytest.approx(sorted(wanted[wanted.algorithm.isin(names)].normalised)), "what the profile is made of"
    words = re.findall(r"[-\d.]+", cells_table(exact["cells"]))
    assert "-0" not in words
    assert not shown or any(word.startswith(shown) for word in words), "not 1 and 0"


def test_small_returns_are_aggregated_with_their_digits(monkeypatch):
    monkeypatch.setattr(benchmarks.bootstrap, "REPETITIONS", 10)
    tidy = _tidy(["sac"], guider=True).query("task == 'Ant'")
    tidy = tidy.assign(learner=tidy.learner / 1e6, guider=tidy.guider / 1e6)
    (cell,) = summarise_cells(tidy, "sac")
    assert (cell["final"], cell["final_mean"], cell["final_iqm"][0]) == ([0.002, 0.004], 0.003, 0.003)
    assert (cell["area_iqm"][0], cell["guider_mean"]) == (0.00225, 0.003005)
    (scale,) = compare(tidy)["compared"]["cells"]
    assert (scale["low"], scale["high"]) == (0.0015, 0.003)
    assert "| 0.00200, 0.00400 | 0.00300 [" in cells_table([cell])
    assert "0.00200, 0.00400" in returns_table([cell])
    small = cell | {"noise": 0.005, "final": [2487.4, 9360.0], "final_mean": 5923.7}
    assert "| 2487, 9360 | 5924 [" in cells_table([small])
    assert "2,487, 9,360" in returns_table([small])
    assert ">0.005<" in returns_table([small])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (9360.4, "9,360"),
        (100.4, "100"),
        (99.96, "100"),
        (38.25, "38.2"),
        (-0.0, "0"),
        (-0.4, "-0.400"),
        (0.0123, "0.0123"),
        (1e-17, "1e-17"),
        (math.inf, "inf"),
        (math.nan, "nan"),
    ],
)
def test_a_return_of_any_size_has_at_least_three_digits(value, text):
    assert number(value) == text


@pytest.mark.parametrize("name", ["noise0.1", "plain"])
def test_a_dot_in_the_name_of_results_begins_no_suffix(name, tmp_path, monkeypatch):
    for suffix in (".csv", ".json"):
        shutil.copy(RESULTS / f"std{suffix}", tmp_path / f"{name}{suffix}")
    monkeypatch.setattr(benchmarks.bootstrap, "REPETITIONS", 10)
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path / name), "--formats", "png"])
    main()
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.{suffix}" for suffix in ("csv", "json", "html", "png")}
    assert f"<title>{name}</title>" in (tmp_path / f"{name}.html").read_text()
    assert not read_together([tmp_path / name]).empty
    assert read_results(tmp_path / name, []) == {}
