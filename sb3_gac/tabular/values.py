"""Guided policy evaluation: eqs. 4 to 6, and corrected forms of eqs. 18 and 19."""

import numpy as np

from sb3_gac.tabular.pomdp import TabularPOMDP, check_policy, expected, state_values


def divergence(guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    """
    The KL from guider to learner in each state.

    :param guider: the guider's probabilities of actions by state, shape (S, A)
    :param learner: the learner's probabilities of actions by state, shape (S, A)
    :return: KL(guider || learner) in nats, shape (S,); infinite where the guider takes an action that the learner never takes
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return expected(guider, np.log(guider) - np.log(learner))


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
    cost = _cost(pomdp, alpha, guider, learner)
    return pomdp.rewards + pomdp.discounted_next(expected(guider, values) - cost)


def guided_values(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    """
    The fixed point of :func:`guided_backup`, by a linear system.

    :param pomdp: decision process with S states, O observations and A actions
    :param alpha: weight of the KL
    :param guider: the guider's probabilities of actions by state, shape (S, A)
    :param learner: the learner's probabilities of actions by observation, shape (O, A)
    :return: guided Q of states and actions, shape (S, A)
    """
    return pomdp.rewards + pomdp.discounted_next(_guided_state_values(pomdp, alpha, guider, learner))


def guided_objective(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> float:
    """
    The objective of eq. 4, discounted: the guider's return less alpha times the sum of the KL over its steps.

    :param pomdp: decision process with S states, O observations and A actions
    :param alpha: weight of the KL
    :param guider: the guider's probabilities of actions by state, shape (S, A)
    :param learner: the learner's probabilities of actions by observation, shape (O, A)
    :return: expected value from the start distribution
    """
    return float(expected(pomdp.start, _guided_state_values(pomdp, alpha, guider, learner)))


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
    return pomdp.rewards - pomdp.discounted_next(_cost(pomdp, alpha, guider, learner))


def _guided_state_values(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    cost = _cost(pomdp, alpha, guider, learner)
    return state_values(pomdp, guider, (guider * pomdp.rewards).sum(axis=1) - cost)


def _cost(pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, learner: np.ndarray) -> np.ndarray:
    """alpha times the KL from guider to learner in each state, shape (S,); with alpha = 0 an infinite KL costs nothing."""
    kl = divergence(check_policy("guider", guider, pomdp.rewards.shape), pomdp.by_state(learner))
    return alpha * kl if alpha else np.zeros_like(kl)
