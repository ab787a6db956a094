"""The identity: at the guider's optimum, the pull of eq. 16 is the gradient of the guider's critic."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_gac.tabular import ascent, coefficient_for, guider_optimum, pull
from tests.tabular.processes import FEW, SEEDS

SIZE = 4
LOG_ALPHAS = st.floats(-4, 4)


def _case(seed):
    """Learner's mean, std, curvature and best action."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(SIZE, SIZE))
    return rng.normal(size=SIZE), rng.uniform(0.05, 1.0, SIZE), root @ root.T + 0.1 * np.eye(SIZE), 3 * rng.normal(size=SIZE)


def _slope(function, point, step=1e-4):
    """Gradient by central differences."""
    return np.array([(function(point + axis) - function(point - axis)) / (2 * step) for axis in step * np.eye(len(point))])


def _kl(guider_mean, learner_mean, std):
    return 0.5 * (((guider_mean - learner_mean) / std) ** 2).sum()


@FEW
@given(SEEDS, LOG_ALPHAS)
def test_the_pull_is_a_second_policy_gradient_for_every_alpha(seed, log_alpha):
    learner, std, curvature, best = _case(seed)
    alpha = float(np.exp(log_alpha))
    guider = guider_optimum(alpha, learner, std, curvature, best)
    gradient = ascent(guider, curvature, best)
    np.testing.assert_allclose(pull(alpha, guider, learner, std), gradient, rtol=1e-8, atol=1e-9 * np.abs(gradient).max())


@FEW
@given(SEEDS, st.floats(0.001, 0.9))
def test_and_for_every_target_kl_by_sum_or_by_mean(seed, share):
    learner, std, curvature, best = _case(seed)
    target = share * _kl(best, learner, std)
    alpha = coefficient_for(target, learner, std, curvature, best)
    guider = guider_optimum(alpha, learner, std, curvature, best)
    assert _kl(guider, learner, std) == pytest.approx(target)
    np.testing.assert_allclose(pull(alpha, guider, learner, std), ascent(guider, curvature, best), rtol=1e-6, atol=1e-6)
    by_mean = SIZE * alpha  # weighs a KL that is SIZE times smaller
    eq_16s_term = _slope(lambda mean: by_mean * _kl(guider, mean, std) / SIZE, learner)
    np.testing.assert_allclose(-eq_16s_term, ascent(guider, curvature, best), rtol=1e-4, atol=1e-4 * np.abs(eq_16s_term).max())


@FEW
@given(SEEDS, st.floats(-1, 2))
def test_optimum_and_gradients_are_those_of_the_losses(seed, log_alpha):
    """By differences; a quadratic critic's expectation is its value at the mean, but for a constant."""
    learner, std, curvature, best = _case(seed)
    alpha = float(np.exp(log_alpha))
    guider = guider_optimum(alpha, learner, std, curvature, best)

    def critic(mean):
        return -0.5 * (mean - best) @ curvature @ (mean - best)

    scale = np.abs(pull(alpha, guider, learner, std)).max() + 1
    np.testing.assert_allclose(
        _slope(lambda mean: alpha * _kl(mean, learner, std) - critic(mean), guider) / scale, 0, atol=1e-5
    )
    np.testing.assert_allclose(_slope(critic, learner), ascent(learner, curvature, best), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(
        -_slope(lambda mean: alpha * _kl(guider, mean, std), learner) / scale,
        pull(alpha, guider, learner, std) / scale,
        atol=1e-5,
    )


def test_away_from_the_guiders_optimum_it_is_not():
    learner, std, curvature, best = _case(0)
    guider = guider_optimum(1.0, learner, std, curvature, best) + 0.1
    assert np.abs(pull(1.0, guider, learner, std) - ascent(guider, curvature, best)).max() > 0.1


@FEW
@given(SEEDS)
def test_the_pull_vanishes_as_the_guider_goes_far(seed):
    learner, std, curvature, best = _case(seed)
    alphas = [10.0**power for power in (4, 2, 0, -2, -4, -6)]
    guiders = [guider_optimum(alpha, learner, std, curvature, best) for alpha in alphas]
    pulls = [np.linalg.norm(pull(alpha, guider, learner, std) * std) for alpha, guider in zip(alphas, guiders, strict=True)]
    kls = [_kl(guider, learner, std) for guider in guiders]
    assert np.diff(kls).min() > 0
    assert np.diff(pulls).max() < 0
    assert pulls[-1] < 1e-2 * pulls[0]


@FEW
@given(SEEDS)
def test_with_discrete_actions_it_is_one_to_first_order(seed):
    """Gradients by the learner's logits; what they differ by halves with each doubling of alpha."""
    rng = np.random.default_rng(seed)
    learner, values = rng.dirichlet(np.ones(5)), rng.normal(size=5)
    gradient = learner * (values - learner @ values)

    def error(alpha):
        guider = learner * np.exp(values / alpha)
        return np.abs(alpha * (guider / guider.sum() - learner) - gradient).max()

    assert error(1000.0) == pytest.approx(0.5 * error(500.0), rel=0.05)
    assert error(1000.0) < 0.01
    assert error(0.5) > 100 * error(1000.0)


def test_a_target_beyond_the_best_action_is_refused():
    learner, std, curvature, best = _case(0)
    with pytest.raises(ValueError, match="target_kl"):
        coefficient_for(2 * _kl(best, learner, std), learner, std, curvature, best)


@pytest.mark.parametrize(("target_kl", "scale"), [(1e-30, 1.0), (1e-3, 1e15), (1e-3, 1e-15)])
def test_a_target_may_need_an_alpha_of_any_size(target_kl, scale):
    learner, std, curvature, best = _case(0)
    alpha = coefficient_for(target_kl, learner, std, scale * curvature, best)
    assert _kl(guider_optimum(alpha, learner, std, scale * curvature, best), learner, std) == pytest.approx(
        target_kl, rel=1e-6
    )
