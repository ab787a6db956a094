"""Guided policy evaluation: eqs. 4 to 6, and corrected forms of eqs. 18 and 19."""

import numpy as np

from sb3_gac.tabular.pomdp import TabularPOMDP, state_values


def divergence(guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    """
    The KL from guider to learner in each state.

    :param guider: the guider's probabilities of actions by state, shape (S, A)
    :param learner: the learner's probabilities of actions by state, shape (S, A)
    :return: KL(guider || learner) in nats, shape (S,); infinite where the guider takes an action that the learner never takes
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(guider > 0, guider * (np.log(guider) - np.log(learner)), 0.0)
    return terms.sum(axis=1)


def guided_backup(
    pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray, values: np.ndarray
) -> np.ndarray:
    """
    One application of the guided Bellman operator of a pair of policies, eqs. 5 and 6.

    :param pomdp: decision process with S states, O observations and A actions
    :param alpha: weight of the KL
    :param guider: the guider's probabilities of actions by state, shape (S, A)
    :param learner: the learner's probabilities of actions by observation, shape (O, A)
    :param values: Q of states and actions, shape (S, A)
    :return: next Q of states and actions, shape (S, A)
    """
    after = (guider * values).sum(axis=1) - alpha * divergence(guider, pomdp.by_state(learner))
    return pomdp.rewards + pomdp.gamma * pomdp.transitions @ after


def guided_values(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    """
    The fixed point of :func:`guided_backup`, by a linear system.

    :param pomdp: decision process with S states, O observations and A actions
    :param alpha: weight of the KL
    :param guider: the guider's probabilities of actions by state, shape (S, A)
    :param learner: the learner's probabilities of actions by observation, shape (O, A)
    :return: guided Q of states and actions, shape (S, A)
    """
    return pomdp.rewards + pomdp.gamma * pomdp.transitions @ _guided_state_values(pomdp, alpha, guider, learner)


def guided_objective(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> float:
    """
    The objective of eq. 4, discounted: the guider's return less alpha times the sum of the KL over its steps.

    :param pomdp: decision process with S states, O observations and A actions
    :param alpha: weight of the KL
    :param guider: the guider's probabilities of actions by state, shape (S, A)
    :param learner: the learner's probabilities of actions by observation, shape (O, A)
    :return: expected value from the start distribution
    """
    return float(pomdp.start @ _guided_state_values(pomdp, alpha, guider, learner))


def augmented_rewards(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    """
    The corrected rewards of eq. 18, with which the guided values are the ordinary values of the guider (eq. 19).

    The paper adds the KL, where it must be subtracted. The paper also takes the KL of the present state instead of the next
    state's; the fixed point would then be that of eq. 5 less alpha times the KL of the state. In eq. 19 the next action must
    be the guider's, not the learner's.

    :param pomdp: decision process with S states, O observations and A actions
    :param alpha: weight of the KL
    :param guider: the guider's probabilities of actions by state, shape (S, A)
    :param learner: the learner's probabilities of actions by observation, shape (O, A)
    :return: corrected rewards r - alpha gamma E[KL in the next state], shape (S, A)
    """
    return pomdp.rewards - alpha * pomdp.gamma * pomdp.transitions @ divergence(guider, pomdp.by_state(learner))


def _guided_state_values(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    own = (guider * pomdp.rewards).sum(axis=1) - alpha * divergence(guider, pomdp.by_state(learner))
    return state_values(pomdp, guider, own)
