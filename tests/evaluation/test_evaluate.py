"""The command, from models and exported files to table, curve and JSON."""

import json
import pickle
import re
import shlex
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import GAC, AsymmetricSAC, export_learner
from sb3_gac.algorithms import ALGORITHMS, algorithm_class
from sb3_gac.base.loading import load_model, model_file
from sb3_gac.evaluate import main, parse_arguments
from sb3_gac.evaluation.episodes import Episode, run_episodes
from sb3_gac.evaluation.figure import draw
from sb3_gac.evaluation.policies import guider_of, learner_of, load_exported
from sb3_gac.evaluation.results import HEADER, outcome, row
from sb3_gac.evaluation.settings import UNDISTURBED, Environment, Setting
from tests.evaluation.helpers import ENV, Walk, noisy_walk
from tests.helpers import Sampled, small_model
from tests.registry import make

SMALL = {"buffer_size": 100, "policy_kwargs": {"net_arch": [8]}, "device": "cpu", "seed": 0}


@pytest.fixture(scope="module")
def gac(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "gac.zip"
    GAC("MultiInputPolicy", noisy_walk(history=2), **SMALL).save(path)
    return path


def _evaluate(model, out, *options):
    main([str(model), "--out", str(out), "--episodes", "3", *options])
    return json.loads((out / "evaluation.json").read_text())


NOISY = ("--env", "tests.evaluation.helpers:noisy_walk", "--env-kwargs", "{history: 2}")


def test_a_model_is_evaluated_with_its_guider_in_every_setting(gac, tmp_path, capsys):
    found = _evaluate(gac, tmp_path, *NOISY, "--noise", "0", "0.5", "--delay", "0", "2", "--guider", "--seed", "5")
    table = (tmp_path / "evaluation.md").read_text()
    assert (tmp_path / "evaluation.png").read_bytes()[:4] == b"\x89PNG"
    settings = [(0, 0), (0.5, 0), (0, 2)]
    assert [(r["noise"], r["delay"], r["policy"]) for r in found["results"]] == [
        (*setting, policy) for setting in settings for policy in ("learner", "guider")
    ]
    assert found["command"].startswith(f"python -m sb3_gac.evaluate {gac}")
    assert found["first_and_last_seed"] == [5, 7]
    assert found["environment"] == {"env_id": NOISY[1], "kwargs": {"history": 2}, "wrappers": []}
    assert {"sb3_gac", "torch", "numpy"} <= set(found["versions"])
    out = capsys.readouterr().out
    assert f"{NOISY[1]}: settings come on top of what it has of its own: SensorNoise." in out
    assert "The learner reads partial. The guider reads partial and privileged." in out
    printed, written = (_cells(text) for text in (out, table))
    assert printed[0] == list(HEADER), "with successes, which the environment reports"
    assert len(printed) == len(found["results"]) + 1
    assert printed == written


def _cells(text):
    """Of the table in it, without the rule."""
    lines = [line.strip("| ") for line in text.splitlines() if line.startswith("|") and not line.startswith("| --")]
    return [re.split(r"\s*\|\s*", line) for line in lines]


def test_numbers_are_those_of_the_models_own_episodes(gac, tmp_path):
    found = _evaluate(gac, tmp_path, *NOISY, "--noise", "0.5", "--drop", "0.3", "--guider")
    model = GAC.load(gac)
    for policy, evaluated in (("learner", learner_of(model)), ("guider", guider_of(model))):
        returns = {}
        for setting in (UNDISTURBED, Setting(0.5, 0, 0.3)):
            env = Environment(NOISY[1], {"history": 2}).make(setting)
            returns[setting] = [episode.total for episode in run_episodes(evaluated, [env], range(10_000, 10_003))]
        for result in (result for result in found["results"] if result["policy"] == policy):
            expected = returns[Setting(result["noise"], result["delay"], result["drop"])]
            np.testing.assert_allclose(result["returns"], expected, rtol=1e-4)
            assert result["mean"] == pytest.approx(np.mean(expected), rel=1e-4)
            assert result["difference"] == pytest.approx(np.mean(expected) - np.mean(returns[UNDISTURBED]), rel=1e-3, abs=1e-6)
    assert len({tuple(result["returns"]) for result in found["results"]}) == 4


def test_the_learner_gets_nothing_that_is_privileged(gac, tmp_path, monkeypatch):
    seen = []

    def predict(self, observation, *args, **kwargs):
        seen.append(set(observation))
        return np.zeros((3, 1), np.float32), None

    monkeypatch.setattr(GAC, "predict", predict)
    _evaluate(gac, tmp_path, *NOISY, "--noise", "0")
    assert seen
    assert all(keys == {"partial"} for keys in seen)


@pytest.mark.parametrize("suffix", [".onnx", ".pt"])
def test_exported_files_do_as_the_model_and_begin_anew_with_each_episode(suffix, tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_gac.evaluate.SIDE_BY_SIDE", 1)
    if suffix == ".onnx":
        pytest.importorskip("onnx", reason="writes the exported file")
        pytest.importorskip("onnxruntime", reason="runs the exported file")
    memory = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]}
    model = GAC("MultiInputGruPolicy", Walk(), **{**SMALL, "policy_kwargs": memory})
    model.save(tmp_path / "gru")
    file = export_learner(model, tmp_path / f"gru{suffix}", verify_on=4)
    options = ("--env", ENV, "--noise", "0.3")
    of_model, of_file = (_evaluate(path, tmp_path, *options)["results"] for path in (tmp_path / "gru", file))
    for result, expected in zip(of_file, of_model, strict=True):
        np.testing.assert_allclose(result["returns"], expected["returns"], rtol=1e-3)
        assert 0 <= result["success"] <= 1


def test_evaluations_of_files_in_one_folder_have_folders_of_their_own(tmp_path):
    model = GAC("MultiInputPolicy", Walk(), **SMALL)
    model.save(tmp_path / "walk.zip")
    export_learner(model, tmp_path / "walk.pt", verify_on=4)
    for file in ("walk.zip", "walk.pt"):
        main([str(tmp_path / file), "--env", ENV, "--episodes", "1", "--noise", "0"])
    assert {path.parent.name for path in tmp_path.glob("*/evaluation.json")} == {"evaluation-walk", "evaluation-walk.pt"}


def test_a_runs_directory_is_enough(tmp_path, capsys):
    run = tmp_path / "run"
    run.mkdir()
    run.joinpath("config.yaml").write_text(yaml.safe_dump({"task": "Pendulum", "noise": 0.1, "history": 2}))
    env = Environment("sb3_gac/Pendulum-v1", {"history": 2}).make(UNDISTURBED)
    GAC("MultiInputPolicy", env, **SMALL).save(run / "model")
    main([str(run), "--episodes", "1", "--noise", "0", "0.3"])
    found = json.loads((run / "evaluation/evaluation.json").read_text())
    assert [result["noise"] for result in found["results"]] == [0, 0.1, 0.3]
    assert found["trained"] == {"noise": 0.1, "delay": 0, "drop": 0}
    lone = found["results"][0]
    assert (lone["std"], lone["interval"], lone["share"], lone["success"]) == (
        None,
        [None, None],
        None,
        None,
    ), "returns below 0"
    out = capsys.readouterr().out
    assert str(run / "evaluation") in out
    assert _cells(out)[0] == list(HEADER[:-1]), "nobody reports successes"


def test_the_statistics_of_vec_normalize_count(tmp_path):
    env = VecNormalize(DummyVecEnv([Walk]))
    model = GAC("MultiInputPolicy", env, **SMALL).learn(20)
    model.save(tmp_path / "normalised")
    partial = env.obs_rms["partial"]
    partial.mean += 3 * np.sqrt(partial.var)
    env.save(str(tmp_path / "far.pkl"))
    partial.mean -= 2.8 * np.sqrt(partial.var)  # near those of training, and not the same
    env.save(str(tmp_path / "statistics.pkl"))
    options = ("--env", ENV, "--noise", "0")
    with pytest.raises(SystemExit, match="pass --vec-normalize"):
        _evaluate(tmp_path / "normalised.zip", tmp_path, *options)
    (tmp_path / "garbage.pkl").write_text("garbage")
    (tmp_path / "other.pkl").write_bytes(pickle.dumps({"mean": 0}))
    foreign = VecNormalize(DummyVecEnv([lambda: noisy_walk(history=2)]))
    foreign.save(str(tmp_path / "foreign.pkl"))
    VecNormalize(DummyVecEnv([Walk]), norm_obs=False).save(str(tmp_path / "rewards.pkl"))
    VecNormalize(DummyVecEnv([Walk]), norm_obs_keys=["privileged"]).save(str(tmp_path / "privileged.pkl"))
    for name, message in {
        "none": "there is no file",
        ".": "there is no file",
        "garbage.pkl": "is no file that VecNormalize.save wrote",
        "other.pkl": "holds dict, not what VecNormalize.save writes",
        "rewards.pkl": r"rewards\.pkl has no statistics of \['partial', 'privileged'\], which were normalised in training",
        "privileged.pkl": r"privileged\.pkl has no statistics of \['partial'\], which were",
        "far.pkl": r'far\.pkl has other statistics of "partial" .* would be 3\.00 standard deviations off',
        "foreign.pkl": r"is of another environment: its \"partial\" has the shape \(5,\), and the model's \(2,\)",
    }.items():
        with pytest.raises(SystemExit, match=message):
            _evaluate(tmp_path / "normalised.zip", tmp_path, *options, "--guider", "--vec-normalize", str(tmp_path / name))
    statistics = str(tmp_path / "statistics.pkl")
    found = _evaluate(tmp_path / "normalised", tmp_path, *options, "--vec-normalize", statistics, "--guider")
    (tmp_path / "statistics.pkl").rename(tmp_path / "vecnormalize.pkl")
    assert _evaluate(tmp_path / "normalised", tmp_path, *options, "--guider")["results"] == found["results"]
    env.training = False
    predictors = {"learner": model.predict, "guider": model.predict_guider}
    for result in found["results"]:
        inner, total, is_over = Walk(), 0.0, False
        observation, _ = inner.reset(seed=10_000)
        while not is_over:
            action, _ = predictors[result["policy"]](env.normalize_obs(observation), deterministic=True)
            observation, reward, terminated, truncated, _ = inner.step(action)
            total, is_over = total + reward, terminated or truncated
        assert result["returns"][0] == pytest.approx(total, rel=1e-4)


def test_statistics_are_needed_of_what_a_policy_reads_alone(tmp_path):
    """Neither those of an entry that it does not read, nor that entry in the environment of the evaluation."""
    env = VecNormalize(DummyVecEnv([Walk]), norm_obs_keys=["privileged"])
    GAC("MultiInputPolicy", env, **SMALL).learn(20).save(tmp_path / "model")
    options = ("--env", ENV, "--noise", "0")
    without = _evaluate(tmp_path / "model.zip", tmp_path, *options)
    with pytest.raises(SystemExit, match="pass --vec-normalize"):
        _evaluate(tmp_path / "model.zip", tmp_path, *options, "--guider")
    env.save(str(tmp_path / "vecnormalize.pkl"))
    assert _evaluate(tmp_path / "model.zip", tmp_path, *options)["results"] == without["results"]
    both = _evaluate(tmp_path / "model.zip", tmp_path, *options, "--guider")
    assert [result["policy"] for result in both["results"]] == ["learner", "guider"]
    whole = VecNormalize(DummyVecEnv([Walk]))
    GAC("MultiInputPolicy", whole, **SMALL).learn(20).save(tmp_path / "whole")
    whole.save(str(tmp_path / "vecnormalize.pkl"))
    on_the_robot = ("--env", "tests.evaluation.helpers:walk_without_privileged", "--noise", "0")
    expected = _evaluate(tmp_path / "whole", tmp_path, *options)["results"]
    assert _evaluate(tmp_path / "whole", tmp_path, *on_the_robot)["results"] == expected
    of_raw = _evaluate(tmp_path / "model.zip", tmp_path, *options)["results"]
    assert of_raw == without["results"], "what was raw in training stays raw, whatever else the file has"


@pytest.mark.parametrize("suffix", [".onnx", ".pt"])
def test_exported_files_take_images_as_the_environment_shows_them(suffix, tmp_path):
    if suffix == ".onnx":
        pytest.importorskip("onnx", reason="writes the exported file")
        pytest.importorskip("onnxruntime", reason="runs the exported file")
    shown = spaces.Dict(partial=spaces.Box(0, 255, (36, 40, 3), np.uint8), privileged=spaces.Box(-1, 1, (1,), np.float32))
    model = small_model(Sampled(shown), policy_kwargs={"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}})
    policy = load_exported(export_learner(model, tmp_path / f"learner{suffix}", verify_on=4))
    images = np.stack([shown["partial"].sample() for _ in range(3)])
    policy.start(3)
    actions = policy.act({"partial": images}, np.ones(3, bool))
    np.testing.assert_allclose(actions, model.predict({"partial": images}, deterministic=True)[0], atol=1e-5)


def test_a_directory_without_a_model_says_what_is_in_it_and_what_to_do(tmp_path):
    (tmp_path / "config.yaml").touch()
    with pytest.raises(FileNotFoundError, match=rf"has no model.zip: .* sb3-gac train --resume {tmp_path} goes on with it"):
        model_file(tmp_path)
    for name in ("last.zip", "best.zip"):
        (tmp_path / name).touch()
    others = f"{tmp_path}/best.zip, {tmp_path}/last.zip"
    with pytest.raises(FileNotFoundError, match=rf"has no model.zip, but other models: give one of {others}\.$"):
        model_file(tmp_path)


def test_what_is_wrong_is_said_before_anything_is_run(gac, tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_gac.evaluate.run_episodes", None)
    asymmetric = tmp_path / "asymmetric.zip"
    AsymmetricSAC("MultiInputPolicy", noisy_walk(history=2), **SMALL).save(asymmetric)
    (tmp_path / "empty").mkdir()
    (tmp_path / "other.pt").write_text("nothing")
    wrong = {
        (tmp_path / "nowhere",): "There is no file or directory",
        (tmp_path / "empty",): "has no model.zip: the run has not finished",
        (gac,): "--env is needed: there is no config.yaml beside",
        (asymmetric, *NOISY, "--guider"): "AsymmetricSAC has no guider",
        (tmp_path / "other.pt", *NOISY): "is no TorchScript file",
        (tmp_path / "other.pt", *NOISY, "--guider"): "--guider: other.pt is an exported file",
        (tmp_path / "other.pt", *NOISY, "--vec-normalize", "x.pkl"): "--vec-normalize: other.pt is an exported file",
        (gac, *NOISY[:2]): r'make the environment as in training, such as by --env-kwargs "\{history: 4\}"',
        (gac, *NOISY, "--noise", "0", "-0.5"): "noise_std must be a finite number >= 0",
        (gac, *NOISY, "--delay", "-1", "1"): "delay: steps must be",
        (gac, *NOISY, "--drop", "1.5"): "drop: probability must be",
        (gac, "--env", "sb3_gac/HalfCheetha-v5"): "HalfCheetha",
        (gac, *NOISY[:2], "--env-kwargs", "{histroy: 2}"): "--env-kwargs: .*noisy_walk can't be made .*'histroy'",
        (gac, "--env", "sb3_gac/Hopper-v5", "--env-kwargs", "{histroy: 2}"): "--env-kwargs: .*'histroy'",
        (gac, *NOISY, "--out", tmp_path / "other.pt"): "--out: nothing can be written in the folder",
        (gac, *NOISY, "--out", tmp_path / "other.pt" / "below"): "--out: nothing can be written in the folder",
        (gac, *NOISY, "--vec-normalize", tmp_path / "other.pt"): "the model was trained without VecNormalize",
    }
    for arguments, message in wrong.items():
        with pytest.raises(SystemExit, match=message):
            main([*map(str, arguments)])


def test_a_folder_that_takes_no_files_is_refused_before_anything_is_run(gac, tmp_path, monkeypatch):
    def full(**options):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("sb3_gac.evaluate.run_episodes", None)
    monkeypatch.setattr("sb3_gac.evaluate.TemporaryFile", full)
    with pytest.raises(SystemExit, match=r"--out: nothing can be written in the folder .*: .*Read-only"):
        _evaluate(gac, tmp_path, *NOISY, "--noise", "0")


def test_what_can_not_be_saved_is_said_in_a_line_below_the_table(gac, tmp_path, capsys):
    (tmp_path / "evaluation.json").mkdir()
    with pytest.raises(SystemExit, match=r"Not all could be saved: .*evaluation\.json"):
        main([str(gac), "--out", str(tmp_path), "--episodes", "1", *NOISY, "--noise", "0"])
    assert "95% of the mean" in capsys.readouterr().out


@pytest.mark.parametrize("content", ["", "[1]", "run: 3", "lr: 0.1", "task: {", "environment: {name: Hopper}"])
def test_a_configuration_of_something_else_says_no_environment(content, gac, tmp_path):
    model = tmp_path / "model.zip"
    model.write_bytes(gac.read_bytes())
    (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(SystemExit, match=r"--env is needed: there is no config.yaml beside .* that says where it was trained"):
        main([str(model)])


@pytest.mark.parametrize("where", ["run_episodes", "load_model"])
def test_what_is_stopped_is_told_so(where, gac, tmp_path, monkeypatch, capsys):
    def stopped(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"sb3_gac.evaluate.{where}", stopped)
    with pytest.raises(SystemExit) as end:
        _evaluate(gac, tmp_path, *NOISY)
    assert end.value.code == 130
    assert capsys.readouterr().err == "\nStopped.\n"
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("name", ALGORITHMS)
def test_models_of_all_algorithms_are_found_in_their_files(name, tmp_path):
    make(name, Walk()).save(tmp_path / "model.zip")
    model = load_model(tmp_path / "model.zip")
    assert type(model) is algorithm_class(name)
    policies = [learner_of(model), *([guider_of(model)] if hasattr(model, "predict_guider") else [])]
    for policy in policies:
        episodes = run_episodes(policy, [Walk()], range(2))
        assert np.isfinite([episode.total for episode in episodes]).all()


def test_choices_are_actions_too():
    env = gym.make("sb3_gac/TigerDoor-v0")
    model = small_model(env)
    for policy in (learner_of(model), guider_of(model)):
        (episode,) = run_episodes(policy, [env], [0])
        assert episode.length >= 1


@pytest.mark.parametrize(
    "options",
    [
        *(["--episodes", "0"], ["--env-kwargs", "4"], ["--env-kwargs", "{a: ["], ["--delay", "0.5"], ["--noise"]),
        *(["--seed", "-1"], ["--video", "worst"], ["--video", "worst.png"]),
    ],
)
def test_the_option_that_is_wrong_is_named(options, capsys):
    with pytest.raises(SystemExit):
        main(["model.zip", *options])
    assert f"{options[0]}: " in capsys.readouterr().err


PAGE = (Path(__file__).parents[2] / "docs/evaluation.md").read_text()


def test_the_pages_commands_and_code_are_right():
    commands = re.findall(r"^(?:sb3-gac evaluate|python -m sb3_gac.evaluate) (.*)$", PAGE, re.MULTILINE)
    assert len(commands) == 2
    for command in commands:
        parse_arguments(shlex.split(command))
    names = {}
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    first, second = code.split("\n\nenv = gymnasium.make(")
    for block in (first, f"import gymnasium\nenv = gymnasium.make({second}"):
        exec(block, names)
        assert names["env"].reset(seed=0)[0] in names["env"].observation_space
    for option in ("--noise", "--delay", "--drop", "--guider", "--env", "--vec-normalize", "--out", "--seed", "--video"):
        assert f"`{option}" in PAGE


# --- numbers ---------------------------------------------------------------------------------------------------------


def _episodes(*totals, success=None):
    return [Episode(total, 10, success) for total in totals]


def test_an_outcome_by_hand():
    found = outcome(_episodes(6, 8, 10, success=True), _episodes(9, 10, 11))
    assert (found.mean.mean, found.std, found.difference.mean, found.success) == (8, 2, -2, 1)
    assert found.share == pytest.approx(0.8)
    half = 4.303 * 2 / np.sqrt(3)
    assert found.mean[1:] == pytest.approx((8 - half, 8 + half), abs=1e-3)
    paired = 4.303 * 1 / np.sqrt(3)
    assert found.difference[1:] == pytest.approx((-2 - paired, -2 + paired), abs=1e-3), "of differences, -3, -2 and -1"


def test_there_are_no_shares_of_what_is_not_above_zero():
    assert outcome(_episodes(-8, -6), _episodes(-5, -5)).share is None
    assert outcome(_episodes(8, 6), _episodes(-5, 5)).share is None


def test_successes_are_those_that_are_reported():
    mixed = [*_episodes(1, success=True), *_episodes(2, success=False)]
    assert outcome(mixed, mixed).success == 0.5
    unknown = [*mixed, *_episodes(2)]
    assert outcome(unknown, unknown).success is None


def test_a_row_says_what_can_not_be_said():
    found = outcome(_episodes(-1234.56), _episodes(-1000.0))
    assert row(Setting(0.1, 2, 0.25), "learner", found) == [
        "0.1",
        "2",
        "0.25",
        "learner",
        "-1235",
        "-",
        "-",
        "-",
        "-234.6",
        "-",
    ]
    reference = outcome(_episodes(4, 6, success=True), _episodes(4, 6))
    cells = row(UNDISTURBED, "guider", reference)
    assert cells[4:] == ["5", "1.414", "[-7.706, 17.71]", "100%", "-", "100%"]


def test_the_curve_shows_what_was_found(tmp_path, monkeypatch):
    from matplotlib import pyplot as plt

    kept = []
    monkeypatch.setattr(plt, "close", kept.append)
    settings = [Setting(noise) for noise in (0.0, 0.2)]
    found = {
        setting: {name: outcome(_episodes(*(base - 10 * setting.noise + x for x in (0, 2))), _episodes(1, 1))}
        for setting in settings
        for name, base in [("learner", 5)]
    }
    draw(found, {"noise": settings}, Setting(0.2), {"learner": "pupil"}, "title", tmp_path / "curve.png")
    draw(found, {}, Setting(0.2), {"learner": "pupil"}, "title", tmp_path / "points.png")
    (axis,) = kept[0].axes
    learner, trained = axis.get_lines()
    np.testing.assert_allclose(learner.get_xydata(), [[0, 6], [0.2, 4]])
    assert list(trained.get_xdata()) == [0.2, 0.2]
    assert axis.get_xlabel() == "standard deviation of the sensor noise"
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["pupil", "as in training"]
    assert axis.get_title() == "delay 0, drop 0"
    (points,) = kept[1].axes
    assert [label.get_text() for label in points.get_xticklabels()] == [
        "noise 0\ndelay 0\ndrop 0",
        "noise 0.2\ndelay 0\ndrop 0",
    ]
