"""Appendix D: MPO's eq. 32 beside eq. 10, on the same arrays."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_gac.tabular import (
    action_values,
    divergence,
    guided_objective,
    guided_values,
    learner_by_likelihood,
    learner_by_mpo,
    likelihood_objective,
    mpo_objective,
    visits,
)
from tests.tabular.processes import FEW, SEEDS, STATES, random_pair, random_policy

ALPHAS, PENALTIES = st.floats(1.0, 5.0), st.floats(0.1, 10.0)


@FEW
@given(SEEDS, ALPHAS, PENALTIES)
def test_eq_32_is_eq_10_less_the_penalty(seed, alpha, penalty):
    for aggregated in (False, True):
        process, guider, learner, rng = random_pair(seed, aggregated)
        values, weights = guided_values(process, alpha, guider, learner), rng.uniform(0.5, 1.5, STATES)
        candidate = random_policy(rng, process.shape[2])
        both = [learner, values, weights, candidate]
        kl = weights @ divergence(process.by_state(learner), process.by_state(candidate))
        eq_10, eq_32 = likelihood_objective(process, alpha, *both), mpo_objective(process, alpha, penalty, *both)
        assert eq_32 == pytest.approx(eq_10 - penalty * kl, rel=1e-9)
        assert eq_32 < eq_10 - 1e-3


@FEW
@given(SEEDS, ALPHAS, PENALTIES)
def test_eq_32s_step_is_eq_10s_shortened_by_the_penalty(seed, alpha, penalty):
    process, guider, learner, rng = random_pair(seed, aggregated=True)
    values, weights = guided_values(process, alpha, guider, learner), rng.uniform(0.5, 1.5, STATES)
    whole = learner_by_likelihood(process, alpha, learner, values, weights)
    np.testing.assert_allclose(learner_by_mpo(process, alpha, 0.0, learner, values, weights), whole, atol=1e-12)
    shorter = learner_by_mpo(process, alpha, penalty, learner, values, weights)
    gain = (learner * process.by_observation(np.exp(values / alpha), weights)).sum(axis=1, keepdims=True)
    share = gain / (gain + penalty)
    np.testing.assert_allclose(shorter, share * whole + (1 - share) * learner, atol=1e-12)


@FEW
@given(SEEDS, ALPHAS, PENALTIES)
def test_both_closed_forms_are_maxima(seed, alpha, penalty):
    process, guider, learner, rng = random_pair(seed, aggregated=True)
    arguments = learner, guided_values(process, alpha, guider, learner), rng.uniform(0.5, 1.5, STATES)
    by_likelihood, by_mpo = learner_by_likelihood(process, alpha, *arguments), learner_by_mpo(
        process, alpha, penalty, *arguments
    )
    best_10 = likelihood_objective(process, alpha, *arguments, by_likelihood)
    best_32 = mpo_objective(process, alpha, penalty, *arguments, by_mpo)
    for candidate in (random_policy(rng, process.shape[2]) for _ in range(10)):
        assert likelihood_objective(process, alpha, *arguments, candidate) <= best_10 + 1e-9 * abs(best_10)
        assert mpo_objective(process, alpha, penalty, *arguments, candidate) <= best_32 + 1e-9 * abs(best_32)


@FEW
@given(SEEDS, ALPHAS)
def test_eq_31_without_its_prior_is_eq_4(seed, alpha):
    """Rewards less alpha KL, summed over the visits of q."""
    process, guider, learner, _ = random_pair(seed, aggregated=True)
    rewards = (guider * process.rewards).sum(axis=1) - alpha * divergence(guider, process.by_state(learner))
    assert visits(process, guider) @ rewards == pytest.approx(guided_objective(process, alpha, guider, learner), abs=1e-9)


@FEW
@given(SEEDS, ALPHAS)
def test_the_two_differ_in_whose_values_they_take(seed, alpha):
    process, guider, learner, _ = random_pair(seed, aggregated=True)
    mpos = action_values(process, process.by_state(learner))
    assert np.abs(mpos - guided_values(process, alpha, guider, learner)).max() > 1e-4
    agreed = process.by_state(learner)
    np.testing.assert_allclose(guided_values(process, alpha, agreed, learner), mpos, atol=1e-9)


def test_actions_that_the_old_learner_never_takes_do_not_count_in_the_objectives():
    process, _, learner, _ = random_pair(0, aggregated=True)
    values, weights = action_values(process, process.by_state(learner)), np.ones(STATES)
    never = np.array([[0.0, 0.4, 0.6]] * len(learner))
    seen = process.by_state(never)
    by_hand = weights @ (seen[:, 1:] * np.exp(values[:, 1:]) * np.log(seen[:, 1:])).sum(axis=1)
    assert likelihood_objective(process, 1.0, never, values, weights, never) == pytest.approx(by_hand)
    assert mpo_objective(process, 1.0, 2.0, never, values, weights, never) == pytest.approx(by_hand)
    assert mpo_objective(process, 1.0, 2.0, learner, values, weights, never) == -np.inf
    for function, arguments in ((learner_by_mpo, (0.0, 1.0)), (learner_by_mpo, (1.0, -1.0)), (learner_by_likelihood, (0.0,))):
        with pytest.raises(ValueError, match=r"^(temperature|penalty|alpha) must"):
            function(process, *arguments, learner, values, weights)
