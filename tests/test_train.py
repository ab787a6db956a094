"""The main job, end to end on a tiny budget."""

import json
import re
import shlex
import signal
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
import yaml

import sb3_gac.train
from sb3_gac import GAC, GuiderLearnerEvalCallback
from sb3_gac.train import PartialOnly, gac_arguments, main, parse_arguments, start, summary, train

QUICK = ["--task", "InvertedDoublePendulum", "--steps", "400", "--seed", "3", "--episodes", "2", "--envs", "2"]
SMALL = {"learning_starts": 50, "batch_size": 8, "gradient_steps": 1, "policy_kwargs": {"net_arch": [8]}}


def test_main_job_leaves_a_model_a_picture_results_and_its_configuration(tmp_path):
    options = ["--task", "InvertedDoublePendulum", "--noise", "0.1", "--steps", "2400", "--seed", "3", "--episodes", "2"]
    options = parse_arguments([*options, "--runs", str(tmp_path)])
    directory = start(options)
    train(options, directory)
    assert directory.parent == tmp_path
    assert {path.name for path in directory.iterdir()} == {"config.yaml", "results.json", "learning_curve.png", "model.zip"}
    assert (directory / "learning_curve.png").read_bytes()[:4] == b"\x89PNG"
    configuration = yaml.safe_load((directory / "config.yaml").read_text())
    assert (configuration["task"], configuration["noise"], configuration["seed"]) == ("InvertedDoublePendulum", 0.1, 3)
    assert configuration["gac"]["batch_size"] == 128
    results = json.loads((directory / "results.json").read_text())
    assert np.isfinite([results["learner"], results["random"]]).all()
    assert len(results["history"]) == 10
    last_lines = summary(directory)
    assert f"(noise 0.1, history 4) for {results['steps']} steps" in last_lines
    assert results["steps"] == 2400
    assert f"return {results['learner']:.0f} +- {results['learner_std']:.0f} over 2 episodes" in last_lines
    assert f"same seeds: {results['random']:.0f} +- {results['random_std']:.0f}." in last_lines
    assert f'GAC.load("{directory / "model"}")' in last_lines
    action, _ = GAC.load(directory / "model").predict({"partial": np.zeros(4 * 5 + 3, np.float32)}, deterministic=True)
    assert action.shape == (1,)


def test_the_learner_is_evaluated_on_partial_alone():
    seen = []

    class Model:
        def predict(self, observation, *args, **kwargs):
            seen.append(observation)

    PartialOnly(Model()).predict({"partial": 1, "privileged": 2}, deterministic=True)
    assert seen == [{"partial": 1}]


@pytest.mark.parametrize("arguments", [["--task", "Cheetah"], ["--privileged", "all"], ["--preset", "large"]])
def test_unknown_choices_are_refused(arguments, capsys):
    with pytest.raises(SystemExit):
        parse_arguments(arguments)
    assert "invalid choice" in capsys.readouterr().err


def test_a_preset_brings_its_number_of_environments():
    options = parse_arguments(["--preset", "paper"])
    assert gac_arguments(options)["gradient_steps"] / options.envs == 0.5, "gradient steps per environment step"
    assert parse_arguments([]).envs == 4
    assert parse_arguments(["--preset", "paper", "--envs", "2"]).envs == 2


def test_robots_have_sensors_and_a_preset_of_their_own():
    options = parse_arguments(["--task", "Go1JoystickFlatTerrain"])
    assert (options.noise, options.preset, options.envs) == (0.0, "playground", 16)
    arguments = gac_arguments(options)
    assert arguments["role_keys"] == {"critic": ["privileged"]}
    assert arguments["gamma"] == 0.97
    assert gac_arguments(parse_arguments(["--task", "LeapCubeReorient"]))["gamma"] == 0.99
    given = parse_arguments(["--task", "Go1Getup", "--noise", "0.2", "--preset", "small", "--envs", "2"])
    assert (given.noise, given.preset, given.envs) == (0.2, "small", 2)


def test_much_noise_has_the_target_kl_of_the_figures():
    assert gac_arguments(parse_arguments(["--noise", "0.3"]))["target_kl"] == 0.001
    assert "target_kl" not in gac_arguments(parse_arguments(["--noise", "0.1"])), "the default"


def test_what_the_learner_sees_is_a_history_where_sensors_are_noisy():
    assert parse_arguments([]).history == 4
    assert parse_arguments(["--noise", "0"]).history == 1
    assert parse_arguments(["--history", "2"]).history == 2
    assert parse_arguments(["--task", "Go1JoystickFlatTerrain"]).history == 1, "which takes none"


def test_a_history_is_of_the_run_and_a_run_from_before_there_was_one_goes_on(tmp_path, monkeypatch):
    options = parse_arguments(["--history", "4", "--runs", str(tmp_path), "--task", "Hopper"])
    directory = start(options)
    assert "-history4-" in directory.name
    assert yaml.safe_load((directory / "config.yaml").read_text())["history"] == 4
    seen = []

    def learn(options, directory, env, eval_env):
        seen.append([e.observation_space["partial"].shape[0] for e in (env, eval_env)])
        raise KeyboardInterrupt

    monkeypatch.setattr(sb3_gac.train, "learn", learn)
    with pytest.raises(KeyboardInterrupt):
        train(options, directory)
    assert seen == [[4 * 5 + 3 * 3] * 2]
    assert "history" not in start(parse_arguments(["--history", "1", "--runs", str(tmp_path)])).name
    (directory / "config.yaml").write_text(
        "".join(line for line in (directory / "config.yaml").read_text().splitlines(True) if not line.startswith("history"))
    )
    monkeypatch.setattr(sb3_gac.train, "checkpoints", lambda path: [path])
    assert sb3_gac.train.options_of(directory).history == 1


@pytest.fixture
def _quick(monkeypatch):
    """Gradient steps from the 50th step on, of a millisecond each."""

    def quick(options):
        return gac_arguments(options) | SMALL

    monkeypatch.setattr(sb3_gac.train, "gac_arguments", quick)
    monkeypatch.setattr(sb3_gac.train, "EVALUATIONS", 4)


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
        context.setattr(sb3_gac.train, "GuiderLearnerEvalCallback", _stopped_after(steps, by))
        with pytest.raises(SystemExit) as end:
            main([*QUICK, "--noise", "0.2", "--privileged", "velocity", "--runs", str(tmp_path / "stopped")])
    assert end.value.code == status
    (directory,) = (tmp_path / "stopped").iterdir()
    assert {path.name for path in directory.iterdir()} == {"config.yaml", "checkpoints"}
    (command,) = re.findall(r"To go on:\s+python -m sb3_gac.train (.*)", capsys.readouterr().err)
    main(shlex.split(command))
    assert str(directory / "model") in capsys.readouterr().out
    (undisturbed,) = (tmp_path / "undisturbed").iterdir()
    assert {path.name for path in directory.iterdir()} == {path.name for path in undisturbed.iterdir()}
    found, expected = (json.loads((path / "results.json").read_text()) for path in (directory, undisturbed))
    for name in ("learner", "learner_std", "random", "steps"):
        assert found[name] == expected[name]
    for name in ("timesteps", "learner", "guider"):
        assert [row[name] for row in found["history"]] == [row[name] for row in expected["history"]]
    assert [row["timesteps"] for row in found["history"]] == [100, 200, 300, 400]
    resumed, model = (GAC.load(path / "model") for path in (directory, undisturbed))
    for parameter, wanted in zip(resumed.policy.parameters(), model.policy.parameters(), strict=True):
        assert th.equal(parameter, wanted)


@pytest.mark.usefixtures("_quick")
def test_minutes_are_those_of_all_processes(tmp_path, monkeypatch):
    clock = iter(range(0, 10**6, 60))  # a minute passes between any two looks at it
    monkeypatch.setattr(sb3_gac.train, "time", SimpleNamespace(time=lambda: next(clock), strftime=time.strftime))
    with monkeypatch.context() as context:
        context.setattr(sb3_gac.train, "GuiderLearnerEvalCallback", _stopped_after(200, signal.SIGINT))
        with pytest.raises(SystemExit):
            main([*QUICK, "--runs", str(tmp_path)])
    (directory,) = tmp_path.iterdir()
    main(["--resume", str(directory)])
    minutes = 2 + 2  # from the start to the checkpoint at 100 steps and to that of the stop; to that at 300 and to the end
    assert json.loads((directory / "results.json").read_text())["minutes"] == minutes


@pytest.mark.usefixtures("_quick")
def test_what_there_is_nothing_to_go_on_with_is_refused(tmp_path, monkeypatch, capsys):
    def stopped(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(sb3_gac.train, "make_vec", stopped)
        with pytest.raises(SystemExit):
            main([*QUICK, "--runs", str(tmp_path)])
    assert "Stopped before there was anything to keep" in capsys.readouterr().err
    (directory,) = tmp_path.iterdir()
    with pytest.raises(SystemExit):
        main(["--resume", str(directory)])
    assert f"there is no checkpoint in {directory / 'checkpoints'}" in capsys.readouterr().err
    (directory / "results.json").write_text("{}")
    with pytest.raises(SystemExit):
        main(["--resume", str(directory)])
    assert "this run is finished" in capsys.readouterr().err


def test_results_are_those_of_each_policy_over_as_many_episodes_as_asked(tmp_path, monkeypatch):
    asked = []

    def evaluated(policy, env, n_eval_episodes):
        asked.append((type(policy).__name__, n_eval_episodes, env.seeds.pop()))
        return {"PartialOnly": (1.0, 2.0), "UniformActions": (3.0, 4.0)}[asked[-1][0]]

    model = SimpleNamespace(save=lambda path: None, num_timesteps=7)
    space = SimpleNamespace(seed=lambda seed: None)
    seeds = []
    env = SimpleNamespace(seeds=seeds, seed=seeds.append, action_space=space, num_envs=1)
    monkeypatch.setattr(sb3_gac.train, "evaluate_policy", evaluated)
    monkeypatch.setattr(sb3_gac.train, "make_vec", lambda *args, **kwargs: env)
    monkeypatch.setattr(sb3_gac.train, "learn", lambda *args: (model, [], 1.5))
    monkeypatch.setattr(sb3_gac.train, "draw_learning_curve", lambda *args: None)
    (tmp_path / "checkpoints").mkdir()
    train(parse_arguments(["--episodes", "3"]), tmp_path)
    assert asked == [("PartialOnly", 3, 10_000), ("UniformActions", 3, 10_000)]
    results = json.loads((tmp_path / "results.json").read_text())
    assert [results.pop(name) for name in ("learner", "learner_std", "random", "random_std")] == [1.0, 2.0, 3.0, 4.0]
    assert results == {"steps": 7, "minutes": 1.5, "history": []}


@pytest.mark.parametrize(("steps", "size"), [(10, 1_000), (5_000, 5_000), (10**7, 10**6)])
def test_a_buffer_holds_the_run_within_bounds(steps, size):
    assert gac_arguments(parse_arguments(["--steps", str(steps)]))["buffer_size"] == size
