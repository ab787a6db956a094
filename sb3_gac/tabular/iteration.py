"""Guided policy iteration: evaluation and improvement in turn, Theorem 3.3."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sb3_gac.tabular.improvement import improved_guider, improved_learner, learner_by_own_critic
from sb3_gac.tabular.pomdp import TabularPOMDP, action_values, visits
from sb3_gac.tabular.values import guided_values

DISTILLATION, OWN_CRITIC = "distillation", "own critic"


class GuidedIterate(NamedTuple):
    """
    Both policies, and the guided values that they have together.

    :param guider: shape (S, A)
    :param learner: shape (O, A)
    :param values: Q, shape (S, A)
    """

    guider: np.ndarray
    learner: np.ndarray
    values: np.ndarray


def uniform_learner(pomdp: TabularPOMDP) -> np.ndarray:
    """
    :param pomdp: with O observations and A actions
    :return: the learner that takes each action as often, shape (O, A)
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
    Evaluate both policies, improve the guider, then the learner, without end. The guider begins as the learner.

    :param pomdp: with S states, O observations and A actions
    :param alpha: weight of the KL, above 0
    :param learner: the first one, shape (O, A); uniform by default. Actions that it never takes are never learned
    :param step: the learner's: "distillation" (eq. 8), or "own critic" (eq. 16 with the learner's own values)
    :param weights: of states in the learner's step, shape (S,); by default the new guider's discounted visits, with which
        eq. 4 can't fall
    :return: the first policies, and those after each iteration
    :raises ValueError: if ``alpha`` is not above 0, or there is no such ``step``
    """
    if not alpha > 0:
        raise ValueError(f"alpha must be above 0, got {alpha!r}.")
    if step not in (DISTILLATION, OWN_CRITIC):
        raise ValueError(f"step must be {DISTILLATION!r} or {OWN_CRITIC!r}, got {step!r}.")
    return _iterate(pomdp, alpha, uniform_learner(pomdp) if learner is None else learner, step, weights)


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
