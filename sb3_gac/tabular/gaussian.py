"""
The pull of a learner towards a guider, for Gaussians with one std and a critic Q(a) = -1/2 (a - best)' curvature (a - best).

At the guider's optimum (eq. 13, without entropy and tanh) the pull of eq. 16 equals the gradient of the guider's critic at
the guider's actions. With a quadratic critic the mean of the gradients is the gradient at the mean action, so that all
quantities have a closed form.
"""

import numpy as np


def guider_optimum(
    alpha: float, learner_mean: np.ndarray, std: np.ndarray, curvature: np.ndarray, best: np.ndarray
) -> np.ndarray:
    """
    The guider's mean that minimises eq. 13.

    :param alpha: weight of the KL, above 0
    :param learner_mean: the learner's mean action, shape (A,)
    :param std: standard deviation that both policies share, shape (A,)
    :param curvature: curvature of the guider's critic, symmetric and positive definite, shape (A, A)
    :param best: best action by the guider's critic, shape (A,)
    :return: the guider's mean action, shape (A,)
    """
    tie = np.diag(alpha / std**2)
    return np.linalg.solve(tie + curvature, tie @ learner_mean + curvature @ best)


def pull(alpha: float, guider_mean: np.ndarray, learner_mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """
    The direction in which the KL of eq. 16 moves the learner's mean.

    :param alpha: weight of the KL
    :param guider_mean: the guider's mean action, shape (A,)
    :param learner_mean: the learner's mean action, shape (A,)
    :param std: standard deviation that both policies share, shape (A,)
    :return: negative gradient of alpha KL(mu || pi) with respect to the learner's mean, shape (A,)
    """
    return alpha * (guider_mean - learner_mean) / std**2


def ascent(mean: np.ndarray, curvature: np.ndarray, best: np.ndarray) -> np.ndarray:
    """
    The mean gradient of the critic over a policy's actions.

    :param mean: mean action of the policy, shape (A,)
    :param curvature: curvature of the critic, shape (A, A)
    :param best: best action by the critic, shape (A,)
    :return: mean gradient of Q with respect to the action, shape (A,)
    """
    return curvature @ (best - mean)


def coefficient_for(
    target_kl: float, learner_mean: np.ndarray, std: np.ndarray, curvature: np.ndarray, best: np.ndarray
) -> float:
    """
    The weight alpha with which the KL of the guider's optimum meets a target.

    :param target_kl: KL(mu || pi) of the guider's optimum, in nats, summed over action dimensions; above 0 and below the KL of
        ``best``
    :param learner_mean: the learner's mean action, shape (A,)
    :param std: standard deviation that both policies share, shape (A,)
    :param curvature: curvature of the guider's critic, shape (A, A)
    :param best: best action by the guider's critic, shape (A,)
    :return: alpha, at which eq. 17 comes to rest
    :raises ValueError: if ``target_kl`` is not above 0, or the critic's best action is nearer, so that no alpha is needed
    """

    def kl_at(mean: np.ndarray) -> float:
        return 0.5 * float((((mean - learner_mean) / std) ** 2).sum())

    if not 0 < target_kl < kl_at(best):
        raise ValueError(f"target_kl must be above 0 and below {kl_at(best):g}, the KL of the best action, got {target_kl!r}.")

    def is_too_far(log_alpha: float) -> bool:
        return kl_at(guider_optimum(float(np.exp(log_alpha)), learner_mean, std, curvature, best)) > target_kl

    low, high = -28.0, 28.0
    while high < 700 and is_too_far(high):  # up to the largest alpha that a float holds
        high += 28
    while low > -700 and not is_too_far(low):
        low -= 28
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if is_too_far(middle) else (low, middle)
    return float(np.exp(high))
