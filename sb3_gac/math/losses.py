"""
Every equation of Guided Actor-Critic as a pure function of tensors.

=====================  ==========================================================  ===========
symbol                 meaning                                                     shape
=====================  ==========================================================  ===========
s                      privileged view: every entry of the observation             (\\*E, S)
o                      partial view: what the learner sees                         (\\*E, P)
mu, ``guider``         policy on s, collects the data                              --
pi, ``learner``        policy on o, the one that is deployed                       --
Q_theta                guided critics, on s                                        (N, \\*E)
Q_phi                  learner critics, on s                                       (N, \\*E)
alpha, ``kl_coef``     weight of KL(mu || pi), dual variable of KL <= target_kl    ()
beta, ``ent_coef``     entropy temperature, dual variable of the entropy bound     ()
=====================  ==========================================================  ===========

``*E`` is any number of leading batch dimensions, (B,) for one-step batches and (T, B) for sequences.  An optional
``mask`` of that shape (1 valid, 0 padding) leaves padding out of every average.  Equation numbers are those of the
Guided Actor-Critic paper.  Whatever must not receive a gradient (targets, frozen critics, the other policy) is
detached by the caller, except in the dual loss, whose violation is always a constant.
"""

import math

import torch as th
import torch.nn.functional as F


def masked_mean(values: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
    """
    Average over all leading dimensions, padding left out.

    :param values: shape (\\*E)
    :param mask: shape (\\*E), 1 for valid entries and 0 for padding; ``None`` if all are valid
    :return: scalar
    """
    if mask is None:
        return values.mean()
    return th.where(mask > 0, values, th.zeros_like(values)).sum() / mask.sum().clamp(min=1)


def masked_quantile(values: th.Tensor, share: float, mask: th.Tensor | None = None) -> th.Tensor:
    """
    Smallest value that at least a share of all values do not exceed, padding left out.

    :param values: shape (\\*E)
    :param share: in (0, 1]
    :param mask: shape (\\*E), 1 for valid entries and 0 for padding; ``None`` if all are valid
    :return: scalar
    """
    if mask is None:
        return values.flatten().kthvalue(math.ceil(share * values.numel())).values
    valid = mask.flatten() > 0
    in_order = values.flatten().masked_fill(~valid, math.inf).sort().values  # no shape depends on the mask
    rank = (share * valid.sum()).ceil().long().clamp(min=1) - 1
    return in_order.gather(0, rank[None]).squeeze(0)


def soft_target(
    *,
    reward: th.Tensor,
    done: th.Tensor,
    next_q: th.Tensor,
    discount: th.Tensor | float,
    next_log_prob: th.Tensor | float = 0.0,
    ent_coef: th.Tensor | float = 0.0,
    next_kl: th.Tensor | float = 0.0,
    kl_coef: th.Tensor | float = 0.0,
) -> th.Tensor:
    """
    Bellman target of a policy's critics: the return of eq. 15, with SAC's entropy term and eq. 12's KL term on request.

    The expectation over a' of log mu - log pi in eq. 12 is the KL divergence itself, so its closed form replaces the sampled
    ratio of the printed equation: less variance, never negative.

    :param reward: shape (\\*E)
    :param done: 1 where the episode terminated (a time limit is not a termination), shape (\\*E)
    :param next_q: target critics at (s', a'), a' from the policy, shape (N, \\*E)
    :param discount: gamma, or gamma to the number of steps between s and s', scalar or (\\*E)
    :param next_log_prob: log-probability of a', shape (\\*E)
    :param ent_coef: beta
    :param next_kl: KL(mu(.|s') || pi(.|o')), shape (\\*E)
    :param kl_coef: alpha
    :return: shape (\\*E)
    :raises ValueError: naming the tensor whose shape is not (\\*E)
    """
    _check_shapes(next_q.shape[1:], reward=reward, done=done, discount=discount, next_log_prob=next_log_prob, next_kl=next_kl)
    next_value = next_q.amin(dim=0) - kl_coef * next_kl - ent_coef * next_log_prob
    return reward + discount * (1 - done) * next_value


def critic_loss(q: th.Tensor, target: th.Tensor, mask: th.Tensor | None = None, weights: th.Tensor | None = None) -> th.Tensor:
    """
    Squared Bellman residual of an ensemble (eqs. 12 and 15): half the mean square, summed over the critics.

    :param q: shape (N, \\*E)
    :param target: shape (\\*E), detached
    :param mask: shape (\\*E)
    :param weights: of the squares, shape (\\*E): what has none counts in the mean, as nothing; ``None`` where all are 1
    :return: scalar
    """
    if weights is not None:
        return 0.5 * masked_mean((q - target).square().sum(dim=0) * weights, mask)
    if mask is None:
        return 0.5 * len(q) * F.mse_loss(q, target.expand_as(q))
    return 0.5 * masked_mean((q - target).square().sum(dim=0), mask)


def policy_loss(
    *,
    q: th.Tensor,
    log_prob: th.Tensor | float = 0.0,
    ent_coef: th.Tensor | float = 0.0,
    kl: th.Tensor | float = 0.0,
    kl_coef: th.Tensor | float = 0.0,
    mask: th.Tensor | None = None,
) -> th.Tensor:
    """
    A policy's objective: climb its critics, with SAC's entropy term and a KL term on request. It is the guider's (eq. 13)
    with KL(mu || sg pi), and the learner's (eq. 16) with KL(sg mu || pi).

    :param q: critics at (s, a), a from the policy and reparameterised, frozen, shape (N, \\*E)
    :param log_prob: log-probability of a, shape (\\*E)
    :param ent_coef: beta
    :param kl: divergence of the two policies, shape (\\*E)
    :param kl_coef: alpha
    :param mask: shape (\\*E)
    :return: scalar
    :raises ValueError: naming the tensor whose shape is not (\\*E)
    """
    _check_shapes(q.shape[1:], log_prob=log_prob, kl=kl, mask=mask)
    return masked_mean(kl_coef * kl + ent_coef * log_prob - q.amin(dim=0), mask)


def clipped_surrogate(
    log_ratio: th.Tensor, advantages: th.Tensor, epsilon: th.Tensor, *, clipped_from: th.Tensor | None = None
) -> th.Tensor:
    """
    PPO's objective (Schulman et al. 2017, arXiv 1707.06347, eq. 7), as a loss.

    :param log_ratio: of an action's probability to that under the policy which took it, shape (B,)
    :param advantages: of the actions, shape (B,)
    :param epsilon: how far from one the clipped ratio may be, scalar
    :param clipped_from: logarithm of what is clipped, where that is not the ratio itself, shape (B,)
    :return: scalar
    :raises ValueError: naming the tensor whose shape is not (B,)
    """
    _check_shapes(log_ratio.shape, advantages=advantages, clipped_from=clipped_from)
    clipped = (log_ratio if clipped_from is None else clipped_from).exp().clamp(1 - epsilon, 1 + epsilon)
    return -th.minimum(log_ratio.exp() * advantages, clipped * advantages).mean()


def distillation_loss(kl: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
    """
    Learner objective without reinforcement learning (eq. 14).

    :param kl: KL(sg mu || pi), shape (\\*E)
    :param mask: shape (\\*E)
    :return: scalar
    """
    return masked_mean(kl, mask)


def log_std_loss(log_std: th.Tensor, guider_log_std: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
    """
    Fit of the learner's own log standard deviation, used at deployment only, to the guider's.

    :param log_std: shape (\\*E, A)
    :param guider_log_std: shape (\\*E, A), detached
    :param mask: shape (\\*E)
    :return: scalar
    """
    return 0.5 * masked_mean((log_std - guider_log_std).square().mean(dim=-1), mask)


def dual_loss(coefficient: th.Tensor, violation: th.Tensor) -> th.Tensor:
    """
    Loss of dual variables; a coefficient rises exactly while its constraint is violated.

    For alpha (eq. 17, with the sign its text describes) the violation is KL - target_kl; for SAC's beta it is
    log mu + target_entropy.

    :param coefficient: shape (), (1,) or, one for each action dimension, (A,)
    :param violation: mean over the batch, of the same shape or a scalar; treated as a constant
    :return: scalar
    """
    return -(coefficient * violation.detach()).sum()


def _check_shapes(expected: th.Size, **tensors: th.Tensor | float | None) -> None:
    """
    Broadcasting would make a wrong shape a wrong number.

    :param expected: of all tensors but scalars
    :param tensors: name -> tensor, or a number
    :raises ValueError: naming the one that has another shape
    """
    for name, tensor in tensors.items():
        if isinstance(tensor, th.Tensor) and tensor.dim() > 0 and tensor.shape != expected:
            raise ValueError(
                f"{name} must have the shape {tuple(expected)}, as the critics' values have, got {tuple(tensor.shape)}."
            )
