"""The paper's figures and tables by number: what is drawn, of which runs, and that our numbers are the paper's."""

import json
import re

import matplotlib
import pandas as pd
import pytest
from matplotlib import pyplot as plt

from benchmarks.finished import name_of
from benchmarks.paper import __main__ as program
from benchmarks.paper import figures
from benchmarks.paper.figures import SCALES, Figure, Group, draw, needs, read_figures
from benchmarks.paper.tables import TABLES
from benchmarks.suite import read_suite

FIGURES = read_figures()


def _rows(table):
    lines = [line for line in table.splitlines() if line.startswith("| ")]
    return [re.split(r"\s+\| ", line.strip("|").strip()) for line in lines[2:]]


def _save(tmp_path, name, algorithms=("gac", "sac"), steps=(1000, 2000), **columns):
    rows = [
        {"task": "T", "noise": noise, "algorithm": algorithm, "seed": seed, "timesteps": step, "learner": step + 10 * seed}
        for noise in (0.3, 0.1)
        for algorithm in algorithms
        for seed in (0, 1)
        for step in steps
    ]
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).assign(**columns).to_csv(tmp_path / f"{name}.csv", index=False)


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """Draws a group of results below ``tmp_path``; what is drawn stays open."""
    monkeypatch.setattr(figures, "RESULTS", tmp_path)
    closed = []
    monkeypatch.setattr(figures.plt, "close", closed.append)

    def draw_group(**group):
        assert draw(Figure(0, "title", {"two-cores": [Group(**group)]}, []), "two-cores", tmp_path / "figure.png")
        return [axis for axis in closed[-1].axes if axis.axison]

    yield draw_group
    monkeypatch.undo()
    for figure in closed:
        plt.close(figure)


def test_there_are_all_of_the_papers_figures_and_tables():
    assert sorted(FIGURES) == list(range(1, 13)), "that show results; its tables are settings and sizes"
    assert sorted(TABLES) == list(range(2, 9))
    assert FIGURES[1].suites("two-cores") == ["first-figure", "baselines", "baselines-taught", "baselines-on-policy"]


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("number", sorted(FIGURES))
def test_every_figure_is_made_of_runs_that_suites_describe(number, scale):
    for group in FIGURES[number].groups[scale]:
        specs = [spec for name in (*group.suites, *group.ends) for spec in read_suite(figures.SUITES / f"{name}.yml")]
        assert set(group.algorithms) <= {spec.algorithm for spec in specs}, "an algorithm that no suite of the group has"
        assert set(group.tasks) <= {spec.title for spec in specs}
        assert set(group.noises) <= {spec.noise for spec in specs}
        assert set(group.panels) <= set(figures.LABELS)


@pytest.mark.parametrize("number", sorted(FIGURES))
def test_every_figure_is_drawn_at_once_or_has_no_results_yet(number, tmp_path, capsys):
    out = tmp_path / "figure.png"
    program.main(["figure", str(number), "--out", str(out)])
    told = capsys.readouterr().out
    assert told.startswith(f"Figure {number}: ")
    assert "Other than in the paper:" in told
    assert f"python -m benchmarks.paper figure {number} --run" in told
    suites = FIGURES[number].suites("two-cores")
    assert all(f"benchmarks/suites/{name}.yml: " in told for name in suites)
    has_results = any((figures.RESULTS / f"{name}.csv").exists() for name in suites)
    assert out.exists() == has_results
    assert ("Drawn so far:" in told) == has_results
    assert ("There is nothing to draw yet." in told) == (not has_results)


@pytest.mark.parametrize("number", sorted(FIGURES))
def test_what_differs_from_the_paper_is_said_of_all_that_is_drawn(number):
    """Networks, learning rates and the form of GAC, as the results record them; and games, where not all are drawn."""
    figure = FIGURES[number]
    said = " ".join(figure.differs)
    for group in figure.groups["two-cores"]:
        for name in group.suites:
            path = figures.RESULTS / f"{name}.json"
            recorded = json.loads(path.read_text())["arguments"] if path.exists() else {}
            wanted = {
                kind: one for kind, one in recorded.items() if kind.split(",")[0] in (group.algorithms or [kind.split(",")[0]])
            }
            for kind, arguments in wanted.items():
                assert f"{arguments['learning_rate']:g}" in said, kind
                assert str(arguments["policy_kwargs"]["net_arch"][0]) in said, kind
                if kind.startswith("gac"):
                    assert ("residual guider" in said) == (arguments.get("guider", "residual") == "residual"), kind
    assert ("20 times as fast" in said) == any("tgrl-scaled" in group.algorithms for group in figure.groups["two-cores"])


def test_cells_and_seeds_that_are_drawn_are_those_of_the_results(tmp_path, monkeypatch, capsys):
    first, second = figures.cells_drawn(FIGURES[2], "two-cores")
    assert "RepeatPreviousMedium" in second
    assert "RepeatPreviousMedium" not in first
    assert first.count("Easy") == second.count("Easy") == 5
    assert all(cells.endswith(": 3 seeds of each algorithm") for cells in (first, second))
    monkeypatch.setattr(figures, "RESULTS", tmp_path)
    _save(tmp_path, "one")
    table = pd.read_csv(tmp_path / "one.csv")
    table[(table.seed == 0) | (table.algorithm == "gac")].to_csv(tmp_path / "one.csv", index=False)
    groups = {"two-cores": [Group(["one"]), Group(["one"], algorithms=["sac"], noises=[0.1]), Group(["none"])]}
    cells = ["T, noise 0.1; T, noise 0.3: 1 to 2 seeds of each algorithm", "T, noise 0.1: 1 seed of each algorithm"]
    assert figures.cells_drawn(Figure(0, "title", groups, []), "two-cores") == cells
    program.show(Figure(0, "title", {"two-cores": []}, ["nothing"]), "two-cores", tmp_path / "figure.png")
    assert "Drawn so far" not in capsys.readouterr().out


def test_means_are_thick_seeds_thin_and_cells_in_order(drawn, tmp_path):
    _save(tmp_path, "one")
    low, high = drawn(suites=["one"])
    assert (low.get_title(), high.get_title()) == ("T, noise 0.1", "T, noise 0.3")
    gac = [line for line in low.lines if line.get_color() == low.lines[0].get_color()]
    assert [list(line.get_ydata()) for line in gac] == [[1005, 2005], [1000, 2000], [1010, 2010]]
    assert [line.get_linewidth() for line in gac] == [2.0, 0.7, 0.7]
    assert [text.get_text() for text in low.get_legend().get_texts()] == ["gac", "sac"]
    assert low.get_xlabel() == "thousand environment steps"


def test_what_is_not_asked_for_is_left_out(drawn, tmp_path):
    _save(tmp_path, "one")
    (axis,) = drawn(suites=["one"], algorithms=["sac"], noises=[0.3])
    assert axis.get_title() == "T, noise 0.3"
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["sac"]


def test_what_has_more_steps_is_a_line_across_at_its_end(drawn, tmp_path):
    _save(tmp_path, "one", algorithms=["gac"])
    _save(tmp_path, "longer", algorithms=["ppo"], steps=(1000, 8000))
    axis, _ = drawn(suites=["one"], ends=["longer"])
    line = axis.lines[-1]
    assert (line.get_label(), list(line.get_ydata())) == ("ppo after 8,000", [8005, 8005])


def test_steps_of_teachers_count(drawn, tmp_path):
    _save(tmp_path, "one", algorithms=["tgrl"], needed_steps=500)
    axis, _ = drawn(suites=["one"])
    assert list(axis.lines[0].get_xdata()) == [1500, 2500]


def test_kl_has_its_target_and_the_guider_is_dashed(drawn, tmp_path):
    _save(tmp_path, "one", algorithms=["gac"], guider=7.0, kl=0.004, target_kl=0.003)
    policies, kl, *_ = drawn(suites=["one"], panels=["policies", "kl"])
    guider = policies.lines[-1]
    assert (guider.get_label(), guider.get_linestyle(), list(guider.get_ydata())) == ("gac, guider", "--", [7.0, 7.0])
    assert [list(line.get_ydata()) for line in kl.lines] == [[0.004, 0.004], [0.003, 0.003]]
    assert kl.get_ylim()[1] / kl.get_ylim()[0] > 8, "a steady line looks steady"


def test_what_runs_it_takes_is_said(tmp_path, monkeypatch):
    assert needs("baselines-taught").startswith("36 runs of 12,500 steps, ")
    monkeypatch.setattr(figures, "RESULTS", tmp_path)
    assert needs("paper/figure-7") == "120 runs of 2,000,000 steps, none of them made yet"
    names = [name_of(spec) for spec in read_suite(figures.SUITES / "hopper.yml")]
    held = {"runs": {name: {} for name in [*names[:6], "of/another/suite"]}, "seconds_per_run": {"median": 120.0}}

    def said(**more):
        (tmp_path / "hopper.json").write_text(json.dumps(held | more))
        return needs("hopper").removeprefix("9 runs of 100,000 steps, ")

    made = "6 of them made in 2 minutes of a core each (median)"
    assert said(still_to_run=names[8:]) == made, "what the results hold, not what they do not miss"
    assert (
        said(set_aside={name: {} for name in names[6:8]})
        == f"{made}, 2 set aside, since other runs of their cells are missing"
    )
    assert said(runs={name: {} for name in names}, seconds_per_run={}) == "all made"


def test_the_number_of_runs_is_that_of_the_committed_table():
    """Five games of three algorithms and three seeds are in the table; the suite has fifteen games."""
    assert "135 runs of 20,000 steps, 45 of them made" in needs("popgym")


@pytest.mark.parametrize("committed", [(), ("baselines",)])
def test_run_launches_and_aggregates_all_suites_of_the_scale(committed, tmp_path, monkeypatch):
    """Runs that committed results hold are neither made again nor lost from these results."""
    commands, status = [], iter([0, 0, 0, 0, 3])

    class Ended:
        def __init__(self, command, check):
            commands.append(command[2:])
            self.returncode = next(status)

    monkeypatch.setattr(program.subprocess, "run", Ended)
    monkeypatch.setattr(program, "RESULTS", tmp_path)
    for name in committed:
        (tmp_path / f"{name}.json").touch()
    with pytest.raises(SystemExit, match=r"baselines-on-policy: launch ended with status 3\. The same command goes on\."):
        program.make(["first-figure", "baselines", "baselines-on-policy"], 2)
    suites = [str(figures.SUITES / f"{name}.yml") for name in ("first-figure", "baselines", "baselines-on-policy")]
    assert commands[0] == ["benchmarks.launch", suites[0], "--jobs", "2"]
    assert commands[1] == [
        "benchmarks.aggregate",
        suites[0],
        "--out",
        str(tmp_path / "first-figure"),
        "--complete-cells",
    ]
    reuse = ["--reuse-results", str(tmp_path / "baselines")] if committed else []
    assert commands[2] == ["benchmarks.launch", suites[1], "--jobs", "2", *reuse]
    assert commands[3][-len(reuse) - 1 :] == ["--complete-cells", *reuse]
    assert commands[4] == ["benchmarks.launch", suites[2], "--jobs", "2"]


def test_the_papers_settings_are_those_of_our_presets_of_its_tables():
    for number in (2, 5):
        for parameter, paper, ours, _ in _rows(TABLES[number]()):
            if parameter not in ("target_entropy", "target_kl"):
                assert ours == paper, f"table {number}, {parameter}"
    memory = {row[0]: row[1:] for row in _rows(TABLES[4]())}
    assert memory["number_of_timesteps"][0] == memory["number_of_timesteps"][1] == "10000000"
    assert memory["target_kl"][:2] == ["0.05", "0.05"]


def test_target_kl_by_task_and_noise_is_the_papers():
    rows = _rows(TABLES[3]())
    assert len(rows) == 20
    assert all(paper == ours for _, _, paper, ours, _ in rows)
    assert ["HalfCheetah", "0.2", "0.001", "0.001", "0.001"] in rows


def test_sizes_are_the_papers_but_for_one_task():
    for number, others in ((7, []), (8, ["h1touch-insert_small"])):
        rows = _rows(TABLES[number]())
        differ = [task for task, _, *paper, ours, _, hidden in rows if paper != [ours, hidden]]
        assert differ == others
    assert re.search(r"caption alone", TABLES[6]())


def test_a_number_that_the_paper_does_not_have_is_refused(capsys):
    for kind, number in (("figure", "13"), ("table", "1")):
        with pytest.raises(SystemExit):
            program.main([kind, number])
        assert "invalid choice" in capsys.readouterr().err


def test_pictures_need_no_screen():
    assert matplotlib.get_backend().lower() == "agg"
