"""The main job, end to end on a tiny budget."""

import itertools
import json
import pickle
import re
import shlex
import signal
import textwrap
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import GAC, GuiderLearnerEvalCallback
from sb3_gac.train import main, parse_arguments
from sb3_gac.training import evaluation, job
from sb3_gac.training.environments import entries_of_floats
from sb3_gac.training.evaluation import DeployedView
from sb3_gac.training.job import Job, finish, prepare
from sb3_gac.training.options import algorithm_arguments
from tests.helpers import Sampled

InvertedDoublePendulum = partial(gymnasium.make, "sb3_gac/InvertedDoublePendulum-v5", noise_std=0.1)
QUICK = ["--task", "InvertedDoublePendulum", "--steps", "400", "--seed", "3", "--episodes", "2", "--envs", "2"]
SMALL = {"learning_starts": 50, "batch_size": 8, "gradient_steps": 1, "policy_kwargs": {"net_arch": [8]}}


def test_main_job_leaves_a_model_a_picture_results_and_its_configuration(tmp_path, capsys):
    options = ["--task", "InvertedDoublePendulum", "--noise", "0.1", "--steps", "2400", "--seed", "3", "--episodes", "2"]
    main([*options, "--runs", str(tmp_path)])
    (directory,) = tmp_path.iterdir()
    assert re.fullmatch(r"InvertedDoublePendulum-noise0\.1-history4-seed3-\d{8}-\d{6}", directory.name)
    assert {path.name for path in directory.iterdir()} == {"config.yaml", "results.json", "learning_curve.png", "model.zip"}
    assert (directory / "learning_curve.png").read_bytes()[:4] == b"\x89PNG"
    configuration = yaml.safe_load((directory / "config.yaml").read_text())
    assert (configuration["task"], configuration["noise"], configuration["seed"]) == ("InvertedDoublePendulum", 0.1, 3)
    assert configuration["environment"] == {
        "id": "sb3_gac/InvertedDoublePendulum-v5",
        "kwargs": {"noise_std": 0.1, "history": 4},
        "wrappers": [],
    }
    arguments = configuration["arguments"]
    assert (arguments["batch_size"], arguments["target_kl"], arguments["compile"]) == (128, 0.001, "auto"), "the preset's"
    assert (arguments["gamma"], arguments["n_steps"], arguments["max_kl"]) == (0.99, 1, None), "and those that no one gave"
    assert configuration["versions"].keys() >= {"python", "sb3_gac", "stable-baselines3", "torch", "gymnasium", "mujoco"}
    assert re.match(r"[0-9a-f]{40}(\+changes)?$|$", configuration["commit"])
    results = json.loads((directory / "results.json").read_text())
    assert np.isfinite([results["learner"], *itertools.chain(*results["untrained"].values())]).all()
    assert results["compiled"] is False
    assert [row["timesteps"] for row in results["history"]] == list(range(240, 2401, 240))
    output = capsys.readouterr().out
    assert "Training for 2,400 steps: GAC on sb3_gac/InvertedDoublePendulum-v5 (noise 0.1, history 4)." in output
    assert output.count("not compiled, for 400 are to come") == 1
    assert len(re.findall(r"^ *[\d,]+ of 2,400 steps: learner [\d.]+, guider [\d.]+", output, re.MULTILINE)) == 10
    assert "(noise 0.1, history 4) for 2,400 steps in" in output
    assert f"return {results['learner']:.3g} +- {results['learner_std']:.3g} over 2 episodes" in output
    (drawn, drawn_std), (middle, middle_std) = results["untrained"].values()
    without_training = f"random actions {drawn:.3g} +- {drawn_std:.3g}, the middle action {middle:.3g} +- {middle_std:.3g}"
    assert f"Without training, same seeds: {without_training}." in output
    assert f'GAC.load("{directory / "model"}")' in output
    action, _ = GAC.load(directory / "model").predict({"partial": np.zeros(4 * 5 + 3, np.float32)}, deterministic=True)
    assert action.shape == (1,)


@pytest.mark.parametrize("entries", [["partial"], ["partial", "gear"]])
def test_the_learner_is_evaluated_on_what_it_reads_alone(entries):
    seen = []

    class Model:
        policy = SimpleNamespace(deployed_entries=entries)

        def predict(self, observation, *args, **kwargs):
            seen.append(observation)

    DeployedView(Model()).predict({"partial": 1, "gear": 2, "privileged": 3}, deterministic=True)
    assert seen == [{"partial": 1, "gear": 2} if "gear" in entries else {"partial": 1}]


def test_a_learner_may_read_more_than_partial(tmp_path, capsys):
    options = ["--env", "tests.training.test_options:make_geared", "--steps", "40", "--episodes", "1", "--runs", str(tmp_path)]
    main([*options, "--overrides", "{learning_starts: 20, role_keys: {learner: [partial, gear]}}"])
    (directory,) = tmp_path.iterdir()
    assert np.isfinite(json.loads((directory / "results.json").read_text())["learner"])
    output = capsys.readouterr().out
    assert "Learner, seeing `partial` and `gear` alone: return" in output
    use = "model.predict({\"partial\": observation['partial'], \"gear\": observation['gear']}, deterministic=True)"
    assert use in output


def test_a_log_that_nothing_can_write_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr("stable_baselines3.common.utils.SummaryWriter", None)
    with pytest.raises(SystemExit, match=r"error: --tensorboard: TensorBoard is not installed: pip install tensorboard"):
        main([*QUICK, "--tensorboard", "--runs", str(tmp_path)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("learning_starts", [400, 2_000])
def test_a_run_without_a_gradient_step_is_refused_before_anything_is_written(learning_starts, tmp_path):
    overrides = f"{{learning_starts: {learning_starts}}}"
    message = rf"error: --steps: GAC makes its first gradient step after {learning_starts:,} steps .* in 400 steps nothing is"
    with pytest.raises(SystemExit, match=message):
        main([*QUICK, "--overrides", overrides, "--runs", str(tmp_path)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "HalfCheetah-v5"], '--task: there is no "HalfCheetah-v5". Is "HalfCheetah" meant?'),
        (["--task", "Quadrotor"], "lists the tasks. Every other environment goes by --env."),
        (["--privileged", "all"], "invalid choice: 'all'"),
        (["--preset", "lagre"], '--preset: there is no "lagre". There are learner-memory, linear-memory, '),
        (["--algorithm", "sac_asym"], 'Is "asymmetric_sac" meant?'),
        (["--stepps", "3"], "unrecognized arguments: --stepps 3"),
    ],
)
@pytest.mark.parametrize("called", ["sb3-gac train", "/place/sb3_gac/train.py"])
def test_what_is_wrong_with_an_option_is_a_line_and_not_the_usage(arguments, message, called, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", [called, *arguments])
    name = called if called.startswith("sb3-gac") else "python -m sb3_gac.train"
    with pytest.raises(SystemExit) as end:
        parse_arguments(arguments)
    assert end.value.code == 2
    error, where = capsys.readouterr().err.splitlines()
    assert error.startswith(f"{name}: error: ")
    assert message in error
    assert where == f"See {name} --help."


def test_a_preset_brings_its_number_of_environments():
    options = parse_arguments(["--preset", "paper"])
    assert algorithm_arguments(options)["gradient_steps"] / options.envs == 0.5, "gradient steps per environment step"
    assert parse_arguments([]).envs == 4
    assert parse_arguments(["--preset", "paper", "--envs", "2"]).envs == 2


def test_robots_have_sensors_and_a_preset_of_their_own():
    options = parse_arguments(["--task", "Go1JoystickFlatTerrain"])
    assert (options.noise, options.preset, options.envs) == (0.0, "playground", 16)
    arguments = algorithm_arguments(options)
    assert arguments["role_keys"] == {"critic": ["privileged"]}
    assert arguments["gamma"] == 0.97
    assert algorithm_arguments(parse_arguments(["--task", "LeapCubeReorient"]))["gamma"] == 0.99
    given = parse_arguments(["--task", "Go1Getup", "--noise", "0.2", "--preset", "small", "--envs", "2"])
    assert (given.noise, given.preset, given.envs) == (0.2, "small", 2)


def test_much_noise_has_the_target_kl_of_the_figures():
    assert algorithm_arguments(parse_arguments(["--noise", "0.3"]))["target_kl"] == 0.001
    assert "target_kl" not in algorithm_arguments(parse_arguments(["--noise", "0.1"])), "the default"


def test_what_the_learner_sees_is_a_history_where_sensors_are_noisy():
    assert parse_arguments([]).history == 4
    assert parse_arguments(["--noise", "0"]).history == 1
    assert parse_arguments(["--history", "2"]).history == 2
    assert parse_arguments(["--task", "Go1JoystickFlatTerrain"]).history == 1, "which takes none"


def test_a_history_is_of_the_run_and_a_run_from_before_there_was_one_goes_on(tmp_path):
    ready = prepare(parse_arguments(["--history", "4", "--runs", str(tmp_path), "--task", "Hopper", "--envs", "1"]))
    assert "-history4-" in ready.directory.name
    for env in (ready.model.env, ready.eval_env):
        assert env.observation_space["partial"].shape == (4 * 5 + 3 * 3,)
    configuration = ready.directory / "config.yaml"
    assert parse_arguments(["--resume", str(ready.directory)]).history == 4
    configuration.write_text("".join(line for line in configuration.read_text().splitlines(True) if "history" not in line))
    assert parse_arguments(["--resume", str(ready.directory)]).history == 1
    assert "history" not in prepare(parse_arguments(["--history", "1", "--runs", str(tmp_path)])).directory.name


@pytest.fixture
def _quick(monkeypatch):
    """Gradient steps from the 50th step on, of a millisecond each."""

    def quick(options):
        return algorithm_arguments(options) | SMALL

    monkeypatch.setattr(job, "algorithm_arguments", quick)
    monkeypatch.setattr(job, "EVALUATIONS", 4)


def _stopped_after(steps, by):
    class Stopped(GuiderLearnerEvalCallback):
        """What the user does while the run is under way."""

        def _on_step(self):
            if self.num_timesteps == steps:
                signal.raise_signal(by)
            return super()._on_step()

    return Stopped


@pytest.mark.usefixtures("_quick")
@pytest.mark.parametrize(("steps", "by", "status"), [(130, signal.SIGINT, 130), (280, signal.SIGTERM, 143)])
@pytest.mark.filterwarnings("ignore:Stopped by SIGTERM")
def test_a_run_that_is_stopped_says_how_to_go_on_and_ends_as_if_it_had_not_been(
    steps, by, status, tmp_path, monkeypatch, capsys
):
    main([*QUICK, "--noise", "0.2", "--privileged", "velocity", "--runs", str(tmp_path / "undisturbed")])
    with monkeypatch.context() as context:
        context.setattr(job, "GuiderLearnerEvalCallback", _stopped_after(steps, by))
        with pytest.raises(SystemExit) as end:
            main([*QUICK, "--noise", "0.2", "--privileged", "velocity", "--runs", str(tmp_path / "stopped")])
    assert end.value.code == status
    (directory,) = (tmp_path / "stopped").iterdir()
    assert {path.name for path in directory.iterdir()} == {"config.yaml", "checkpoints"}
    told = capsys.readouterr().err.strip().splitlines()
    (command,) = re.findall(rf"^Stopped; {steps} of 400 steps are saved\. To go on: python -m sb3_gac\.train (.*)", told[-1])
    assert len(told) == 2, "that the step is being finished, and how to go on"
    main(shlex.split(command))
    assert str(directory / "model") in capsys.readouterr().out
    (undisturbed,) = (tmp_path / "undisturbed").iterdir()
    assert {path.name for path in directory.iterdir()} == {path.name for path in undisturbed.iterdir()}
    found, expected = (json.loads((path / "results.json").read_text()) for path in (directory, undisturbed))
    for name in ("learner", "learner_std", "untrained", "steps"):
        assert found[name] == expected[name]
    assert found["history"] == expected["history"]
    assert [row["timesteps"] for row in found["history"]] == [100, 200, 300, 400]
    resumed, model = (GAC.load(path / "model") for path in (directory, undisturbed))
    for parameter, wanted in zip(resumed.policy.parameters(), model.policy.parameters(), strict=True):
        assert th.equal(parameter, wanted)


def test_a_preset_that_normalises_observations_leaves_their_statistics(tmp_path, capsys):
    """And the learner is evaluated on what it learned from."""
    small = "{learning_starts: 50, batch_size: 8, gradient_steps: 1, policy_kwargs: {net_arch: [8]}}"
    main([*QUICK, "--preset", "paper-brax", "--overrides", small, "--history", "1", "--runs", str(tmp_path)])
    (directory,) = tmp_path.iterdir()
    statistics = VecNormalize.load(str(directory / "vecnormalize.pkl"), DummyVecEnv([InvertedDoublePendulum] * 2))
    assert statistics.obs_rms["partial"].count == pytest.approx(402, abs=0.1), "of training alone"
    statistics.training = False
    model = GAC.load(directory / "model")
    snippet = textwrap.dedent(capsys.readouterr().out.partition("To use the learner:\n")[2])
    raw = {key: np.full(space.shape, 2.5, space.dtype) for key, space in model.observation_space.items()}
    pasted = {"observation": raw["partial"]}
    exec(snippet, pasted)
    expected, _ = model.predict({"partial": statistics.normalize_obs(raw)["partial"]}, deterministic=True)
    np.testing.assert_allclose(pasted["action"], expected, rtol=1e-5)
    assert model.trained_normalised
    results = json.loads((directory / "results.json").read_text())
    assert results["learner"] == pytest.approx(job.evaluate(DeployedView(model), statistics, 2)[0], rel=1e-3)


@pytest.mark.parametrize(("algorithm", "memory"), [("gac", "rnn_type: gru, rnn_hidden_size: 8"), ("rma", "latent_dim: 2")])
def test_the_printed_lines_carry_the_state_of_a_memory(algorithm, memory, tmp_path, capsys):
    """The line that acts, repeated over an episode, acts as the model does with its state, and anew in the next episode."""
    small = f"{{learning_starts: 50, batch_size: 2, gradient_steps: 1, policy_kwargs: {{net_arch: [8], {memory}}}}}"
    main([*QUICK, "--algorithm", algorithm, "--overrides", small, "--history", "1", "--runs", str(tmp_path)])
    *before, act, after = textwrap.dedent(capsys.readouterr().out.partition("To use the learner:\n")[2]).strip().splitlines()
    pasted, state = {}, None
    exec("\n".join(before), pasted)
    model = pasted["model"]
    generator, shape = np.random.default_rng(0), model.observation_space["partial"].shape
    observations = generator.normal(size=(4, *shape)).astype(np.float32)
    actions = []
    for step in (0, 1, 2, 3, 0):
        pasted["observation"] = observations[step]
        if step == 0:
            pasted["start"], state = [True], None
        exec(act, pasted)
        exec(after, pasted)
        expected, state = model.predict({"partial": observations[step]}, state, deterministic=True)
        np.testing.assert_array_equal(pasted["action"], expected)
        actions.append(pasted["action"])
    np.testing.assert_array_equal(actions[4], actions[0])
    forgetful, _ = model.predict({"partial": observations[3]}, deterministic=True)
    assert not np.array_equal(actions[3], forgetful), "the memory counts"


def test_a_teachers_statistics_are_its_students(tmp_path):
    """So the teacher sees what it was trained on, whether the student's normalisation was asked for or not."""
    small = ["--history", "1", "--overrides", "{learning_starts: 50, batch_size: 8, policy_kwargs: {net_arch: [8]}}"]
    main([*QUICK, *small, "--algorithm", "asymmetric_sac", "--normalize", "--runs", str(tmp_path / "teachers")])
    (teacher,) = (tmp_path / "teachers").iterdir()
    main([*QUICK, *small, "--algorithm", "cosil", "--teacher", str(teacher), "--runs", str(tmp_path / "students")])
    (student,) = (tmp_path / "students").iterdir()
    shown, seen = (pickle.loads((run / "vecnormalize.pkl").read_bytes()).obs_rms for run in (teacher, student))
    for key in ("partial", "privileged"):
        np.testing.assert_array_equal(shown[key].mean, seen[key].mean)
        assert shown[key].count == seen[key].count > 400
    configuration = student / "config.yaml"
    assert yaml.safe_load(configuration.read_text())["normalize"] == "teacher"
    (student / "results.json").unlink()  # as if it were unfinished
    assert parse_arguments(["--resume", str(student)]).normalize == "teacher"
    configuration.write_text(configuration.read_text().replace("normalize: teacher", "normalize: true"))
    assert parse_arguments(["--resume", str(student)]).normalize is True, "of an earlier version: its own statistics"


def test_observations_are_normalised_on_request(tmp_path):
    """The run's configuration says so, by which it would be resumed."""
    small = "{learning_starts: 50, batch_size: 8, policy_kwargs: {net_arch: [8]}}"
    main([*QUICK, "--normalize", "--overrides", small, "--history", "1", "--runs", str(tmp_path)])
    (directory,) = tmp_path.iterdir()
    model = GAC.load(directory / "model")
    assert sorted(model.normalised_entries) == ["partial", "privileged"]
    statistics = VecNormalize.load(str(directory / "vecnormalize.pkl"), DummyVecEnv([InvertedDoublePendulum] * 2))
    assert not statistics.norm_reward
    assert yaml.safe_load((directory / "config.yaml").read_text())["normalize"] is True


def test_images_stay_as_they_are_where_observations_are_normalised():
    image = spaces.Box(0, 255, (3, 36, 36), np.uint8)
    vector = spaces.Box(-1, 1, (2,), np.float32)
    env = DummyVecEnv([lambda: Sampled(spaces.Dict(partial=image, privileged=vector))])
    assert entries_of_floats(env) == ["privileged"]
    with pytest.raises(ValueError, match="--normalize: no entry of the observations holds floating-point numbers"):
        entries_of_floats(DummyVecEnv([lambda: Sampled(spaces.Dict(partial=image, privileged=image))]))


@pytest.mark.usefixtures("_quick")
def test_minutes_are_those_of_all_processes(tmp_path, monkeypatch):
    clock = iter(range(0, 10**6, 60))  # a minute passes between any two looks at it
    monkeypatch.setattr(job, "time", SimpleNamespace(time=lambda: next(clock)))
    with monkeypatch.context() as context:
        context.setattr(job, "GuiderLearnerEvalCallback", _stopped_after(200, signal.SIGINT))
        with pytest.raises(SystemExit):
            main([*QUICK, "--runs", str(tmp_path)])
    (directory,) = tmp_path.iterdir()
    main(["--resume", str(directory)])
    # From the start to the check of the notes, to the checkpoints at 0, at 100 steps and of the stop; then to the check again,
    # to the checkpoints at 300 and of the end, and to the end
    minutes = 4 + 4
    assert json.loads((directory / "results.json").read_text())["minutes"] == minutes


@pytest.mark.usefixtures("_quick")
def test_a_run_that_was_stopped_before_its_first_checkpoint_starts_anew(tmp_path, monkeypatch, capsys):
    def stopped(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(job, "learn", stopped)
        with pytest.raises(SystemExit) as end:
            main([*QUICK, "--runs", str(tmp_path)])
    assert end.value.code == 130
    (directory,) = tmp_path.iterdir()
    message = capsys.readouterr().err.strip()
    assert message == f"Stopped; 0 of 400 steps are saved. To go on: python -m sb3_gac.train --resume {directory}"
    main(["--resume", str(directory)])
    assert json.loads((directory / "results.json").read_text())["steps"] == 400
    assert list(tmp_path.iterdir()) == [directory]


@pytest.mark.usefixtures("_quick")
def test_a_run_that_was_stopped_while_it_was_evaluated_is_evaluated(tmp_path, monkeypatch, capsys):
    def stopped(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(job, "evaluate", stopped)
        with pytest.raises(SystemExit):
            main([*QUICK, "--runs", str(tmp_path)])
    (directory,) = tmp_path.iterdir()
    assert "400 of 400 steps are saved. To go on" in capsys.readouterr().err
    trained = GAC.load(directory / "model")
    monkeypatch.setattr(GAC, "learn", stopped)
    main(["--resume", str(directory)])
    results = json.loads((directory / "results.json").read_text())
    assert len(results["history"]) == 4
    for parameter, wanted in zip(GAC.load(directory / "model").policy.parameters(), trained.policy.parameters(), strict=True):
        assert th.equal(parameter, wanted)


def test_what_there_is_nothing_to_go_on_with_is_refused(tmp_path, capsys):
    for content, message in {
        None: "there is no config.yaml in it",
        "config.yaml": "leave out --env-kwargs, --steps. A run with other options is a new one: leave out --resume",
        "results.json": "this run is finished, its results are in results.json. Its checkpoints are gone: train anew with "
        f'more --steps; or go on in Python with an empty replay buffer: GAC.load("{tmp_path}/model", env=env).learn(...)',
    }.items():
        if content is not None:
            (tmp_path / content).write_text("{}")
        others = ["--steps", "3", "--env-kwargs", "{}"] if content == "config.yaml" else []
        with pytest.raises(SystemExit):
            parse_arguments(["--resume", str(tmp_path), *others])
        assert message in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "lacks task, steps, seed, environment"),
        ("[1, 2]", "lacks task, steps, seed, environment"),
        (
            "run: {algorithm: gac, task: Hopper}\narguments: {}\ncommit: ''",
            "is no run of sb3_gac.train: its config.yaml lacks",
        ),
        ("task: {", "config.yaml is no YAML"),
        ("{task: Hopper, steps: 9, seed: 0, environment: {}, preset: large}", "preset must be one of"),
        ("{task: Nothing, steps: 9, seed: 0, environment: {}}", "task must be one of"),
    ],
)
def test_a_directory_of_something_else_is_no_run_and_stays_as_it_is(content, message, tmp_path, capsys):
    (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(SystemExit):
        parse_arguments(["--resume", str(tmp_path)])
    assert message in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]
    assert (tmp_path / "config.yaml").read_text() == content


def test_a_run_is_one_processs_alone_and_has_its_configuration_from_its_start(tmp_path):
    new = ["--task", "InvertedDoublePendulum", "--envs", "1", "--runs", str(tmp_path)]
    begun = prepare(parse_arguments(new))
    configuration = begun.directory / "config.yaml"
    configuration.write_text(f"# mine\n{configuration.read_text()}")
    resumed = parse_arguments(["--resume", str(begun.directory)])
    with pytest.raises(ValueError, match=r"--resume: Another process is running .* Wait until"):
        prepare(resumed)
    with begun.alone:
        pass
    with prepare(resumed).alone, pytest.raises(ValueError, match="Another process is running"):
        prepare(resumed)
    assert configuration.read_text().startswith("# mine\n"), "no checkpoint is no reason to write it again"
    (begun.directory / "results.json").write_text("{}")
    with pytest.raises(ValueError, match="this run is finished"):
        prepare(resumed)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env-kwargs", "{foo: 2}"], "sb3_gac/InvertedDoublePendulum-v5: .*unexpected keyword argument 'foo'"),
        (["--overrides", "{gama: 0.9}"], 'Is "gamma" meant'),
        (["--overrides", "{task: 3}"], 'got "task", which is no argument of GAC'),
        (["--overrides", "{policy_kwargs: {net_arhc: [8]}}"], "net_arhc"),
        (["--overrides", "{policy_kwargs: [1]}"], "policy_kwargs: must be a mapping, got"),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(arguments, message, tmp_path):
    with pytest.raises(SystemExit, match=rf"^python -m sb3_gac.train: error: .*{message}"):
        main([*QUICK, *arguments, "--runs", str(tmp_path)])
    assert list(tmp_path.iterdir()) == []


def test_a_directory_that_can_not_be_made_is_one_line(monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(job, "write_configuration", full)
    with pytest.raises(SystemExit, match=r"error: .*No space left"):
        main([*QUICK, "--overrides", "{learning_starts: 50}"])


def test_a_model_that_could_not_be_written_whole_is_none(tmp_path):
    def save(path):
        path.write_text("half of it")
        raise OSError(28, "No space left on device")

    model = SimpleNamespace(save=save)
    with pytest.raises(OSError, match="No space left"):
        finish(Job(parse_arguments([]), tmp_path, model, None), [], 1.5)
    assert not (tmp_path / "model.zip").exists()


@pytest.mark.parametrize(("asked", "taken"), [(2, 2), (12, 5)])
def test_evaluations_on_the_way_have_five_episodes_at_most(asked, taken, tmp_path, monkeypatch):
    numbers = []

    class Noted(job.GuiderLearnerEvalCallback):
        def _on_step(self):
            numbers.append((self.n_eval_episodes, self.eval_env.num_envs))
            raise KeyboardInterrupt

    monkeypatch.setattr(job, "GuiderLearnerEvalCallback", Noted)
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        main([*QUICK, "--overrides", "{learning_starts: 50}", "--episodes", str(asked), "--runs", str(tmp_path)])
    assert numbers == [(taken, taken)]


def test_results_are_those_of_each_policy_over_as_many_episodes_as_asked(tmp_path, monkeypatch):
    asked = []

    def evaluated(policy, env, n_eval_episodes):
        asked.append((type(policy).__name__, n_eval_episodes, env.seeds.pop()))
        return {"DeployedView": (1.0, 2.0), "UniformActions": (3.0, 4.0), "MiddleAction": (5.0, 6.0)}[asked[-1][0]]

    policy = SimpleNamespace(deployed_entries=["partial", "gear"])
    model = SimpleNamespace(save=Path.touch, num_timesteps=7, compiles=True, learning_starts=5, policy=policy)
    seeds, drawn = [], []
    env = SimpleNamespace(seeds=seeds, seed=seeds.append, action_space=spaces.Box(-1, 1, (2,)), num_envs=1)
    monkeypatch.setattr(evaluation, "evaluate_policy", evaluated)
    monkeypatch.setattr(job, "draw_learning_curve", lambda *args: drawn.extend(args))
    (tmp_path / "checkpoints").mkdir()
    finish(Job(parse_arguments(["--episodes", "3"]), tmp_path, model, env), [], 1.5)
    assert asked == [("DeployedView", 3, 10_000), ("UniformActions", 3, 10_000), ("MiddleAction", 3, 10_000)]
    untrained = {"random actions": (3.0, 4.0), "the middle action": (5.0, 6.0)}
    assert drawn[-3:] == [
        untrained,
        5,
        "partial and gear",
    ], "without training, the warm-up, what the learner reads"
    results = json.loads((tmp_path / "results.json").read_text())
    assert [results.pop(name) for name in ("learner", "learner_std")] == [1.0, 2.0]
    assert results.pop("untrained") == {"random actions": [3.0, 4.0], "the middle action": [5.0, 6.0]}
    assert results == {"steps": 7, "minutes": 1.5, "compiled": True, "history": []}
    assert not (tmp_path / "checkpoints").exists()


@pytest.mark.parametrize(("steps", "size"), [(10, 1_000), (5_000, 5_000), (10**7, 10**6)])
def test_a_buffer_holds_the_run_within_bounds(steps, size):
    assert algorithm_arguments(parse_arguments(["--steps", str(steps)]))["buffer_size"] == size
