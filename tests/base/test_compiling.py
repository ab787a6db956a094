"""compile="auto": what is decided when learning begins, and that a stopped run goes on with it."""

import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from torch._dynamo.exc import TorchDynamoException

from sb3_gac import GAC, GPOClip
from sb3_gac.base import compiling
from sb3_gac.optim import compile as optim_compile
from sb3_gac.optim.compile import missing_compiler
from tests.helpers import TwoViewBandit, small_model


@pytest.fixture(autouse=True)
def _whatever_is_decided_nothing_is_compiled(monkeypatch):
    """As if there were a compiler, and it had nothing to do; 100 gradient steps pay for it."""
    monkeypatch.setattr(optim_compile.th, "compile", lambda function, **options: function)
    monkeypatch.setattr(compiling, "missing_compiler", lambda device: None)
    monkeypatch.setattr(compiling, "PAYS_FROM", 100)


def _auto(**arguments):
    return small_model(**{"compile": "auto", "learning_starts": 10, "train_freq": 1, "gradient_steps": 1, **arguments})


@pytest.mark.parametrize(("steps", "compiled"), [(109, False), (110, True)])
def test_it_is_compiled_where_enough_gradient_steps_are_to_come(steps, compiled, capsys):
    model = _auto(verbose=1)
    capsys.readouterr()
    assert not model.compiles, "before it is known how many there are"
    model.learn(steps, log_interval=10**6)
    assert model.compiles == compiled == bool(model.programs)
    assert capsys.readouterr().out.count("compile=") == 1
    decided, why = ("compiled", "which pays for half a minute of compiling") if compiled else ("not compiled", "")
    why = why or "and half a minute of compiling pays from 100 on"
    assert model.compile_decision == f'compile="auto": gradient steps are {decided}, for {steps - 10} are to come, {why}.'


def test_nothing_is_said_unless_asked_for(capsys):
    _auto().learn(1)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("arguments", "steps", "expected"),
    [
        ({"gradient_steps": -1}, 1000, 990),
        ({"train_freq": 4, "gradient_steps": 2}, 1000, 495),
        ({"train_freq": (2, "episode"), "gradient_steps": 500}, 10_010, 2500),
        ({"learning_starts": 2000}, 1000, 0),
    ],
)
def test_gradient_steps_to_come_off_policy(arguments, steps, expected):
    assert _auto(**arguments).gradient_steps_in(steps) == expected


def test_gradient_steps_to_come_on_policy():
    model = GPOClip("MultiInputPolicy", TwoViewBandit(), n_steps=10, batch_size=4, n_epochs=3, policy_kwargs={"net_arch": [4]})
    assert model.gradient_steps_in(21) == 3 * 3 * 3, "rollouts, minibatches, epochs"


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"policy_kwargs": {"net_arch": [4], "optimizer_class": th.optim.SGD}}, "the optimiser of learner is SGD"),
        ({"policy": "MultiInputGruPolicy"}, "for compilation can't do recurrent policies."),
    ],
)
def test_what_can_not_be_compiled_is_not(arguments, why):
    model = _auto(**arguments).learn(200)
    assert not model.compiles
    assert why in model.compile_decision
    with pytest.raises(ValueError, match=r"compile=True can.*leave"):
        _auto(**arguments, compile=True)


def test_nor_is_anything_without_a_compiler(monkeypatch):
    monkeypatch.setattr(compiling, "missing_compiler", missing_compiler)
    monkeypatch.setenv("CXX", "no-such-compiler")
    model = _auto().learn(200)
    assert not model.compiles
    assert "for there is no C++ compiler (no-such-compiler)." in model.compile_decision


def test_what_a_compiler_needs_is_looked_for(monkeypatch, tmp_path):
    compiler = tmp_path / "some-compiler"
    compiler.touch(mode=0o755)
    monkeypatch.setenv("CXX", str(compiler))
    monkeypatch.setenv("CC", str(tmp_path / "none"))
    monkeypatch.setattr(optim_compile.sysconfig, "get_path", lambda name: str(tmp_path))
    assert "Python.h" in missing_compiler(th.device("cpu"))
    (tmp_path / "Python.h").touch()
    assert missing_compiler(th.device("cpu")) is None
    monkeypatch.setattr(optim_compile, "find_spec", lambda name: None)
    assert missing_compiler(th.device("cuda")) == "Triton"
    monkeypatch.setattr(optim_compile, "find_spec", lambda name: name)
    assert missing_compiler(th.device("cuda")) == f"C compiler ({tmp_path / 'none'})"
    monkeypatch.delenv("CXX")
    monkeypatch.setenv("PATH", str(tmp_path))
    for platform, name in (("linux", "g++"), ("darwin", "clang++")):
        monkeypatch.setattr(sys, "platform", platform)
        assert missing_compiler(th.device("cpu")) == f"C++ compiler ({name})"
    assert missing_compiler(th.device("mps")) == "compiler for mps"


@pytest.mark.parametrize("compiled", [True, False])
def test_a_resumed_run_goes_on_with_what_it_had(compiled, tmp_path):
    model = _auto().learn(200 if compiled else 50)
    model.save_checkpoint(tmp_path)
    resumed = GAC.resume(tmp_path, TwoViewBandit())
    assert resumed.compile == "auto"
    resumed.learn(20 if compiled else 500, reset_num_timesteps=False)
    assert resumed.compiles == compiled
    assert "as before the run was stopped" in resumed.compile_decision
    resumed.programs.clear()
    resumed.learn(500 if not compiled else 20)
    assert resumed.compiles != compiled, "a new run decides anew"


def test_a_resumed_run_goes_on_where_there_is_no_compiler_any_more(tmp_path, monkeypatch):
    _auto().learn(200).save_checkpoint(tmp_path)
    monkeypatch.setattr(compiling, "missing_compiler", lambda device: "C++ compiler")
    assert not GAC.resume(tmp_path, TwoViewBandit()).learn(20, reset_num_timesteps=False).compiles


@pytest.mark.parametrize("before", [True, False])
def test_auto_given_at_resume_changes_nothing_about_the_run(before, tmp_path):
    _auto(compile=before).learn(50).save_checkpoint(tmp_path)
    resumed = GAC.resume(tmp_path, TwoViewBandit(), compile="auto")
    assert resumed.learn(500, reset_num_timesteps=False).compiles == before


def test_a_file_keeps_auto_and_a_loaded_model_decides_anew(tmp_path):
    _auto().learn(200).save(tmp_path / "model")
    loaded = GAC.load(tmp_path / "model", TwoViewBandit())
    assert loaded.compile == "auto"
    assert not loaded.compiles
    assert not loaded.learn(20).compiles
    assert loaded.learn(200).compiles


def test_what_has_programs_goes_on_with_them():
    model = _auto().learn(200)
    assert model.learn(20, reset_num_timesteps=False).compiles


def test_where_compiling_fails_training_goes_on_without(monkeypatch):
    def fails(*args):
        raise TorchDynamoException("no room on the disk\nand more")

    monkeypatch.setattr(optim_compile.th, "compile", lambda function, **options: fails)
    plain = _auto(compile=False, seed=0).learn(150)
    with pytest.warns(
        UserWarning, match='compile="auto": compiling failed.*TorchDynamoException: no room on the disk$'
    ) as told:
        model = _auto(seed=0).learn(150)
    assert len(told) == 1
    assert not model.compiles
    for one, other in zip(model.policy.parameters(), plain.policy.parameters(), strict=True):
        np.testing.assert_allclose(one.detach(), other.detach(), rtol=1e-4, atol=1e-6)
    with pytest.raises(TorchDynamoException, match="no room"):
        _auto(compile=True).learn(150)


def test_training_without_learning_compiles_on_request_alone():
    for argument in (False, True, "auto"):
        model = SimpleNamespace(compile=argument, _compiles_on_auto=False)
        assert compiling.Compilation.compiles.fget(model) == (argument is True)


class _Sets(BaseCallback):
    """Sets tau to one value after the other."""

    def __init__(self, values):
        super().__init__()
        self.values = iter(values)

    def _on_step(self):
        self.model.tau = next(self.values, self.model.tau)
        return True


@pytest.mark.parametrize(("n_values", "warns"), [(3, False), (4, True), (9, True)])
def test_a_setting_that_keeps_changing_is_warned_of_once(n_values, warns):
    model = _auto(compile=True)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(40, callback=_Sets(0.01 + 0.001 * np.arange(10 + n_values)))
    told = [str(warning.message) for warning in caught if "compiled for the 4th time" in str(warning.message)]
    assert len(told) == warns
    assert all("tau" in message and "compile=False" in message for message in told)
