"""Steps of policy improvement: eqs. 7 and 8, eq. 10, eq. 16 with the learner's own critic, and MPO's eq. 32."""

import numpy as np

from sb3_gac.tabular.pomdp import TabularPOMDP, check_above_zero, expected
from sb3_gac.tabular.values import divergence

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
    :raises ValueError: if ``alpha`` is not above 0
    """
    check_above_zero("alpha", alpha)
    seen = pomdp.by_state(learner)
    best = np.where(seen > 0, values, -np.inf).max(axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        logits = np.where(seen > 0, np.log(seen) + _less(values, best, alpha), -np.inf)
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    weights[weights < TINY] = 0.0
    return weights / weights.sum(axis=1, keepdims=True)


def _less(values: np.ndarray, best: np.ndarray, temperature: float) -> np.ndarray:
    """(values - best) / temperature, and 0 where a value is the best, even if both are infinite."""
    with np.errstate(over="ignore", invalid="ignore"):  # a temperature near 0 makes all other values infinitely worse
        return np.where(values == best, 0.0, (values - best) / temperature)


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
    :raises ValueError: if ``alpha`` is not above 0
    """
    check_above_zero("alpha", alpha)
    imitated, critic = (pomdp.by_observation(array, weights) for array in (guider, own_values))
    worse = critic.max(axis=1, keepdims=True) - critic
    # The level's distance from the best value: the level itself would round a small alpha away
    height = (alpha * imitated - worse).max(axis=1, keepdims=True)
    for _ in range(100):  # Newton's method on 1 / total, which is concave and nearly linear in the level, from below
        gap = height + worse
        terms = np.divide(alpha * imitated, gap, out=np.zeros_like(gap), where=gap > 0)
        total = terms.sum(axis=1, keepdims=True)
        if (total <= 1 + 1e-14).all():  # after a few steps, unless the guider hardly ever takes a best action
            break
        with np.errstate(over="ignore"):  # where alpha is too small for a step to matter
            slopes = np.divide(terms, gap, out=np.zeros_like(gap), where=gap > 0)
        slope = slopes.sum(axis=1, keepdims=True)
        step = np.divide(total * (total - 1), slope, out=np.zeros_like(slope), where=slope > 0)
        height = np.maximum(height + step, 0.0)
    gap = height + worse
    learner = np.divide(alpha * imitated, gap, out=np.zeros_like(gap), where=gap > 0)
    left = 1 - learner.sum(axis=1)  # share of a best action that the guider never takes, or rounding
    learner[np.arange(len(learner)), critic.argmax(axis=1)] += np.maximum(left, 0.0)
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
    :return: value of the objective, which the new learner maximises; ``-inf`` if the new learner never takes an action that
        the old one takes
    :raises ValueError: if ``alpha`` is not above 0
    """
    check_above_zero("alpha", alpha)
    return float(expected(weights, _log_likelihood(pomdp, alpha, learner, values, candidate)))


def _log_likelihood(
    pomdp: TabularPOMDP, temperature: float, learner: np.ndarray, values: np.ndarray, candidate: np.ndarray
) -> np.ndarray:
    """E[exp(Q / temperature) log new pi] over the old learner's actions, by state, shape (S,)."""
    with np.errstate(divide="ignore", invalid="ignore"):  # in what the old learner never does, which does not count
        return expected(pomdp.by_state(learner), np.exp(values / temperature) * np.log(pomdp.by_state(candidate)))


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
    :raises ValueError: if ``alpha`` is not above 0
    """
    check_above_zero("alpha", alpha)
    if normalised:
        return pomdp.by_observation(improved_guider(pomdp, alpha, learner, values), weights)
    gains, _ = _averaged_gains(pomdp, alpha, learner, values, weights)
    new = learner * gains
    return new / new.sum(axis=1, keepdims=True)


def _averaged_gains(
    pomdp: TabularPOMDP, temperature: float, learner: np.ndarray, values: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    The averages of exp(Q / temperature) over the states that look the same, as multiples of the largest exp that counts.

    :param pomdp: decision process with S states, O observations and A actions
    :param temperature: difference in value for which a gain is e times as large, above 0
    :param learner: the old learner's probabilities of actions by observation; actions that it never takes do not count, shape
        (O, A)
    :param values: Q of states and actions, shape (S, A)
    :param weights: weights of states, not negative, shape (S,)
    :return: averages divided by exp(best value / temperature), shape (O, A), and that best value, shape (O, 1)
    """
    shares, taken = pomdp.shares(weights), pomdp.by_state(learner) > 0
    counts = (shares > 0)[:, :, None] & taken
    best = np.where(counts, values, -np.inf).max(axis=(1, 2))[:, None]
    below = np.minimum(_less(values, best[pomdp.observations], temperature), 0.0)  # what does not count may lie above
    return shares @ np.exp(below), best


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
    :return: value of the objective, which the new learner maximises; ``-inf`` if the new learner never takes an action that
        the old one takes
    :raises ValueError: if ``temperature`` is not above 0
    """
    check_above_zero("temperature", temperature)
    kl = divergence(pomdp.by_state(learner), pomdp.by_state(candidate))
    per_state = _log_likelihood(pomdp, temperature, learner, values, candidate) - (penalty * kl if penalty else 0.0)
    return float(expected(weights, per_state))


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
    :raises ValueError: if ``temperature`` is not above 0, or ``penalty`` is negative or not finite
    """
    check_above_zero("temperature", temperature)
    if not 0 <= penalty < np.inf:
        raise ValueError(f"penalty must be a number of at least 0, got {penalty!r}.")
    gains, best = _averaged_gains(pomdp, temperature, learner, values, weights)
    largest = np.finfo(float).max
    with np.errstate(divide="ignore", over="ignore"):  # logarithms of what gains and penalty count for; no penalty for nothing
        of_gains, of_penalty = np.clip(best / temperature, -largest, largest), np.full_like(best, np.log(penalty))
    larger = np.maximum(of_gains, of_penalty)
    in_gains, in_penalty = (np.exp(_less(part, larger, 1.0)) for part in (of_gains, of_penalty))
    new = learner * (in_gains * gains + in_penalty)
    return new / new.sum(axis=1, keepdims=True)
