"""Named sets of arguments."""

import re
import warnings

import gymnasium
import numpy as np
import pytest
import torch as th
import yaml

import sb3_gac.presets
from sb3_gac import GAC, PRESETS, AsymmetricSAC, GACShare, preset
from sb3_gac.algorithms import ALGORITHMS, algorithm_class
from sb3_gac.checks.arguments import constructor_parameters
from sb3_gac.envs.suites import SUITES, env_id_of, task_named, task_of
from sb3_gac.presets import instantiate, read_preset
from tests.helpers import TwoViewBandit


@pytest.mark.parametrize("name", ["small", "paper"])
def test_presets_train(name):
    arguments = preset(name, learning_starts=20, batch_size=8, gradient_steps=1, buffer_size=100)
    model = GAC("MultiInputPolicy", TwoViewBandit(), **arguments)
    model.learn(30)
    assert model._n_updates > 0


def test_preset_paper_is_the_papers_table():
    model = GAC("MultiInputPolicy", TwoViewBandit(), **preset("paper", buffer_size=1000))
    assert (model.guider, model.batch_size, model.gradient_steps) == ("independent", 512, 64)
    assert (model.gamma, model.tau, model.learning_rate, model.max_grad_norm) == (0.99, 0.005, 3e-4, 1.0)
    assert model.target_entropy == -0.5
    assert model.policy.learner.net_arch == [256, 256]


def test_preset_merges_policy_kwargs_and_leaves_the_table_alone():
    arguments = preset("small", policy_kwargs={"n_critics": 3})
    assert arguments["policy_kwargs"] == {"net_arch": [128, 128], "n_critics": 3}
    assert "n_critics" not in preset("small")["policy_kwargs"]
    with pytest.raises(ValueError, match="preset must be one of"):
        preset("large")


def test_critics_get_all_entries_where_the_privileged_one_is_not_the_whole_state():
    arguments = {"task": "HalfCheetah", "noise": 0.1}
    whole = preset("small", **arguments)["role_keys"]
    assert whole is not None
    assert preset("small", privileged="state", **arguments)["role_keys"] == whole
    assert preset("small", privileged="velocity", **arguments)["role_keys"] is None
    assert preset("small", privileged="velocity", role_keys={"critic": ["partial"]}, **arguments)["role_keys"] == {
        "critic": ["partial"]
    }


def test_who_changes_what_he_got_does_not_change_the_preset():
    for name in ("small", "paper"):
        arguments = preset(name)
        before = repr(arguments)
        for value in arguments.values():
            if isinstance(value, dict):
                value["more"] = 1
                [layers.append(1) for layers in value.values() if isinstance(layers, list)]
        assert repr(preset(name)) == before


def test_every_preset_says_for_how_many_environments_it_is_and_is_taken_by_every_algorithm():
    assert {"small", "paper", "paper-brax"} <= set(PRESETS)
    assert len(PRESETS) == len(list(PRESETS))
    for name, found in PRESETS.items():
        assert found.envs >= 1
        for algorithm in ALGORITHMS:
            arguments = preset(name, algorithm=algorithm, task="Ant", noise=0.3)
            assert set(arguments) <= set(constructor_parameters(algorithm_class(algorithm))), (name, algorithm)


def test_the_papers_presets_are_for_as_many_environments_as_its_tables_say():
    assert PRESETS["paper"].envs == PRESETS["paper-brax"].envs == 128


def test_the_papers_tasks_in_brax_are_the_papers_tasks():
    for task in SUITES["brax"].environments:
        name = task_of(task).removeprefix("brax-")
        assert preset("paper", task=task_of(task), noise=0.1) == preset("paper", task=name, noise=0.1)
        assert name in PRESETS["paper"].tasks
    assert preset("paper", task="brax-Ant", noise=0.3)["target_kl"] == 0.001
    with pytest.raises(ValueError, match=r"nearest are \[.*'Ant'.*got 'other-Ant'"):
        preset("paper", task="other-Ant", noise=0.3)
    assert preset("paper", task="Hopper", noise=0.3)["target_kl"] == preset("paper")["target_kl"] == 0.005


def test_target_kl_is_that_of_task_and_noise_or_ones_own():
    found = [preset("small", task="HalfCheetah", noise=noise).get("target_kl") for noise in (0.0, 0.1, 0.2, 0.3)]
    assert found == [0.01, None, 0.001, 0.001]
    assert preset("small", task="InvertedDoublePendulum", noise=0.05)["target_kl"] == 0.001, "at every noise"
    assert preset("small", task="HalfCheetah", noise=0.3, target_kl=0.5)["target_kl"] == 0.5
    assert "target_kl" not in preset("small", task="Hopper", noise=0.3)
    assert "target_kl" not in preset("small")
    assert preset("paper")["target_kl"] == 0.005


@pytest.mark.parametrize("name", ["HalfCheetah-v5", "sb3_gac/HalfCheetah-v5", "sb3_gac:sb3_gac/HalfCheetah-v5", "HalfCheetah"])
def test_a_task_may_be_an_id(name):
    assert preset("paper", task=name, noise=0.3) == preset("paper", task="HalfCheetah", noise=0.3)
    assert preset("paper", task=name, noise=0.3)["target_kl"] == 0.001
    assert task_named(name) == "HalfCheetah"
    assert env_id_of(name) == "sb3_gac/HalfCheetah-v5"


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("HalfCheeta", "HalfCheetah"),
        ("halfcheetah", "HalfCheetah"),
        ("Ant-v4", "Ant"),
        ("RepeatPreviousEasy", "popgym-RepeatPreviousEasy"),
    ],
)
def test_an_unknown_task_is_an_error_that_names_the_nearest(name, nearest):
    for named in (lambda: preset("small", task=name), lambda: env_id_of(name)):
        with pytest.raises(ValueError, match=rf"^task must be one of .*nearest are \[.*'{nearest}'.*got '{name}'"):
            named()


@pytest.mark.parametrize("name", ["Drone-v0", "MyRobot", "quadrotor"])
def test_no_task_is_called_near_that_is_not(name):
    message = rf"^task must be one of [^;]* lists, got '{name}'\. For an environment of your own, leave task out\.$"
    with pytest.raises(ValueError, match=message):
        preset("small", task=name)


def test_the_preset_and_the_algorithm_that_may_be_meant_are_named():
    with pytest.raises(ValueError, match=r"got 'smal'\. Is \"small\" meant\?$"):
        preset("smal")
    for name, nearest in {"sac_asym": "asymmetric_sac", "SAC-asym": "asymmetric_sac", "GAC": "gac", "tglr": "tgrl"}.items():
        with pytest.raises(ValueError, match=rf"got '{name}'\. Is \"{nearest}\" meant\?$"):
            preset("small", algorithm=name)
    with pytest.raises(ValueError, match=r"got 'dreamer'\.$"):
        preset("small", algorithm="dreamer")


def test_an_environment_that_somebody_else_registers_is_a_task(monkeypatch):
    monkeypatch.setitem(gymnasium.registry, "sb3_gac/Mine-v3", gymnasium.spec("CartPole-v1"))
    assert env_id_of("Mine") == env_id_of("Mine-v3") == "sb3_gac/Mine-v3"
    assert preset("small", task="Mine") == preset("small", task=None)


def test_a_noise_is_the_nearest_entry_within_rounding():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for noise in (0.1 + 0.2, np.float32(0.3).item(), 0.3 - 1e-12):
            assert noise != 0.3
            assert preset("paper", task="Ant", noise=noise)["target_kl"] == 0.001
        for noise in (np.float32(0.3), np.array(0.3)[()]):
            assert preset("paper", task="Ant", noise=noise)["target_kl"] == 0.001
        assert preset("paper", task="Ant", noise=1e-12)["target_kl"] == 0.01
        for name in ("small", "paper"):
            for task in PRESETS[name].tasks:
                for noise in (0, 0.1, 0.2, 0.3):
                    preset(name, task=task, noise=noise)


def test_between_two_noises_numbers_are_interpolated_which_is_said():
    with pytest.warns(UserWarning, match=r"^The preset small for HalfCheetah has no .* noise 0\.15: .*0\.1 and 0\.2"):
        found = preset("small", task="HalfCheetah", noise=0.15)
    assert found["target_kl"] == pytest.approx((0.0033 + 0.001) / 2), "the default of GAC at 0.1, which the file leaves alone"
    with pytest.warns(UserWarning, match=r"between those at 0 and 0\.1: target_kl 0\.00875"):
        assert preset("paper", task="brax-Ant", noise=0.025)["target_kl"] == pytest.approx(0.01 - 0.005 / 4)
    with pytest.warns(UserWarning, match=r"those at 0\.3, the nearest: target_kl 0\.001"):
        assert preset("paper", task="Ant", noise=0.7)["target_kl"] == 0.001


def test_below_the_first_noise_there_is_what_the_task_has_and_nothing_is_said(tmp_path, monkeypatch):
    content = {
        "run": {"envs": 1},
        "arguments": {"gac": {"tau": 0.2}},
        "tasks": {"Own": {"arguments": {"gac": {"gamma": 0.9}}, "noises": {0.2: {"gac": {"tau": 0.4, "gamma": 0.5}}}}},
    }
    (tmp_path / "own.yml").write_text(yaml.safe_dump(content))
    monkeypatch.setattr(sb3_gac.presets, "DIRECTORY", tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = preset("own", task="Own", noise=0.1)
    assert (found["tau"], found["gamma"]) == (0.2, 0.9)


def test_nothing_is_said_where_an_algorithm_has_nothing_by_noise():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert preset("small", algorithm=AsymmetricSAC, task="Ant", noise=0.15) == preset("small", algorithm=AsymmetricSAC)
        preset("small", task="InvertedDoublePendulum", noise=0.15)


def test_what_is_no_number_is_that_of_the_nearer_noise(tmp_path, monkeypatch):
    monkeypatch.setattr(sb3_gac.presets, "DIRECTORY", tmp_path)
    noises = {0.1: {"gac": {"guider": "independent", "tau": 0.1}}, 0.2: {"gac_share": {"policy_kwargs": {"n_critics": 3}}}}
    content = {"run": {"envs": 1}, "arguments": {"gac": {"tau": 0.2}}, "tasks": {"Own": {"noises": noises}}}
    (tmp_path / "own.yml").write_text(yaml.safe_dump(content))
    with pytest.warns(UserWarning, match="interpolated"):
        found = [preset("own", algorithm="gac_share", task="Own", noise=noise) for noise in (0.125, 0.175)]
    assert [arguments["guider"] for arguments in found] == ["independent", "residual"]
    assert [arguments["tau"] for arguments in found] == [pytest.approx(0.125), pytest.approx(0.175)]
    assert [arguments["policy_kwargs"] for arguments in found] == [{}, {"n_critics": 3}]


@pytest.mark.parametrize("noise", [-0.1, float("nan"), float("inf"), None, "0.1", True])
def test_a_noise_that_is_none_is_refused(noise):
    with pytest.raises(ValueError, match="noise must be a finite number of at least 0, got"):
        preset("small", task="Ant", noise=noise)


def test_what_one_algorithm_has_of_its_own_reaches_it_and_its_subclasses_alone():
    for algorithm in ("gac", GAC, "gac_share", GACShare, "sb3_gac.gac.ablations:GACShare"):
        assert preset("paper", algorithm=algorithm)["guider"] == "independent"
    of_sac = preset("paper", algorithm=AsymmetricSAC, task="Ant")
    assert not {"guider", "learner_entropy", "target_kl"} & set(of_sac)
    assert preset("sb3", algorithm="asymmetric_sac")["policy_kwargs"]["log_std_bounds"] == [-20, 2]
    assert "log_std_bounds" not in preset("sb3", algorithm="stable_baselines3:SAC")["policy_kwargs"]
    with pytest.raises(ValueError, match=r"algorithm must be one of \[.*'gac'.*got 'ppo'"):
        preset("small", algorithm="ppo")


def test_names_of_activations_and_optimisers_become_classes():
    kwargs = preset("paper")["policy_kwargs"]
    assert (kwargs["activation_fn"], kwargs["optimizer_class"]) == (th.nn.SiLU, th.optim.Adam)
    assert preset("paper", policy_kwargs={"activation_fn": th.nn.Tanh})["policy_kwargs"]["activation_fn"] is th.nn.Tanh
    assert preset("paper", policy_kwargs={"activation_fn": "ReLU"})["policy_kwargs"]["activation_fn"] is th.nn.ReLU
    with pytest.raises(ValueError, match=r"activation_fn must name a class of torch\.nn, got 'silu'"):
        preset("small", policy_kwargs={"activation_fn": "silu"})
    with pytest.raises(ValueError, match=r"policy_kwargs: must be a mapping, got \[1\]"):
        instantiate({"policy_kwargs": [1]})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"arguments": {}}, "own.yml: .*missing keys ['run']"),
        ({"run": {"envs": 1}, "arguments": {}, "more": {}}, "own.yml: unknown keys ['more']"),
        ({"run": {}, "arguments": {}}, "own.yml, run: .*missing keys ['envs']"),
        ({"run": {"envs": 1}, "arguments": {"GAC": {}}}, "own.yml, arguments: unknown keys ['GAC']"),
        ({"run": {"envs": 1}, "arguments": {"tau": 0.1}}, "own.yml, arguments: unknown keys ['tau']"),
        ({"run": {"envs": 1}, "arguments": {"gac": 0.1}}, "own.yml, arguments, gac: must be a mapping, got 0.1"),
        ({"run": {"envs": 1, "eval_every": 5}, "arguments": {}}, "own.yml, run: unknown keys ['eval_every']"),
        ({"run": {"envs": 1}, "arguments": {}, "normalize": {"sac": {}}}, "own.yml, normalize: unknown keys ['sac']"),
        ({"extends": "own", "argument": {}}, "own.yml: unknown keys ['argument']"),
        ({"run": {"envs": 1}, "arguments": [1]}, "own.yml, arguments: must be a mapping, got [1]"),
        (
            {"run": {"envs": 1}, "arguments": {}, "tasks": {"Ant": {"noise": {}}}},
            "own.yml, Ant: unknown keys ['noise']",
        ),
        (
            {"run": {"envs": 1}, "arguments": {}, "tasks": {"Ant": {"noises": {"1e-1": {"gac": {}}}}}},
            "own.yml, Ant, noises: must be numbers, each, got '1e-1'",
        ),
        (
            {"run": {"envs": 1}, "arguments": {}, "tasks": {"Ant": {"noises": {0.1: {"gacc": {}}}}}},
            "own.yml, Ant, noise 0.1: unknown keys ['gacc']",
        ),
    ],
)
def test_a_file_with_keys_that_mean_nothing_is_refused(content, message, tmp_path, monkeypatch):
    monkeypatch.setattr(sb3_gac.presets, "DIRECTORY", tmp_path)
    (tmp_path / "own.yml").write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=re.escape(message).replace(r"\.\*", ".*")):
        read_preset("own")


class Own(GAC):
    """Of somebody else."""


def test_a_preset_may_have_arguments_for_somebody_elses_class(tmp_path, monkeypatch):
    monkeypatch.setattr(sb3_gac.presets, "DIRECTORY", tmp_path)
    sections = {f"{__name__}:Own": {"tau": 0.3}, "gac": {"tau": 0.2, "gamma": 0.2}, "all": {"tau": 0.1, "batch_size": 8}}
    (tmp_path / "own.yml").write_text(yaml.safe_dump({"run": {"envs": 1}, "arguments": sections}))
    arguments = preset("own", algorithm=Own)
    assert (arguments["tau"], arguments["gamma"], arguments["batch_size"]) == (0.3, 0.2, 8), "over those of its ancestors"
    assert preset("own")["tau"] == 0.2
