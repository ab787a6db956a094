"""Steps of policy improvement: eqs. 7 and 8, eq. 10, eq. 16 with the learner's own critic, and MPO's eq. 32."""

import numpy as np

from sb3_gac.tabular.pomdp import TabularPOMDP

#: Smaller probabilities count as zero: their average over states could round to zero and make a KL infinite
TINY = 1e-200


def improved_guider(pomdp: TabularPOMDP, alpha: float, learner: np.ndarray, values: np.ndarray) -> np.ndarray:
    """
    The guider's step of eq. 7, solved by eq. 27: mu is proportional to pi exp(Q / alpha).

    :param pomdp: decision process with S states, O observations and A actions
    :param alpha: weight of the KL, above 0
    :param learner: the learner's probabilities of actions by observation, shape (O, A)
    :param values: guided Q of states and actions, shape (S, A)
    :return: the new guider's probabilities of actions by state, shape (S, A)
    """
    with np.errstate(divide="ignore"):
        logits = np.log(pomdp.by_state(learner)) + values / alpha
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    weights[weights < TINY] = 0.0
    return weights / weights.sum(axis=1, keepdims=True)


def improved_learner(pomdp: TabularPOMDP, guider: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """
    The learner's step of eq. 8, the same as eq. 14: the learner with the smallest KL from the guider on average over the
    states that look the same.

    :param pomdp: decision process with S states, O observations and A actions
    :param guider: the guider's probabilities of actions by state, shape (S, A)
    :param weights: weights of states, not negative, which the paper leaves open, shape (S,)
    :return: the new learner's probabilities of actions by observation, shape (O, A)
    """
    return pomdp.by_observation(guider, weights)


def learner_by_own_critic(
    pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, own_values: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """
    The learner's step of eq. 16: the learner that minimises alpha KL(mu || pi) less the value of its actions by its own
    critic.

    In each observation pi(a) = alpha m(a) / (level - q(a)), where m and q are the averages of guider and critic over the
    observation's states, and the level makes the probabilities sum to one. With any guider the learner loses at most alpha:
    sum pi q >= max q - alpha.

    :param pomdp: decision process with S states, O observations and A actions
    :param alpha: weight of the KL, above 0
    :param guider: the guider's probabilities of actions by state, shape (S, A)
    :param own_values: Q_phi of states and actions, shape (S, A), such as :func:`~sb3_gac.tabular.pomdp.action_values` of the
        learner
    :param weights: weights of states, not negative, shape (S,)
    :return: the new learner's probabilities of actions by observation, shape (O, A)
    """
    imitated, critic = (pomdp.by_observation(array, weights) for array in (guider, own_values))
    level = (critic + alpha * imitated).max(axis=1, keepdims=True)
    for _ in range(12):  # Newton's method on 1 / total, which is concave and nearly linear in the level, from below
        gap = level - critic
        terms = np.divide(alpha * imitated, gap, out=np.zeros_like(gap), where=gap > 0)
        slopes = np.divide(terms, gap, out=np.zeros_like(gap), where=gap > 0)
        total = terms.sum(axis=1, keepdims=True)
        level = np.maximum(level + total * (total - 1) / slopes.sum(axis=1, keepdims=True), critic.max(axis=1, keepdims=True))
    gap = level - critic
    learner = np.divide(alpha * imitated, gap, out=np.zeros_like(gap), where=gap > 0)
    left = 1 - learner.sum(axis=1)  # share of a best action that the guider never takes, or rounding
    learner[np.arange(len(learner)), critic.argmax(axis=1)] += left
    return learner


def likelihood_objective(
    pomdp: TabularPOMDP, alpha: float, learner: np.ndarray, values: np.ndarray, weights: np.ndarray, candidate: np.ndarray
) -> float:
    """
    The objective of eq. 10 as printed: E[exp(Q / alpha) log pi] over states and the old learner's actions.

    :param pomdp: decision process with S states, O observations and A actions
    :param alpha: weight of the KL, above 0
    :param learner: the old learner's probabilities of actions by observation, shape (O, A)
    :param values: guided Q of states and actions, shape (S, A)
    :param weights: weights of states, not negative, shape (S,)
    :param candidate: probabilities of the new learner that is evaluated, shape (O, A)
    :return: value of the objective, which the new learner maximises
    """
    gains = pomdp.by_state(learner) * np.exp(values / alpha) * np.log(pomdp.by_state(candidate))
    return float(weights @ gains.sum(axis=1))


def learner_by_likelihood(
    pomdp: TabularPOMDP, alpha: float, learner: np.ndarray, values: np.ndarray, weights: np.ndarray, normalised: bool = False
) -> np.ndarray:
    """
    The learner that maximises the objective of eq. 10.

    :param pomdp: decision process with S states, O observations and A actions
    :param alpha: weight of the KL, above 0
    :param learner: the old learner's probabilities of actions by observation, shape (O, A)
    :param values: guided Q of states and actions, shape (S, A)
    :param weights: weights of states, not negative, shape (S,)
    :param normalised: whether exp(Q / alpha) is divided by Z(s), as in eqs. 7 and 8; eq. 28 drops Z(s)
    :return: the new learner's probabilities of actions by observation, shape (O, A)
    """
    gains = np.exp((values - values.max()) / alpha)
    by_state = pomdp.by_state(learner) * gains
    if normalised:
        by_state = by_state / by_state.sum(axis=1, keepdims=True)
    new = pomdp.by_observation(by_state, weights)
    return new / new.sum(axis=1, keepdims=True)


def mpo_objective(
    pomdp: TabularPOMDP,
    temperature: float,
    penalty: float,
    learner: np.ndarray,
    values: np.ndarray,
    weights: np.ndarray,
    candidate: np.ndarray,
) -> float:
    """
    The objective of eq. 32, MPO's: E[E[exp(Q / eta) log pi] - alpha KL(old pi || pi)].

    :param pomdp: decision process with S states, O observations and A actions
    :param temperature: MPO's eta, above 0
    :param penalty: MPO's alpha, weight of KL(old policy || new policy), not negative
    :param learner: the old learner's probabilities of actions by observation, shape (O, A)
    :param values: Q of states and actions, shape (S, A)
    :param weights: weights of states, not negative, shape (S,)
    :param candidate: probabilities of the new learner that is evaluated, shape (O, A)
    :return: value of the objective, which the new learner maximises
    """
    old, new = pomdp.by_state(learner), pomdp.by_state(candidate)
    per_state = (old * np.exp(values / temperature) * np.log(new)).sum(axis=1) - penalty * (old * np.log(old / new)).sum(
        axis=1
    )
    return float(weights @ per_state)


def learner_by_mpo(
    pomdp: TabularPOMDP, temperature: float, penalty: float, learner: np.ndarray, values: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """
    The learner that maximises the objective of eq. 32: the old learner times the sum of the penalty and the average of
    exp(Q / eta) over the states that look the same, normalised.

    :param pomdp: decision process with S states, O observations and A actions
    :param temperature: MPO's eta, above 0
    :param penalty: MPO's alpha, weight of KL(old policy || new policy), not negative
    :param learner: the old learner's probabilities of actions by observation, shape (O, A)
    :param values: Q of states and actions, shape (S, A)
    :param weights: weights of states, not negative, shape (S,)
    :return: the new learner's probabilities of actions by observation, shape (O, A)
    """
    new = learner * (pomdp.by_observation(np.exp(values / temperature), weights) + penalty)
    return new / new.sum(axis=1, keepdims=True)
