"""
A gradient step of every algorithm is the plain one of :mod:`tests.plain.algorithm_1`, from the replay buffer to the targets.

Weights, targets' weights and standard deviations are all unlike each other at the start, plain gradient descent shows each
gradient's size, and the plain computation looks up what it needs of a batch in what the environments returned.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import COSIL, GAC, TGRL, AsymmetricMPO, AsymmetricSAC, GACShare, GACWithoutQ
from sb3_gac.networks.heads import LOG_STD_BOUNDS
from tests.helpers import gradient_step, noise_of_step, unlike_each_other
from tests.plain.algorithm_1 import PlainGAC, PlainGACWithoutQ, PlainSAC, PlainTGRL
from tests.plain.cosil import PlainCOSIL
from tests.plain.mpo import PlainMPO
from tests.plain.replay import PlainReplay, Recorded

BOUNDS = (-1.2, 0.4)
SIZES = {"net_arch": [8, 6], "log_std_bounds": BOUNDS}
MEMORY = {"net_arch": [6], "rnn_hidden_size": 5, "rnn_net_arch": [6]}
SHARED = {"learning_rate": 0.01, "gamma": 0.9, "tau": 0.1}
ENTROPY = {"ent_coef": "auto_0.3", "target_entropy": -0.7}
NEAR = {
    "target_divergence": 0.4,
    "teacher_coef": "auto_2.0",
    "teacher_coef_bounds": (0.5, 8.0),
    "teacher_coef_learning_rate": 0.05,
}
GUIDED = {"target_kl": 0.2, "kl_coef": "auto_2.0", "kl_coef_bounds": (0.5, 8.0), "kl_coef_learning_rate": 0.05}
PLAIN = {GAC: PlainGAC, GACShare: PlainGAC, GACWithoutQ: PlainGACWithoutQ, AsymmetricSAC: PlainSAC, TGRL: PlainTGRL}
PLAIN |= {COSIL: PlainCOSIL, AsymmetricMPO: PlainMPO}
#: Algorithm, with its subclasses -> arguments of all its cases
OF_ALL = {GAC: ENTROPY | GUIDED, AsymmetricSAC: ENTROPY, TGRL: ENTROPY, COSIL: NEAR, AsymmetricMPO: {}}


@dataclass
class Case:
    """
    :param arguments: of the model and of the plain computation
    :param resolved: of the plain computation alone: what "auto" means there
    :param of_model: of the model alone
    """

    cls: type
    arguments: dict[str, Any] = field(default_factory=dict)
    resolved: dict[str, Any] = field(default_factory=dict)
    of_model: dict[str, Any] = field(default_factory=dict)
    discrete: bool = False
    cell: str = ""
    normalised: bool = False


OWN = {"shared_std": "learner"}
GUIDERS_STD = {"shared_std": "guider"}
INDEPENDENT = {"guider": "independent"}
SUM = {"kl_reduction": "sum", "target_kl": 0.4}
CLIPPED = {"max_grad_norm": 0.5}
N_STEPS = {"n_steps": 3}
PARTS = {"replay_buffer_kwargs": {"sequence_length": 2, "burn_in": 2}}
LRU = {"policy_kwargs": {"rnn_type": "lru"}}  # in place of the policy class's GRU
MASKED = {"replay_buffer_kwargs": {"mask_truncations": True}}
SOFTPLUS = {"policy_kwargs": {"softplus_min_std": 0.05, "log_std_bounds": LOG_STD_BOUNDS}}
PAIRS, FOUR = {"critic_groups": 2}, {"policy_kwargs": {"n_critics": 4}}
MPO = {
    "n_actions": 3,
    "temperature": "auto_1.5",
    "target_improvement": 0.3,
    "kl_coef": "auto_2.0",
    "target_kl": 0.2,
    "std_kl_coef": "auto_3.0",
    "target_std_kl": 0.1,
    "dual_learning_rate": 0.05,
}
OTHERS = {
    "kl_coef": 0.7,
    "ent_coef": 0.2,
    "target_update_interval": 2,
    "optimizer": th.optim.Adam,
    "max_grad_norm": 1.0,
}
CASES = {
    "residual": Case(GAC),
    "residual, clipped": Case(GAC, CLIPPED, {}, {"learner_kl_scale": 0.0}),
    "residual, guider's std": Case(GAC, GUIDERS_STD | CLIPPED),
    "residual, pulled": Case(GAC, SUM, {"pull": 1.0}, {"learner_kl_scale": 1.0}),
    "residual, guider's std, pulled": Case(GAC, GUIDERS_STD, {"pull": 0.5}, {"learner_kl_scale": 0.5}),
    "residual, guided": Case(GAC, {"guidance": 0.7}),
    "residual, guided and pulled": Case(GAC, SUM | {"guidance": 0.7}, {"pull": 0.5}, {"learner_kl_scale": 0.5}),
    "residual, as printed": Case(GAC, {"learner_entropy": False} | SUM, GUIDERS_STD),
    "residual, bounded": Case(GAC, {"max_kl": 0.05}),
    "residual, bounded sum": Case(GAC, {"max_kl": 0.05} | SUM),
    "independent": Case(GAC, INDEPENDENT, GUIDERS_STD | {"pull": 1.0}),
    "independent, sum": Case(GAC, INDEPENDENT | SUM | CLIPPED, GUIDERS_STD | {"pull": 1.0}),
    "independent, learner's std": Case(GAC, INDEPENDENT | OWN | SUM, {"pull": 0.5}, {"learner_kl_scale": 0.5}),
    "independent, bounded": Case(GAC, INDEPENDENT | {"max_kl": 0.05}, GUIDERS_STD | {"pull": 1.0}),
    "independent, bounded sum": Case(GAC, INDEPENDENT | {"max_kl": 0.05} | SUM | OWN, {"pull": 1.0}),
    "independent, as printed": Case(GAC, INDEPENDENT | {"learner_entropy": False}, GUIDERS_STD | {"pull": 1.0}),
    "lagged": Case(GAC, {"guider": "lagged"}, {"pull": 1.0}),
    "lagged, guider's std, sum": Case(GAC, {"guider": "lagged"} | GUIDERS_STD | SUM | CLIPPED, {"pull": 1.0}),
    "lagged, bounded": Case(GAC, {"guider": "lagged", "max_kl": 0.05}, {"pull": 0.5}, {"learner_kl_scale": 0.5}),
    "lagged, discrete": Case(GAC, {"guider": "lagged"}, {"pull": 1.0}, discrete=True),
    "n steps": Case(GAC, of_model=N_STEPS),
    "softplus": Case(GAC, {}, {"softplus_min_std": 0.05}, SOFTPLUS),
    "independent, softplus, truncations masked": Case(
        GAC, INDEPENDENT, GUIDERS_STD | {"pull": 1.0, "softplus_min_std": 0.05}, SOFTPLUS | MASKED
    ),
    "SAC, truncations masked, n steps": Case(AsymmetricSAC, of_model=MASKED | N_STEPS),
    "MPO, softplus, truncations masked": Case(AsymmetricMPO, MPO, {"softplus_min_std": 0.05}, SOFTPLUS | MASKED),
    "GRU, SAC, truncations masked": Case(AsymmetricSAC, of_model=MASKED, cell="Gru"),
    "normalised": Case(GAC, normalised=True),
    "normalised, n steps": Case(GAC, of_model=N_STEPS, normalised=True),
    "bound of alpha": Case(GAC, {"kl_coef_bounds": (1.9, 2.05), "target_kl": 1e-3}),
    "fixed coefficients, other rates": Case(
        GAC,
        OTHERS,
        {"rates": {"guider": 0.02, "guider_critic": 0.005, "learner_critic": 0.005}},
        {"lr_scales": {"guider": 2.0, "critic": 0.5}, "role_keys": {"critic": ["privileged"]}},
    ),
    "share": Case(GACShare, SUM, {"pull": 1.0}),
    "share, independent": Case(GACShare, INDEPENDENT | CLIPPED, GUIDERS_STD | {"pull": 1.0}),
    "share, discrete": Case(GACShare, {}, {"pull": 1.0}, discrete=True),
    "without Q": Case(GACWithoutQ, CLIPPED, GUIDERS_STD),
    "without Q, independent": Case(GACWithoutQ, INDEPENDENT | SUM, GUIDERS_STD),
    "without Q, discrete": Case(GACWithoutQ, discrete=True),
    "SAC": Case(AsymmetricSAC),
    "SAC, clipped": Case(AsymmetricSAC, CLIPPED),
    "SAC, full state": Case(AsymmetricSAC, of_model={"role_keys": {"actor": ["partial", "privileged"]}}),
    "SAC, normalised, n steps": Case(AsymmetricSAC, of_model=N_STEPS, normalised=True),
    "SAC, discrete": Case(AsymmetricSAC, {"target_entropy": 0.8}, discrete=True),
    "SAC, two pairs of critics": Case(AsymmetricSAC, PAIRS, of_model=FOUR),
    "SAC, two pairs of critics, discrete": Case(AsymmetricSAC, PAIRS | {"target_entropy": 0.8}, of_model=FOUR, discrete=True),
    "GRU, SAC, two pairs of critics": Case(AsymmetricSAC, PAIRS, of_model=FOUR, cell="Gru"),
    "discrete": Case(GAC, {"target_entropy": 0.8}, discrete=True),
    "discrete, pulled": Case(GAC, CLIPPED, {"pull": 1.0}, {"learner_kl_scale": 1.0}, discrete=True),
    "discrete, guided": Case(GAC, {"guidance": 0.7}, discrete=True),
    "discrete, independent": Case(GAC, INDEPENDENT, {"pull": 1.0}, discrete=True),
    "discrete, as printed": Case(GAC, {"learner_entropy": False}, discrete=True),
    "discrete, normalised, n steps": Case(GAC, of_model=N_STEPS, discrete=True, normalised=True),
    "GRU": Case(GAC, cell="Gru"),
    "GRU, guider's std, pulled": Case(GAC, GUIDERS_STD | CLIPPED, {"pull": 1.0}, {"learner_kl_scale": 1.0}, cell="Gru"),
    "GRU, guided": Case(GAC, {"guidance": 0.7}, cell="Gru"),
    "GRU, independent": Case(GAC, INDEPENDENT, GUIDERS_STD | {"pull": 1.0}, cell="Gru"),
    "GRU, discrete": Case(GAC, cell="Gru", discrete=True),
    "GRU, parts of episodes": Case(GAC, GUIDERS_STD, of_model=PARTS, cell="Gru"),
    "GRU, SAC, parts of episodes": Case(AsymmetricSAC, of_model=PARTS, cell="Gru", normalised=True),
    "GRU, share": Case(GACShare, {}, {"pull": 1.0}, cell="Gru"),
    "GRU, without Q": Case(GACWithoutQ, {}, GUIDERS_STD, cell="Gru"),
    "GRU, SAC": Case(AsymmetricSAC, cell="Gru"),
    "GRU, SAC, discrete": Case(AsymmetricSAC, cell="Gru", discrete=True),
    "LSTM, normalised": Case(GAC, cell="Lstm", normalised=True),
    "LSTM, share, discrete": Case(GACShare, {}, {"pull": 1.0}, cell="Lstm", discrete=True),
    "GRU for the learner alone": Case(GAC, of_model={"policy_kwargs": {"rnn_type": {"learner": "gru"}}}, cell="Gru"),
    "GRU for critics alone": Case(GAC, of_model={"policy_kwargs": {"rnn_type": {"critic": "gru"}}}, cell="Gru"),
    "TGRL": Case(TGRL, {"teacher_coef": 0.6}),
    "TGRL, clipped": Case(TGRL, CLIPPED | {"teacher_coef": 2.0}),
    "TGRL, discrete": Case(TGRL, {"teacher_coef": 0.6, "target_entropy": 0.8}, discrete=True),
    "TGRL, GRU": Case(TGRL, {"teacher_coef": 0.6}, cell="Gru"),
    "TGRL, GRU for actors alone": Case(
        TGRL, of_model={"policy_kwargs": {"rnn_type": dict.fromkeys(("actor", "auxiliary"), "gru")}}, cell="Gru"
    ),
    "LRU": Case(GAC, of_model=LRU, cell="Gru"),
    "LRU, SAC, parts of episodes, discrete": Case(AsymmetricSAC, of_model=LRU | PARTS, cell="Gru", discrete=True),
    "LSTM, SAC, normalised": Case(AsymmetricSAC, cell="Lstm", normalised=True),
    "COSIL": Case(COSIL),
    "COSIL, clipped, n steps": Case(COSIL, CLIPPED | {"teacher_coef": 0.6}, of_model=N_STEPS),
    "COSIL, bound of its weight": Case(COSIL, {"teacher_coef_bounds": (1.9, 2.05), "target_divergence": 1e-3}),
    "COSIL, critics that see all": Case(COSIL, of_model={"role_keys": {"critic": ["partial", "privileged"]}}),
    "COSIL, discrete": Case(COSIL, discrete=True),
    "COSIL, GRU": Case(COSIL, cell="Gru"),
    "COSIL, GRU, parts of episodes, discrete": Case(COSIL, of_model=PARTS, cell="Gru", discrete=True),
    "COSIL, LSTM, normalised": Case(COSIL, cell="Lstm", normalised=True),
    "MPO": Case(AsymmetricMPO, MPO),
    "MPO, clipped, n steps": Case(AsymmetricMPO, MPO | CLIPPED, of_model=N_STEPS),
    "MPO, fixed coefficients": Case(AsymmetricMPO, MPO | {"temperature": 0.5, "kl_coef": 0.0, "std_kl_coef": 0.7}),
    "MPO, discrete": Case(AsymmetricMPO, MPO, discrete=True),
    "MPO, GRU": Case(AsymmetricMPO, MPO, cell="Gru"),
    "MPO, GRU, discrete": Case(AsymmetricMPO, MPO, cell="Gru", discrete=True),
    "MPO, GRU, parts of episodes": Case(AsymmetricMPO, MPO, of_model=PARTS, cell="Gru", normalised=True),
    "MPO, GRU for the actor alone": Case(
        AsymmetricMPO, MPO, of_model={"policy_kwargs": {"rnn_type": {"actor": "gru"}}}, cell="Gru"
    ),
}


def _settings(case):
    (of_all,) = (arguments for cls, arguments in OF_ALL.items() if issubclass(case.cls, cls))
    arguments = SHARED | of_all | case.arguments
    return PLAIN[case.cls].settings_class(**{"log_std_bounds": BOUNDS, **arguments, **case.resolved}), arguments


def _model(case, settings, arguments):
    """With steps of two environments in its replay buffer, and weights that are all unlike each other."""
    envs = [Recorded(case.discrete) for _ in range(2)]
    vec_env = DummyVecEnv([lambda env=env: env for env in envs])
    if case.normalised:
        vec_env = VecNormalize(vec_env, clip_obs=1.3, clip_reward=0.9, gamma=settings.gamma)
    arguments = {"max_grad_norm": settings.max_grad_norm, **arguments}
    arguments.pop("optimizer", None)
    sizes = {"optimizer_class": settings.optimizer, **(MEMORY if case.cell else SIZES), "log_std_bounds": BOUNDS}
    of_model = dict(case.of_model)
    sizes |= of_model.pop("policy_kwargs", {})
    if case.cls.frozen_arguments:
        of_model["teacher"] = _teacher(case)
    model = case.cls(
        f"MultiInput{case.cell}Policy",
        vec_env,
        learning_starts=1000,
        buffer_size=1000,
        batch_size=16,
        policy_kwargs=sizes,
        seed=0,
        device="cpu",
        **arguments,
        **of_model,
    ).learn(80)
    unlike_each_other(model.policy)
    return model, envs


def _teacher(case):
    role_keys = {"actor": ["partial", "privileged"]}
    teacher = AsymmetricSAC("MultiInputPolicy", Recorded(case.discrete), role_keys=role_keys, policy_kwargs=SIZES, seed=1)
    unlike_each_other(teacher.policy)
    return teacher


@pytest.mark.parametrize("name", CASES)
def test_a_gradient_step_is_the_plain_one(name):
    case = CASES[name]
    settings, arguments = _settings(case)
    model, envs = _model(case, settings, arguments)
    frozen = [frozen.policy.actor for frozen in model.frozen.values()]
    plain = PLAIN[case.cls](model.policy, settings, *frozen)
    options = case.of_model.get("replay_buffer_kwargs", {})
    how = (options.get("sequence_length"), options.get("mask_truncations", False))
    replay = PlainReplay(envs, model.get_vec_normalize_env(), case.of_model.get("n_steps", 1), settings.gamma, *how)
    if case.cls in (GACShare, GACWithoutQ):
        assert "learner_critic" not in plain.networks
    before = {key: th.cat([p.detach().flatten().clone() for p in one.parameters()]) for key, one in plain.networks.items()}
    for seed in range(4):
        batch = replay.batch(gradient_step(model, 5 if case.cell else 16, seed))
        metrics = plain.step(batch, noise_of_step(seed, plain.n_noises, batch.actions.shape).double())
        logged = {key: model.logger.name_to_value[f"train/{key}"] for key in metrics}
        assert logged == pytest.approx({key: value.item() for key, value in metrics.items()}, rel=1e-3, abs=1e-5)
    for key, network in {**plain.networks, **plain.targets}.items():
        _assert_same(key, plain.copied(model.policy, key), network)
    for key, start in before.items():
        moved = (th.cat([p.detach().flatten() for p in plain.networks[key].parameters()]) - start).abs().max()
        assert moved > 1e-3, f"{key} stood still: nothing was tested"
    by_steps = {"teacher_coef"} if case.cls is TGRL else set()
    assert set(plain.coefficients) == set(model.coefficients) - by_steps
    for key, coefficient in plain.coefficients.items():
        np.testing.assert_allclose(model.coefficients[key].value, coefficient.value, rtol=1e-5, err_msg=key)


def _assert_same(name, ours, theirs):
    expected = dict(theirs.named_parameters())
    for parameter, value in ours.named_parameters():
        np.testing.assert_allclose(
            value.detach(), expected[parameter].detach(), rtol=1e-4, atol=5e-6, err_msg=f"{name}: {parameter}"
        )
