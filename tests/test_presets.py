"""Named sets of arguments."""

import re

import pytest
import torch as th
import yaml

import sb3_gac.presets
from sb3_gac import GAC, PRESETS, AsymmetricSAC, GACShare, preset
from sb3_gac.algorithms import ALGORITHMS, algorithm_class
from sb3_gac.checks.arguments import constructor_parameters
from sb3_gac.envs.suites import SUITES, task_of
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


def test_the_papers_preset_has_the_name_of_its_file_and_a_short_one():
    assert preset("paper", task="Ant", noise=0.3) == preset("paper-brax", task="Ant", noise=0.3)
    assert PRESETS["paper"].envs == 128


def test_the_papers_tasks_in_brax_are_the_papers_tasks():
    for task in SUITES["brax"].environments:
        name = task_of(task).removeprefix("brax-")
        assert preset("paper", task=task_of(task), noise=0.1) == preset("paper", task=name, noise=0.1)
        assert name in PRESETS["paper"].tasks
    assert preset("paper", task="brax-Ant", noise=0.3)["target_kl"] == 0.001
    assert preset("paper", task="other-Ant", noise=0.3)["target_kl"] == preset("paper")["target_kl"] == 0.005


def test_target_kl_is_that_of_task_and_noise_or_ones_own():
    found = [preset("small", task="HalfCheetah", noise=noise).get("target_kl") for noise in (0.0, 0.1, 0.2, 0.3)]
    assert found == [0.01, None, 0.001, 0.001]
    assert preset("small", task="InvertedDoublePendulum", noise=0.05)["target_kl"] == 0.001, "at every noise"
    assert preset("small", task="HalfCheetah", noise=0.3, target_kl=0.5)["target_kl"] == 0.5
    assert "target_kl" not in preset("small", task="Hopper", noise=0.3)
    assert "target_kl" not in preset("small")
    assert preset("paper")["target_kl"] == 0.005


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
    with pytest.raises(ValueError, match=r"activation_fn must name a class of torch\.nn, got 'silu'"):
        instantiate({"policy_kwargs": {"activation_fn": "silu"}})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"arguments": {}}, "own.yml: .*missing keys ['run']"),
        ({"run": {"envs": 1}, "arguments": {}, "more": {}}, "own.yml: unknown keys ['more']"),
        ({"run": {}, "arguments": {}}, "own.yml, run: .*missing keys ['envs']"),
        ({"run": {"envs": 1}, "arguments": {"GAC": {}}}, "own.yml, arguments: unknown keys ['GAC']"),
        ({"run": {"envs": 1}, "arguments": {"tau": 0.1}}, "own.yml, arguments: unknown keys ['tau']"),
        ({"run": {"envs": 1}, "arguments": {"gac": 0.1}}, "own.yml, arguments, gac: must be a mapping, got 0.1"),
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
