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

``*E`` stands for the leading batch dimensions, (B,) for batches of transitions and (T, B) for sequences.  An optional
``mask`` of that shape (1 valid, 0 padding) leaves padding out of every average.  Equation numbers are those of the
Guided Actor-Critic paper.  The caller detaches all that must not receive a gradient (targets, frozen critics, the other
policy), except for the violation in the dual loss, which is always treated as a constant.
"""

import math

import torch as th
import torch.nn.functional as F


def masked_mean(values: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
    """
    The average over all leading dimensions, without padding.

    :param values: values to average, shape (\\*E)
    :param mask: 1 for valid values and 0 for padding, shape (\\*E); ``None`` if all are valid
    :return: average, scalar
    """
    if mask is None:
        return values.mean()
    return th.where(mask > 0, values, th.zeros_like(values)).sum() / mask.sum().clamp(min=1)


def masked_quantile(values: th.Tensor, share: float, mask: th.Tensor | None = None) -> th.Tensor:
    """
    The smallest value that at least a share of all values do not exceed, without padding.

    :param values: values whose quantile is taken, shape (\\*E)
    :param share: share of the values, in (0, 1]
    :param mask: 1 for valid values and 0 for padding, shape (\\*E); ``None`` if all are valid
    :return: quantile, scalar
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

    The expectation over a' of log mu - log pi in eq. 12 is the KL divergence itself, so the closed form of the KL replaces the
    sampled ratio of the printed equation: it has less variance and is never negative.

    :param reward: reward of each transition, shape (\\*E)
    :param done: 1 where the episode terminated (a time limit is no termination), else 0, shape (\\*E)
    :param next_q: values of target critics at (s', a'), a' from the policy, shape (N, \\*E)
    :param discount: gamma to the power of the number of steps between s and s', scalar or shape (\\*E)
    :param next_log_prob: log-probability of a', shape (\\*E)
    :param ent_coef: entropy temperature beta, scalar
    :param next_kl: KL(mu(.|s') || pi(.|o')), shape (\\*E)
    :param kl_coef: weight alpha of the KL, scalar
    :return: Bellman target of each transition, shape (\\*E)
    :raises ValueError: if the shape of a tensor is not (\\*E); the message names the tensor
    """
    _check_shapes(next_q.shape[1:], reward=reward, done=done, discount=discount, next_log_prob=next_log_prob, next_kl=next_kl)
    next_value = next_q.amin(dim=0) - kl_coef * next_kl - ent_coef * next_log_prob
    return reward + discount * (1 - done) * next_value


def critic_loss(q: th.Tensor, target: th.Tensor, mask: th.Tensor | None = None, weights: th.Tensor | None = None) -> th.Tensor:
    """
    Squared Bellman residual of an ensemble (eqs. 12 and 15): half the mean square, summed over the critics.

    :param q: values of the critics at (s, a), shape (N, \\*E)
    :param target: Bellman target, detached, shape (\\*E), or (N, \\*E) with a target for each critic
    :param mask: 1 for valid steps and 0 for padding, shape (\\*E); ``None`` if all are valid
    :param weights: weights of the squares, shape (\\*E); a square of weight 0 still counts in the number that the mean divides
        by. ``None`` if all weights are 1
    :return: loss, scalar
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
    A policy's loss: the policy climbs its critics, with SAC's entropy term and a KL term on request. With KL(mu || sg pi) the
    loss is the guider's (eq. 13), with KL(sg mu || pi) the learner's (eq. 16); sg stands for a stopped gradient.

    :param q: values of frozen critics at (s, a), a from the policy and reparameterised, shape (N, \\*E)
    :param log_prob: log-probability of a, shape (\\*E)
    :param ent_coef: entropy temperature beta, scalar
    :param kl: KL divergence of the two policies, shape (\\*E)
    :param kl_coef: weight alpha of the KL, scalar
    :param mask: 1 for valid steps and 0 for padding, shape (\\*E); ``None`` if all are valid
    :return: loss, scalar
    :raises ValueError: if the shape of a tensor is not (\\*E); the message names the tensor
    """
    _check_shapes(q.shape[1:], log_prob=log_prob, kl=kl, mask=mask)
    return masked_mean(kl_coef * kl + ent_coef * log_prob - q.amin(dim=0), mask)


def clipped_surrogate(
    log_ratio: th.Tensor, advantages: th.Tensor, epsilon: th.Tensor, *, clipped_from: th.Tensor | None = None
) -> th.Tensor:
    """
    PPO's objective (Schulman et al. 2017, arXiv 1707.06347, eq. 7), as a loss.

    :param log_ratio: logarithm of the ratio of an action's probability to its probability under the policy that took it, shape
        (B,)
    :param advantages: advantages of the actions, shape (B,)
    :param epsilon: largest distance of the clipped ratio from 1, scalar
    :param clipped_from: logarithm of the ratio that is clipped, shape (B,); ``None`` to clip the ratio of ``log_ratio`` itself
    :return: loss, scalar
    :raises ValueError: if the shape of a tensor is not (B,); the message names the tensor
    """
    _check_shapes(log_ratio.shape, advantages=advantages, clipped_from=clipped_from)
    clipped = (log_ratio if clipped_from is None else clipped_from).exp().clamp(1 - epsilon, 1 + epsilon)
    return -th.minimum(log_ratio.exp() * advantages, clipped * advantages).mean()


def distillation_loss(kl: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
    """
    The learner's loss without reinforcement learning (eq. 14).

    :param kl: KL(sg mu || pi), shape (\\*E)
    :param mask: 1 for valid steps and 0 for padding, shape (\\*E); ``None`` if all are valid
    :return: loss, scalar
    """
    return masked_mean(kl, mask)


def log_std_loss(log_std: th.Tensor, guider_log_std: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
    """
    The loss that fits the learner's own log standard deviation, used at deployment only, to the guider's.

    :param log_std: the learner's own log standard deviation, shape (\\*E, A)
    :param guider_log_std: the guider's log standard deviation, detached, shape (\\*E, A)
    :param mask: 1 for valid steps and 0 for padding, shape (\\*E); ``None`` if all are valid
    :return: half the mean squared difference, scalar
    """
    return 0.5 * masked_mean((log_std - guider_log_std).square().mean(dim=-1), mask)


def dual_loss(coefficient: th.Tensor, violation: th.Tensor) -> th.Tensor:
    """
    The loss of dual variables: a coefficient rises exactly while its constraint is violated.

    The violation is KL - target_kl for alpha (eq. 17, with the sign that its text describes), and log mu + target_entropy for
    SAC's beta.

    :param coefficient: dual variable, shape () or (1,), or (A,) with one for each action dimension
    :param violation: mean violation over the batch, of the same shape or a scalar; treated as a constant
    :return: loss, scalar
    """
    return -(coefficient * violation.detach()).sum()


def _check_shapes(expected: th.Size, **tensors: th.Tensor | float | None) -> None:
    """
    Check shapes, since broadcasting would turn a wrong shape into a wrong number.

    :param expected: shape that all tensors must have, except for scalars
    :param tensors: name -> tensor, number or ``None``
    :raises ValueError: if a tensor has another shape; the message names the tensor
    """
    for name, tensor in tensors.items():
        if isinstance(tensor, th.Tensor) and tensor.dim() > 0 and tensor.shape != expected:
            raise ValueError(
                f"{name} must have the shape {tuple(expected)}, as the critics' values have, got {tuple(tensor.shape)}."
            )
