"""Asymmetric MPO: its steps in numbers that are worked out here, the limit of no bounds, and what it learns."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import configure

from sb3_gac import AsymmetricMPO, DivergenceError, OnnxPolicy, export_learner
from sb3_gac.base.batch import Batch, Outputs
from sb3_gac.checks.divergence import check_finite_metrics
from sb3_gac.math.distributions import Candidates, Categorical, TanhGaussian
from sb3_gac.optim.coefficients import SoftplusDual
from tests.helpers import Recall, Sampled, TwoViewBandit, TwoViewChoice, small_model

VECTOR = spaces.Box(-1, 1, (2,), np.float32)
IMAGES = spaces.Dict(partial=spaces.Box(0, 255, (3, 36, 36), np.uint8), privileged=VECTOR)
TWO_ACTIONS = Sampled(spaces.Dict(partial=VECTOR, privileged=VECTOR), VECTOR)


def _small(env=None, **arguments):
    return small_model(env, AsymmetricMPO, **arguments)


def _doubles(*shape, seed=0):
    return th.randn(*shape, generator=th.Generator().manual_seed(seed), dtype=th.float64)


# --- numbers ----------------------------------------------------------------------------------------------------------

Q = np.array([[1.0, 3.0, 2.0, -1.0], [0.2, 0.1, 0.4, 0.3]])
SHARES = {"samples": np.full((2, 4), 0.25), "all actions": np.array([[0.5, 0.3, 0.1, 0.1], [0.1, 0.2, 0.3, 0.4]])}


@pytest.mark.parametrize("kind", SHARES)
@pytest.mark.parametrize("eta", [0.5, 2.0])
def test_weights_of_the_e_step_and_what_moves_the_temperature(kind, eta):
    """The dual's gradient is the bound less the KL: numerically, of the dual as the paper has it."""
    shares = SHARES[kind]
    log_shares = np.log(0.25) if kind == "samples" else np.log(shares)
    candidates = Candidates(th.as_tensor(Q), th.as_tensor(log_shares))
    weights, kl = candidates.improved(th.tensor(eta, dtype=th.float64))
    expected = shares * np.exp(Q / eta)
    expected /= expected.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(weights, expected)
    np.testing.assert_allclose(kl, (expected * np.log(expected / shares)).sum(axis=1))

    def dual(eta, eps=0.1):
        return eta * eps + eta * np.log((shares * np.exp(Q / eta)).sum(axis=1)).mean()

    slope = (dual(eta + 1e-6) - dual(eta - 1e-6)) / 2e-6
    assert 0.1 - kl.mean().item() == pytest.approx(slope, abs=1e-8)


@pytest.mark.parametrize(("spread", "direction"), [(3000.0, 1), (0.1, -1)])
def test_the_temperature_rises_while_the_weights_are_above_their_bound(spread, direction):
    """One step of Adam, of the learning rate's size, on the softplus's argument."""
    model = _small(learning_starts=1000).learn(40)
    with th.no_grad():
        model.policy.critic_target.output.weight.mul_(spread)
    model.train(1, 16)
    start = np.log(np.expm1(10.0))
    assert (model.logger.name_to_value["train/improvement"] > 0.1) == (direction > 0)
    assert model.coefficients["temperature"].value.item() == pytest.approx(
        np.log1p(np.exp(start + direction * 0.01)), rel=1e-6
    )


def test_an_expectation_is_over_the_shares():
    for shares in SHARES.values():
        mean = Candidates(th.as_tensor(Q), th.as_tensor(np.log(shares))).mean_value
        np.testing.assert_allclose(mean, (shares * Q).sum(axis=1)[None])


def test_coefficients_start_where_the_paper_has_them_one_a_dimension():
    duals = _small(TWO_ACTIONS).coefficients
    assert {name: dual.value.tolist() for name, dual in duals.items()} == {
        "temperature": pytest.approx(10.0),
        "kl_coef": pytest.approx([10.0, 10.0]),
        "std_kl_coef": pytest.approx([1000.0, 1000.0]),
    }
    assert all(isinstance(dual, SoftplusDual) for dual in duals.values())
    assert {dual.optimizer.param_groups[0]["lr"] for dual in duals.values()} == {0.01}
    of_choice = _small(TwoViewChoice()).coefficients
    assert {name: dual.value.tolist() for name, dual in of_choice.items()} == {
        "temperature": pytest.approx(10.0),
        "kl_coef": pytest.approx([10.0]),
    }


class _Known(Batch):
    """Whose critics are known: the first values an action by its sum, the second by half of that and a little."""

    def q_at_obs(self, critic):
        assert not critic.training, "the target"
        return lambda actions: th.stack([actions.sum(dim=-1), 0.5 * actions.sum(dim=-1) + 0.1])

    q_at_next_obs = q_at_obs


def _known(n=3, mask=None):
    ones = th.ones(n, dtype=th.float64)
    dones = th.zeros(n, dtype=th.float64)
    dones[1] = 1.0
    return _Known({}, th.zeros(n, 2), ones * th.arange(n), {}, dones, 0.9 * ones, mask=mask)


def _q(actions):
    return np.minimum(actions.sum(axis=-1), 0.5 * actions.sum(axis=-1) + 0.1)


def _gaussians(n=3):
    old = TanhGaussian(_doubles(n, 2, seed=1), 0.3 * _doubles(n, 2, seed=2))
    new = TanhGaussian(_doubles(n, 2, seed=3).requires_grad_(), (0.3 * _doubles(n, 2, seed=4)).requires_grad_())
    return old, new


def _m_step(model, batch, old, new, noise, temperature):
    fits = dict(zip(("kl", "std_kl"), new.decoupled(old), strict=False))
    kls = {name: old.kl_by_dimension(fit) for name, fit in fits.items()}
    return model.actor_loss(batch, fits, kls, Outputs(old, old), noise, th.tensor(temperature, dtype=th.float64))


def test_the_critics_target_is_the_mean_over_the_target_actors_actions():
    """Of each the smaller critic's value; nothing follows where an episode terminated."""
    model = _small(TWO_ACTIONS)
    model.bellman_loss = lambda name, batch, target: target
    old, _ = _gaussians()
    noise = _doubles(5, 3, 2)
    target = model.critic_loss(_known(), Outputs(None, old), noise)
    tried = np.tanh(old.mean.numpy() + np.exp(old.log_std.numpy()) * noise.numpy())
    expected = np.arange(3.0) + 0.9 * np.array([1.0, 0.0, 1.0]) * _q(tried).mean(axis=0)
    np.testing.assert_allclose(target, expected)


def _normal(x, mean, std):
    return -0.5 * ((x - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)


@pytest.mark.parametrize("mask", [None, [1.0, 0.0, 1.0]])
def test_the_m_step_fits_mean_and_std_apart(mask):
    """Each with the other one of the target actor, and with weights of its own for each action dimension."""
    model = _small(TWO_ACTIONS)
    coefs = {"kl_coef": np.array([2.0, 5.0]), "std_kl_coef": np.array([3.0, 0.5])}
    for name, values in coefs.items():
        model.coefficients[name].parameter.data = th.as_tensor(np.log(np.expm1(values)))
    (old, new), noise, eta = _gaussians(), _doubles(4, 3, 2), 0.3
    batch = _known(mask=None if mask is None else th.tensor(mask))
    loss, seen = _m_step(model, batch, old, new, noise, eta)
    m0, s0, m, s = (part.detach().numpy() for part in (old.mean, old.log_std.exp(), new.mean, new.log_std.exp()))
    x = m0 + s0 * noise.numpy()
    weights = np.exp(_q(np.tanh(x)) / eta)
    weights /= weights.sum(axis=0)
    kl, std_kl = 0.5 * ((m - m0) / s0) ** 2, np.log(s / s0) + 0.5 * ((s0 / s) ** 2 - 1)
    likelihood = (weights * (_normal(x, m, s0) + _normal(x, m0, s)).sum(axis=-1)).sum(axis=0)
    per_state = (coefs["kl_coef"] * kl + coefs["std_kl_coef"] * std_kl).sum(axis=-1) - likelihood
    counts = np.ones(3) if mask is None else np.array(mask)
    assert loss.item() == pytest.approx((per_state * counts).sum() / counts.sum())
    assert seen["kl"].item() == pytest.approx((kl.mean(axis=-1) * counts).sum() / counts.sum())
    assert seen["std_kl"].item() == pytest.approx((std_kl.mean(axis=-1) * counts).sum() / counts.sum())
    improvement = (weights * np.log(4 * weights)).sum(axis=0)
    assert seen["improvement"].item() == pytest.approx((improvement * counts).sum() / counts.sum())
    of_mean, of_log_std = th.autograd.grad(loss, [new.mean, new.log_std])
    weights, each = weights[..., None], (counts / counts.sum())[:, None]
    expected = coefs["kl_coef"] * (m - m0) / s0**2 - (weights * (x - m)).sum(axis=0) / s0**2
    np.testing.assert_allclose(of_mean, each * expected)
    expected = coefs["std_kl_coef"] * (1 - (s0 / s) ** 2) + 1 - (weights * ((x - m0) / s) ** 2).sum(axis=0)
    np.testing.assert_allclose(of_log_std, each * expected)


def test_the_m_step_of_choices_has_one_bound_and_exact_expectations():
    model = _small(TwoViewChoice())
    model.coefficients["kl_coef"].parameter.data = th.tensor([np.log(np.expm1(3.0))])
    old, new = Categorical(_doubles(3, 3, seed=1)), Categorical(_doubles(3, 3, seed=2).requires_grad_())
    q = _doubles(2, 3, 3, seed=3)
    loss, _ = _m_step(model, SimpleNamespace(q_at_obs=lambda critic: lambda actions: q, mask=None), old, new, None, 0.4)
    p, log_new = old.logits.softmax(dim=-1).numpy(), new.logits.detach().log_softmax(dim=-1).numpy()
    weights = p * np.exp(q.numpy().min(axis=0) / 0.4)
    weights /= weights.sum(axis=1, keepdims=True)
    expected = 3.0 * (p * (np.log(p) - log_new)).sum(axis=1) - (weights * log_new).sum(axis=1)
    assert loss.item() == pytest.approx(expected.mean())


def test_each_dimensions_weight_follows_its_own_kl():
    """By one step of Adam each: up where the KL is above its bound, which a mean far off sees to, down elsewhere."""
    model = _small(TWO_ACTIONS, learning_starts=1000).learn(40)
    with th.no_grad():
        model.policy.actor.head.mean.bias[0] += 0.3
        model.policy.actor.head.log_std.bias[1] += 0.3
    model.train(1, 16)
    start = np.log(np.expm1(10.0))
    expected = [np.log1p(np.exp(start + step)) for step in (0.01, -0.01)]
    assert model.coefficients["kl_coef"].value.tolist() == pytest.approx(expected, rel=1e-6)
    assert model.coefficients["std_kl_coef"].value.tolist() == pytest.approx([999.99, 1000.01], rel=1e-6)


# --- a limit ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("eta", [0.3, 1e-3])
def test_without_bounds_the_m_step_is_weighted_regression_to_the_better_actions(eta):
    """The mean goes to the samples' weighted mean, the std to their weighted spread around the old one; cold, to the best."""
    model = _small(TWO_ACTIONS, kl_coef=0.0, std_kl_coef=0.0)
    (old, _), noise = _gaussians(), _doubles(6, 3, 2)
    x = old.mean + old.log_std.exp() * noise
    weights = th.as_tensor(_q(np.tanh(x.numpy())) / eta).softmax(dim=0)[..., None]
    mean = (weights * x).sum(dim=0).requires_grad_()
    log_std = (0.5 * (weights * (x - old.mean) ** 2).sum(dim=0).log()).requires_grad_()
    loss, _ = _m_step(model, _known(), old, TanhGaussian(mean, log_std), noise, eta)
    for gradient in th.autograd.grad(loss, [mean, log_std]):
        th.testing.assert_close(gradient, th.zeros_like(gradient), atol=1e-12, rtol=0)
    if eta < 0.01:
        best = th.as_tensor(_q(np.tanh(x.numpy()))).argmax(dim=0)
        th.testing.assert_close(mean.detach(), x[best, th.arange(3)])


# --- what it learns ---------------------------------------------------------------------------------------------------

FAST = {"learning_rate": 1e-2, "tau": 0.1, "n_actions": 10, "kl_coef": "auto_1", "learning_starts": 400}


def _trained(env, **arguments):
    """On actions drawn at random, so that what it does is what its critics say."""
    model = _small(env, **FAST, **arguments).learn(400)
    model.train(180, 128)
    return model


def test_learns_what_can_be_known_from_the_partial_view():
    """Noise as large as the target's spread: the best guess is the posterior mean, about half of what is seen."""
    narrow = {"net_arch": [32], "log_std_bounds": (-5.0, -2.0)}
    env = TwoViewBandit(noise_std=0.46)
    model = _trained(env, policy_kwargs=narrow, temperature="auto_0.05", target_kl=0.2, std_kl_coef="auto_10")
    seen, targets = np.array([0.4, -0.4, 0.0]), np.linspace(-0.8, 0.8, 201)
    likelihood = np.exp(-0.5 * ((seen[:, None] - targets) / 0.46) ** 2)
    posterior_mean = (likelihood * targets).sum(axis=1) / likelihood.sum(axis=1)
    partial = np.stack([seen, np.zeros(3)], axis=1).astype(np.float32)
    action, _ = model.predict({"partial": partial}, deterministic=True)
    np.testing.assert_allclose(action[:, 0], posterior_mean, atol=0.12)


def test_learns_the_right_choices():
    model = _trained(TwoViewChoice(), temperature="auto_0.1", target_kl=0.05)
    targets = np.array([-0.7, -0.4, 0.0, 0.15, 0.4, 0.7], np.float32)
    partial = np.stack([targets, np.zeros(6, np.float32)], axis=1)
    action, _ = model.predict({"partial": partial}, deterministic=True)
    assert action.tolist() == [0, 0, 1, 1, 2, 2]


# --- who does what ----------------------------------------------------------------------------------------------------


def test_the_actor_collects_and_its_target_follows_it():
    model = _small(learning_starts=0, gradient_steps=0, tau=0.25)
    with th.no_grad():
        for network, sign in ((model.policy.actor, 50.0), (model.policy.actor_target, -50.0)):
            network.head.mean.bias.fill_(sign)
    model.learn(6)
    assert (model.replay_buffer.sample(50).actions == 1).all()
    model.policy.update_targets(0.25)
    assert model.policy.actor_target.head.mean.bias.item() == -25.0
    assert set(model.policy.trained) == {"actor", "critic"}


@pytest.mark.parametrize("n_actions", [1, 7])
def test_so_many_actions_are_tried_in_each_state(n_actions):
    model = _small(TWO_ACTIONS, n_actions=n_actions, learning_starts=1000).learn(30)
    seen = []
    values = model.policy.critic_target.values
    model.policy.critic_target.values = lambda features, actions: seen.append(actions) or values(features, actions)
    model.train(1, 16)
    assert [actions.shape for actions in seen] == [(n_actions, 16, 2)] * 2, "of the next observations, and of the present ones"
    assert not th.equal(*seen)


def test_the_actor_sees_what_is_partial_alone_and_so_does_its_target():
    policy = _small().policy
    assert policy.role_keys == {"actor": ("partial",), "critic": ("partial", "privileged")}
    assert set(policy.actor_target.observation_space.spaces) == {"partial"}
    policy = _small(role_keys={"actor": ["partial", "privileged"]}).policy
    assert set(policy.actor_target.observation_space.spaces) == {"partial", "privileged"}


# --- arguments --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "value"), [("ent_coef", 0.1), ("ent_coef", "auto_0.5"), ("target_entropy", "sac")])
def test_what_is_of_the_entropy_is_refused(name, value):
    with pytest.raises(ValueError, match=rf"AsymmetricMPO has no entropy term, so {name} would do nothing: leave it out"):
        _small(**{name: value})
    assert not {"train/ent_coef", "train/ent_coef_loss"} & set(_small(**{name: "auto"}).learn(20).logger.name_to_value)


def test_saved_and_loaded_it_goes_on_and_takes_other_arguments(tmp_path):
    model = _small(TWO_ACTIONS, kl_coef="auto_2", dual_learning_rate=0.1).learn(30)
    model.save(tmp_path / "model")
    values = {name: dual.value.clone() for name, dual in model.coefficients.items()}
    loaded = AsymmetricMPO.load(tmp_path / "model", env=TWO_ACTIONS)
    for name, dual in loaded.coefficients.items():
        assert th.equal(dual.value, values[name]), name
    assert loaded.learn(10, reset_num_timesteps=False).num_timesteps == 40
    loaded = AsymmetricMPO.load(tmp_path / "model", env=TWO_ACTIONS, kl_coef="auto_5", std_kl_coef=0.0, dual_learning_rate=0.5)
    assert loaded.coefficients["kl_coef"].value.tolist() == pytest.approx([5.0, 5.0])
    assert loaded.coefficients["std_kl_coef"].value.item() == 0.0
    before = loaded.coefficients["temperature"].value.item()
    assert before == values["temperature"].item()
    loaded.learn(10, reset_num_timesteps=False)
    assert abs(loaded.coefficients["temperature"].value.item() - before) > 2.0, "at the rate that was given"
    loaded = AsymmetricMPO.load(tmp_path / "model", env=TWO_ACTIONS, kl_coef="auto")
    assert th.equal(loaded.coefficients["kl_coef"].value, values["kl_coef"]), "learned before and after"


@pytest.mark.parametrize("setting", ["n_actions", "target_improvement", "target_kl", "target_std_kl"])
def test_a_number_that_is_compiled_in_has_a_program_of_its_own(setting):
    model, keys = _small(learning_starts=1000).learn(20), []
    for value in (3, 5):
        setattr(model, setting, value)
        model.train(1, 8)
        keys.append(model.programs.settings)
    assert keys[0] != keys[1]


def test_a_diagnosis_has_the_weights_of_each_dimension(tmp_path):
    model = _small(TWO_ACTIONS).learn(20)
    model.set_logger(configure(str(tmp_path), []))
    with pytest.raises(DivergenceError) as raised:
        check_finite_metrics(model, {"kl": np.nan}, {}, {name: dual.value for name, dual in model.coefficients.items()})
    assert raised.value.diagnosis["coefficients"]["kl_coef"] == model.coefficients["kl_coef"].value.tolist()


# --- every kind -------------------------------------------------------------------------------------------------------

GRU = {"policy": "MultiInputGruPolicy", "policy_kwargs": {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]}}
LSTM = GRU | {"policy": "MultiInputLstmPolicy"}
CNN = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}}
KINDS = {
    "numbers": (lambda: TWO_ACTIONS, {}),
    "choices": (TwoViewChoice, {}),
    "gru": (lambda: Recall(continuous=True), GRU),
    "gru, choices": (Recall, GRU),
    "lstm": (lambda: Recall(continuous=True), LSTM),
    "gru without layers behind it": (
        lambda: Recall(continuous=True),
        GRU | {"policy_kwargs": GRU["policy_kwargs"] | {"rnn_net_arch": []}},
    ),
    "images": (lambda: Sampled(IMAGES), {"policy_kwargs": CNN}),
    "images, shared encoder": (lambda: Sampled(IMAGES), {"policy_kwargs": CNN | {"share_features_extractor": True}}),
    "bfloat16": (lambda: TWO_ACTIONS, {"mixed_precision": True}),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_trains(kind):
    env, arguments = KINDS[kind]
    model = _small(env(), batch_size=4, **arguments)
    start = [p.detach().clone() for p in model.policy.actor.parameters()]
    model.learn(30)
    logged = {name: value for name, value in model.logger.name_to_value.items() if name.startswith("train/")}
    assert np.isfinite(list(logged.values())).all()
    stds = isinstance(model.action_space, spaces.Box)
    assert {"train/kl", "train/kl_coef", "train/kl_coef_loss", "train/improvement", "train/temperature"} <= set(logged)
    assert ("train/std_kl" in logged) == ("train/std_kl_coef" in logged) == stds
    assert any(not th.equal(p, q) for p, q in zip(model.policy.actor.parameters(), start, strict=True))


def test_exported_it_acts_as_predict_does(tmp_path):
    model = _small(TWO_ACTIONS).learn(30)
    robot = OnnxPolicy.load(export_learner(model, tmp_path / "actor.onnx", verify_on=8))
    obs = np.random.default_rng(0).standard_normal((5, 2)).astype(np.float32)
    np.testing.assert_allclose(robot.act(obs), model.predict({"partial": obs}, deterministic=True)[0], atol=1e-5)
