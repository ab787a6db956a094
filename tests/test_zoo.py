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
from tests.registry import LINES, algorithms, is_taught, small_arguments, teacher_for

ENV = "sb3_gac/InvertedDoublePendulum-v5"
WITH_NOISE = ("--env-kwargs", "noise_std:0.2")


def _small(algorithm):
    """As the zoo takes arguments."""
    of_policy = {"net_arch": [8], **LINES[algorithm].policy_kwargs}
    arguments = {"n_envs": 1, "policy_kwargs": of_policy, "gradient_steps": 1, **small_arguments(algorithm)}
    arguments |= {"teacher": teacher_for(ENV)} if is_taught(algorithm) else {}
    if not issubclass(algorithm_class(algorithm), OffPolicyAlgorithm):
        del arguments["gradient_steps"]
    return ["-params", *(f"{name}:{value!r}" for name, value in arguments.items())]


@pytest.fixture(scope="module")
def zoo(tmp_path_factory):
    """Calls a script of the zoo in this process, in a folder of its own: script, options -> that folder."""
    folder = tmp_path_factory.mktemp("zoo")
    with pytest.MonkeyPatch.context() as context:
        context.chdir(folder)

        def call(script, *options):
            context.setattr(sys, "argv", ["zoo"])
            main([script, *map(str, options)])
            return folder

        yield call


def _train(zoo, algorithm, *options):
    return zoo("train", "--algo", algorithm, "--env", ENV, *WITH_NOISE, *options, *_small(algorithm))


@pytest.mark.parametrize("algorithm", [name for name in LINES if is_taught(name)])
def test_an_algorithm_with_a_teacher_asks_for_it(algorithm, zoo):
    with pytest.raises(SystemExit, match=rf"--algo {algorithm}: it learns from a teacher.*-params teacher:"):
        zoo("train", "--algo", algorithm, "--env", ENV)


@pytest.fixture(scope="module", params=list(LINES))
def trained(request, zoo):
    """An algorithm that was trained for a moment, and the folder of its files."""
    return request.param, _train(zoo, request.param, "-n", 40, "--eval-freq", 20, "--eval-episodes", 1)


def test_train_saves_what_the_zoo_saves(trained):
    algorithm, folder = trained
    (run,) = (folder / "logs" / algorithm).iterdir()
    files = {path.name for path in run.rglob("*")}
    assert {"best_model.zip", "config.yml", "args.yml", "evaluations.npz"} <= files
    config = next(run.rglob("config.yml")).read_text()
    assert "MultiInputPolicy" in config
    if hyperparameters(algorithm)[ENV].get("role_keys"):
        assert "privileged" in config, "from our YAML: critics on the state alone"


def test_enjoy_runs_the_deployed_policy(trained, zoo, capsys):
    algorithm, _ = trained
    zoo("enjoy", "--algo", algorithm, "--env", ENV, "--folder", "logs", "-n", 20, "--no-render")
    assert "Mean reward" in capsys.readouterr().out


@algorithms()
def test_optimize_samples_and_trains(algorithm, zoo, capsys):
    trials = ("-optimize", "--n-trials", 1, "--n-jobs", 1, "--n-evaluations", 1, "--eval-episodes", 1, "--no-optim-plots")
    _train(zoo, algorithm, "-n", 20, *trials)
    printed = capsys.readouterr().out
    assert "Best trial" in printed
    assert "learning_rate" in printed


def test_the_programs_run_as_commands(tmp_path):
    """Train, then record a video of it."""
    environment = {**os.environ, "MUJOCO_GL": "egl", "OMP_NUM_THREADS": "1"}
    train = ("train", "-n", 30, "--eval-freq", -1, *_small("gac"))
    for script, *options in (train, ("record_video", "--folder", "logs", "-n", 20)):
        command = [sys.executable, "-m", "sb3_gac.zoo", script, "--algo", "gac", "--env", ENV, *map(str, options)]
        result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment)
        assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-4000:]
    assert list(tmp_path.rglob("*.mp4"))


def test_sampled_values_become_arguments():
    sampled = {"one_minus_gamma": 0.01, "batch_size_pow": 7, "net_arch": "small", "tau": 0.01}
    assert convert(sampled) == {"gamma": 0.99, "batch_size": 128, "policy_kwargs": {"net_arch": [128, 128]}, "tau": 0.01}
    assert sampled["net_arch"] == "small", "left as the trial stored it"


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_our_algorithms_have_our_hyperparameters(algorithm, tmp_path):
    for options in (["--algo", algorithm, "-n", "5"], ["-n", "5", f"--algo={algorithm}"]):
        assert with_hyperparameters(options, tmp_path) == [*options, "--conf-file", str(tmp_path / f"{algorithm}.yml")]
        assert yaml.safe_load((tmp_path / f"{algorithm}.yml").read_text()) == hyperparameters(algorithm)


def test_critics_see_all_where_the_environments_privileged_entry_is_less_than_the_state(tmp_path):
    path = tmp_path / "gac.yml"
    for words, sees_state_alone in ((["privileged:'velocity'"], False), (["noise_std:0.2", "privileged:'state'"], True)):
        with_hyperparameters(["--algo", "gac", "--env", "sb3_gac/Hopper-v5", "--env-kwargs", *words], tmp_path)
        written = yaml.safe_load(path.read_text())
        assert ("role_keys" in written.get("sb3_gac/Hopper-v5", written["default"])) == sees_state_alone


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


def test_the_zoos_own_algorithms_train(zoo):
    small = ("-params", "n_envs:1", "n_steps:32", "batch_size:32")
    folder = zoo("train", "--algo", "ppo", "--env", "CartPole-v1", "-n", 32, "--eval-freq", -1, *small)
    assert (folder / "logs" / "ppo").is_dir()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_has_hyperparameters_that_it_takes_for_every_registered_task(algorithm):
    settings = hyperparameters(algorithm)
    of_mujoco = {f"sb3_gac/{task}-v5" for task in envs.suites.mujoco.TASKS}
    of_playground = {f"sb3_gac/{task}-v0" for task in envs.suites.playground.TASKS}
    of_brax = {f"sb3_gac/brax-{task}-v0" for task in envs.suites.brax.TASKS}
    of_pixels = {f"sb3_gac/{task}Pixels-v5" for task in envs.suites.pixels.TASKS}
    with_whole_state = {"sb3_gac/Pendulum-v1", *of_mujoco, *of_playground, *of_brax, *of_pixels}
    assert set(settings) == {"default", *with_whole_state}
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
