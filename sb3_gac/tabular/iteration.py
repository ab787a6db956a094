"""Guided policy iteration (Theorem 3.3): policy evaluation and policy improvement in turn."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sb3_gac.tabular.improvement import improved_guider, improved_learner, learner_by_own_critic
from sb3_gac.tabular.pomdp import TabularPOMDP, action_values, check_above_zero, visits
from sb3_gac.tabular.values import guided_values

DISTILLATION, OWN_CRITIC = "distillation", "own critic"


class GuidedIterate(NamedTuple):
    """
    The policies of one iteration and their guided values.

    :param guider: the guider's probabilities of actions by state, shape (S, A)
    :param learner: the learner's probabilities of actions by observation, shape (O, A)
    :param values: guided Q of the two policies, shape (S, A)
    """

    guider: np.ndarray
    learner: np.ndarray
    values: np.ndarray


def uniform_learner(pomdp: TabularPOMDP) -> np.ndarray:
    """
    :param pomdp: decision process with O observations and A actions
    :return: probabilities of the learner that takes all actions equally often, shape (O, A)
    """
    _, actions, observations = pomdp.shape
    return np.full((observations, actions), 1.0 / actions)


def guided_policy_iteration(
    pomdp: TabularPOMDP,
    alpha: float,
    learner: np.ndarray | None = None,
    step: str = DISTILLATION,
    weights: np.ndarray | None = None,
) -> Iterator[GuidedIterate]:
    """
    Guided policy iteration without end: each iteration evaluates both policies, improves the guider, and then improves the
    learner. The first guider equals the first learner.

    :param pomdp: decision process with S states, O observations and A actions
    :param alpha: weight of the KL, above 0
    :param learner: probabilities of the first learner, shape (O, A); ``None`` for a uniform learner. Actions that the first
        learner never takes are never learned
    :param step: the learner's step: "distillation" (eq. 8), or "own critic" (eq. 16 with the learner's own values)
    :param weights: weights of states in the learner's step, shape (S,); ``None`` for the new guider's discounted visits, with
        which eq. 4 can't fall
    :return: iterator over the first policies and those after each iteration
    :raises ValueError: if ``alpha`` is not above 0, ``step`` is unknown, or ``learner`` or ``weights`` are impossible
    """
    check_above_zero("alpha", alpha)
    if step not in (DISTILLATION, OWN_CRITIC):
        raise ValueError(f"step must be {DISTILLATION!r} or {OWN_CRITIC!r}, got {step!r}.")
    learner = uniform_learner(pomdp) if learner is None else np.asarray(learner)
    pomdp.by_state(learner)  # raises here, not at the first step
    if weights is not None:
        pomdp.shares(weights)
    return _iterate(pomdp, alpha, learner, step, weights)


def _iterate(
    pomdp: TabularPOMDP, alpha: float, learner: np.ndarray, step: str, weights: np.ndarray | None
) -> Iterator[GuidedIterate]:
    guider = pomdp.by_state(learner)
    while True:
        values = guided_values(pomdp, alpha, guider, learner)
        yield GuidedIterate(guider, learner, values)
        guider = improved_guider(pomdp, alpha, learner, values)
        counted = visits(pomdp, guider) if weights is None else weights
        if step == OWN_CRITIC:
            own = action_values(pomdp, pomdp.by_state(learner))
            learner = learner_by_own_critic(pomdp, alpha, guider, own, counted)
        else:
            learner = improved_learner(pomdp, guider, counted)
