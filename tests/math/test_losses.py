"""Every equation against independently computed numbers, small cases by hand, and properties."""

import math

import pytest
import torch as th

from sb3_gac.math import losses
from tests.math.golden import assert_close, golden

DTYPES = pytest.mark.parametrize("dtype", [th.float64, th.float32], ids=["float64", "float32"])


@DTYPES
def test_guided_target_eq12(dtype):
    case = golden("targets", dtype)
    target = losses.soft_target(
        reward=case["reward"],
        done=case["done"],
        next_q=case["q_target"],
        discount=case["gamma"],
        next_log_prob=case["log_prob"],
        ent_coef=case["ent_coef"],
        next_kl=case["kl"],
        kl_coef=case["kl_coef"],
    )
    assert_close(target, case["guided_target_eq12"])


@DTYPES
def test_learner_target_eq15(dtype):
    case = golden("targets", dtype)
    target = losses.soft_target(reward=case["reward"], done=case["done"], next_q=case["q_target"], discount=case["gamma"])
    assert_close(target, case["learner_target_eq15"])


@DTYPES
def test_guider_and_learner_objectives(dtype):
    case = golden("actor_losses", dtype)
    kl = {"kl": case["kl"], "kl_coef": case["kl_coef"]}
    entropy = {"log_prob": case["log_prob"], "ent_coef": case["ent_coef"]}
    assert_close(losses.policy_loss(q=case["q_guider"], **entropy, **kl), case["guider_loss_eq13"])
    assert_close(losses.policy_loss(q=case["q_learner"], **kl), case["learner_loss_eq16"])
    assert_close(losses.policy_loss(q=case["q_guider"], **kl), case["learner_loss_share"])
    assert_close(losses.distillation_loss(case["kl"]), case["learner_loss_eq14"])


@DTYPES
def test_critic_loss_sums_half_the_mean_squares(dtype):
    case = golden("critic_loss", dtype)
    assert_close(losses.critic_loss(case["q"], case["target"]), 0.5 * sum(case["mse_mean_per_critic"].tolist()))


@DTYPES
def test_what_has_no_weight_counts_in_the_critics_mean_as_nothing(dtype):
    """
    Errors 0.5, 1, 1 and -0.5, 1, 3; of their squares 0.25 + 1 and 0.25 + 9 count: 10.5 / 3 / 2. Brax's loss, the mean over
    critics as well, is half of it; masked, the last of three is padding: (0.25 + 0.25) / 2 / 2.
    """
    q, target = th.tensor([[1, 2, 3], [0, 2, 5]], dtype=dtype), th.tensor([0.5, 1, 2], dtype=dtype)
    truncation = th.tensor([0, 1, 0], dtype=dtype)
    loss = losses.critic_loss(q, target, None, 1 - truncation)
    assert_close(loss, 1.75)
    assert_close(loss, 2 * 0.5 * (((q - target) * (1 - truncation)) ** 2).mean())
    assert_close(losses.critic_loss(q, target, th.tensor([1, 1, 0], dtype=dtype), 1 - truncation), 0.125)
    assert_close(losses.critic_loss(q, target, None, th.ones(3, dtype=dtype)), losses.critic_loss(q, target))


@pytest.mark.parametrize("index", range(3))
@DTYPES
def test_dual_gradient_and_direction_eq17(index, dtype):
    from tests.math.golden import GOLDEN

    case = GOLDEN["dual"][index]
    log_coef = th.tensor([case["log_coef"]], dtype=dtype, requires_grad=True)
    kl = th.full((5,), case["kl_mean"], dtype=dtype)
    losses.dual_loss(log_coef.exp(), (kl - case["target"]).mean()).backward()
    assert_close(log_coef.grad, [case["grad_log_coef"]])
    moved_up = (log_coef - log_coef.grad > log_coef).item()
    assert moved_up == (case["coef_moves"] == "up")


def test_dual_loss_leaves_the_violation_alone():
    violation = th.tensor(0.1, requires_grad=True)
    log_coef = th.zeros(1, requires_grad=True)
    losses.dual_loss(log_coef.exp(), violation).backward()
    assert violation.grad is None
    assert log_coef.grad.item() == pytest.approx(-0.1)


def test_a_termination_cuts_the_future_and_a_time_limit_does_not():
    reward, next_q = th.tensor([1.0, 1.0]), th.tensor([[10.0, 10.0], [20.0, 20.0]])
    terminated = th.tensor([1.0, 0.0])
    assert losses.soft_target(reward=reward, done=terminated, next_q=next_q, discount=0.9).tolist() == pytest.approx(
        [1.0, 10.0]
    )
    # 10 - 2 * 0.5 - 0.1 * 3 = 8.7
    kl, log_prob = th.full((2,), 0.5), th.full((2,), 3.0)
    extra = {"next_kl": kl, "kl_coef": 2.0, "next_log_prob": log_prob, "ent_coef": 0.1}
    target = losses.soft_target(reward=reward, done=terminated, next_q=next_q, discount=0.9, **extra)
    assert target.tolist() == pytest.approx([1.0, 1.0 + 0.9 * 8.7])


def test_discount_may_differ_per_transition():
    discount = th.tensor([0.9, 0.81])
    target = losses.soft_target(reward=th.zeros(2), done=th.zeros(2), next_q=th.ones(1, 2), discount=discount)
    assert target.tolist() == pytest.approx([0.9, 0.81])


def test_log_std_loss_by_hand():
    # ((1 - 0)^2 + (2 - 0)^2) / 2 = 2.5, halved
    assert losses.log_std_loss(th.tensor([[1.0, 2.0]]), th.zeros(1, 2)).item() == pytest.approx(1.25)


def _sequence_losses(mask, kl, log_prob, q, log_std):
    return [
        losses.critic_loss(q, kl, mask),
        losses.policy_loss(q=q, log_prob=log_prob, ent_coef=0.2, kl=kl, kl_coef=0.7, mask=mask),
        losses.distillation_loss(kl, mask),
        losses.log_std_loss(log_std, th.zeros_like(log_std), mask),
        losses.masked_quantile(kl, 0.5, mask),
    ]


def test_padding_has_no_say():
    """Losses of (T, B) sequences with a mask are those of the valid entries, whatever the padding holds."""
    generator = th.Generator().manual_seed(0)
    kl, log_prob, q, log_std = (th.randn(shape, generator=generator) for shape in [(3, 4), (3, 4), (2, 3, 4), (3, 4, 5)])
    mask = th.tensor([[1, 1, 1, 0], [1, 0, 1, 0], [1, 0, 0, 0]], dtype=th.float32)
    valid = mask > 0
    expected = _sequence_losses(None, kl[valid], log_prob[valid], q[:, valid], log_std[valid])
    for poison in (1e9, math.nan, math.inf):
        kl[~valid] = poison
        q[:, ~valid] = poison
        log_prob[~valid] = poison
        for actual, wanted in zip(_sequence_losses(mask, kl, log_prob, q, log_std), expected, strict=True):
            th.testing.assert_close(actual, wanted)


def test_padding_gets_no_gradient():
    kl = th.tensor([1.0, math.nan], requires_grad=True)
    losses.distillation_loss(kl, th.tensor([1.0, 0.0])).backward()
    assert kl.grad.tolist() == [1.0, 0.0]


def test_entropy_terms_of_the_learner_by_hand():
    q, log_prob = th.tensor([[2.0], [3.0]]), th.tensor([0.5])
    # 1 + 0.9 * (2 - 0.2 * 0.5) = 2.71
    target = losses.soft_target(
        reward=th.ones(1), done=th.zeros(1), next_q=q, discount=0.9, next_log_prob=log_prob, ent_coef=0.2
    )
    assert target.item() == pytest.approx(2.71)
    # 0.7 * 0.1 + 0.2 * 0.5 - 2 = -1.83
    loss = losses.policy_loss(q=q, log_prob=log_prob, ent_coef=0.2, kl=th.tensor([0.1]), kl_coef=0.7)
    assert loss.item() == pytest.approx(-1.83)


@pytest.mark.parametrize("name", ["reward", "done", "discount", "next_log_prob", "next_kl"])
@pytest.mark.parametrize("shape", [(4, 1), (1, 4), (1,), (5,)])
def test_a_target_of_another_shape_is_named(name, shape):
    """(B, 1) beside (B,) would broadcast to (B, B) without a word."""
    tensors = {key: th.ones(4) for key in ("reward", "done", "discount", "next_log_prob", "next_kl")}
    tensors[name] = th.ones(shape)
    with pytest.raises(ValueError, match=rf"^{name} must have the shape \(4,\)"):
        losses.soft_target(next_q=th.ones(2, 4), ent_coef=0.1, kl_coef=0.1, **tensors)


@pytest.mark.parametrize("name", ["log_prob", "kl", "mask"])
@pytest.mark.parametrize("shape", [(4, 1), (1, 4), (1,), (5,)])
def test_an_objective_of_another_shape_is_named(name, shape):
    with pytest.raises(ValueError, match=rf"^{name} must have the shape \(4,\)"):
        losses.policy_loss(q=th.ones(2, 4), ent_coef=0.1, kl_coef=0.1, **{name: th.ones(shape)})


@pytest.mark.parametrize("share", [0.01, 0.3, 0.5, 0.7, 0.95, 1.0])
@pytest.mark.parametrize("n", [1, 7, 20])
def test_a_quantile_is_the_smallest_value_that_the_share_does_not_exceed(n, share):
    """With padding of any value between, and in whatever shape."""
    values = th.linspace(-3, 2, n)[th.randperm(n)]
    expected = next(value for value in values.sort().values if (values <= value).double().mean() >= share - 1e-6)
    assert losses.masked_quantile(values, share) == expected
    for padding in (-9.0, 0.0, 9.0):
        padded = th.cat([values, th.full((n,), padding)]).view(2, n)
        mask = th.cat([th.ones(n), th.zeros(n)]).view(2, n)
        assert losses.masked_quantile(padded, share, mask) == expected
        assert losses.masked_quantile(padded.T, share, mask.T) == expected
