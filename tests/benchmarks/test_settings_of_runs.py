"""Which finished runs count: those of the suite's settings, arguments and normalisation; and what results keep of them."""

import json
from contextlib import nullcontext
from dataclasses import asdict, replace

import pandas as pd
import pytest
import yaml

import benchmarks.aggregate
import benchmarks.bootstrap
from benchmarks.aggregate import finished_runs, origins
from benchmarks.config import resolve
from benchmarks.finished import FinishedRun, conflicts, is_finished, name_of, read_results
from benchmarks.launch import jobs_left
from benchmarks.page.document import _origin
from benchmarks.page.summary import in_short
from benchmarks.page.tables import with_surroundings
from benchmarks.recorded import with_defaults
from benchmarks.run import _refuse_other_settings, run
from benchmarks.suite import RunSpec, read_suite
from sb3_gac import GAC
from tests.benchmarks.helpers import SMALL_SUITE

CELL = {"task": "Pendulum", "noises": [0.1], "algorithms": ["gac", "sac-asym"], "seeds": [0, 1]}
NORMALIZED = {"mine": {"class": "gac", "normalize": {"clip_obs": 5.0}}}


@pytest.fixture(autouse=True)
def _few_resamples(monkeypatch):
    monkeypatch.setattr(benchmarks.bootstrap, "REPETITIONS", 20)


def _suite(directory, *cells, **changes):
    path = directory / "suite.yml"
    path.write_text(yaml.safe_dump({**SMALL_SUITE, "cells": list(cells or [CELL]), **changes}))
    return path


def _finish(spec, root, change=lambda configuration: None, learner=1.0):
    """The files of a finished run, as nobody has made it."""
    directory = spec.directory(root)
    directory.mkdir(parents=True, exist_ok=True)
    configuration = {"run": asdict(spec), "arguments": resolve(spec)[1], "commit": "0", "versions": {}, "cpus": 1}
    change(configuration)
    (directory / "config.yaml").write_text(yaml.safe_dump(configuration))
    rows = {"timesteps": [20, 40, 60], "learner": [0.1, 1 / 3, learner + spec.seed], "kl": [None, 0.5, 0.25]}
    pd.DataFrame(rows).to_csv(directory / "evaluations.csv", index=False)
    (directory / "timing.json").write_text(json.dumps({"seconds": 60.0}))
    return directory


def _aggregate(suite, root, out, *more):
    benchmarks.aggregate.main([str(suite), "--runs", str(root), "--out", str(out), *map(str, more)])
    return json.loads(out.with_suffix(".json").read_text())


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda one: one["arguments"].update(tau=0.5), "arguments.tau"),
        (lambda one: one["arguments"]["policy_kwargs"].update(net_arch=[5]), "arguments.policy_kwargs.net_arch"),
        (lambda one: one["arguments"].update(ent_coef=0.3), "arguments.ent_coef"),
        (lambda one: one.update(normalize={"clip_obs": 5.0}), "normalize"),
    ],
)
def test_a_finished_run_with_other_arguments_is_neither_skipped_nor_counted(tmp_path, change, named):
    suite = _suite(tmp_path)
    specs = read_suite(suite)
    for spec in specs:
        _finish(spec, tmp_path)
    assert jobs_left(suite, tmp_path) == ([], 4)
    directory = _finish(specs[0], tmp_path, change)
    for program in (
        lambda: run(specs[0], tmp_path),
        lambda: jobs_left(suite, tmp_path),
        lambda: finished_runs(suite, tmp_path),
    ):
        with pytest.raises(ValueError, match=rf"{directory} holds a run with other settings under \['{named}'\]: remove it"):
            program()
    with pytest.raises(SystemExit, match=named):
        _aggregate(suite, tmp_path, tmp_path / "made")


def _suite_with(directory, **arguments):
    return _suite(directory, overrides=SMALL_SUITE["overrides"] | arguments)


@pytest.mark.parametrize(
    ("now", "missing", "named"),
    [
        ({"gamma": 0.99}, "gamma", None),
        ({"gamma": 0.1}, "gamma", "arguments.gamma"),
        ({"kl_coef_bounds": [0.0001, 100.0]}, "kl_coef_bounds", None),  # whose default is a tuple
        ({"policy_kwargs": {"net_arch": [4], "n_critics": 2}}, "n_critics", None),
        ({"policy_kwargs": {"net_arch": [4], "n_critics": 3}}, "n_critics", "arguments.policy_kwargs.n_critics"),
        ({}, "policy_kwargs", "arguments.policy_kwargs.net_arch"),
        ({"policy_kwargs": {"optimizer_class": "torch.optim:Adam"}}, "optimizer_class", None),  # which YAML can't say
    ],
)
def test_an_argument_that_was_not_recorded_had_its_default(now, missing, named, tmp_path):
    spec, *_ = read_suite(_suite_with(tmp_path, **now))

    def without(configuration):
        arguments = configuration["arguments"]
        del (arguments if missing in arguments else arguments["policy_kwargs"])[missing]

    _finish(spec, tmp_path, without)
    if named is None:
        assert is_finished(spec, tmp_path)
        return
    with pytest.raises(ValueError, match=rf"other settings under \['{named}'\]: remove it"):
        is_finished(spec, tmp_path)


class Patient(GAC):
    """Hands on most arguments, as one's own algorithms do."""

    def __init__(self, *args, patience=3, **kwargs):
        super().__init__(*args, **kwargs)


def test_the_defaults_of_ancestors_count_where_a_constructor_hands_arguments_on():
    wanted = {"patience": 4, "gamma": 0.1, "tau": 1, "unknown": 2, "policy_kwargs": {"n_critics": 3}}
    complete = with_defaults(Patient, {"tau": 0.5}, wanted)
    assert complete == {"patience": 3, "gamma": 0.99, "tau": 0.5, "policy_kwargs": {"n_critics": 2}}


def test_what_no_version_recorded_is_no_other_value(tmp_path):
    suite = _suite(tmp_path)
    spec, *_ = read_suite(suite)
    _finish(spec, tmp_path, lambda one: one.pop("arguments"))
    assert is_finished(spec, tmp_path)
    _finish(spec, tmp_path, lambda one: one["run"].pop("eval_episodes"))
    with pytest.raises(ValueError, match=r"\['eval_episodes'\]"):
        is_finished(spec, tmp_path)


def test_a_finished_run_with_former_names_of_arguments_counts(tmp_path):
    suite = _suite(tmp_path, overrides=SMALL_SUITE["overrides"] | {"shared_std": "guider"})

    def former(value, configuration):
        for one in (configuration["run"]["overrides"], configuration["arguments"]):
            one.pop("shared_std")
            one["std_of"] = value

    spec = read_suite(suite)[0]
    _finish(spec, tmp_path, lambda one: former("guider", one))
    assert is_finished(spec, tmp_path)
    _finish(spec, tmp_path, lambda one: former("learner", one))
    with pytest.raises(ValueError, match=r"\['overrides', 'arguments.shared_std'\]"):
        is_finished(spec, tmp_path)


@pytest.mark.filterwarnings("ignore:.*has no arguments at noise")
@pytest.mark.parametrize("noise", [0.33333333, 0.1 + 0.2, 1e-7])
def test_a_noise_of_many_digits_is_found_in_results(noise, tmp_path):
    suite = _suite(tmp_path, CELL | {"noises": [noise]})
    for spec in read_suite(suite):
        _finish(spec, tmp_path)
    first = _aggregate(suite, tmp_path, tmp_path / "first")
    again = _aggregate(suite, tmp_path / "none", tmp_path / "again", "--reuse-results", tmp_path / "first")
    assert first["cells"] == again["cells"]
    assert {cell["noise"] for cell in again["cells"]} == {noise}
    assert (tmp_path / "first.csv").read_bytes() == (tmp_path / "again.csv").read_bytes()


def test_a_run_with_the_same_normalisation_counts(tmp_path):
    suite = _suite(tmp_path, CELL | {"algorithms": ["mine"]}, algorithms=NORMALIZED)
    spec = read_suite(suite)[0]
    _finish(spec, tmp_path, lambda one: one.update(normalize={"clip_obs": 5.0}))
    assert is_finished(spec, tmp_path)
    _finish(spec, tmp_path)
    with pytest.raises(ValueError, match=r"\['normalize'\]"):
        is_finished(spec, tmp_path)


@pytest.mark.parametrize("before", [None, {"clip_obs": 5.0}])
@pytest.mark.parametrize("now", [None, {"clip_obs": 5.0}])
def test_an_unfinished_run_goes_on_with_the_same_normalisation_alone(before, now, tmp_path):
    path = tmp_path / "config.yaml"
    then, today = ({"run": {}, "arguments": {}} | ({"normalize": one} if one else {}) for one in (before, now))
    path.write_text(yaml.safe_dump(then))
    with nullcontext() if before == now else pytest.raises(ValueError, match=r"under \['normalize'\]: remove it first"):
        _refuse_other_settings(path, GAC, today)


def test_conflicts_by_hand():
    recorded = {"a": 1, "b": {"c": 2, "d": [3]}, "e": None}
    assert conflicts("x", recorded, recorded | {"f": 4}) == []
    assert conflicts("x", recorded, {"a": 1, "b": {"c": 0, "d": [4], "g": 5}}) == ["x.e", "x.b.c", "x.b.d"]
    assert conflicts("x", {"b": {}}, {"b": 1}) == ["x.b"]


def test_seeds_of_one_algorithm_with_other_arguments_are_not_averaged():
    spec = RunSpec("gac", "Hopper", 0.1, 0, 20, 1, "small", 10, 1)
    rows = pd.DataFrame({"timesteps": [20], "learner": [1.0]})

    def made_of(*arguments, normalize=(None, None, None)):
        runs = [
            FinishedRun(replace(spec, seed=seed), rows, given, [], 1.0, 1, normalize[seed])
            for seed, given in enumerate(arguments)
        ]
        return origins([*runs, FinishedRun(replace(spec, algorithm="sac"), rows, {"tau": 9}, [], 1.0, 1)])

    recorded = made_of({"tau": 0.005}, {}, {"tau": 0.005, "b": 2}, normalize=(None, False, False))
    assert recorded["normalize"] == {"gac, Hopper, noise 0.1": False}
    for arguments, normalize, named in (
        (({"tau": 0.1}, {"tau": 0.1}, {"tau": 0.2}), (None, None, None), r"seed0 and .*seed2 .*values of \['arguments.tau'\]"),
        (({"tau": 0.1}, {}, {"tau": 0.1}), (None, None, None), r"seed0 and .*seed1 .*different values of \['arguments.tau'\]"),
        (({}, {}, {}), (None, False, {"clip_obs": 5.0}), r"seed1 and .*seed2 .*different values of \['normalize'\]"),
    ):
        with pytest.raises(ValueError, match=named):
            made_of(*arguments, normalize=normalize)


def test_results_record_normalisation_and_count_for_the_same_one_alone(tmp_path):
    suite = _suite(tmp_path, CELL | {"algorithms": ["mine", "sac-asym"]}, algorithms=NORMALIZED)
    specs = read_suite(suite)
    for spec in specs:
        options = {"normalize": {"clip_obs": 5.0}} if spec.algorithm == "mine" else {}
        _finish(spec, tmp_path, lambda one, options=options: one.update(options))
    record = _aggregate(suite, tmp_path, tmp_path / "made")
    mine, other = "mine, Pendulum, noise 0.1", "sac-asym, Pendulum, noise 0.1"
    assert record["normalize"] == {mine: {"clip_obs": 5.0}, other: False}
    found = read_results(tmp_path / "made", specs)
    assert [found[name_of(spec)].normalize for spec in specs[:2]] == [{"clip_obs": 5.0}, False]
    for normalize, counted in (({mine: False}, 2), ({other: {}}, 2), ({}, 4), (None, 4)):
        changed = record | {"normalize": normalize} if normalize is not None else record
        changed = {key: value for key, value in changed.items() if key != "normalize" or normalize is not None}
        (tmp_path / "made.json").write_text(json.dumps(changed))
        assert len(read_results(tmp_path / "made", specs)) == counted, "what was not recorded is no other value"


def test_each_run_of_several_machines_has_its_number_of_processors(tmp_path):
    suite = _suite(tmp_path, CELL, CELL | {"noises": [0.2]})
    specs, cpus = read_suite(suite), [2, 2, 16, 2, 2, 8, 4]
    for spec, number in zip(specs, cpus, strict=False):
        _finish(spec, tmp_path / "runs", lambda one, number=number: one.update(cpus=number))
    record = _aggregate(suite, tmp_path / "runs", tmp_path / "made", "--complete-cells")
    assert record["cpus"] == 16
    assert [run["cpus"] for run in (record["runs"] | record["set_aside"]).values()] == cpus
    found = read_results(tmp_path / "made", specs)
    assert [found[name_of(spec)].cpus for spec in specs[:-1]] == cpus
    same = {"runs": {name: {"seconds": 1.0, "made_with": [0]} for name in record["runs"]}, "cpus": 3}
    (tmp_path / "made.json").write_text(json.dumps(record | same))
    assert {run.cpus for run in list(read_results(tmp_path / "made", specs[:4]).values())} == {3}


def test_the_page_tells_normalisation_and_needed_runs_apart():
    kinds = [f"{name}, Hopper, noise 0.1" for name in ("gpo", "taught")]
    results = {
        "command": "c",
        "arguments": {kind: {"tau": 1} for kind in kinds},
        "normalize": {kinds[0]: {"clip_obs": 5.0}, kinds[1]: False},
        "particulars": {kinds[1]: {"needs": {"teacher": {"algorithm": "sac-full", "steps": 40}}, "history": 4}},
    }
    assert with_surroundings(results) == {
        kinds[0]: {"tau": 1, "normalize": {"clip_obs": 5.0}},
        kinds[1]: {"tau": 1, "normalize": "nothing", "needs": {"teacher": {"algorithm": "sac-full", "steps": 40}}},
    }
    shown = _origin(results)
    for row in ("normalize.clip_obs</td><td class=short-text>5.0<", "needs.teacher.algorithm</td><td class=short-text></td>"):
        assert row in shown
    without = {key: value for key, value in results.items() if key not in ("normalize", "particulars")}
    assert with_surroundings(without) == results["arguments"]
    assert "<p>They have the same arguments.</p>" in _origin(without)


def test_finished_runs_of_incomplete_cells_are_kept_beside_those_that_count(tmp_path, capsys):
    suite = _suite(tmp_path, CELL, CELL | {"noises": [0.2]})
    specs = read_suite(suite)
    for spec in specs[:-1]:
        _finish(spec, tmp_path / "runs")
    record = _aggregate(suite, tmp_path / "runs", tmp_path / "made", "--complete-cells")
    names = [name_of(spec) for spec in specs]
    assert list(record["runs"]) == names[:4]
    assert list(record["set_aside"]) == names[4:7]
    assert record["still_to_run"] == names[7:]
    assert "3 finished runs are set aside, since other runs of their cells are missing: ['small-60/" in capsys.readouterr().err
    assert set(pd.read_csv(tmp_path / "made.csv").noise) == {0.1}
    assert in_short(record)[-1] == "3 finished runs are set aside, since other runs of their cells are missing."
    assert names[4] in _origin(record)

    again = _aggregate(suite, tmp_path, tmp_path / "again", "--complete-cells", "--reuse-results", tmp_path / "made")
    assert again["set_aside"] == record["set_aside"], "nothing is lost with the directories"
    _finish(specs[-1], tmp_path / "runs-of-today")
    whole = _aggregate(suite, tmp_path / "runs-of-today", tmp_path / "whole", "--reuse-results", tmp_path / "again")
    assert list(whole["runs"]) == names
    assert whole["set_aside"] == {}
    rows = pd.read_csv(tmp_path / "whole.csv")
    kept = rows[(rows.noise == 0.2) & (rows.algorithm == "gac") & (rows.seed == 1)]
    assert kept.learner.tolist() == pytest.approx([0.1, 1 / 3, 2.0], rel=1e-5)
    assert kept.kl.isna().tolist() == [True, False, False]
    changed = _suite(tmp_path, CELL, CELL | {"noises": [0.2]}, overrides=SMALL_SUITE["overrides"] | {"tau": 0.5})
    assert read_results(tmp_path / "made", read_suite(changed)) == {}


def test_results_are_replaced_together_or_not_at_all(tmp_path, monkeypatch):
    suite = _suite(tmp_path)
    for spec in read_suite(suite):
        _finish(spec, tmp_path)
    _aggregate(suite, tmp_path, tmp_path / "made")
    before = {suffix: (tmp_path / f"made.{suffix}").read_bytes() for suffix in ("csv", "json")}
    for spec in read_suite(suite):
        _finish(spec, tmp_path, learner=7.0)

    def stopped(tidy):
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(benchmarks.aggregate, "compare", stopped)
        with pytest.raises(KeyboardInterrupt):
            _aggregate(suite, tmp_path, tmp_path / "made")
    assert {suffix: (tmp_path / f"made.{suffix}").read_bytes() for suffix in ("csv", "json")} == before
    _aggregate(suite, tmp_path, tmp_path / "made")
    assert all((tmp_path / f"made.{suffix}").read_bytes() != text for suffix, text in before.items())
    assert not list(tmp_path.glob("*.tmp"))
