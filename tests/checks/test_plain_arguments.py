"""Numbers of numpy and torch as arguments: Python's own inside, so that a file that was written can be read."""

import enum
import inspect
from collections import namedtuple
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.utils import LinearSchedule

from sb3_gac import GAC, TGRL, AsymmetricSAC
from sb3_gac.checks.arguments import PlainSchedule, constructor_arguments
from sb3_gac.checks.values import plain
from tests.helpers import Recall, TwoViewBandit, optimizers_of, small_model
from tests.registry import classes

ALGORITHMS = classes("replay", "temperature")
Pair = namedtuple("Pair", "low high")


class _Choice(enum.IntEnum):
    TWO = 2


#: Values that are no number of Python's, and what they become
FOREIGN = [
    (np.float64(0.5), 0.5),
    (np.float16(0.5), 0.5),
    (np.longdouble(0.5), 0.5),
    (np.int8(3), 3),
    (np.uint64(3), 3),
    (np.bool_(True), True),
    (np.str_("auto"), "auto"),
    (np.array(0.5), 0.5),
    (th.tensor(0.5), 0.5),
    (Fraction(1, 2), 0.5),
    (Decimal("0.5"), 0.5),
    (_Choice.TWO, 2),
    ({"a": [np.int64(1), (np.float32(2), {"b": np.array(3)})]}, {"a": [1, (2.0, {"b": 3})]}),
    (Pair(np.float64(1), 2), Pair(1.0, 2)),
]


def _types(value):
    if isinstance(value, dict):
        return {key: _types(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return type(value), [_types(part) for part in value]
    return type(value)


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("number", [Fraction(1, 2), Decimal("0.5")])
def test_numbers_of_pythons_other_types_are_saved_loaded_and_resumed(cls, number, tmp_path):
    options = {"net_arch": [4], "optimizer_kwargs": {"weight_decay": number}}
    model = small_model(cls=cls, lr_scales={"critic": number}, ent_coef=number, policy_kwargs=options).learn(20)
    model.save(tmp_path / "model")
    model.save_checkpoint(tmp_path / "checkpoints")
    for again in (cls.load(tmp_path / "model"), cls.resume(tmp_path / "checkpoints", TwoViewBandit(), device="cpu")):
        assert again.ent_coef_tensor.item() == 0.5
        assert optimizers_of(again.policy)[0].param_groups[0]["weight_decay"] == 0.5


@pytest.mark.parametrize(("value", "expected"), FOREIGN, ids=lambda value: repr(value)[:30])
def test_numbers_become_pythons_own(value, expected):
    assert plain(value) == expected
    assert _types(plain(value)) == _types(expected)


def test_arrays_become_numbers_only_where_they_are_the_packages_own():
    array = np.array([0.5])
    assert plain({"mean": array})["mean"] is array
    assert plain({"scale": array}, arrays=True) == {"scale": 0.5}
    assert plain(np.array([1.0, 2.0]), arrays=True) == [1.0, 2.0]
    assert plain(th.tensor([[3]]), arrays=True) == 3


#: Arguments in which numbers can be, as they are given
SHARED = {
    "learning_rate": np.float64(1e-3),
    "buffer_size": np.int64(300),
    "learning_starts": np.int32(10),
    "batch_size": np.uint8(8),
    "tau": np.float32(0.01),
    "gamma": np.array(0.98),
    "train_freq": (np.int64(2), "step"),
    "gradient_steps": np.int16(2),
    "n_steps": np.int64(3),
    "ent_coef": np.float32(0.05),
    "target_update_interval": np.int64(2),
    "target_entropy": np.float32(-1.0),
    "max_grad_norm": np.array([0.5]),
    "lr_scales": {"critic": np.array([3.0])},
    "policy_delay": np.int64(1),
    "random_shift": np.int64(0),
    "update_every": {"critic": np.int64(1)},
    "compile": np.bool_(False),
    "mixed_precision": np.bool_(False),
    "optimize_memory_usage": np.bool_(False),
    "stats_window_size": np.int64(7),
    "verbose": np.int64(0),
    "seed": np.uint32(3),
    "replay_buffer_kwargs": {"handle_timeout_termination": np.bool_(True)},
    "policy_kwargs": {
        "net_arch": [np.int64(8)],
        "n_critics": np.int64(3),
        "log_std_bounds": (np.float64(-4), np.float32(1)),
        "optimizer_kwargs": {"weight_decay": np.float64(1e-4), "betas": np.array([0.5, 0.9])},
    },
}
GACS_OWN = {
    "target_kl": np.float64(0.01),
    "guidance": np.float32(0.0),  # which GACWithoutQ takes too
    "behaviour": {"learner": np.float32(0.25)},
    "kl_coef_bounds": np.array([1e-3, 10.0]),
    "kl_coef_learning_rate": np.float64(1e-2),
    "max_kl": np.float32(0.5),
    "learner_kl_scale": np.float64(0.5),
    "learner_entropy": np.bool_(True),
}


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_a_model_made_with_foreign_numbers_is_saved_loaded_and_resumed(cls, tmp_path):
    arguments = SHARED | (GACS_OWN if issubclass(cls, GAC) else {}) | ({"n_steps": np.int64(1)} if cls is TGRL else {})
    model = small_model(cls=cls, **arguments).learn(20)
    assert model._n_updates > 0
    for argument in constructor_arguments(cls):
        if argument not in ("policy", "train_freq", "replay_buffer_class", "policy_kwargs") and argument in arguments:
            value = getattr(model, {"stats_window_size": "_stats_window_size"}.get(argument, argument))
            assert type(value) in (int, float, bool, list, dict), argument
    model.save(tmp_path / "model")
    model.save_checkpoint(tmp_path / "checkpoints")
    loaded = cls.load(tmp_path / "model", env=TwoViewBandit()).learn(20)
    resumed = cls.resume(tmp_path / "checkpoints", TwoViewBandit(), device="cpu").learn(5, reset_num_timesteps=False)
    for one in (loaded, resumed):
        options = optimizers_of(one.policy)[0].param_groups[0]
        assert (options["weight_decay"], tuple(options["betas"])) == (1e-4, (0.5, 0.9))
        assert one.replay_buffer.gamma == pytest.approx(0.98)


def test_every_argument_that_can_hold_a_number_is_tried():
    others = {"policy", "env", "action_noise", "replay_buffer_class", "role_keys", "kl_coef", "kl_reduction", "guider"}
    others |= {"shared_std", "tensorboard_log", "device", "_init_setup_model", "behaviour_per", "recording"}
    assert set(inspect.signature(GAC).parameters) == {*SHARED, *GACS_OWN, *others}


def test_sequences_of_foreign_lengths(tmp_path):
    kwargs = {"replay_buffer_kwargs": {"sequence_length": np.int64(2), "burn_in": np.int64(1)}, "batch_size": 4}
    kwargs["policy_kwargs"] = {"net_arch": [8], "rnn_hidden_size": np.int64(8), "rnn_net_arch": [np.int64(8)]}
    model = small_model(Recall(), policy="MultiInputGruPolicy", **kwargs).learn(20)
    model.save_checkpoint(tmp_path)
    assert GAC.resume(tmp_path, Recall(), device="cpu").replay_buffer.sequence_length == 2


@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
@pytest.mark.parametrize("number", [np.float64, np.float32, np.array, lambda x: np.array([x]), th.tensor])
def test_schedules_may_return_them(cls, number, tmp_path):
    schedules = {"learning_rate": lambda left: number(1e-3 * left)}
    if cls is GAC:
        schedules["target_kl"] = LinearSchedule(number(0.1), number(0.01), 1.0)
    model = small_model(cls=cls, **schedules).learn(15)
    assert type(model.policy.deployed.optimizer.param_groups[0]["lr"]) is float
    model.save(tmp_path / "model")
    assert type(cls.load(tmp_path / "model").lr_schedule(0.5)) is float


def test_a_plain_schedule_of_a_number_is_that_number():
    assert PlainSchedule(0.5)(0.3) == PlainSchedule(PlainSchedule(0.5))(0.3) == 0.5


@pytest.mark.parametrize("save", ["save", "save_checkpoint"])
def test_what_a_callback_leaves_in_an_optimiser_is_written_as_pythons_numbers(save, tmp_path):
    model = small_model().learn(15)
    model.lr_schedule = lambda left: np.float64(1e-3)
    model.policy.guider.optimizer.param_groups[0]["weight_decay"] = np.float32(0.5)
    model.learn(5, reset_num_timesteps=False)
    getattr(model, save)(tmp_path / "model")
    read = GAC.load if save == "save" else GAC.resume
    again = read(tmp_path / "model", TwoViewBandit(), device="cpu")
    options = again.policy.guider.optimizer.param_groups[0]
    assert (options["lr"], options["weight_decay"]) == (1e-3, 0.5)
