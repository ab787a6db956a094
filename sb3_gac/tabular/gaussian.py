"""
What the pull towards a guider is, for Gaussians that share one std, and Q(a) = -1/2 (a - best)' curvature (a - best).

At the guider's optimum (eq. 13, without entropy and squashing) the pull of eq. 16 equals the gradient of the guider's critic
at the guider's actions. With a quadratic critic the gradient's mean is that at the mean, and all is in closed form.
"""

import numpy as np


def guider_optimum(
    alpha: float, learner_mean: np.ndarray, std: np.ndarray, curvature: np.ndarray, best: np.ndarray
) -> np.ndarray:
    """
    :param alpha: weight of the KL, above 0
    :param learner_mean: shape (A,)
    :param std: of both policies, shape (A,)
    :param curvature: of the guider's critic, symmetric and positive definite, shape (A, A)
    :param best: action of the guider's critic, shape (A,)
    :return: the mean that minimises eq. 13, shape (A,)
    """
    tie = np.diag(alpha / std**2)
    return np.linalg.solve(tie + curvature, tie @ learner_mean + curvature @ best)


def pull(alpha: float, guider_mean: np.ndarray, learner_mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """
    :param alpha: weight of the KL
    :param guider_mean: shape (A,)
    :param learner_mean: shape (A,)
    :param std: of both policies, shape (A,)
    :return: the direction in which the KL of eq. 16 moves the learner's mean: minus the gradient of alpha KL, shape (A,)
    """
    return alpha * (guider_mean - learner_mean) / std**2


def ascent(mean: np.ndarray, curvature: np.ndarray, best: np.ndarray) -> np.ndarray:
    """
    :param mean: of the actions at which the critic is asked, shape (A,)
    :param curvature: shape (A, A)
    :param best: shape (A,)
    :return: the critic's gradient, on average over the actions, shape (A,)
    """
    return curvature @ (best - mean)


def coefficient_for(
    target_kl: float, learner_mean: np.ndarray, std: np.ndarray, curvature: np.ndarray, best: np.ndarray
) -> float:
    """
    :param target_kl: KL(mu || pi) of the guider's optimum, summed over actions; above 0 and below that of ``best``
    :param learner_mean: shape (A,)
    :param std: of both policies, shape (A,)
    :param curvature: of the guider's critic, shape (A, A)
    :param best: action of the guider's critic, shape (A,)
    :return: the alpha with which it has it, which is where eq. 17 comes to rest
    :raises ValueError: if the critic's best action is nearer than ``target_kl``, so that no alpha is needed
    """

    def kl_at(mean: np.ndarray) -> float:
        return 0.5 * float((((mean - learner_mean) / std) ** 2).sum())

    if not 0 < target_kl < kl_at(best):
        raise ValueError(f"target_kl must be above 0 and below {kl_at(best):g}, the KL of the best action, got {target_kl!r}.")
    low, high = np.log(1e-12), np.log(1e12)
    for _ in range(200):
        middle = (low + high) / 2
        too_far = kl_at(guider_optimum(float(np.exp(middle)), learner_mean, std, curvature, best)) > target_kl
        low, high = (middle, high) if too_far else (low, middle)
    return float(np.exp(high))
