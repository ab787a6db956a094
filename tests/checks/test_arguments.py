"""Every constructor argument out of its range gets a ValueError that names it, what is allowed and what it was."""

import inspect

import numpy as np
import pytest
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gac import COSIL, GAC, AsymmetricMPO, AsymmetricSAC, GPOClip, GPOPenalty
from sb3_gac.checks.arguments import HANDED_ON, merged, unless
from sb3_gac.checks.values import check_fraction, check_positive
from tests.helpers import TwoViewBandit, TwoViewChoice, small_model

NAN, INF = float("nan"), float("inf")

#: Argument -> (values out of its range, what the message says is allowed)
SHARED = {
    "policy": (["MlpPolicy", "CnnPolicy", "Multi", int, 3], "MultiInputPolicy"),
    "env": ([3, TwoViewBandit, None], "environment"),
    "learning_rate": (
        [-1e-3, NAN, INF, "fast", None, lambda _: -1.0, lambda _: NAN, lambda left: left - 0.5],
        r"learning_rate( at the (start|end) of training)? must be a number >",
    ),
    "buffer_size": ([0, -1, 1e6, "big", None], "buffer_size must be an integer >= 1"),
    "learning_starts": ([-1, NAN, INF, "soon", None], "learning_starts must be a number >= 0"),
    "batch_size": ([0, -1, 16.0, "big", None], "batch_size must be an integer >= 1"),
    "tau": ([-0.1, 1.1, NAN, "slow", None], "tau must be a number from 0 to 1"),
    "gamma": ([-0.1, 1.1, NAN, "far", None], "gamma must be a number from 0 to 1"),
    "train_freq": (
        [0, -1, 1.5, "4", None, (0, "step"), (1, "day"), (1,), (1, "step", 2), [1, "episode"]],
        'train_freq must be an integer >= 1 or .integer >= 1, "step" or "episode".',
    ),
    "gradient_steps": ([-2, 0.5, "many", None], "gradient_steps must be an integer >= -1"),
    "action_noise": (
        [0.1, "normal", NormalActionNoise(np.zeros(3), np.ones(3))],
        "action_noise must (be an ActionNoise or None|have as many components as an action, 1, but its mean has 3)",
    ),
    "replay_buffer_class": ([ReplayBuffer, dict, "DictReplayBuffer"], "replay_buffer_class.*DictReplayBuffer"),
    "replay_buffer_kwargs": (
        [3, ["storage_dtype"]],
        "replay_buffer_kwargs must be a dict or None",
    ),
    "optimize_memory_usage": (["yes", 2, None], r"optimize_memory_usage must be one of \[False, True\]"),
    "n_steps": ([0, -1, 1.5, "three", None], "n_steps must be an integer >= 1"),
    "ent_coef": (["automatic", "auto_zero", "auto_-1", "auto_0", -1, NAN, INF, None], 'ent_coef must be "auto"'),
    "target_update_interval": ([0, -1, 0.5, None], "target_update_interval must be an integer >= 1"),
    "target_entropy": (["high", NAN, -INF, None], 'target_entropy must be "auto", "sac" or a number'),
    "max_grad_norm": ([0, -1, NAN, INF, "one"], "max_grad_norm must be a number > 0, or None"),
    "lr_scales": (
        [{"critic": 0}, {"critic": NAN}, {"nobody": 2.0}, 3.0, "critic"],
        r'lr_scales(\["critic"\] must be a number > 0| names unknown roles \[.nobody.\]| must be a dict)',
    ),
    "role_keys": (
        [{"student": ["partial"]}, {"critic": ["touch"]}, {"critic": []}, {"critic": "partial"}, 3, "partial"],
        r'role_keys( names unknown roles|\["\w*critic"\] (names unknown.*touch|must be a non-empty list)| must be a dict)',
    ),
    "policy_delay": ([0, -1, 1.5, None], "policy_delay must be an integer >= 1"),
    "update_every": (
        [2, "critic", {"nobody": 2}, {"critic": 0}, {"critic": 1.5}],
        r'update_every( must be a dict|\["critic"\] must be an integer >= 1| names unknown roles \[.nobody.\])',
    ),
    "behaviour": (
        [0.5, "critic", {"nobody": 0.5}, {"POLICY": 1.5}],
        "behaviour(: a policy must be one of| must be a policy's name, a dict of shares or None| must be shares from 0 to 1)",
    ),
    "behaviour_per": (["step", 2, None], r"behaviour_per must be one of \['environment', 'episode'\]"),
    "recording": ([3, True, ["a.npz"]], "recording must be a path or None"),
    "random_shift": ([-1, 1.5, "far", None], "random_shift must be an integer >= 0"),
    "compile": (["yes", 2, None], 'compile must be True, False or "auto"'),
    "mixed_precision": (["bfloat16", 2, None], r"mixed_precision must be one of \[False, True\]"),
    "stats_window_size": ([0, -1, 1.5, None], "stats_window_size must be an integer >= 1"),
    "tensorboard_log": ([3, True], "tensorboard_log must be a directory or None"),
    "policy_kwargs": (
        [
            3,
            {"net_arch": {"nobody": [8]}},
            {"net_arch": [0]},
            {"net_arch": [8.5]},
            {"net_arch": 8},
            {"n_critics": 0},
            {"rnn_hidden_size": 0},
            {"log_std_bounds": (1, -1)},
            {"log_std_bounds": 1},
            {"activation_fn": "relu"},
            {"optimizer_class": "adam"},
            {"optimizer_kwargs": 3},
            {"optimizer_kwargs": {"lr": 1e-3}},
            {"optimizer_kwargs": {"betas": 0.9}},
            {"optimizer_kwargs": {"weight_dcay": 0.1}},
            {"features_extractor_class": "cnn"},
            {"features_extractor_class": {"critic": "cnn"}},
            {"features_extractor_kwargs": [3]},
            {"features_extractor_kwargs": {"cnn_output": 3}},
            {"share_features_extractor": "no"},
            {"normalize_images": "a"},
            {"rnn_net_arch": -1},
            {"rnn_net_arch": [0]},
            {"rnn_net_arch": "8"},
        ],
        r"(policy_kwargs must be a dict|(net_arch.*|n_critics|rnn_hidden_size|log_std_bounds|activation_fn|optimizer_class|"
        r"features_extractor_class|features_extractor_kwargs|share_features_extractor|normalize_images|rnn_net_arch|"
        r"optimizer_kwargs) must (be|not have)|optimizer_kwargs=.* does not fit Adam|features_extractor_kwargs has .* take)",
    ),
    "verbose": ([-1, 0.5, "loud", None], "verbose must be an integer >= 0"),
    "seed": ([-1, 2**32, 0.5, "random"], "seed must be an integer from 0 to 4294967295, or None"),
    "device": (["gpu", 3.5], 'device must be "auto", "cpu"'),
}
GACS_OWN = {
    "target_kl": (
        [0, -0.1, NAN, INF, "small", None, lambda _: NAN, lambda left: left - 0.5],
        r"target_kl( at the (start|end) of training)? must be a number >",
    ),
    "kl_coef": (["automatic", "auto_", "auto_1000", -1, NAN, None], "kl_coef(=.*outside kl_coef_bounds| must be)"),
    "kl_coef_bounds": (
        [(1, 0.1), (0, 1), (1,), 3, (1, INF), None],
        r"kl_coef_bounds must be a pair \(low, high\) with 0 < low",
    ),
    "kl_coef_learning_rate": ([0, -1, NAN, "fast", None], "kl_coef_learning_rate must be a number > 0"),
    "kl_reduction": (["max", None, 3], r"kl_reduction must be one of \['mean', 'sum'\]"),
    "guider": (["teacher", None, []], r"guider must be one of \['independent', 'lagged', 'residual'\]"),
    "shared_std": (["nobody", None, 1], r"shared_std must be one of \['auto', 'guider', 'learner'\]"),
    "max_kl": ([0, -1, NAN, INF, "tight"], "max_kl must be a number > 0, or None"),
    "guidance": ([-1, NAN, INF, "hard", None], r"guidance( at the (start|end) of training)? must be a number >= 0"),
    "learner_kl_scale": ([-1, NAN, INF, "full", None], 'learner_kl_scale must be a number >= 0, or "auto"'),
    "learner_entropy": (["yes", 2, None], r"learner_entropy must be one of \[False, True\]"),
}
COSILS_OWN = {
    "teacher": ([small_model(TwoViewChoice(), AsymmetricSAC)], r"teacher was trained for actions in Discrete\(3\)"),
    "target_divergence": ([-0.1, NAN, INF, "near", None], 'target_divergence must be a number >= 0, or "auto"'),
    "teacher_coef": (
        ["automatic", "auto_", "auto_1000", -1, NAN, None],
        "teacher_coef(=.*outside teacher_coef_bounds| must be)",
    ),
    "teacher_coef_bounds": (
        [(1, 0.1), (0, 1), (1,), 3, (1, INF), None],
        r"teacher_coef_bounds must be a pair \(low, high\) with 0 < low",
    ),
    "teacher_coef_learning_rate": ([0, -1, NAN, "fast", None], "teacher_coef_learning_rate must be a number > 0"),
    "ent_coef": ([0.0, 0.1, "auto_0.5", "automatic", None], "COSIL has no entropy term, so ent_coef would do nothing"),
    "target_entropy": ([-3.0, "sac"], "COSIL has no entropy term, so target_entropy would do nothing"),
}
SACS_OWN = {"critic_groups": ([0, -1, 1.5, "two", None, 3], r"critic_groups( must be an integer >= 1|=3 can't be)")}
OFF_POLICY = {"buffer_size", "learning_starts", "tau", "train_freq", "gradient_steps", "action_noise", "ent_coef"}
OFF_POLICY |= {
    "optimize_memory_usage",
    "target_update_interval",
    "target_entropy",
    "policy_delay",
    "update_every",
    "behaviour",
}
OFF_POLICY |= {"behaviour_per", "recording", "random_shift", "replay_buffer_class", "replay_buffer_kwargs"}
ON_POLICY = {name: entry for name, entry in SHARED.items() if name not in OFF_POLICY} | {
    "n_epochs": ([0, -1, 1.5, None], "n_epochs must be an integer >= 1"),
    "gae_lambda": ([-0.1, 1.1, NAN, "far", None], "gae_lambda must be a number from 0 to 1"),
    "clip_range": (
        [0, -0.1, NAN, "far", None, lambda _: -1.0],
        "clip_range( at the (start|end) of training)? must be a number >",
    ),
    "normalize_advantage": (["yes", 2, None], r"normalize_advantage must be one of \[False, True\]"),
    "ent_coef": (["auto", -1, NAN, INF, None], "ent_coef must be a number >= 0"),
    "vf_coef": (["half", -1, NAN, INF, None], "vf_coef must be a number >= 0"),
    "reward_scale": ([0, -1, NAN, INF, None], "reward_scale must be a number > 0"),
    "unroll_length": ([0, -1, 1.5, "long"], "unroll_length must be an integer >= 1, or None for the whole rollout"),
    "learner_rl_coef": (["much", -1, NAN, INF, None], "learner_rl_coef must be a number >= 0"),
}
CLIPS_OWN = {"delta": ([0, 1, -0.1, 1.5, NAN, "near", None], "delta must be a number between 0 and 1")}
PENALTYS_OWN = {
    "target_kl": ([0, -1, NAN, INF, None], "target_kl must be a number > 0"),
    "largest_kl_coef": ([0, -1, NAN, INF, None], "largest_kl_coef must be a number > 0"),
}
MPOS_OWN = {
    "n_actions": ([0, -1, 2.5, "many", None], "n_actions must be an integer >= 1"),
    "temperature": (
        [0, -1, NAN, INF, None, "warm", "auto_0", "auto_1e9"],
        'temperature( must be a number > 0, or "auto"| must be "auto"|=.*outside temperature_bounds)',
    ),
    "kl_coef": (["automatic", "auto_1e7", -1, NAN, None], "kl_coef(=.*outside kl_coef_bounds| must be)"),
    "std_kl_coef": (["automatic", "auto_0", -1, NAN, None], "std_kl_coef must be"),
    **{
        name: ([0, -1, NAN, INF, "small", None], f"{name} must be a number > 0")
        for name in ("target_improvement", "target_kl", "target_std_kl", "dual_learning_rate")
    },
    "ent_coef": ([0.1, 0, "auto_0.1", None], "AsymmetricMPO has no entropy term, so ent_coef would do nothing"),
    "target_entropy": (["sac", -1.0], "AsymmetricMPO has no entropy term, so target_entropy would do nothing"),
}
ARGUMENTS = {
    GAC: {**SHARED, **GACS_OWN},
    AsymmetricSAC: {**SHARED, **SACS_OWN},
    COSIL: {**SHARED, **COSILS_OWN},
    AsymmetricMPO: {**SHARED, **MPOS_OWN},
    GPOClip: {**ON_POLICY, **CLIPS_OWN},
    GPOPenalty: {**ON_POLICY, **PENALTYS_OWN},
}
CASES = [
    pytest.param(
        cls, name, value, message, id=f"{cls.__name__}-{name}-{'a function' if callable(value) else repr(value)[:30]}"
    )
    for cls, arguments in ARGUMENTS.items()
    for name, (values, message) in arguments.items()
    for value in values
]


@pytest.mark.parametrize(("cls", "name", "value", "message"), CASES)
def test_an_argument_out_of_its_range_is_named(cls, name, value, message):
    if value == {"POLICY": 1.5}:
        value = {cls.policy_aliases["MultiInputPolicy"].roles.deployed: 1.5}
    small = {"buffer_size": 100} if "buffer_size" in ARGUMENTS[cls] else {"n_steps": 8}
    arguments = {"policy": "MultiInputPolicy", "env": TwoViewBandit(), **small, name: value}
    with pytest.raises(ValueError, match=message):
        cls(**arguments)


@pytest.mark.parametrize("cls", ARGUMENTS)
def test_no_argument_is_forgotten(cls):
    parameters = set(inspect.signature(cls).parameters) - {"_init_setup_model"}  # SB3's, for load()
    assert parameters == set(ARGUMENTS[cls])


#: Checked where they are used, with what they depend on: by the set-up, or by what is made of them
NOT_IN_TABLES = {"policy", "env", "ent_coef", "target_entropy"}
NOT_IN_TABLES |= {"kl_coef", "kl_coef_bounds", "teacher", "teacher_coef", "teacher_coef_bounds", "std_kl_coef"}


@pytest.mark.parametrize("cls", ARGUMENTS)
def test_every_argument_has_a_check_in_the_tables_or_needs_none_there(cls):
    checks = merged(cls, "argument_checks")
    elsewhere = NOT_IN_TABLES - {"ent_coef"} if issubclass(cls, OnPolicyAlgorithm) else NOT_IN_TABLES
    assert set(checks) == set(ARGUMENTS[cls]) - elsewhere
    defaults = {name: parameter.default for name, parameter in inspect.signature(cls).parameters.items()}
    for name, check in checks.items():
        check(name, {} if name in HANDED_ON else defaults[name])


class _WithOneMore(AsymmetricSAC):
    argument_checks = {"weight": check_positive, "tau": unless("slow", check_fraction)}  # noqa: RUF012

    def __init__(self, *args, weight=1.0, **shared):
        self.weight = weight
        super().__init__(*args, **shared)


def test_a_subclass_adds_to_the_table_and_may_replace_entries():
    assert small_model(cls=_WithOneMore, tau="slow").tau == "slow"
    for name, value in {"weight": 0, "tau": "fast", "gamma": 2}.items():
        with pytest.raises(ValueError, match=f"^{name} must be a number .*, got {value!r}"):
            small_model(cls=_WithOneMore, **{name: value})


class _SetTooLate(_WithOneMore):
    def __init__(self, *args, **shared):
        AsymmetricSAC.__init__(self, *args, **shared)
        self.weight = 1.0


def test_an_argument_that_is_kept_too_late_is_named():
    with pytest.raises(AttributeError, match=r"no attribute 'weight' to check: .* before it calls super\(\).__init__\(\)"):
        small_model(cls=_SetTooLate)


@pytest.mark.parametrize("cls", ARGUMENTS)
def test_what_is_at_the_edge_of_its_range_is_taken_again_and_again(cls, tmp_path):
    """The checks see their own results again when a model is loaded."""
    arguments = {
        "learning_rate": lambda left: 3e-4 * left,
        "buffer_size": np.int64(50),
        "learning_starts": 0,
        "tau": 1,
        "gamma": 0,
        "train_freq": (2, "step"),
        "gradient_steps": -1,
        "max_grad_norm": None,
        "seed": np.int64(0),
        "verbose": False,
        "tensorboard_log": None,
    }
    if cls is GAC:
        arguments |= {"target_kl": lambda left: 0.01 * left, "learner_kl_scale": 0, "kl_coef": "auto_100"}
    if cls is AsymmetricMPO:
        arguments |= {"n_actions": 1, "temperature": "auto_1e6", "kl_coef": 0, "std_kl_coef": "auto_1e-8"}
    if cls is COSIL:
        small_model(cls=AsymmetricSAC).save(tmp_path / "teacher.zip")
        arguments |= {"teacher": tmp_path / "teacher.zip", "target_divergence": 0, "teacher_coef": "auto_100"}
    if issubclass(cls, OnPolicyAlgorithm):
        of_rollouts = {
            "ent_coef": 0,
            "gae_lambda": 1,
            "clip_range": lambda left: 0.3 * left,
            "n_steps": np.int64(3),
            "batch_size": 3,
        }
        arguments = {name: value for name, value in arguments.items() if name in ARGUMENTS[cls]} | of_rollouts
        model = cls("MultiInputPolicy", TwoViewBandit(), device="cpu", **arguments).learn(6)
    else:
        model = small_model(cls=cls, **arguments).learn(6)
    model.save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model", env=model.get_env())
    assert loaded.learn(6)._n_updates > 0


def test_episodes_are_counted_in_one_environment_only():
    with pytest.raises(ValueError, match=r"train_freq .*one environment only, got \(1, 'episode'\) for 2"):
        small_model(DummyVecEnv([TwoViewBandit] * 2), train_freq=(1, "episode"))


@pytest.mark.parametrize(("name", "value"), [("batch_size", 0), ("target_kl", -1.0), ("learning_rate", NAN)])
def test_arguments_given_to_load_are_checked(name, value, tmp_path):
    small_model().save(tmp_path / "model")
    with pytest.raises(ValueError, match=name):
        GAC.load(tmp_path / "model", **{name: value})
