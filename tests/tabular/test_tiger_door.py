"""TigerDoor: what appendix B says of it, and where Lemma 3.4's "regardless of alpha" ends."""

import math
from itertools import islice, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_gac.tabular import (
    OWN_CRITIC,
    TabularPOMDP,
    action_values,
    expected_return,
    guided_objective,
    guided_policy_iteration,
    guided_values,
    improved_guider,
    improved_learner,
    learner_by_own_critic,
    tiger_door,
    uniform_learner,
    visits,
)
from tests.tabular.processes import FEW, SEEDS, STATES, random_pair

LISTEN = 2
#: alpha -> return of the learner in the end, worked out by another program
FIXED_POINTS = {1.0: 0.9, 0.5: 0.9, 0.2: 0.9, 0.15: 0.9, 0.14: 0.5, 0.1: 0.5, 0.05: 0.5}
OPEN_AT_ONCE = np.array([[0.5, 0.5, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
LISTEN_FIRST = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def _after(alpha, iterations, **arguments):
    *_, last = islice(guided_policy_iteration(tiger_door(), alpha, **arguments), iterations + 1)
    return last


def _return(learner):
    process = tiger_door()
    return expected_return(process, process.by_state(learner))


def _threshold():
    """Alpha at which e^(0.1 / alpha) + e^(-0.9 / alpha) is 2: above it, a door's share shrinks with each iteration."""
    low, high = 0.05, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        grows = math.exp(0.1 / middle) + math.exp(-0.9 / middle) > 2
        low, high = (middle, high) if grows else (low, middle)
    return high


def test_appendix_b_to_listen_first_is_best_and_returns_0_9():
    learners = {choice: np.eye(3)[list(choice)] for choice in product(range(3), range(2), range(2))}
    best = max(learners, key=lambda choice: _return(learners[choice]))
    assert best == (LISTEN, 0, 1)
    assert _return(learners[best]) == pytest.approx(0.9)
    assert _return(LISTEN_FIRST) == pytest.approx(0.9)


def test_appendix_b_who_imitates_the_best_teacher_opens_a_door_at_random():
    process = tiger_door()
    teacher = np.eye(3)[[0, 1, 0, 1]]
    assert expected_return(process, teacher) == pytest.approx(1.0)
    student = improved_learner(process, teacher, visits(process, teacher))
    np.testing.assert_allclose(student, OPEN_AT_ONCE)
    assert _return(student) == pytest.approx(0.5)


@pytest.mark.parametrize(("alpha", "expected"), FIXED_POINTS.items())
def test_lemma_3_4_fails_the_learner_ends_at_0_5_or_at_0_9(alpha, expected):
    last = _after(alpha, 800 if alpha in (0.14, 0.15) else 100)
    assert _return(last.learner) == pytest.approx(expected, abs=1e-4)
    np.testing.assert_allclose(last.learner, LISTEN_FIRST if expected == 0.9 else OPEN_AT_ONCE, atol=1e-3)


def test_lemma_3_4_fails_below_the_alpha_at_which_a_doors_share_grows():
    """By bisection over iterations, beside the bisection of the closed form."""
    low, high = 0.1, 0.2
    for _ in range(8):
        middle = (low + high) / 2
        before, after = islice(guided_policy_iteration(tiger_door(), middle), 100, 102)
        rises = after.learner[0, LISTEN] > before.learner[0, LISTEN]
        low, high = (low, middle) if rises else (middle, high)
    assert low < _threshold() < high
    assert _threshold() == pytest.approx(0.1445, abs=1e-4)


def test_lemma_3_4_fails_because_eq_4_counts_the_guiders_return():
    """The pair that listens is worth less to eq. 4 than the one whose learner guesses, exactly below the threshold."""
    process = tiger_door()
    for alpha, guessing_is_better in ((_threshold() - 1e-3, True), (_threshold() + 1e-3, False)):
        listening = guided_objective(process, alpha, process.by_state(LISTEN_FIRST), LISTEN_FIRST)
        odds = np.exp(1 / alpha)
        guider = np.array([[odds, 1, 0], [1, odds, 0], [1 + odds, 0, 0], [0, 1 + odds, 0]]) / (1 + odds)
        guessing = guided_objective(process, alpha, guider, OPEN_AT_ONCE)
        assert guessing == pytest.approx(alpha * math.log((1 + odds) / 2))
        assert (guessing > listening) == guessing_is_better


def test_lemma_3_4_fails_its_learner_is_not_deterministic_nor_the_guider():
    last = _after(0.1, 150)
    assert last.learner[0] == pytest.approx([0.5, 0.5, 0.0], abs=1e-9)
    assert last.guider[0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-3)
    assert last.guider[1] == pytest.approx([0.0, 1.0, 0.0], abs=1e-3)


@pytest.mark.parametrize("alpha", [1.0, 0.14, 0.05, 0.02, 0.005])
def test_eq_16_the_own_critic_mends_it_but_for_alpha(alpha):
    learner = _after(alpha, 100, step=OWN_CRITIC).learner
    assert 0.9 - alpha - 1e-9 <= _return(learner) <= 0.9 + 1e-9
    assert _return(learner) > 0.885
    exact = alpha > 0.0299  # a door's share grows below: exp(0.1 / alpha) / 2 > 1 + 0.4 / alpha
    assert (_return(learner) > 0.9 - 1e-6) == exact


@FEW
@given(SEEDS, st.floats(0.001, 5.0), st.booleans())
def test_eq_16_is_minimised_and_loses_at_most_alpha(seed, alpha, guider_never_takes_one):
    process, guider, learner, rng = random_pair(seed, aggregated=True)
    if guider_never_takes_one:
        guider[:, 0] = 0.0
        guider /= guider.sum(axis=1, keepdims=True)
    own, weights = action_values(process, process.by_state(learner)), rng.uniform(0.5, 1.5, STATES)
    new = learner_by_own_critic(process, alpha, guider, own, weights)
    assert new.min() >= -1e-9
    np.testing.assert_allclose(new.sum(axis=1), 1.0)
    imitated, critic = process.by_observation(guider, weights), process.by_observation(own, weights)
    assert ((new * critic).sum(axis=1) >= critic.max(axis=1) - alpha - 1e-9).all()

    def eq_16(policy):
        logs = np.log(np.where(imitated > 0, policy, 1.0))
        return -(alpha * imitated * logs + policy * critic).sum(axis=1)

    for other in rng.dirichlet(np.ones(3), size=(20, len(new))):
        nearby = 0.99 * new + 0.01 * other
        assert (eq_16(new) <= eq_16(nearby) + 1e-9).all()


@pytest.mark.parametrize("alpha", [1.0, 0.1, 0.02, 0.005])
def test_eq_16_with_the_guiders_critic_does_as_well_on_tiger_door(alpha):
    """What it needs is an average over doors; whose critic is averaged is all one to a game that ends there."""
    process = tiger_door()
    learner = uniform_learner(process)
    guider = process.by_state(learner)
    for _ in range(100):
        values = guided_values(process, alpha, guider, learner)
        guider = improved_guider(process, alpha, learner, values)
        learner = learner_by_own_critic(process, alpha, guider, values, visits(process, guider))
    assert _return(learner) == pytest.approx(_return(_after(alpha, 100, step=OWN_CRITIC).learner), abs=1e-6)


@FEW
@given(SEEDS, st.floats(0.05, 5.0))
def test_eq_16_in_the_iteration_follows_the_learners_values_not_the_guiders(seed, alpha):
    process, _, learner, _ = random_pair(seed, aggregated=True)
    _, before, after = islice(guided_policy_iteration(process, alpha, learner, step=OWN_CRITIC), 3)
    own = action_values(process, process.by_state(before.learner))
    expected = learner_by_own_critic(process, alpha, after.guider, own, visits(process, after.guider))
    np.testing.assert_allclose(after.learner, expected, atol=1e-12)
    assert np.abs(own - before.values).max() > 1e-9


def test_with_little_alpha_the_own_critic_alone_is_followed():
    process = tiger_door()
    own = action_values(process, process.by_state(LISTEN_FIRST))
    new = learner_by_own_critic(process, 1e-6, process.by_state(OPEN_AT_ONCE), own, np.ones(4))
    best = process.by_observation(own, np.ones(4)).argmax(axis=1)
    np.testing.assert_allclose(new, np.eye(3)[best], atol=1e-4)


@pytest.mark.parametrize("alpha", [1e-300, 1e-20, 1e-8, 1.0, 1e6, 1e300])
@pytest.mark.parametrize("imitated", [[1e-12, 0.0, 1 - 1e-12], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.5, 0.5, 0.0]])
@pytest.mark.parametrize("critic", [[1.0, 1.0, 0.0], [1e3, 0.0, 0.0], [-1e6, -1e6 + 1e-6, 0.0]])
def test_eq_16_of_any_size_is_a_policy_that_loses_at_most_alpha(alpha, imitated, critic):
    process = TabularPOMDP(np.zeros((1, 3, 1)), np.zeros((1, 3)), np.array([0]), np.array([1.0]), gamma=0.9)
    (new,) = learner_by_own_critic(process, alpha, np.array([imitated]), np.array([critic]), np.ones(1))
    assert new.min() >= 0.0
    assert new.sum() == pytest.approx(1.0, abs=1e-12)
    assert max(critic) - new @ critic <= alpha * (1 + 1e-9) + 1e-9 * np.abs(critic).max()
    can_be_held = np.array(imitated) * alpha > 1e-290
    assert (new[can_be_held] > 0).all()  # so that no KL of the guider is infinite
