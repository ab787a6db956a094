"""Arguments that are set on a model in the middle of training: they count as if ``resume`` had got them, or are refused."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise

from sb3_gac import GAC, AsymmetricSAC
from sb3_gac.algorithms import algorithm_class
from sb3_gac.base.changing import arguments_of
from sb3_gac.checks.arguments import KEPT_AS, constructor_arguments
from tests import registry
from tests.helpers import TwoViewBandit, TwoViewChoice, small_model

#: Argument -> another value than the small model's
OTHERS = {
    "learning_rate": 1e-2,
    "learning_starts": 60,
    "batch_size": 5,
    "tau": 0.5,
    "gamma": 0.5,
    "train_freq": 3,
    "gradient_steps": 3,
    "action_noise": NormalActionNoise(np.zeros(1), 0.3 * np.ones(1)),
    "n_steps": 3,
    "ent_coef": 0.3,
    "target_update_interval": 3,
    "target_entropy": -3.0,
    "max_grad_norm": 0.01,
    "policy_delay": 2,
    "update_every": {"critic": 2},
    "lr_scales": {"critic": 3.0},
    "mixed_precision": True,
    "n_epochs": 3,
    "gae_lambda": 0.5,
    "clip_range": 0.01,
    "normalize_advantage": False,
    "vf_coef": 2.0,
    "reward_scale": 3.0,
    "unroll_length": 2,
}
#: Algorithm -> the same of its own arguments
OWN = {
    "gac": {
        "behaviour": "learner",
        "target_kl": 0.5,
        "kl_coef": 5.0,
        "kl_coef_bounds": (20.0, 30.0),
        "kl_coef_learning_rate": 0.1,
        "learner_kl_scale": 2.0,
        "guidance": 0.5,
    },
    "asymmetric_sac": {"behaviour": {"actor": 1.0}},
    "asymmetric_mpo": {
        "n_actions": 7,
        "temperature": 2.0,
        "target_improvement": 3.0,
        "kl_coef": 30.0,
        "target_kl": 5.0,
        "std_kl_coef": 30.0,
        "target_std_kl": 5.0,
        "dual_learning_rate": 0.3,
    },
    "tgrl": {"teacher_coef": 0.1, "coef_step": 0.7, "compare_every": 7, "window": 1},
    "cosil": {
        "target_divergence": 0.9,
        "teacher_coef": 3.0,
        "teacher_coef_bounds": (4.0, 5.0),
        "teacher_coef_learning_rate": 0.3,
    },
    "rma": {"phase_1_steps": 45},
    "gpo_clip": {"delta": 0.9, "learner_rl_coef": 3.0, "ent_coef": 0.3},
    "gpo_penalty": {"target_kl": 10.0, "largest_kl_coef": 1e-9},
}
#: Arguments without which training goes the same way, or on whose own tests they are left
ELSEWHERE = {
    "compile": "tests/optim/test_compilation.py",
    "behaviour_per": "counts beside shares in behaviour alone",
    "recording": "tests/base/test_recording.py",
    "random_shift": "counts for images alone",
    "stats_window_size": "counts for the log alone",
    "tensorboard_log": "counts for the log alone",
    "verbose": "counts for the log alone",
    "teacher": "test_another_teacher_teaches_from_then_on",
    "critic_groups": "tests/baselines/test_asymmetric_sac.py",
}
#: What networks, data or random numbers are made with
BUILT_IN = {
    "policy": AsymmetricSAC.policy_aliases["MultiInputPolicy"],
    "policy_kwargs": {"net_arch": [9]},
    "buffer_size": 999,
    "replay_buffer_class": DictReplayBuffer,
    "replay_buffer_kwargs": {"mask_truncations": True},
    "optimize_memory_usage": True,
    "role_keys": {"critic": ["privileged"]},
    "seed": 99,
    "guider": "lagged",
    "kl_reduction": "sum",
    "max_kl": 0.5,
    "shared_std": "guider",
    "learner_entropy": False,
}
BUILT_IN_ELSEWHERE = {"rma": {"history": 5}, "gpo_clip": {"n_steps": 12}}
CASES = [
    *(("gac", name, value) for name, value in OTHERS.items() if name in constructor_arguments(GAC)),
    *(("gpo_clip", name, value) for name, value in OTHERS.items() if name not in constructor_arguments(GAC)),
    *(("gpo_clip", name, OTHERS[name]) for name in ("learning_rate", "gamma", "max_grad_norm", "lr_scales")),
    *((algorithm, name, value) for algorithm, own in OWN.items() for name, value in own.items()),
]


def _env():
    return TwoViewBandit(length=4)


def _learned(algorithm, **arguments):
    if algorithm == "tgrl":
        arguments = {"compare_every": 13, "window": 3} | arguments
    return registry.make(algorithm, _env(), seed=0, **arguments).learn(40)


def _set(model, name, value):
    setattr(model, KEPT_AS.get(name, name), value)


def _go_on(model):
    model.learn(40, reset_num_timesteps=False)
    return th.cat([registry.parameters(model), *(one.value.flatten() for one in model.coefficients.values())])


@pytest.mark.parametrize(("algorithm", "name", "value"), CASES)
def test_a_value_that_is_set_counts_as_one_that_resume_got(algorithm, name, value, tmp_path):
    model = _learned(algorithm)
    model.save_checkpoint(tmp_path)
    _set(model, name, value)
    now, resume = _go_on(model), algorithm_class(algorithm).resume
    th.testing.assert_close(now, _go_on(resume(tmp_path, _env(), "cpu", **{name: value})), rtol=0, atol=0)
    assert not now.equal(_go_on(resume(tmp_path, _env(), "cpu")))


@pytest.mark.parametrize(
    ("algorithm", "name", "value"),
    [
        *(("gac", name, value) for name, value in BUILT_IN.items()),
        *((algorithm, name, value) for algorithm, own in BUILT_IN_ELSEWHERE.items() for name, value in own.items()),
    ],
)
def test_what_a_model_was_built_of_is_refused_and_training_can_go_on(algorithm, name, value):
    model = _learned(algorithm)
    before = arguments_of(model)
    _set(model, name, value)
    with pytest.raises(ValueError, match=rf"Setting an argument can't change {name}: the model's networks, data or random"):
        model.learn(40, reset_num_timesteps=False)
    assert arguments_of(model) == before
    _go_on(model)


#: Algorithm -> wrong values of its arguments: of all coefficients, and of what networks, data and teachers are asked for
WRONG = {
    "gac": [
        *(("tau", 2.0), ("target_kl", -1.0), ("behaviour", "nobody"), ("train_freq", "often"), ("ent_coef", "oops")),
        *(("kl_coef", -1.0), ("kl_coef_bounds", (3.0, 1.0)), ("kl_coef_learning_rate", 0.0), ("lr_scales", {"nobody": 1.0})),
    ],
    "asymmetric_mpo": [(name, "auto_1e9") for name in ("temperature", "kl_coef", "std_kl_coef")],
    "tgrl": [("teacher_coef", -1.0), ("teacher", "nowhere.zip")],
    "cosil": [("teacher_coef", "oops"), ("teacher_coef_bounds", (3.0, 1.0)), ("teacher", "nowhere.zip")],
    "gpo_penalty": [("largest_kl_coef", -1.0)],
}


def _refuses(model, name, value, tmp_path):
    """Whether a value that is set is refused as if it had never been there, also in files that are written afterwards."""
    before, coefficients = arguments_of(model), model.coefficients
    _set(model, name, value)
    with pytest.raises((ValueError, OSError), match=name if name != "teacher" else "nowhere|teacher"):
        model.learn(40, reset_num_timesteps=False)
    assert arguments_of(model) == before
    assert model.coefficients is coefficients
    model.save(tmp_path / "model.zip")
    model.save_checkpoint(tmp_path / "checkpoints")
    now, frozen = _go_on(model), {each: getattr(model, each) for each in model.frozen_arguments}
    type(model).load(tmp_path / "model.zip", _env(), **frozen)
    assert now.equal(_go_on(type(model).resume(tmp_path / "checkpoints", _env(), "cpu", **frozen)))


@pytest.mark.parametrize(("algorithm", "name", "value"), [(name, *pair) for name, pairs in WRONG.items() for pair in pairs])
def test_a_wrong_value_is_refused_by_name_and_training_can_go_on(algorithm, name, value, tmp_path):
    _refuses(_learned(algorithm), name, value, tmp_path)


def test_a_teacher_of_other_spaces_is_refused_and_the_former_one_teaches_on(tmp_path):
    other = AsymmetricSAC("MultiInputPolicy", TwoViewChoice(), role_keys={"actor": ["partial", "privileged"]}, buffer_size=1)
    _refuses(_learned("cosil"), "teacher", other, tmp_path)


def test_a_learning_rate_of_the_memory_that_the_optimiser_can_not_have_is_refused(tmp_path):
    options = {"rnn_type": "gru", "rnn_hidden_size": 8, "rnn_net_arch": [], "net_arch": [8], "optimizer_class": th.optim.SGD}
    model = registry.make("gac", _env(), seed=0, policy_kwargs=options).learn(40)
    scales = {"memory": 0.1, "learner": 3.0, "guider": 3.0, "critic": 3.0}
    _refuses(model, "lr_scales", scales, tmp_path)
    assert {getattr(model.policy, role).optimizer.param_groups[0]["lr_scale"] for role in model.policy.trained} == {1.0}


def test_values_beside_a_wrong_one_are_refused_with_it():
    model = _learned("gac")
    before = arguments_of(model)
    model.target_kl, model.behaviour, model.kl_coef = 0.5, "learner", -1.0
    with pytest.raises(ValueError, match="kl_coef"):
        model.learn(40, reset_num_timesteps=False)
    assert arguments_of(model) == before
    assert model.target_kl_schedule(1.0) == before["target_kl"]


def test_a_wrong_value_comes_into_no_file(tmp_path):
    model = _learned("gac")
    for save in (lambda: model.save(tmp_path / "model.zip"), lambda: model.save_checkpoint(tmp_path)):
        model.ent_coef = "oops"
        with pytest.raises(ValueError, match="ent_coef"):
            save()
        save()
    GAC.load(tmp_path / "model.zip", _env())
    GAC.resume(tmp_path, _env())


def test_a_value_that_was_just_set_is_in_files_with_what_is_made_of_it(tmp_path):
    model = _learned("gac")
    model.ent_coef = 0.3
    model.save(tmp_path / "model.zip")
    assert GAC.load(tmp_path / "model.zip", _env()).ent_coef_tensor == pytest.approx(0.3)


#: Arguments that are dicts: before, and what changes in place
IN_PLACE = [
    ("behaviour", {"learner": 0.0}, ("learner", 1.0)),
    ("lr_scales", {"learner": 1.0}, ("learner", 0.1)),
    ("update_every", {"learner": 1}, ("learner", 3)),
]


@pytest.mark.parametrize(("name", "value", "entry"), IN_PLACE)
def test_a_dict_that_changes_in_place_counts_as_one_that_is_set(name, value, entry):
    in_place = _learned("gac", **{name: dict(value)})
    getattr(in_place, name).update([entry])
    now, by_value = _go_on(in_place), _learned("gac", **{name: dict(value)})
    setattr(by_value, name, dict([entry]))
    assert now.equal(_go_on(by_value))
    assert not now.equal(_go_on(_learned("gac", **{name: value})))


@pytest.mark.parametrize(
    ("name", "value", "entry"),
    [
        ("replay_buffer_kwargs", {"mask_truncations": False}, ("mask_truncations", True)),
        ("policy_kwargs", {"net_arch": {"critic": [8], "actor": [8]}}, ("net_arch", {"critic": [9], "actor": [8]})),
        ("behaviour", {"learner": 0.0}, ("learner", 2.0)),
    ],
)
def test_a_dict_that_changes_in_place_to_what_can_not_be_is_refused_each_time(name, value, entry):
    model = _learned("asymmetric_sac" if name != "behaviour" else "gac", **{name: value})
    before = deepcopy(getattr(model, name))
    for _ in range(2):
        getattr(model, name).update([entry])
        with pytest.raises(ValueError, match=name):
            model.learn(40, reset_num_timesteps=False)
        assert getattr(model, name) == before
    _go_on(model)


def test_a_list_within_a_dict_is_followed_as_well():
    model = _learned("asymmetric_sac", policy_kwargs={"net_arch": [8]})
    model.policy_kwargs["net_arch"].append(8)
    with pytest.raises(ValueError, match="policy_kwargs"):
        model.learn(40, reset_num_timesteps=False)
    assert model.policy_kwargs["net_arch"] == [8]


def test_every_argument_of_every_algorithm_has_a_test():
    for algorithm in registry.LINES:
        family = "gac" if algorithm.startswith("gac") else algorithm
        own = {**OWN.get(family, {}), **BUILT_IN_ELSEWHERE.get(family, {}), **OWN["gpo_clip"]}
        known = {*OTHERS, *ELSEWHERE, *BUILT_IN, *OWN["gac"], *own}
        assert set(constructor_arguments(algorithm_class(algorithm))) - known == set(), algorithm


@registry.algorithms()
def test_training_itself_changes_no_argument(algorithm, monkeypatch):
    model = _learned(algorithm)
    monkeypatch.setattr(type(model), "_change_arguments", lambda *_: pytest.fail("an argument has changed"))
    _go_on(model)


def test_another_teacher_teaches_from_then_on():
    other = AsymmetricSAC("MultiInputPolicy", _env(), role_keys={"actor": ["partial", "privileged"]}, seed=7, buffer_size=1)
    changed, unchanged = _learned("cosil"), _learned("cosil")
    changed.teacher = other
    assert not _go_on(changed).equal(_go_on(unchanged))
    assert changed.frozen["teacher"].policy is not unchanged.frozen["teacher"].policy


def test_a_schedule_that_is_set_follows_training():
    model = small_model(_env(), learning_starts=10).learn(40)
    model.target_kl = "linear 1 -> 0"
    model.learn(100)
    assert model.current_target_kl == pytest.approx(0, abs=0.05)


def test_policy_kwargs_have_no_arguments_of_the_algorithm():
    for name, value in (("guider", "lagged"), ("kl_reduction", "sum"), ("max_kl", 0.1)):
        with pytest.raises(ValueError, match=f"policy_kwargs has {name}, which is an argument of GAC: pass it as that"):
            small_model(policy_kwargs={"net_arch": [8], name: value})
