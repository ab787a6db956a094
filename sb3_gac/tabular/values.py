"""Guided policy evaluation: eqs. 4 to 6, and eqs. 18 and 19 as they are meant."""

import numpy as np

from sb3_gac.tabular.pomdp import TabularPOMDP, state_values


def divergence(guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    """
    :param guider: probabilities of actions, shape (S, A)
    :param learner: the same of the learner, by state, shape (S, A)
    :return: KL(guider || learner), shape (S,); infinite where the guider does what the learner never does
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(guider > 0, guider * (np.log(guider) - np.log(learner)), 0.0)
    return terms.sum(axis=1)


def guided_backup(
    pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray, values: np.ndarray
) -> np.ndarray:
    """
    Eqs. 5 and 6: the Bellman operator of a pair of policies, applied once.

    :param pomdp: with S states, O observations and A actions
    :param alpha: weight of the KL
    :param guider: shape (S, A)
    :param learner: shape (O, A)
    :param values: Q, shape (S, A)
    :return: the next Q, shape (S, A)
    """
    after = (guider * values).sum(axis=1) - alpha * divergence(guider, pomdp.by_state(learner))
    return pomdp.rewards + pomdp.gamma * pomdp.transitions @ after


def guided_values(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    """
    The fixed point of :func:`guided_backup`, by a linear system.

    :param pomdp: with S states, O observations and A actions
    :param alpha: weight of the KL
    :param guider: shape (S, A)
    :param learner: shape (O, A)
    :return: Q, shape (S, A)
    """
    return pomdp.rewards + pomdp.gamma * pomdp.transitions @ _guided_state_values(pomdp, alpha, guider, learner)


def guided_objective(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> float:
    """
    Eq. 4, discounted: the guider's return less alpha times the KL on its way.

    :param pomdp: with S states, O observations and A actions
    :param alpha: weight of the KL
    :param guider: shape (S, A)
    :param learner: shape (O, A)
    :return: expected from the start distribution
    """
    return float(pomdp.start @ _guided_state_values(pomdp, alpha, guider, learner))


def augmented_rewards(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    """
    Eq. 18 as it is meant: rewards with which guided values are a policy's ordinary ones, under the guider (eq. 19).

    The paper adds the KL, which is subtracted, and takes that of the present state, which eq. 5 does not have: with it, the
    fixed point is that of eq. 5 less alpha KL of the state. Eq. 19's next action is the guider's, not the learner's.

    :param pomdp: with S states, O observations and A actions
    :param alpha: weight of the KL
    :param guider: shape (S, A)
    :param learner: shape (O, A)
    :return: r - alpha gamma E[KL in the next state], shape (S, A)
    """
    return pomdp.rewards - alpha * pomdp.gamma * pomdp.transitions @ divergence(guider, pomdp.by_state(learner))


def _guided_state_values(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    own = (guider * pomdp.rewards).sum(axis=1) - alpha * divergence(guider, pomdp.by_state(learner))
    return state_values(pomdp, guider, own)
