"""Tanh-Gaussians, the KL of two that share a std, and the projection onto a KL ball."""

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sb3_gac.math.distributions import Categorical, TanhGaussian, kl_shared_std, project_to_kl_ball
from sb3_gac.math.losses import policy_loss, soft_target
from tests.math.golden import assert_close, golden

DTYPES = pytest.mark.parametrize("dtype", [th.float64, th.float32], ids=["float64", "float32"])


@DTYPES
def test_log_prob(dtype):
    case = golden("tanh_gaussian_log_prob", dtype)
    distribution = TanhGaussian(case["mean"], case["log_std"])
    assert_close(distribution.log_prob(case["pre_tanh"]), case["log_prob"])
    assert_close(th.tanh(case["pre_tanh"]), case["action"])


def test_sampled_log_prob_is_that_of_the_sampled_action():
    th.manual_seed(0)
    distribution = TanhGaussian(th.zeros(1000, 2, dtype=th.float64), th.full((1000, 2), -0.5, dtype=th.float64))
    action, log_prob = distribution.sample_with_log_prob(th.randn_like(distribution.mean))
    th.testing.assert_close(log_prob, distribution.log_prob(th.atanh(action)))


def test_density_integrates_to_one():
    """Over actions, not over what is before tanh: the change of variables is right."""
    action = th.linspace(-1, 1, 20_001, dtype=th.float64)[1:-1, None]
    distribution = TanhGaussian(th.full_like(action, 0.4), th.full_like(action, -0.7))
    density = distribution.log_prob(th.atanh(action)).exp()
    assert th.trapezoid(density, action[:, 0]).item() == pytest.approx(1.0, abs=1e-4)


def test_samples_follow_mean_and_std():
    th.manual_seed(0)
    distribution = TanhGaussian(th.full((100_000, 1), 0.3), th.full((100_000, 1), -1.0))
    pre_tanh = th.atanh(distribution.sample())
    assert pre_tanh.mean().item() == pytest.approx(0.3, abs=0.005)
    assert pre_tanh.std().item() == pytest.approx(np.exp(-1.0), abs=0.005)


def test_log_prob_is_finite_for_saturated_actions():
    extreme = th.tensor([[-30.0, 30.0, 0.0]])
    assert th.isfinite(TanhGaussian(extreme, th.zeros(1, 3)).log_prob(extreme)).all()
    # One dimension: log N(30; 30, 1) - 2 (log 2 - 30)
    expected = -np.log(2 * np.pi) / 2 - 2 * (np.log(2) - 30.0)
    at_thirty = th.tensor([[30.0]])
    assert TanhGaussian(at_thirty, th.zeros(1, 1)).log_prob(at_thirty).item() == pytest.approx(expected)


def test_sample_is_reparameterised():
    mean, log_std = th.zeros(4, 2, requires_grad=True), th.zeros(4, 2, requires_grad=True)
    TanhGaussian(mean, log_std).sample().sum().backward()
    assert (mean.grad > 0).all()
    assert (log_std.grad != 0).all()


@DTYPES
def test_kl(dtype):
    case = golden("kl_shared_std", dtype)
    arguments = case["guider_mean"], case["learner_mean"], case["log_std"].exp()
    assert_close(kl_shared_std(*arguments, reduction="sum"), case["kl_sum"])
    assert_close(kl_shared_std(*arguments, reduction="mean"), case["kl_mean"])


def test_kl_is_torchs_own():
    case = golden("kl_shared_std", th.float64)
    std = case["log_std"].exp()
    normals = [th.distributions.Normal(case[name], std) for name in ("guider_mean", "learner_mean")]
    assert_close(
        kl_shared_std(*(normal.mean for normal in normals), std, "sum"), th.distributions.kl_divergence(*normals).sum(-1)
    )


@pytest.mark.parametrize("dtype", [th.float64, th.float32])
def test_kl_of_any_two_gaussians_is_torchs_own(dtype):
    """With stds of their own, in both directions; and its gradient moves means and stds."""
    generator = th.Generator().manual_seed(0)
    draw = [th.randn(5, 3, generator=generator, dtype=dtype) for _ in range(4)]
    one, other = TanhGaussian(draw[0], 0.5 * draw[1]), TanhGaussian(draw[2], 0.5 * draw[3])
    for p, q in ((one, other), (other, one)):
        normals = [th.distributions.Normal(x.mean, x.log_std.exp()) for x in (p, q)]
        expected = th.distributions.kl_divergence(*normals)
        th.testing.assert_close(p.kl(q), expected.sum(-1))
        th.testing.assert_close(p.kl(q, "mean"), expected.mean(-1))
    leaves = [part.clone().requires_grad_() for part in (*one, *other)]
    TanhGaussian(*leaves[:2]).kl(TanhGaussian(*leaves[2:])).sum().backward()
    assert all((leaf.grad != 0).all() for leaf in leaves)


@pytest.mark.parametrize("reduction", ["sum", "mean"])
def test_kl_by_dimension_is_what_the_kl_sums_up(reduction):
    one, other = (TanhGaussian(th.randn(5, 3), 0.5 * th.randn(5, 3)) for _ in range(2))
    th.testing.assert_close(getattr(one.kl_by_dimension(other), reduction)(dim=-1), one.kl(other, reduction))
    assert one.kl_by_dimension(other).shape == (5, 3)
    one, other = (Categorical(th.randn(5, 3)) for _ in range(2))
    assert th.equal(one.kl_by_dimension(other), one.kl(other)[:, None])


def test_kl_of_nearly_the_same_std_is_not_lost_in_rounding():
    """Of stds that differ by a thousandth it is a millionth."""
    log_std = th.linspace(-2, 0.5, 101)[:, None]
    one, other = (TanhGaussian(th.zeros(101, 1), log_std + shift) for shift in (0.0, 1e-3))
    exact = other.log_std.double() - one.log_std.double()
    exact = exact + 0.5 * th.expm1(-2 * exact)
    assert ((one.kl(other).double() / exact[:, 0] - 1).abs() < 1e-3).all()


def test_decoupled_parts_move_mean_or_std_alone():
    mean, log_std = (th.randn(4, 2).requires_grad_() for _ in range(2))
    anchor = TanhGaussian(th.randn(4, 2), th.randn(4, 2))
    of_mean, of_std = TanhGaussian(mean, log_std).decoupled(anchor)
    assert (of_mean.mean is mean, of_mean.log_std is anchor.log_std) == (True, True)
    assert (of_std.mean is anchor.mean, of_std.log_std is log_std) == (True, True)
    choice = Categorical(th.randn(4, 3))
    assert choice.decoupled(Categorical(th.randn(4, 3))) == (choice,)


@pytest.mark.parametrize("leading", [(5,), (2, 5)])
def test_candidates_are_samples_with_the_smallest_critics_values(leading):
    one, other = (TanhGaussian(th.randn(*leading, 3), 0.5 * th.randn(*leading, 3)) for _ in range(2))
    noise = th.randn(7, *leading, 3)
    candidates = one.candidates(lambda actions: th.stack([actions.sum(dim=-1), actions[..., 0]]), noise)
    x = one.mean + one.log_std.exp() * noise
    values = th.minimum(th.tanh(x).sum(dim=-1), th.tanh(x)[..., 0]).movedim(0, -1)
    th.testing.assert_close(candidates.values, values)
    th.testing.assert_close(candidates.mean_value, values.mean(dim=-1)[None])
    expected = th.distributions.Normal(other.mean, other.log_std.exp()).log_prob(x).sum(dim=-1).movedim(0, -1)
    th.testing.assert_close(other.log_likelihood(candidates), expected)
    jacobian = (1 - th.tanh(x).double().square()).log().sum(dim=-1).movedim(0, -1).float()
    of_actions = th.stack([other.log_prob(each) for each in x], dim=-1)
    th.testing.assert_close(expected - jacobian, of_actions, rtol=1e-3, atol=1e-3)


def test_candidates_among_choices_are_all_of_them_by_their_probabilities():
    one, other = (Categorical(th.randn(5, 3)) for _ in range(2))
    q = th.randn(2, 5, 3)
    candidates = one.candidates(lambda actions: q if actions is None else None, th.empty(0))
    assert th.equal(candidates.values, q.amin(dim=0))
    th.testing.assert_close(candidates.mean_value, one.value_and_log_prob(lambda actions: q, th.empty(0))[0])
    th.testing.assert_close(other.log_likelihood(candidates), other.logits.log_softmax(dim=-1))


def test_kl_of_means_is_the_kl_of_a_shared_std_and_moves_no_std():
    mean, other_mean = th.tensor([[0.5, -1.0]], requires_grad=True), th.tensor([[0.0, 1.0]], requires_grad=True)
    log_std = th.tensor([[0.2, -0.3]], requires_grad=True)
    one, other = TanhGaussian(mean, log_std), TanhGaussian(other_mean, log_std)
    for reduction in ("mean", "sum"):
        th.testing.assert_close(one.kl_of_means(other, reduction), one.kl(other, reduction))
    one.kl_of_means(other).sum().backward()
    assert log_std.grad is None
    assert (mean.grad != 0).all()


@DTYPES
def test_kl_of_the_residual_guider_is_half_its_squared_correction(dtype):
    case = golden("residual_guider", dtype)
    std = case["log_std"].exp()
    guider_mean = case["learner_mean"] + std * case["delta"]
    assert_close(guider_mean, case["guider_mean"])
    assert_close(kl_shared_std(guider_mean, case["learner_mean"], std, "sum"), case["kl_sum"])
    assert_close(kl_shared_std(guider_mean, case["learner_mean"], std, "mean"), case["kl_mean"])
    assert_close(case["kl_sum"], 0.5 * case["delta"].square().sum(-1))


@DTYPES
def test_projection(dtype):
    case = golden("projection", dtype)
    std = case["log_std"].exp()
    offset = project_to_kl_ball((case["guider_mean"] - case["learner_mean"]) / std, case["kl_bound_sum"], "sum")
    projected = case["learner_mean"] + std * offset
    assert_close(projected, case["projected_mean"])
    assert_close(kl_shared_std(projected, case["learner_mean"], std, "sum"), case["kl_after"])


@given(
    offset=hnp.arrays(np.float64, (3, 4), elements=st.floats(-1e6, 1e6)),
    max_kl=st.floats(1e-6, 10.0),
    reduction=st.sampled_from(["mean", "sum"]),
)
@settings(deadline=None)
def test_projected_kl_never_exceeds_the_bound(offset, max_kl, reduction):
    offset = th.from_numpy(offset)
    zero, one = th.zeros_like(offset), th.ones_like(offset)
    projected = project_to_kl_ball(offset, max_kl, reduction)
    kl_before, kl_after = (kl_shared_std(x, zero, one, reduction) for x in (offset, projected))
    assert (kl_after <= max_kl * (1 + 1e-9)).all()
    inside = kl_before <= max_kl * (1 - 1e-9)
    assert th.equal(projected[inside], offset[inside]), "a mean inside the ball stays where it is"
    # Shrunk, never turned: parallel to what it was
    cosine = (projected * offset).sum(-1) / (projected.norm(dim=-1) * offset.norm(dim=-1)).clamp(min=1e-300)
    assert (cosine[kl_before > 1e-9] > 1 - 1e-9).all()


def test_projection_of_zero_has_a_finite_gradient():
    offset = th.zeros(2, 3, requires_grad=True)
    project_to_kl_ball(offset, 0.01).sum().backward()
    assert th.isfinite(offset.grad).all()


@pytest.mark.parametrize("dtype", [th.float64, th.float32])
def test_categorical_expectations_and_losses(dtype):
    """Every equation with exact sums over actions."""
    case = golden("discrete", dtype)
    guider, learner = Categorical(case["guider_logits"]), Categorical(case["learner_logits"])
    noise = th.zeros(())
    kl = guider.kl(learner)
    assert_close(kl, case["kl"])
    q_guided, log_prob = guider.value_and_log_prob(lambda actions: case["q_guided"], noise)
    assert_close(-log_prob, case["entropy_guider"])
    kl_coef, ent_coef = case["kl_coef"], case["ent_coef"]
    extra = {"log_prob": log_prob, "ent_coef": ent_coef}
    assert_close(policy_loss(q=q_guided, kl=kl, kl_coef=kl_coef, **extra), case["guider_loss_eq13"])
    q_learner, _ = learner.value_and_log_prob(lambda actions: case["q_learner"], noise)
    assert_close(policy_loss(q=q_learner, kl=kl, kl_coef=kl_coef), case["learner_loss_eq16"])
    given = {"reward": case["reward"], "done": case["done"], "discount": case["gamma"]}
    extra = {"next_log_prob": log_prob, "ent_coef": ent_coef, "next_kl": kl, "kl_coef": kl_coef}
    assert_close(soft_target(next_q=q_guided, **given, **extra), case["guided_target_eq12"])
    assert_close(soft_target(next_q=q_learner, **given), case["learner_target_eq15"])


def test_kl_of_choices_has_a_direction():
    """By hand: 0.5 log(0.5 / 0.8) + 0.5 log(0.5 / 0.2) = 0.2231, the other way round 0.1927."""
    even, uneven = Categorical(th.tensor([[0.5, 0.5]]).log()), Categorical(th.tensor([[0.8, 0.2]]).log())
    assert even.kl(uneven).item() == pytest.approx(0.22314, abs=1e-4)
    assert uneven.kl(even).item() == pytest.approx(0.19274, abs=1e-4)


def test_categorical_corrections_samples_and_modes():
    th.manual_seed(0)
    logits = th.tensor([1.0, 0.0, -1.0], requires_grad=True)
    learner = Categorical(logits)
    assert th.equal(learner.with_residual(Categorical(th.zeros(3))).logits, logits)
    corrected = learner.with_residual(Categorical(th.tensor([0.0, 3.0, 0.0], requires_grad=True)))
    assert corrected.mode.item() == 1
    assert th.autograd.grad(corrected.logits.sum(), logits, allow_unused=True)[0] is None, "the learner is a constant"
    samples = Categorical(logits.detach().expand(20_000, 3)).sample()
    frequencies = th.bincount(samples, minlength=3) / 20_000
    th.testing.assert_close(frequencies, logits.detach().softmax(-1), rtol=0, atol=0.015)


def test_diagnostics_of_states_by_themselves():
    """Signs of means do not cancel each other, nor do logarithms of stds."""
    gaussian = TanhGaussian(th.tensor([[3.0, -1.0], [0.5, 0.5]]), th.tensor([[1.0, 3.0], [2.0, 2.0]]).log())
    assert {name: values.tolist() for name, values in gaussian.diagnostics().items()} == {
        "std": pytest.approx([2.0, 2.0]),
        "mean_abs": [2.0, 0.5],
    }
    categorical = Categorical(th.tensor([[0.7, 0.2, 0.1], [0.1, 0.1, 0.8]]).log())
    assert categorical.diagnostics()["max_prob"].tolist() == pytest.approx([0.7, 0.8])
