"""What the command line of the main job takes, and what becomes of what it leaves out."""

import re
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from gymnasium import spaces

from sb3_gac.algorithms import ALGORITHMS
from sb3_gac.envs import PARTIAL
from sb3_gac.evaluation.settings import environment_of_run
from sb3_gac.train import parse_arguments
from sb3_gac.training.directory import in_words, new_directory
from sb3_gac.training.environments import find_modules_here
from sb3_gac.training.job import open_environments, prepare
from sb3_gac.training.options import DEFAULTS, algorithm_arguments, make_parser, resolve
from tests.helpers import Sampled, TwoViewBandit

OWN = "tests.training.test_options:make_own"


def make_own(mass=1.0):
    """An environment of one's own."""
    env = TwoViewBandit()
    env.mass = mass
    return env


def make_geared():
    """One with a third entry."""
    shown = {name: spaces.Box(-1, 1, (2,), np.float32) for name in ("partial", "privileged")}
    return Sampled(spaces.Dict(**shown, gear=spaces.Discrete(3)))


def make_unsplit():
    """One whose entries are none of ours."""
    return Sampled(spaces.Dict(gps=spaces.Box(-1, 1, (2,), np.float32), wind=spaces.Box(-1, 1, (2,), np.float32)))


def make_foreign():
    """One whose observations are none of ours."""
    return gym.make("CartPole-v1")


def test_help_has_the_defaults_and_needs_no_more_than_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = " ".join(make_parser().format_help().split())
    for name, value in DEFAULTS.items():
        if value and value is not True:
            assert f"(default: {value}" in text, name
    assert text.count("(default: ") == len(make_parser()._actions) - len({"help", "resume", "env", "teacher"})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", OWN, "--task", "Hopper"], "--task and --env: give one of them"),
        (["--env", OWN, "--noise", "0.1"], "--noise: an environment of one's own has its arguments in --env-kwargs"),
        (["--task", "Hopper", "--whole-state"], "--whole-state: whether privileged is the whole state"),
        (["--env", "sb3_gac/TigerDoor-v0", "--noise", "0.1"], "--noise: sb3_gac/TigerDoor-v0 has no such argument"),
        (["--noise", "0.1", "--env-kwargs", "{noise_std: 0.2}"], "--env-kwargs and --noise say different things"),
        (["--task", "Go1Getup", "--history", "2"], "--history: Go1Getup takes none"),
        (["--algorithm", "cosil"], "give --teacher runs/<its directory>/model.zip"),
        (["--algorithm", "tgrl", "--teacher", "nowhere.zip"], "--teacher: There is no file or directory nowhere.zip"),
        (["--algorithm", "tgrl", "--teacher", "tests"], "--teacher: tests has no model.zip: the run has not finished"),
        (["--runs", "pyproject.toml"], "--runs: pyproject.toml is a file: give a directory"),
        (["--runs", "pyproject.toml/runs"], "pyproject.toml is a file: give a directory"),
        (["--env-kwargs", "{noise_std: '0.2'}"], "noise_std must be a number, or a list of one for each component, got '0.2'"),
        (["--env-kwargs", "{noise_std: [0.1, x]}"], "noise_std must be a number, or a list of one for each component"),
        (["--overrides", "{1: 2}"], "--overrides: must have names of arguments as keys, got 1"),
        (["--overrides", "{seed: 3}"], "--overrides: seed is no argument of the preset: leave it out, and give --seed"),
        (
            ["--overrides", "{teacher: x}"],
            "teacher is no argument of the preset: leave it out, and give --teacher",
        ),
        (["--env", "sb3_gac:sb3_gac/TigerDoor-v0", "--noise", "0.1"], "--noise: sb3_gac/TigerDoor-v0 has no such argument"),
        (["--teacher", "model.zip"], "--teacher: GAC has none"),
        (["--steps", "0"], "--steps: must be an integer of at least 1, got 0"),
        (["--steps", "1e-4"], "--steps: must be an integer of at least 1, got 1e-4"),
        (["--env-kwargs", "3"], "must be a mapping"),
        (["--overrides", "{"], "is no YAML"),
    ],
)
def test_what_does_not_go_together_is_refused_by_name(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        parse_arguments(arguments)
    assert end.value.code == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_compiling_is_decided_by_the_run_unless_it_is_said():
    given = {(): "auto", ("--compile",): True, ("--compile", "no"): False, ("--compile", "auto"): "auto"}
    for arguments, expected in given.items():
        assert algorithm_arguments(parse_arguments(list(arguments)))["compile"] == expected


@pytest.mark.parametrize("algorithm", sorted(set(ALGORITHMS) - {"cosil", "tgrl"}))
def test_every_algorithm_without_a_teacher_can_be_made(algorithm, tmp_path):
    job = prepare(parse_arguments(["--env", OWN, "--algorithm", algorithm, "--runs", str(tmp_path)]))
    assert job.directory.name.startswith("make_own-seed0-" if algorithm == "gac" else f"{algorithm}-make_own-seed0-")
    assert parse_arguments(["--resume", str(job.directory)]).algorithm == algorithm


def test_a_teacher_is_the_file_of_another_run(tmp_path, monkeypatch):
    prepare(parse_arguments(["--env", OWN, "--runs", str(tmp_path)])).model.save(tmp_path / "teacher.zip")
    arguments = ["--env", OWN, "--algorithm", "cosil", "--runs", str(tmp_path), "--teacher"]
    job = prepare(parse_arguments([*arguments, str(tmp_path / "teacher.zip")]))
    assert job.model.teacher == str(tmp_path / "teacher.zip")
    assert parse_arguments([*arguments, str(tmp_path / "teacher")]).teacher == tmp_path / "teacher.zip"
    assert str(parse_arguments(["--resume", str(job.directory)]).teacher) == job.model.teacher
    monkeypatch.chdir(tmp_path)
    assert parse_arguments([*arguments, "teacher.zip"]).teacher == tmp_path / "teacher.zip"


def test_an_environment_of_ones_own_has_its_arguments_and_a_history_on_request(tmp_path):
    arguments = ["--env", OWN, "--env-kwargs", "{mass: 2.5}", "--history", "3", "--overrides", "{gamma: 0.5}"]
    job = prepare(parse_arguments([*arguments, "--tensorboard", "--runs", str(tmp_path)]))
    single = TwoViewBandit()
    n_actions, width = single.action_space.shape[0], single.observation_space[PARTIAL].shape[0]
    assert job.model.observation_space[PARTIAL].shape == (3 * width + 2 * n_actions,)
    assert job.model.env.get_attr("mass") == [2.5] * 4
    assert job.model.gamma == 0.5
    assert job.model.role_keys is None, "privileged need not be the whole state"
    assert job.model.tensorboard_log == str(job.directory / "tensorboard")
    again = parse_arguments(["--resume", str(job.directory)])
    assert (again.env_id, again.env_kwargs, again.history, again.tensorboard) == (OWN, {"mass": 2.5}, 3, True)
    configuration = yaml.safe_load((job.directory / "config.yaml").read_text())
    assert configuration["environment"]["kwargs"] == {"mass": 2.5}
    assert configuration["arguments"]["gamma"] == 0.5


def test_arguments_of_an_environment_are_kept_as_yaml_reads_them(tmp_path):
    text = "{mass: {0: 1.5, 1.5: a, true: b, null: c, names: [{2: x}], 2020-01-02: 2020-01-03}}"
    job = prepare(parse_arguments(["--env", OWN, "--env-kwargs", text, "--runs", str(tmp_path)]))
    job.alone.close()
    given = yaml.safe_load(text)
    assert job.options.env_kwargs == given
    assert parse_arguments(["--resume", str(job.directory)]).env_kwargs == given
    assert environment_of_run(job.directory).kwargs == given


def test_a_task_is_the_same_after_the_name_of_a_module(tmp_path):
    arguments = ["--env-kwargs", "{reset_noise_scale: 0.1}", "--env"]
    alone, behind = (parse_arguments([*arguments, f"{module}sb3_gac/Hopper-v5"]) for module in ("", "sb3_gac:"))
    assert (behind.task, behind.noise, behind.history, behind.env_id) == ("Hopper", 0.1, 4, "sb3_gac/Hopper-v5")
    assert algorithm_arguments(behind) == algorithm_arguments(alone)


def test_each_component_may_have_a_noise_of_its_own(tmp_path):
    arguments = ["--task", "Pendulum", "--envs", "1", "--runs", str(tmp_path), "--env-kwargs"]
    job = prepare(parse_arguments([*arguments, "{noise_std: [0.0, 0.2]}"]))
    assert job.directory.name.startswith("Pendulum-noise-by-component-history4-")
    again = parse_arguments(["--resume", str(job.directory)])
    for options in (job.options, again):
        assert options.env_kwargs == {"noise_std": [0.0, 0.2], "history": 4}
    assert in_words(again) == "sb3_gac/Pendulum-v1 (noise by component, history 4)"
    assert parse_arguments([*arguments, "{noise_std: [0.0, 0.0]}"]).history == 1
    by_component = parse_arguments(["--task", "Ant", "--env-kwargs", f"{{noise_std: {[0.2, 0.4] * 6 + [0.3]}}}"])
    assert algorithm_arguments(by_component) == algorithm_arguments(
        parse_arguments(["--task", "Ant", "--noise", "0.3"])
    ), "the mean"


def test_names_of_torchs_classes_are_classes_in_overrides_too():
    given = parse_arguments(["--overrides", "{policy_kwargs: {activation_fn: ReLU, optimizer_class: SGD}}"])
    of_policy = algorithm_arguments(given)["policy_kwargs"]
    assert (of_policy["activation_fn"], of_policy["optimizer_class"]) == (th.nn.ReLU, th.optim.SGD)
    assert of_policy["net_arch"] == [128, 128], "the preset's"


def test_hindsight_is_for_python(tmp_path):
    given = ["--overrides", "{replay_buffer_class: HerReplayBuffer}", "--runs", str(tmp_path)]
    with pytest.raises(
        ValueError, match=r"got 'HerReplayBuffer'\. .* train in Python with the class itself, as docs/goals\.md"
    ):
        prepare(parse_arguments(given))


def test_critics_see_the_whole_state_alone_where_privileged_is_said_to_be_it():
    options = parse_arguments(["--env", OWN, "--whole-state"])
    assert algorithm_arguments(options)["role_keys"] == {"critic": ["privileged"]}


def test_one_of_this_packages_environments_is_a_task_by_its_id():
    by_id = parse_arguments(["--env", "sb3_gac/Hopper-v5", "--env-kwargs", "{noise_std: 0.3, reset_noise_scale: 0.1}"])
    assert (by_id.task, by_id.noise, by_id.history) == ("Hopper", 0.3, 4)
    assert by_id.env_kwargs == {"noise_std": 0.3, "history": 4, "reset_noise_scale": 0.1}
    assert algorithm_arguments(by_id)["role_keys"] == {"critic": ["privileged"]}


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("no_such_module:Env-v0", "no_such_module"),
        ("NoSuch-v0", "NoSuch.* An id that a module of yours registers is my_module:NoSuch-v0"),
        ("tests.training.test_options:Nothing-v0", "Nothing"),
    ],
)
def test_an_environment_that_there_is_not_is_named(env_id, message, tmp_path):
    with pytest.raises(ValueError, match=rf"^{re.escape(env_id)}: .*{message}"):
        open_environments(parse_arguments(["--env", env_id]))


def test_nothing_is_written_for_an_environment_with_other_observations(tmp_path):
    module = "tests.training.test_options"
    for name, message in {
        "make_foreign": r"foreign are Box\(.* must be a Dict with .* a function of yours .* sb3_gac.envs.SplitObservation\(",
        "make_unsplit": r"unsplit have the entries \['gps', 'wind'\], .* returns sb3_gac.envs.SplitDictObservation\(",
    }.items():
        with pytest.raises(ValueError, match=rf"^--env: the observations of {module}:make_{message}"):
            prepare(parse_arguments(["--env", f"{module}:{name}", "--runs", str(tmp_path)]))
    assert list(tmp_path.iterdir()) == []
    by_name = ["--overrides", "{role_keys: {learner: [gps], guider: [gps, wind], critic: [wind]}}", "--runs", str(tmp_path)]
    assert prepare(parse_arguments(["--env", f"{module}:make_unsplit", *by_name])).model.policy.deployed_entries == ("gps",)


def test_runs_of_the_same_second_have_directories_of_their_own(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_gac.training.directory.time.strftime", lambda format: "now")
    options = parse_arguments(["--runs", str(tmp_path)])
    for ending in ("now", "now-2", "now-3"):
        directory = new_directory(options)
        assert directory.name == f"HalfCheetah-noise0.1-history4-seed0-{ending}"
        directory.mkdir()


def test_a_console_script_finds_modules_in_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["/elsewhere"])
    for _ in range(2):
        find_modules_here()
    assert sys.path == [str(tmp_path), "/elsewhere"]


def test_the_spaces_of_the_bandit_are_what_these_tests_take_them_for():
    assert isinstance(TwoViewBandit().observation_space, spaces.Dict)


@pytest.mark.parametrize(
    ("env_id", "default", "other"),
    [("Hopper", "state", "velocity"), ("FetchReach", "hidden", "state"), ("h1-walk", "hidden", "state")],
)
def test_what_is_privileged_is_said_to_the_environment_as_the_task_has_it(env_id, default, other):
    """A task's default is never told from a word of one's own by the name that another suite gives its default."""
    assert parse_arguments(["--task", env_id]).privileged == default
    for value in (default, other):
        options = parse_arguments(["--task", env_id, "--privileged", value])
        assert (options.privileged, options.env_kwargs.get("privileged", default)) == (value, value)
    sees_all = algorithm_arguments(parse_arguments(["--task", env_id])).get("role_keys") is not None
    assert sees_all == (default == "state")
    wrong = next(value for value in ("hidden", "velocity") if value not in (default, other))
    with pytest.raises(ValueError, match=rf"--privileged: sb3_gac/.* has {default} or {other}, got {wrong}"):
        resolve({"task": env_id, "privileged": wrong})


def test_a_run_that_wrote_down_what_its_task_does_not_have_goes_on_as_it_was(tmp_path):
    """Of an earlier version, whose default was "state" for all tasks."""
    job = prepare(parse_arguments(["--task", "FetchReach", "--envs", "1", "--runs", str(tmp_path)]))
    job.alone.close()
    path = job.directory / "config.yaml"
    written = path.read_text()
    assert "\nprivileged: hidden\n" in written
    path.write_text(written.replace("\nprivileged: hidden\n", "\nprivileged: state\n"))
    again = parse_arguments(["--resume", str(job.directory)])
    assert again.env_kwargs == job.options.env_kwargs
