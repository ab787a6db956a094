"""One step of the policies: eqs. 7 and 8, eq. 10, eq. 16 with the learner's own critic, and MPO's eq. 32."""

import numpy as np

from sb3_gac.tabular.pomdp import TabularPOMDP

#: Smaller probabilities are zero: an average of them over states could be, where they are not yet, and their KL infinite
TINY = 1e-200


def improved_guider(pomdp: TabularPOMDP, alpha: float, learner: np.ndarray, values: np.ndarray) -> np.ndarray:
    """
    Eq. 7, which for arrays is eq. 27: mu proportional to pi exp(Q / alpha).

    :param pomdp: with S states, O observations and A actions
    :param alpha: weight of the KL, above 0
    :param learner: shape (O, A)
    :param values: guided Q, shape (S, A)
    :return: the new guider, shape (S, A)
    """
    with np.errstate(divide="ignore"):
        logits = np.log(pomdp.by_state(learner)) + values / alpha
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    weights[weights < TINY] = 0.0
    return weights / weights.sum(axis=1, keepdims=True)


def improved_learner(pomdp: TabularPOMDP, guider: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """
    Eq. 8, which is eq. 14: the learner nearest to the guider, over the states that look the same to it.

    :param pomdp: with S states, O observations and A actions
    :param guider: shape (S, A)
    :param weights: of states, which the paper leaves open, shape (S,)
    :return: the new learner, shape (O, A)
    """
    return pomdp.by_observation(guider, weights)


def learner_by_own_critic(
    pomdp: TabularPOMDP, alpha: float, guider: np.ndarray, own_values: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """
    Eq. 16, minimised: alpha KL(mu || pi) less what the learner's own critic says of its actions.

    In each observation pi(a) = alpha m(a) / (level - q(a)), with m and q the averages of guider and critic over its states,
    and a level at which probabilities sum to one. It loses at most alpha: sum pi q >= max q - alpha, whatever the guider does.

    :param pomdp: with S states, O observations and A actions
    :param alpha: weight of the KL, above 0
    :param guider: shape (S, A)
    :param own_values: Q_phi, shape (S, A), such as :func:`~sb3_gac.tabular.pomdp.action_values` of the learner
    :param weights: of states, shape (S,)
    :return: the new learner, shape (O, A)
    """
    imitated, critic = (pomdp.by_observation(array, weights) for array in (guider, own_values))
    level = (critic + alpha * imitated).max(axis=1, keepdims=True)
    for _ in range(12):  # Newton's method on one over the sum, which is concave in the level: from below, and nearly linear
        gap = level - critic
        terms = np.divide(alpha * imitated, gap, out=np.zeros_like(gap), where=gap > 0)
        slopes = np.divide(terms, gap, out=np.zeros_like(gap), where=gap > 0)
        total = terms.sum(axis=1, keepdims=True)
        level = np.maximum(level + total * (total - 1) / slopes.sum(axis=1, keepdims=True), critic.max(axis=1, keepdims=True))
    gap = level - critic
    learner = np.divide(alpha * imitated, gap, out=np.zeros_like(gap), where=gap > 0)
    left = 1 - learner.sum(axis=1)  # to the best action, where the guider never takes it; else rounding
    learner[np.arange(len(learner)), critic.argmax(axis=1)] += left
    return learner


def likelihood_objective(
    pomdp: TabularPOMDP, alpha: float, learner: np.ndarray, values: np.ndarray, weights: np.ndarray, candidate: np.ndarray
) -> float:
    """
    Eq. 10 as printed, over states: E[exp(Q / alpha) log pi] under the old learner.

    :param pomdp: with S states, O observations and A actions
    :param alpha: weight of the KL, above 0
    :param learner: the old one, shape (O, A)
    :param values: guided Q, shape (S, A)
    :param weights: of states, shape (S,)
    :param candidate: the learner that is judged, shape (O, A)
    :return: what the new learner maximises
    """
    gains = pomdp.by_state(learner) * np.exp(values / alpha) * np.log(pomdp.by_state(candidate))
    return float(weights @ gains.sum(axis=1))


def learner_by_likelihood(
    pomdp: TabularPOMDP, alpha: float, learner: np.ndarray, values: np.ndarray, weights: np.ndarray, normalised: bool = False
) -> np.ndarray:
    """
    Eq. 10, maximised.

    :param pomdp: with S states, O observations and A actions
    :param alpha: weight of the KL, above 0
    :param learner: the old one, shape (O, A)
    :param values: guided Q, shape (S, A)
    :param weights: of states, shape (S,)
    :param normalised: whether exp(Q / alpha) is divided by Z(s), as by eqs. 7 and 8; eq. 28 has lost it
    :return: the new learner, shape (O, A)
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
    Eq. 32, MPO's: E[E[exp(Q / eta) log pi] - alpha KL(old pi || pi)].

    :param pomdp: with S states, O observations and A actions
    :param temperature: MPO's eta, above 0
    :param penalty: MPO's alpha, of the KL from the old policy to the new one
    :param learner: the old one, shape (O, A)
    :param values: Q, shape (S, A)
    :param weights: of states, shape (S,)
    :param candidate: the learner that is judged, shape (O, A)
    :return: what the new learner maximises
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
    Eq. 32, maximised: the old learner, times exp(Q / eta) on average over the states that look the same, plus the penalty.

    :param pomdp: with S states, O observations and A actions
    :param temperature: MPO's eta, above 0
    :param penalty: MPO's alpha, not negative
    :param learner: the old one, shape (O, A)
    :param values: Q, shape (S, A)
    :param weights: of states, shape (S,)
    :return: the new learner, shape (O, A)
    """
    new = learner * (pomdp.by_observation(np.exp(values / temperature), weights) + penalty)
    return new / new.sum(axis=1, keepdims=True)
