"""The paper's lemmas, its theorem and its equations, each as what docs/theory.md says that it is."""

from itertools import islice, pairwise

import numpy as np
import pytest
from hypothesis import given, settings

from sb3_gac.tabular import (
    DISTILLATION,
    OWN_CRITIC,
    TabularPOMDP,
    action_values,
    augmented_rewards,
    divergence,
    expected_return,
    guided_backup,
    guided_objective,
    guided_policy_iteration,
    guided_values,
    improved_guider,
    improved_learner,
    learner_by_likelihood,
    learner_by_mpo,
    tiger_door,
    uniform_learner,
    visits,
)
from tests.tabular.processes import (
    ACTIONS,
    ALPHAS,
    FEW,
    SEEDS,
    STATES,
    best_return,
    random_pair,
    random_policy,
    random_process,
)

# --- evaluation: Lemma 3.1 ----------------------------------------------------------------------------------------------


@FEW
@given(SEEDS, ALPHAS)
def test_lemma_3_1_the_backup_is_a_contraction_by_gamma(seed, alpha):
    process, guider, learner, rng = random_pair(seed, aggregated=True)
    one, other = rng.normal(size=(2, STATES, ACTIONS))
    backups = [guided_backup(process, alpha, guider, learner, values) for values in (one, other, one + 1.0)]
    assert np.abs(backups[0] - backups[1]).max() <= process.gamma * np.abs(one - other).max() + 1e-9
    np.testing.assert_allclose(backups[2] - backups[0], process.gamma)  # and by no less


@FEW
@given(SEEDS, ALPHAS)
def test_lemma_3_1_its_iterates_converge_to_one_fixed_point(seed, alpha):
    process, guider, learner, rng = random_pair(seed, aggregated=True)
    values = rng.normal(size=(STATES, ACTIONS))
    for _ in range(150):
        values = guided_backup(process, alpha, guider, learner, values)
    np.testing.assert_allclose(values, guided_values(process, alpha, guider, learner), atol=1e-9)


def test_lemma_3_1_needs_a_learner_that_may_do_what_the_guider_does():
    process, guider, learner, _ = random_pair(0, aggregated=True)
    learner[0] = [0.0, 0.5, 0.5]
    assert (guided_values(process, 1.0, guider, learner) == -np.inf).any()


def test_lemma_3_1_what_the_learner_may_not_do_costs_nothing_where_the_guider_does_not_come():
    """The guider opens the left door; it never hears the right one, where the learner would not open the left."""
    process, guider = tiger_door(), np.eye(3)[[0, 0, 0, 0]]
    learner = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 1.0, 0.0]])
    heard_left = -0.1 + 1.0 - 0.1 * np.log(2)
    values = np.array([[1.0, 0.0, heard_left], [0.0, 1.0, -np.inf]] * 2)
    np.testing.assert_allclose(guided_values(process, 0.1, guider, learner), values)
    np.testing.assert_allclose(guided_backup(process, 0.1, guider, learner, values), values)
    assert guided_objective(process, 0.1, guider, learner) == pytest.approx(0.5)
    rewards = augmented_rewards(process, 0.1, guider, learner)
    np.testing.assert_allclose(rewards[:, 2], [-0.1 - 0.1 * np.log(2), -np.inf] * 2)
    np.testing.assert_allclose(guided_values(process, 0.0, guider, learner), action_values(process, guider))


@FEW
@given(SEEDS, ALPHAS)
def test_eqs_18_and_19_hold_with_the_sign_the_state_and_the_policy_changed(seed, alpha):
    process, guider, learner, _ = random_pair(seed, aggregated=True)
    seen = process.by_state(learner)
    kl = divergence(guider, seen)[:, None]
    values = guided_values(process, alpha, guider, learner)
    as_meant = augmented_rewards(process, alpha, guider, learner)
    np.testing.assert_allclose(_evaluated(process, as_meant, guider), values, atol=1e-9)
    for rewards, policy, off_by in (
        (process.rewards + alpha * kl, seen, None),  # as printed
        (process.rewards + alpha * kl, guider, None),
        (as_meant, seen, None),
        (process.rewards - alpha * kl, guider, -alpha * kl),
    ):
        difference = _evaluated(process, rewards, policy) - values
        assert np.abs(difference).max() > 1e-4
        if off_by is not None:
            np.testing.assert_allclose(difference, np.broadcast_to(off_by, values.shape), atol=1e-9)


def _evaluated(process, rewards, policy):
    """Eq. 19 until it stands still."""
    values = np.zeros_like(rewards)
    for _ in range(150):
        values = rewards + process.gamma * process.transitions @ (policy * values).sum(axis=1)
    return values


# --- improvement: Lemma 3.2 ---------------------------------------------------------------------------------------------


def _improved(process, alpha, guider, learner, weights=None):
    new = improved_guider(process, alpha, learner, guided_values(process, alpha, guider, learner))
    return new, improved_learner(process, new, visits(process, new) if weights is None else weights)


@FEW
@given(SEEDS, ALPHAS)
def test_eq_7_minimises_eq_13(seed, alpha):
    process, guider, learner, rng = random_pair(seed, aggregated=True)
    values = guided_values(process, alpha, guider, learner)
    seen = process.by_state(learner)

    def eq_13(policy):
        return alpha * divergence(policy, seen) - (policy * values).sum(axis=1)

    best = eq_13(improved_guider(process, alpha, learner, values))
    assert all((best <= eq_13(random_policy(rng, STATES)) + 1e-9).all() for _ in range(10))
    assert best == pytest.approx(-alpha * np.log((seen * np.exp(values / alpha)).sum(axis=1)), abs=1e-8)


@FEW
@given(SEEDS, ALPHAS)
def test_lemma_3_2_holds_where_the_learner_tells_states_apart(seed, alpha):
    process, guider, learner, _ = random_pair(seed, aggregated=False)
    old, new = (
        guided_values(process, alpha, *pair) for pair in ((guider, learner), _improved(process, alpha, guider, learner))
    )
    assert (new >= old - 1e-9).all()
    assert new.max() > old.max()


def test_lemma_3_2_fails_where_states_look_the_same():
    """A corridor mostly leads left; in the rooms, which look the same, the learner goes for the left one's reward."""
    transitions = np.zeros((3, 2, 3))
    transitions[0] = [[0, 0.9, 0.1], [0, 0, 1]]
    rewards = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    process = TabularPOMDP(transitions, rewards, np.array([0, 1, 1]), np.array([1.0, 0.0, 0.0]), gamma=0.9)
    pairs = list(islice(guided_policy_iteration(process, 1.0), 6))
    changes = np.diff([pair.values for pair in pairs], axis=0)
    assert changes[1:, 0, 0].min() > 0
    assert changes[1:, 0, 1].max() < -0.01, "eq. 9: the room that is rarely met is worth less and less"
    assert np.diff([guided_objective(process, 1.0, pair.guider, pair.learner) for pair in pairs]).min() > 0


@FEW
@given(SEEDS, ALPHAS)
def test_lemma_3_2_holds_on_average_over_the_new_guiders_visits(seed, alpha):
    process, guider, learner, _ = random_pair(seed, aggregated=True)
    pairs = [(guider, learner)]
    for _ in range(10):
        pairs.append(_improved(process, alpha, *pairs[-1]))
    assert np.diff([guided_objective(process, alpha, *pair) for pair in pairs]).min() >= -1e-9


def test_lemma_3_2_does_not_hold_with_any_weights_of_states():
    falls = []
    for seed in range(40):
        process, guider, learner, _ = random_pair(seed, aggregated=True)
        guider = process.by_state(learner)
        for _ in range(4):
            pair = _improved(process, 0.3, guider, learner, np.array([1.0, 1.0, 100.0, 100.0]))
            falls.append(guided_objective(process, 0.3, guider, learner) - guided_objective(process, 0.3, *pair))
            guider, learner = pair
    assert max(falls) > 0.01


# --- iteration: Theorem 3.3 and Lemma 3.4 -------------------------------------------------------------------------------


@settings(FEW, max_examples=6)
@given(SEEDS, ALPHAS)
def test_theorem_3_3_the_objective_rises_and_comes_to_rest(seed, alpha):
    process = random_process(np.random.default_rng(seed), aggregated=True)
    objectives = [
        guided_objective(process, alpha, pair.guider, pair.learner)
        for pair in islice(guided_policy_iteration(process, alpha), 200)
    ]
    rises = np.diff(objectives)
    assert rises.min() >= -1e-9
    assert objectives[-1] <= best_return(process) + 1e-9
    assert rises[-20:].max() < 5e-3


@FEW
@given(SEEDS, ALPHAS)
def test_theorem_3_3_every_deterministic_learner_is_a_fixed_point(seed, alpha):
    process, _, _, rng = random_pair(seed, aggregated=True)
    learner = np.eye(ACTIONS)[rng.integers(ACTIONS, size=process.shape[2])]
    first, second = islice(guided_policy_iteration(process, alpha, learner), 2)
    np.testing.assert_allclose(second.learner, first.learner, atol=1e-12)
    np.testing.assert_allclose(second.guider, first.guider, atol=1e-12)


@settings(FEW, max_examples=6)
@given(SEEDS, ALPHAS)
def test_lemma_3_4_holds_for_any_alpha_where_the_learner_tells_states_apart(seed, alpha):
    """By the bound of natural policy gradients (Agarwal et al. 2021, Theorem 16), which goes to zero."""
    process = random_process(np.random.default_rng(seed), aggregated=False)
    steps, best = 150, best_return(process)
    for pair in islice(guided_policy_iteration(process, alpha), steps + 1):
        np.testing.assert_allclose(pair.guider, pair.learner, atol=1e-12)
    room = 1 / (1 - process.gamma)
    lost = best - expected_return(process, pair.learner)
    assert -1e-9 <= lost <= (alpha * np.log(ACTIONS) * room + room**2) / steps
    assert lost < 0.2 * (best - expected_return(process, uniform_learner(process))) + 0.05


@FEW
@given(SEEDS, ALPHAS)
def test_eq_10_is_eqs_7_and_8_with_the_partition_function_that_eq_28_drops(seed, alpha):
    for aggregated in (False, True):
        process, guider, learner, rng = random_pair(seed, aggregated)
        values, weights = guided_values(process, alpha, guider, learner), rng.uniform(0.5, 1.5, STATES)
        two_steps = improved_learner(process, improved_guider(process, alpha, learner, values), weights)
        arguments = process, alpha, learner, values, weights
        np.testing.assert_allclose(learner_by_likelihood(*arguments, normalised=True), two_steps, atol=1e-12)
        as_printed = np.abs(learner_by_likelihood(*arguments) - two_steps).max()
        assert as_printed > 1e-6 if aggregated else as_printed < 1e-12


def test_eq_17_as_printed_can_only_grow():
    """Its derivative, by differences, on both sides of the target; that of what is meant changes sign."""
    target, step = 0.01, 1e-6

    def slope(loss, kl):
        return (loss(0.5 + step, kl) - loss(0.5 - step, kl)) / (2 * step)

    for kl, meant_to_grow in ((0.001, False), (0.1, True)):
        assert slope(lambda alpha, kl: -alpha * kl - alpha * target, kl) < 0
        assert (slope(lambda alpha, kl: -alpha * (kl - target), kl) < 0) == meant_to_grow


def test_what_is_no_iteration_is_refused_by_name():
    process = random_process(np.random.default_rng(0), aggregated=True)
    for alpha in (0.0, -1.0, 1e-310, np.inf, np.nan):
        with pytest.raises(ValueError, match="alpha must"):
            guided_policy_iteration(process, alpha)
    with pytest.raises(ValueError, match="step"):
        guided_policy_iteration(process, 1.0, step="teacher")
    with pytest.raises(ValueError, match="learner must"):
        guided_policy_iteration(process, 1.0, np.ones((2, ACTIONS)))
    with pytest.raises(ValueError, match="weights must"):
        guided_policy_iteration(process, 1.0, weights=-np.ones(STATES))


@pytest.mark.parametrize("step", [DISTILLATION, OWN_CRITIC])
@pytest.mark.parametrize("alpha", [1e-300, 1e-20, 1e-3, 1e20, 1e300])
def test_an_alpha_of_any_size_has_an_iteration(alpha, step):
    process = tiger_door()
    for now in islice(guided_policy_iteration(process, alpha, step=step), 6):
        for policy in (now.guider, now.learner):
            np.testing.assert_allclose(policy.sum(axis=1), 1.0)
        assert np.isfinite(guided_objective(process, alpha, now.guider, now.learner))
        assert np.isfinite(now.values).all()


@pytest.mark.parametrize("scale", [1e-3, 1e-307])
@pytest.mark.parametrize("normalised", [False, True])
def test_the_learners_steps_do_not_overflow_where_values_differ_much(scale, normalised):
    """One observation's values are all far below another's."""
    process, values = tiger_door(), np.array([[5.0, 4.0, 3.0], [4.0, 5.0, 3.0], [-5.0, -6.0, -6.0], [-6.0, -5.0, -6.0]])
    uniform, weights = uniform_learner(process), np.ones(4)
    best = np.array([[0.5, 0.5, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    new = learner_by_likelihood(process, scale, uniform, values, weights, normalised)
    np.testing.assert_allclose(new, best, atol=1e-12)
    np.testing.assert_allclose(learner_by_mpo(process, scale, 0.0, uniform, values, weights), best, atol=1e-12)
    stays = np.vstack([best[:1], uniform[1:]])  # exp of values far below 0 is nothing beside the penalty
    np.testing.assert_allclose(learner_by_mpo(process, scale, 0.1, uniform, values, weights), stays, atol=1e-12)


def test_the_objective_of_an_iterate_is_that_of_its_values():
    process = random_process(np.random.default_rng(1), aggregated=True)
    for now, _ in pairwise(islice(guided_policy_iteration(process, 0.5), 4)):
        kl = divergence(now.guider, process.by_state(now.learner))
        value = (now.guider * now.values).sum(axis=1) - 0.5 * kl
        assert guided_objective(process, 0.5, now.guider, now.learner) == pytest.approx(process.start @ value)
