"""``python -m sb3_gac.compare``: options become a suite, runs are made once, and the page says what follows."""

import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml
from gymnasium import spaces

from benchmarks import comparison, comparison_page, launch
from benchmarks.comparison import command, main, parse_arguments, suite_of_options
from benchmarks.config import first_gradient_step, reads_partial_alone
from benchmarks.headroom import worth
from benchmarks.run import run
from benchmarks.suite import RunSpec, cells_of, read_suite
from sb3_gac.checkpoint.lock import locked
from sb3_gac.optim.compile import missing_compiler

SPLIT = "sb3_gac.envs:SplitObservation: {partial: [0, 1], privileged: [2]}"
SMALL = "{learning_starts: 20, batch_size: 4, gradient_steps: 1, policy_kwargs: {net_arch: [4]}}"
SHORT = [
    "--env",
    "Pendulum-v1",
    "--wrappers",
    SPLIT,
    "--steps",
    "60",
    "--eval-episodes",
    "1",
    "--overrides",
    SMALL,
    "--jobs",
    "1",
]
MODULE = """
import gymnasium


def make_env(torque=2.0):
    env = gymnasium.make("Pendulum-v1")
    env.unwrapped.max_torque = torque
    return env
"""


class MiddleWins(gymnasium.Env):
    """Five steps, each of which rewards the middle action, 1.5, with 1."""

    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Box(1, 2, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.step_number = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.step_number += 1
        return np.zeros(1, np.float32), float(np.all(action == 1.5)), self.step_number == 5, False, {}


class Broken(MiddleWins):
    """An environment with an error that says nothing."""

    def __init__(self):
        raise NotImplementedError


class Numbers(MiddleWins):
    """The same with two actions, neither of which is in the middle."""

    action_space = spaces.Discrete(2)


class InProcess:
    """An engine that makes runs here, and counts them."""

    cpus = 1

    def __init__(self):
        self.made = 0

    def run(self, command, log):
        suite, index, runs = (command[command.index(name) + 1] for name in ("--suite", "--index", "--runs"))
        run(read_suite(Path(suite))[int(index)], Path(runs))
        self.made += 1
        return 0


@pytest.fixture
def engine(monkeypatch, tmp_path):
    engine = InProcess()
    monkeypatch.setattr(launch, "LocalEngine", lambda: engine)
    monkeypatch.setattr("benchmarks.bootstrap.REPETITIONS", 10)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", "")
    return engine


def _compare(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["compare", *map(str, arguments)])
    main("What it is for")


def _specs(*arguments):
    suite = yaml.safe_load(yaml.safe_dump(_suite(*arguments)))
    return [spec for cell in cells_of("suite.yml", suite) for spec in cell]


def _suite(*arguments):
    return suite_of_options(parse_arguments(None, [*map(str, arguments)]))


def test_a_comparison_from_its_command_to_its_page(engine, monkeypatch, tmp_path, capsys):
    _compare(monkeypatch, *SHORT, "--seeds", 1)
    assert engine.made == 4
    out = capsys.readouterr().out
    page = tmp_path / "comparisons" / "Pendulum-v1" / "index.html"
    assert out.endswith(f"Page: {page}\n")
    text = page.read_text()
    for name in (
        "SAC on the full state",
        "SAC-asym",
        "GAC",
        "SAC on partial alone",
        "random actions",
        "Headroom over training",
    ):
        assert name in text
    assert "python -m sb3_gac.compare --env Pendulum-v1" in text
    _compare(monkeypatch, *SHORT, "--seeds", 2, "--algorithms", "sac")
    assert engine.made == 5, "the first seed is there already"
    _compare(monkeypatch, *SHORT, "--seeds", 2, "--algorithms", "sac")
    assert engine.made == 5


@pytest.mark.parametrize(("random_return", "bold"), [(5.0, ["SAC-asym"]), (50.0, [])])
def test_the_best_row_is_bold_where_something_was_learned(random_return, bold):
    """And no row is, if random actions return more than all that was trained."""
    returns = {"sac-full": 20.0, "sac-asym": 11.0, "gac": 10.0}
    rows = [
        {"algorithm": name, "seed": seed, "timesteps": step, "learner": value + 0.1 * seed}
        for name, value in returns.items()
        for seed in range(3)
        for step in range(1, 5)
    ]
    untrained = {"random actions": np.linspace(random_return - 0.1, random_return + 0.1, 5)}
    found = worth(pd.DataFrame(rows), untrained, {"sac-asym", "gac"})
    marked = re.findall(r"<tr class=best><td[^>]*>([^<]*)", comparison_page._ends_table(found))
    assert marked == bold


@pytest.mark.parametrize(("seeds", "bands"), [(2, 0), (3, 2)])
def test_the_axis_fits_late_returns_and_bands_need_three_seeds(seeds, bands):
    rows = [
        {"algorithm": name, "seed": seed, "timesteps": step, "learner": -900.0 if step == 1 else step + seed}
        for name in ("sac", "gac")
        for seed in range(seeds)
        for step in range(1, 13)
    ]
    figure = comparison_page._curves(pd.DataFrame(rows), "random actions", -5.0)
    floor = figure.data[-1]
    assert (floor.name, list(floor.x), list(floor.y)) == ("random actions, without training", [1, 12], [-5.0, -5.0])
    assert not figure.layout.annotations, "which would hide the ends of curves"
    assert len([line for line in figure.data if line.fill]) == bands
    margin = 0.08 * (12 + seeds - 1 + 5)
    assert figure.layout.yaxis.range == pytest.approx((-5 - margin, 12 + seeds - 1 + margin))


def test_the_command_on_the_page_is_the_same_comparison():
    given = [
        "--env",
        "m:make",
        "--env-kwargs",
        "{noise: 0.2, kind: a b}",
        "--wrappers",
        SPLIT,
        "m:Other",
        "--seeds",
        "3",
        "--whole-state",
    ]
    given += ["--steps", "900", "--algorithms", "sac-asym", "gac", "--preset", "sb3", "--overrides", "{gamma: 0.9}"]
    options = parse_arguments(None, given)
    again = parse_arguments(None, shlex.split(command(options))[3:])
    assert vars(again) == vars(options)
    assert SPLIT in shlex.split(command(options)), "as it was typed"


def test_critics_see_every_entry_unless_privileged_is_the_whole_state():
    assert _suite("--env", "m:make")["overrides"]["role_keys"] is None
    assert "role_keys" not in _suite("--env", "m:make", "--whole-state")["overrides"]
    assert "role_keys" not in _suite("--env", "sb3_gac/Hopper-v5")["overrides"], "whose preset knows"


def test_a_registered_task_has_its_own_settings():
    (cell,) = _suite("--env", "sb3_gac/Hopper-v5", "--env-kwargs", "{noise_std: 0.3, history: 4}")["cells"]
    assert (cell["task"], cell["noises"], cell["history"]) == ("Hopper", [0.3], 4)
    behind_a_module = _suite("--env", "sb3_gac:sb3_gac/Hopper-v5", "--env-kwargs", "{noise_std: 0.3, history: 4}")
    assert behind_a_module == _suite("--env", "sb3_gac/Hopper-v5", "--env-kwargs", "{noise_std: 0.3, history: 4}")
    suite = _suite("--env", "sb3_gac/HopperPixels-v5")
    assert (suite["preset"], suite["cells"][0]["noises"]) == ("pixels", [0.0])
    (cell,) = _suite("--env", "sb3_gac/Hopper-v5", "--env-kwargs", "{privileged: velocity}")["cells"]
    assert cell["env"] == "sb3_gac/Hopper-v5", "with arguments that the task's settings are not for"


def test_gradient_steps_are_compiled_where_it_pays():
    assert _suite("--env", "m:make", "--steps", 10_000)["overrides"]["compile"] == "auto"
    assert "compile" not in _suite("--env", "m:make", "--steps", 9_000)["overrides"]
    assert _suite("--env", "m:make", "--overrides", "{compile: false}")["overrides"]["compile"] is False
    assert "compile" not in _suite("--env", "m:make", "--algorithms", "sac-asym", "sb3-sac")["overrides"], "SB3 has no such"
    assert _suite("--env", "m:make", "--algorithms", "gpo-clip", "random-actions")["overrides"]["compile"] == "auto"


def test_runs_are_the_same_with_a_compiler_and_without(monkeypatch):
    with_compiler = _suite("--env", "m:make")
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert missing_compiler(th.device("cpu")) == "C++ compiler (no-such-compiler)", "or nothing is tested"
    assert _suite("--env", "m:make") == with_compiler


def test_a_function_that_makes_an_environment(engine, monkeypatch, tmp_path, capsys):
    (tmp_path / "my_own_envs.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    arguments = [word if word != "Pendulum-v1" else "my_own_envs:make_env" for word in SHORT]
    _compare(monkeypatch, *arguments, "--env-kwargs", "{torque: 1.0}", "--algorithms", "sac", "--seeds", 1)
    suite = yaml.safe_load((tmp_path / "comparisons" / "make_env" / "suite.yml").read_text())
    assert suite["cells"][0]["env_kwargs"] == {"torque": 1.0}
    assert engine.made == 1
    assert "has changed" not in capsys.readouterr().out
    (tmp_path / "my_own_envs.py").write_text(MODULE.replace("max_torque", "max_speed"))
    _compare(monkeypatch, *arguments, "--env-kwargs", "{torque: 1.0}", "--algorithms", "sac", "--seeds", 1)
    assert engine.made == 1
    assert "The code of my_own_envs has changed since 1 of the runs in " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "Pendulum-v1"], "partial"),
        (["--env", "NoSuchEnvironment-v7"], "NoSuchEnvironment"),
        (["--env", "no_such_module:make"], "no_such_module"),
        (["--env", f"{__name__}:Broken"], "NotImplementedError: raise NotImplementedError (" + __file__),
        ([*SHORT, "--overrides", "{gama: 0.9}"], "gama"),
        ([*SHORT, "--overrides", "{1: 2, foo: 3}"], "has no arguments ['1', 'foo']"),
        (["--env", "Pendulum-v1", "--wrappers", "5"], "wrappers: must be module:Class"),
        ([*SHORT, "--out", __file__], "Not a directory"),
        (["--env", "sb3_gac/FetchReach-v4", "--env-kwargs", "{goal_entries: true}"], "sb3_gac.envs:AppendDesiredGoal"),
    ],
)
def test_what_is_wrong_is_said_before_the_first_run(engine, monkeypatch, arguments, message):
    with pytest.raises(SystemExit) as stop:
        _compare(monkeypatch, *arguments)
    assert message in str(stop.value)
    assert engine.made == 0
    assert not Path("comparisons").exists(), "nothing is left of what was refused"


def test_a_comparison_that_is_refused_leaves_an_earlier_one_as_it_was(engine, monkeypatch, tmp_path):
    _compare(monkeypatch, *SHORT, "--seeds", 1, "--algorithms", "sac")
    there = tmp_path / "comparisons/Pendulum-v1"
    before = {path: path.read_bytes() for path in there.iterdir() if path.is_file()}
    assert there / "suite.yml" in before
    for more, message in (
        (["--eval-episodes", 2], "other settings under ['eval_episodes', 'overrides', 'arguments.learning_starts']"),
        (["--overrides", "{nosuch: 1}"], "nosuch"),
    ):
        again = [*SHORT, "--seeds", 1, "--algorithms", "sac", "--overrides", SMALL.replace("20", "30"), *more]
        with pytest.raises(SystemExit) as stop:
            _compare(monkeypatch, *again)
        assert message in str(stop.value)
        assert {path: path.read_bytes() for path in there.iterdir() if path.is_file()} == before
    assert engine.made == 1
    (evaluations,) = there.glob("runs/**/evaluations.csv")
    evaluations.unlink()  # so that the run was begun and is not finished
    with pytest.raises(SystemExit, match=r"unfinished run with other settings under \['run', 'arguments'\]"):
        _compare(monkeypatch, *SHORT, "--seeds", 1, "--algorithms", "sac", "--overrides", SMALL.replace("20", "30"))
    assert {path: path.read_bytes() for path in there.iterdir() if path.is_file()} == before


def test_a_second_comparison_in_the_same_directory_is_refused(engine, monkeypatch, tmp_path):
    runs = tmp_path / "comparisons/Pendulum-v1/runs"
    runs.mkdir(parents=True)
    with locked(runs), pytest.raises(SystemExit, match=r"Another process is running .*runs"):
        _compare(monkeypatch, *SHORT, "--seeds", 1, "--algorithms", "sac")
    assert not (runs.parent / "suite.yml").exists()
    assert engine.made == 0


@pytest.mark.parametrize("error", [ImportError("--engine ray needs ray"), ConnectionError("no cluster")])
def test_a_cluster_that_is_not_there_leaves_nothing_behind(error, engine, monkeypatch, tmp_path):
    def no_engine(address):
        raise error

    monkeypatch.setattr(launch, "RayEngine", no_engine)
    with pytest.raises(SystemExit, match=str(error)):
        _compare(monkeypatch, *SHORT, "--seeds", 1, "--algorithms", "sac", "--ray", "auto")
    assert not (tmp_path / "comparisons").exists()


@pytest.mark.parametrize(("steps", "overrides"), [(80, "{}"), (2_000, "{}"), (60, "{learning_starts: 60}")])
def test_runs_without_a_gradient_step_are_refused(steps, overrides, engine, monkeypatch):
    """The preset small makes none before 2,000 steps."""
    given = ["--env", "Pendulum-v1", "--wrappers", SPLIT, "--steps", steps, "--overrides", overrides]
    with pytest.raises(
        SystemExit, match=r"--steps: sac-full makes its first gradient step after .* nothing is learned"
    ) as stop:
        _compare(monkeypatch, *given)
    assert f"in {steps:,} steps" in str(stop.value)
    assert engine.made == 0
    specs = _specs("--env", "m:make", "--steps", 2_001)
    assert [first_gradient_step(spec) for spec in specs] == [2_000] * 20
    comparison._check_steps(specs)
    assert first_gradient_step(_specs("--env", "m:make", "--algorithms", "gpo-clip")[0]) == 0, "rollouts come at once"
    assert first_gradient_step(replace(specs[0], algorithm="sb3-sac", preset="sb3", overrides={})) == 2_000


@pytest.mark.parametrize(("name", "wrapper"), [("make_foreign", "SplitObservation"), ("make_unsplit", "SplitDictObservation")])
def test_an_environment_whose_observations_are_not_split_is_refused_without_the_words_of_a_suite(
    name, wrapper, engine, monkeypatch
):
    env_id = f"tests.training.test_options:{name}"
    with pytest.raises(SystemExit, match=rf"^--env: the observations of {env_id} .* returns sb3_gac.envs.{wrapper}\("):
        _compare(monkeypatch, "--env", env_id)
    assert engine.made == 0


def test_what_can_be_deployed_is_decided_by_what_the_deployed_policy_reads():
    names = ("sac-full", "sac-asym", "gac", "sac", "sb3-sac", "gpo-clip", "rma", "tgrl", "dreamer-v3")
    spec = replace(_specs("--env", "m:make")[0], overrides={"role_keys": None}, environment=None, task="Hopper")
    presets = {name: "sb3" if name == "sb3-sac" else "small" for name in names}
    read = {name: reads_partial_alone(replace(spec, algorithm=name, overrides={}, preset=presets[name])) for name in names}
    assert [name for name in names if not read[name]] == ["sac-full", "sb3-sac"]
    seeing = {"role_keys": {"learner": ["partial", "privileged"]}}
    for overrides in (seeing, {"policy_kwargs": seeing, "role_keys": None}):
        assert not reads_partial_alone(replace(spec, algorithm="gac", overrides=overrides))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "0"], "must be an integer of at least 1"),
        (["--env-kwargs", "noise"], "must be a mapping"),
        (["--env-kwargs", "{noise: ["], "is no YAML"),
        (["--algorithms", "ppo"], 'there is no "ppo"'),
    ],
)
def test_bad_options_are_named(capsys, arguments, message):
    with pytest.raises(SystemExit):
        parse_arguments(None, ["--env", "m:make", *arguments])
    assert message in capsys.readouterr().err


def test_returns_without_training_are_read_again_only_where_they_are_of_the_same_environment(tmp_path, monkeypatch):
    played = []
    monkeypatch.setattr(comparison, "evaluate_policy", lambda *_, **__: (played.append(1) or [float(len(played))], []))
    path = tmp_path / "untrained.json"
    spec = RunSpec("sac", "Pendulum", 0.1, 0, 60, 1, "small", 20, 1)
    own = {"id": "Pendulum-v1", "kwargs": {"g": 9.0}, "wrappers": []}
    specs = [
        spec,
        replace(spec, noise=0.2),
        replace(spec, history=3),
        replace(spec, environment=own),
        replace(spec, environment=own | {"kwargs": {"g": 1.0}}),
        replace(spec, environment=own | {"wrappers": [{"gymnasium.wrappers:ClipReward": {"max_reward": 1}}]}),
    ]
    for number, other in enumerate(specs, 1):
        expected = {"random actions": [2 * number - 1], "the middle action": [2 * number]}
        assert comparison.untrained_returns(other, path) == comparison.untrained_returns(other, path) == expected
    assert comparison.untrained_returns(replace(specs[-1], seed=3, algorithm="gac"), path) == expected
    path.write_text(path.read_text()[:9])  # by a full disk
    assert comparison.untrained_returns(specs[-1], path) == {"random actions": [13], "the middle action": [14]}


def test_policies_without_training_by_hand(tmp_path):
    own = {"id": f"{__name__}:MiddleWins", "kwargs": {}, "wrappers": []}
    spec = RunSpec("sac", "x", 0.0, 0, 60, 2, "small", 20, 3, environment=own)
    returns = comparison.untrained_returns(spec, tmp_path / "untrained.json")
    assert set(returns["the middle action"]) == {5.0}
    assert max(returns["random actions"]) < 5
    assert {len(of_episodes) for of_episodes in returns.values()} == {30}
    without_middle = own | {"id": f"{__name__}:Numbers"}, own | {"wrappers": [{"gymnasium.wrappers:ClipAction": {}}]}
    for number, other in enumerate(without_middle):
        returns = comparison.untrained_returns(replace(spec, environment=other), tmp_path / f"{number}.json")
        assert list(returns) == ["random actions"]


def test_a_history_of_the_newest_observation_alone_is_none():
    for length, cell in ((1, {}), (2, {"history": 2})):
        (made,) = _suite("--env", "sb3_gac/Pendulum-v1", "--env-kwargs", f"{{history: {length}}}")["cells"]
        assert {key: value for key, value in made.items() if key == "history"} == cell


def test_a_run_that_fails_is_named_with_its_log(engine, monkeypatch):
    monkeypatch.setattr(engine, "run", lambda command, log: 1)
    with pytest.raises(SystemExit) as stop:
        _compare(monkeypatch, *SHORT, "--seeds", 1, "--algorithms", "sac")
    assert "1 run failed" in str(stop.value)
    assert "seed0/log.txt" in str(stop.value)


def test_help_from_anywhere(tmp_path):
    result = subprocess.run(
        [sys.executable, "-m", "sb3_gac.compare", "--help"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert "headroom" in result.stdout
    assert "--whole-state" in result.stdout
