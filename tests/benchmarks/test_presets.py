"""The package's presets and the benchmarks' are the same settings."""

import inspect

import pytest
import torch as th

from benchmarks.config import instantiate, resolve
from benchmarks.suite import RunSpec, read_preset
from sb3_gac import GAC, PRESETS, preset

NOISES = (0.0, 0.1, 0.2, 0.3)
DEFAULTS = {name: parameter.default for name, parameter in inspect.signature(GAC).parameters.items()}


def _of_benchmarks(name, task, noise):
    _, arguments = resolve(RunSpec("gac", task, noise, 0, 2_000_000, 128, name, 500, 1))
    arguments = DEFAULTS | instantiate(arguments)
    of_policy = dict(arguments["policy_kwargs"])
    assert of_policy.pop("optimizer_class", th.optim.Adam) is th.optim.Adam, "the default"
    if isinstance(of_policy["net_arch"], dict):
        of_policy["net_arch"], of_critics = of_policy["net_arch"].values()
        assert of_policy["net_arch"] == of_critics
    return arguments | {"policy_kwargs": of_policy}


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize(("ours", "of_benchmarks"), [("small", "small"), ("paper", "paper-brax")])
def test_presets_agree(ours, of_benchmarks, noise):
    assert PRESETS[ours].envs == read_preset(of_benchmarks)["run"]["envs"]
    tasks = {*PRESETS[ours].target_kls, *read_preset(of_benchmarks)["tasks"], "Hopper"}
    for task in tasks:
        assert DEFAULTS | preset(ours, task=task, noise=noise) == _of_benchmarks(of_benchmarks, task, noise), task


def test_a_target_kl_of_ones_own_is_taken():
    assert preset("small", task="HalfCheetah", noise=0.3, target_kl=0.5)["target_kl"] == 0.5
    assert preset("paper")["target_kl"] == 0.005
