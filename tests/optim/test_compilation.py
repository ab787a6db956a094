"""Compiled gradient steps do what plain ones do, notice what changes, and refuse what they can't do."""

from copy import deepcopy
from functools import partial

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from torch._dynamo.backends.debugging import aot_eager

from sb3_gac import COSIL, GAC, RMA, TGRL, AsymmetricMPO, AsymmetricSAC, GPOClip
from sb3_gac.optim.compile import Program
from tests.helpers import Recall, Sampled, TwoViewBandit, TwoViewChoice, small_model
from tests.registry import LINES, algorithms, load, make, needed

#: Made of what others' programs are made of, which the C++ compiler is given; RMA's are compiled below, both of them
SIBLINGS = ("gac_share", "gac_without_q", "gpo_penalty", "rma")


def _filled(cls, **arguments):
    return small_model(cls=cls, learning_starts=1000, **needed(cls, TwoViewBandit()), **arguments).learn(64)


def _train(models, gradient_steps=3, batch_size=16):
    for model in models:
        th.manual_seed(0)
        np.random.seed(0)
        model.train(gradient_steps, batch_size)


def _assert_equal(model, other, **tolerance):
    for (name, p), q in zip(model.policy.named_parameters(), other.policy.parameters(), strict=True):
        th.testing.assert_close(p, q, **tolerance, msg=lambda text, name=name: f"{name}: {text}")
    for name, coefficient in model.coefficients.items():
        th.testing.assert_close(coefficient.value, other.coefficients[name].value, **tolerance)


def _check_compiled_is_plain(algorithm):
    of_method = {"seed": 0, **LINES[algorithm].one_phase}
    plain, compiled = (make(algorithm, TwoViewBandit(), compile=flag, **of_method).learn(20) for flag in (False, True))
    assert compiled.programs
    assert plain._n_updates == compiled._n_updates > 1
    _assert_equal(plain, compiled, rtol=1e-4, atol=1e-6)


@algorithms(but=SIBLINGS)
def test_compiled_training_is_plain_training(algorithm):
    _check_compiled_is_plain(algorithm)


@pytest.mark.parametrize("algorithm", SIBLINGS)
def test_traced_training_is_plain_training(algorithm, traced):
    _check_compiled_is_plain(algorithm)


@pytest.fixture
def traced(monkeypatch):
    """Programs are traced as ever, gradients and all, and run without the C++ compiler, which takes far longer."""
    compiled = th.compile

    def only_trace(function, *, options, **others):
        return compiled(function, backend=aot_eager, options={"guard_filter_fn": options["guard_filter_fn"]}, **others)

    monkeypatch.setattr(th, "compile", only_trace)


def _collected(algorithm, **arguments):
    """The same data whether compiled or not, and no gradient step yet."""
    arguments |= {"seed": 0, "learning_starts": 1000, **LINES[algorithm].one_phase}
    return make(algorithm, TwoViewBandit(), **arguments).learn(32)


@algorithms("replay")
def test_compiled_training_goes_on_through_whatever_changes(algorithm, tmp_path, traced):
    """Through other batch sizes and settings, new weights, a copy of the policy and a save: nothing stale is used."""
    plain, compiled = _collected(algorithm), _collected(algorithm, compile=True)
    _train((plain, compiled))
    n_programs = len(compiled.programs)
    _train((plain, compiled))
    assert len(compiled.programs) == n_programs > 0, "compiled once"
    for model in (plain, compiled):
        model.gamma = 0.5
        with th.no_grad():
            for p in model.policy.parameters():
                p.add_(0.01)
    _train((plain, compiled))
    _assert_equal(plain, compiled, rtol=1e-4, atol=1e-6)
    compiled.save(tmp_path / "model")
    loaded = load(algorithm, tmp_path / "model", TwoViewBandit())
    loaded.set_logger(compiled.logger)
    loaded.replay_buffer = compiled.replay_buffer
    assert loaded.compile
    _train((plain, loaded), batch_size=8)
    _assert_equal(plain, loaded, rtol=1e-4, atol=1e-6)


def test_a_coefficient_that_is_set_counts_in_compiled_steps(traced):
    plain, compiled = _collected("gac"), _collected("gac", compile=True)
    _train((plain, compiled))
    for model in (plain, compiled):
        model.kl_coef = 5.0
    _train((plain, compiled))
    assert compiled._last_metrics["kl_coef"] == 5.0
    _assert_equal(plain, compiled, rtol=1e-4, atol=1e-6)


def test_each_phase_is_a_program_of_its_own():
    """And what rests in one of them stays as it is."""
    plain, compiled = _filled(RMA, history=7), _filled(RMA, history=7, compile=True)
    for phase in (1, 2, 1):
        for model in (plain, compiled):
            model.phase = phase
        _train((plain, compiled))
        _assert_equal(plain, compiled, rtol=1e-4, atol=1e-6)
    assert len(compiled.programs) == 2


IMAGES = spaces.Dict(partial=spaces.Box(0, 255, (3, 36, 36), np.uint8), privileged=spaces.Box(-1, 1, (2,), np.float32))
KINDS = {
    "lagged, guided": lambda **arguments: _filled(GAC, guider="lagged", guidance="linear 0.5 -> 0.0", **arguments),
    "discrete": lambda **arguments: _filled(GAC, env=TwoViewChoice(), **arguments),
    "images, AdamW": lambda **arguments: _filled(
        AsymmetricSAC,
        env=Sampled(IMAGES),
        policy_kwargs={
            "net_arch": [8],
            "features_extractor_kwargs": {"cnn_output_dim": 8},
            "optimizer_class": th.optim.AdamW,
            "optimizer_kwargs": {"weight_decay": 0.1},
        },
        role_keys={"critic": ["privileged"]},
        **arguments,
    ),
    "MPO, discrete": lambda **arguments: _filled(AsymmetricMPO, env=TwoViewChoice(), **arguments),
    "Brax's recipe": lambda **arguments: _filled(
        GAC,
        env=TimeLimit(TwoViewBandit(length=9), 3),
        guider="independent",
        policy_kwargs={"net_arch": [8], "softplus_min_std": 0.001, "initialization": "lecun_uniform"},
        replay_buffer_kwargs={"mask_truncations": True},
        **arguments,
    ),
    "guider's std, pulled": lambda **arguments: _filled(GAC, shared_std="guider", learner_kl_scale=1.0, **arguments),
}


@pytest.mark.parametrize(("kind", "threads"), [*((kind, 1) for kind in KINDS), ("discrete", 2), ("guider's std, pulled", 2)])
def test_every_kind_is_compiled_to_what_it_is(kind, threads):
    """As one program, whose products have all threads, targets and all."""
    before = th.get_num_threads()
    th.set_num_threads(threads)
    try:
        plain, compiled = KINDS[kind](), KINDS[kind](compile=True)
        _train((plain, compiled))
        assert [name for name, *_ in compiled.programs] == ["_update_with_targets"]
    finally:
        th.set_num_threads(before)
    _assert_equal(plain, compiled, rtol=1e-4, atol=1e-6)


def test_an_optimiser_that_can_not_be_compiled_is_named():
    for options in ({"optimizer_class": th.optim.SGD}, {"optimizer_kwargs": {"amsgrad": True}}):
        with pytest.raises(ValueError, match=r"compile=True can do torch's Adam and AdamW.*the optimiser of learner is"):
            small_model(compile=True, policy_kwargs={"net_arch": [8], **options})


@pytest.mark.parametrize(
    ("cls", "setting", "value", "before"),
    [
        (AsymmetricSAC, "max_grad_norm", 0.001, {}),
        (GAC, "learner_kl_scale", 100.0, {}),
        (COSIL, "target_divergence", 1e3, {"target_divergence": 0.0, "teacher_coef_learning_rate": 1.0}),
    ],
)
def test_a_setting_that_is_compiled_in_is_noticed(cls, setting, value, before, traced):
    plain, compiled, unchanged = _filled(cls, **before), _filled(cls, compile=True, **before), _filled(cls, **before)
    _train((plain, compiled, unchanged))
    for model in (plain, compiled):
        setattr(model, setting, value)
    _train((plain, compiled, unchanged))
    _assert_equal(plain, compiled, rtol=1e-4, atol=1e-6)
    with pytest.raises(AssertionError):  # or the setting did not matter
        _assert_equal(plain, unchanged, rtol=1e-4, atol=1e-6)


def test_a_copy_of_a_compiled_model_trains_itself(traced):
    """The original's programs train the original."""
    plain, original = _filled(AsymmetricSAC), _filled(AsymmetricSAC, compile=True)
    _train((plain, original))
    copy = deepcopy(original)
    before = [p.clone() for p in original.policy.parameters()]
    _train((plain, copy))
    _assert_equal(plain, copy, rtol=1e-4, atol=1e-6)
    assert all(map(th.equal, before, original.policy.parameters()))


@pytest.mark.parametrize("cls", [COSIL, TGRL])
def test_another_teacher_is_another_program(cls, traced, tmp_path):
    """Of the same shapes, with layers of another kind."""
    full = {"role_keys": {"actor": ["partial", "privileged"]}}
    policy_kwargs = {"net_arch": [16, 16], "activation_fn": th.nn.Tanh}
    small_model(cls=AsymmetricSAC, policy_kwargs=policy_kwargs, **full).save(tmp_path / "other")
    plain, compiled, unchanged = _filled(cls), _filled(cls, compile=True), _filled(cls)
    _train((plain, compiled, unchanged))
    for model in (plain, compiled):
        model.teacher = tmp_path / "other"
    _train((plain, compiled, unchanged))
    _assert_equal(plain, compiled, rtol=1e-4, atol=1e-6)
    with pytest.raises(AssertionError):  # or the teacher did not matter
        _assert_equal(plain, unchanged, rtol=1e-4, atol=1e-6)


def test_what_draws_random_numbers_is_refused():
    class Dropout(th.nn.Dropout):
        """An activation that is none."""

    with pytest.raises(ValueError, match="compile=True can't do dropout"):
        small_model(compile=True, policy_kwargs={"net_arch": [8], "activation_fn": Dropout})


@pytest.mark.parametrize("env", [TwoViewBandit, TwoViewChoice, Recall, partial(Recall, continuous=True)])
@pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])
def test_mixed_precision_is_near_full_precision_and_keeps_parameters_and_heads_in_it(cls, env):
    """With numbers for actions and with choices; with a memory and without."""
    memory = {"policy": "MultiInputGruPolicy"} if isinstance(env(), Recall) else {}
    full, mixed = (_filled(cls, env=env(), mixed_precision=flag, **memory) for flag in (False, True))
    _train((full, mixed), gradient_steps=1, batch_size=64)
    assert {p.dtype for p in mixed.policy.parameters()} == {th.float32}
    for name in ("actor_loss", "critic_loss"):
        values = [model.logger.name_to_value[f"train/{name}"] for model in (full, mixed)]
        assert values[0] == pytest.approx(values[1], rel=0.02, abs=0.01)
        assert values[0] != values[1], "nothing was in bfloat16"
    with th.autocast("cpu", th.bfloat16):
        batch = mixed._sample_batch(4)
        observations = batch.observations if batch.sequence is None else batch.sequence
        assert {output.dtype for output in mixed.policy.deployed.distribution(observations)} == {th.float32}


@pytest.mark.parametrize("env", [TwoViewBandit, TwoViewChoice])
def test_mixed_precision_leaves_the_last_layers_alone(env):
    policy = small_model(env()).policy
    x = th.randn(2, 5, 16)
    value = GPOClip("MultiInputPolicy", env(), policy_kwargs={"net_arch": [16]}).policy.critic.value_net[-1]
    last = {"actor": next(policy.deployed.head.children()), "critic": policy.critic.output, "state value": value}
    for name, layer in last.items():
        plain = layer(x)
        with th.autocast("cpu", th.bfloat16):
            assert th.equal(layer(x), plain), name


def test_each_program_has_code_of_its_own(monkeypatch):
    """By which torch keeps what it has compiled."""
    monkeypatch.setattr(th, "compile", lambda function, **options: function)
    programs = [Program(function, th.device("cpu")) for function in (th.sin, th.cos, th.sin)]
    assert len({id(program._run.__code__) for program in programs}) == 3
    x = th.rand(3)
    for program, function in zip(programs, (th.sin, th.cos, th.sin), strict=True):
        assert th.equal(program(x), function(x))


def test_steps_that_are_compiled_go_on_from_plain_ones_and_the_reverse():
    plain, switched = _filled(AsymmetricSAC), _filled(AsymmetricSAC)
    for compiled in (False, True, False, True):
        switched.compile = compiled
        _train((plain, switched), gradient_steps=2)
    _assert_equal(plain, switched, rtol=1e-4, atol=1e-6)
