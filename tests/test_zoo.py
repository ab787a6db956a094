"""rl_zoo3 with our algorithms: train, optimise, enjoy and record, as its users call them."""

import os
import subprocess
import sys

import pytest
import yaml
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

pytest.importorskip("rl_zoo3")

from sb3_gac import envs
from sb3_gac.algorithms import ALGORITHMS, algorithm_class
from sb3_gac.zoo import convert, hyperparameters, main, sample, with_hyperparameters

TRAINED = ("gac", "asymmetric_sac")
TAUGHT = sorted(name for name in ALGORITHMS if "teacher" in algorithm_class(name).frozen_arguments)
ENV = "sb3_gac/InvertedDoublePendulum-v5"
QUICK = ["learning_starts:20", "batch_size:8", "policy_kwargs:dict(net_arch=[8])", "n_envs:1", "gradient_steps:1"]


def _zoo(script, folder, *options):
    command = [sys.executable, "-m", "sb3_gac.zoo", script, "--env", ENV, *map(str, options)]
    environment = {**os.environ, "MUJOCO_GL": "egl", "OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=environment)
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-4000:]
    return result.stdout


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder in which each algorithm was trained for a moment."""
    folder = tmp_path_factory.mktemp("zoo")
    for algorithm in TRAINED:
        options = ("--algo", algorithm, "-n", 120, "--env-kwargs", "noise_std:0.2", "--eval-freq", 60, "--eval-episodes", 1)
        _zoo("train", folder, *options, "-params", *QUICK)
    return folder


@pytest.mark.parametrize("algorithm", TRAINED)
def test_train_saves_what_the_zoo_saves(trained, algorithm):
    (run,) = (trained / "logs" / algorithm).iterdir()
    files = {path.name for path in run.rglob("*")}
    assert {"best_model.zip", "config.yml", "args.yml", "evaluations.npz"} <= files
    config = next(run.rglob("config.yml")).read_text()
    assert "MultiInputPolicy" in config
    assert "privileged" in config, "from our YAML: critics on the state alone"


@pytest.mark.parametrize("algorithm", TRAINED)
def test_enjoy_runs_the_deployed_policy(trained, algorithm):
    output = _zoo("enjoy", trained, "--algo", algorithm, "--folder", "logs", "-n", 50, "--no-render")
    assert "Mean reward" in output


@pytest.mark.parametrize("algorithm", TAUGHT)
def test_a_student_trains_with_a_teachers_file_and_acts(algorithm, tmp_path, monkeypatch, capsys):
    env = envs.make_mujoco("InvertedDoublePendulum", noise_std=0.2)
    algorithm_class("asymmetric_sac")("MultiInputPolicy", env, buffer_size=10).save(tmp_path / "teacher.zip")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["zoo"])
    given = ["--algo", algorithm, "--env", ENV]
    own = ["-n", "60", "--env-kwargs", "noise_std:0.2", "--eval-freq", "-1", "-params", *QUICK, "teacher:'teacher.zip'"]
    main(["train", *given, *own])
    main(["enjoy", *given, "--folder", "logs", "-n", "20", "--no-render"])
    assert "Mean reward" in capsys.readouterr().out
    trials = ["-optimize", "--n-trials", "1", "--n-jobs", "1", "--n-evaluations", "1", "--eval-episodes", "1"]
    main(["train", *given, "-n", "30", *trials, "--no-optim-plots", "-params", *QUICK, "teacher:'teacher.zip'"])
    assert "Best trial" in capsys.readouterr().out


def test_record_video_writes_one(trained):
    _zoo("record_video", trained, "--algo", "gac", "--folder", "logs", "-n", 20)
    assert list(trained.rglob("*.mp4"))


def test_optimize_samples_and_trains(trained):
    options = (
        "--algo",
        "gac",
        "-n",
        60,
        "-optimize",
        "--n-trials",
        2,
        "--n-jobs",
        1,
        "--no-optim-plots",
        "--eval-episodes",
        1,
    )
    output = _zoo("train", trained, *options, "--n-evaluations", 1, "-params", "learning_starts:20", "n_envs:1")
    assert "target_kl" in output


def test_sampled_values_become_arguments():
    sampled = {"one_minus_gamma": 0.01, "batch_size_pow": 7, "net_arch": "small", "tau": 0.01}
    assert convert(sampled) == {"gamma": 0.99, "batch_size": 128, "policy_kwargs": {"net_arch": [128, 128]}, "tau": 0.01}
    assert sampled["net_arch"] == "small", "left as the trial stored it"


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_our_algorithms_have_our_hyperparameters(algorithm, tmp_path):
    for options in (["--algo", algorithm, "-n", "5"], ["-n", "5", f"--algo={algorithm}"]):
        assert with_hyperparameters(options, tmp_path) == [*options, "--conf-file", str(tmp_path / f"{algorithm}.yml")]
        assert yaml.safe_load((tmp_path / f"{algorithm}.yml").read_text()) == hyperparameters(algorithm)


@pytest.mark.parametrize(
    "options",
    [
        ["--algo", "gac", "--conf-file", "my.yml"],
        ["--algo", "gac", "--conf-file=my.yml"],
        ["--algo", "gac", "-conf", "my.yml"],
        ["--algo", "gac", "--conf", "my.yml"],
        ["--algo", "ppo", "--env", "CartPole-v1"],
        ["--env", "CartPole-v1"],
    ],
)
def test_a_file_of_ones_own_and_other_algorithms_are_left_to_the_zoo(options, tmp_path):
    assert with_hyperparameters(options, tmp_path) == options


def test_the_zoos_own_algorithms_train(tmp_path):
    options = (
        "train",
        "--algo",
        "ppo",
        "--env",
        "CartPole-v1",
        "-n",
        "64",
        "-params",
        "n_envs:1",
        "n_steps:32",
        "batch_size:32",
    )
    command = [sys.executable, "-m", "sb3_gac.zoo", *options]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-4000:]
    assert (tmp_path / "logs" / "ppo").is_dir()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_has_hyperparameters_that_it_takes_for_every_registered_task(algorithm):
    settings = hyperparameters(algorithm)
    of_mujoco = {f"sb3_gac/{task}-v5" for task in envs.suites.mujoco.TASKS}
    of_playground = {f"sb3_gac/{task}-v0" for task in envs.suites.playground.TASKS}
    assert set(settings) == {"default", "sb3_gac/Pendulum-v1", *of_mujoco, *of_playground}
    of_critics = None if algorithm in ("cosil", "rma") else {"critic": ["privileged"]}  # theirs see what the preset can't say
    assert settings[ENV]["role_keys"] == of_critics
    assert "role_keys" not in settings["default"], "elsewhere the privileged entry may not be the whole state"
    kind = algorithm_class(algorithm)
    off_policy = issubclass(kind, OffPolicyAlgorithm)
    of_family = {"batch_size": 128, "gradient_steps": -1} if off_policy else {"batch_size": 256, "n_steps": 512}
    shared = {"n_envs": 4, "n_timesteps": 100_000, "policy": "MultiInputPolicy"} | of_family
    assert shared.items() <= settings["default"].items()
    arguments = {key: value for key, value in settings[ENV].items() if key not in ("n_envs", "n_timesteps")}
    kind(env=envs.make_mujoco("InvertedDoublePendulum"), **arguments | ({"buffer_size": 10} if off_policy else {}))


def test_every_argument_that_is_sampled_is_used():
    class Trial:
        """Gives the lower end of what it is asked for, or the first choice."""

        def suggest_float(self, name, low, high, log=False):
            return low

        suggest_int = staticmethod(lambda name, low, high: low)
        suggest_categorical = staticmethod(lambda name, choices: choices[0])

    shared = {"gamma", "learning_rate", "batch_size", "tau", "policy_kwargs"}
    names = ("gac", "gac_share", "asymmetric_sac", "tgrl", "cosil", "asymmetric_mpo")
    of_gac, of_share, of_sac, of_tgrl, of_cosil, of_mpo = (sample(name, Trial(), 1, 1, {}) for name in names)
    assert set(of_sac) == set(of_tgrl) == shared | {"target_entropy"}
    assert set(of_cosil) == shared | {"target_divergence", "teacher_coef_learning_rate"}
    assert set(of_gac) == set(of_sac) | {"target_kl", "kl_coef_learning_rate"}
    assert set(of_mpo) == shared | {"target_improvement", "target_kl", "target_std_kl"}
    assert set(of_share) == set(of_gac), "as a subclass of GAC"
    assert (of_gac["gamma"], of_gac["batch_size"], of_gac["target_kl"]) == (0.999, 64, 3e-4)
    of_clip, of_penalty = (set(sample(name, Trial(), 1, 1, {})) for name in ("gpo_clip", "gpo_penalty"))
    assert of_clip - of_penalty == {"delta"}
    assert of_penalty - of_clip == {"target_kl"}
    on_policy = (shared - {"tau", "target_entropy"}) | {"n_epochs", "gae_lambda", "clip_range", "ent_coef", "learner_rl_coef"}
    assert of_clip & of_penalty == on_policy
