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


def guided_target(
    reward: th.Tensor,
    done: th.Tensor,
    next_q: th.Tensor,
    next_kl: th.Tensor,
    next_log_prob: th.Tensor,
    kl_coef: th.Tensor | float,
    ent_coef: th.Tensor | float,
    discount: th.Tensor | float,
) -> th.Tensor:
    """
    Bellman target of the guided critics (eq. 12), with SAC's entropy term.

    The expectation over a' of log mu - log pi is the KL divergence itself, so its closed form replaces the sampled
    ratio of the printed equation: less variance, never negative.

    :param reward: shape (\\*E)
    :param done: 1 where the episode terminated (a time limit is not a termination), shape (\\*E)
    :param next_q: target critics at (s', a'), a' from the guider, shape (N, \\*E)
    :param next_kl: KL(mu(.|s') || pi(.|o')), shape (\\*E)
    :param next_log_prob: log mu(a'|s'), shape (\\*E)
    :param kl_coef: alpha
    :param ent_coef: beta
    :param discount: gamma, or gamma to the number of steps between s and s', scalar or (\\*E)
    :return: shape (\\*E)
    """
    next_value = next_q.amin(dim=0) - kl_coef * next_kl - ent_coef * next_log_prob
    return reward + discount * (1 - done) * next_value


def learner_target(
    reward: th.Tensor,
    done: th.Tensor,
    next_q: th.Tensor,
    discount: th.Tensor | float,
    next_log_prob: th.Tensor | float = 0.0,
    ent_coef: th.Tensor | float = 0.0,
) -> th.Tensor:
    """
    Bellman target of the learner critics (eq. 15): the plain return, without KL; with SAC's entropy term on request.

    :param reward: shape (\\*E)
    :param done: 1 where the episode terminated, shape (\\*E)
    :param next_q: target critics at (s', a'), a' from the learner, shape (N, \\*E)
    :param discount: scalar or (\\*E)
    :param next_log_prob: log pi(a'|o'), shape (\\*E)
    :param ent_coef: beta, or 0 for the equation as printed
    :return: shape (\\*E)
    """
    next_value = next_q.amin(dim=0) - ent_coef * next_log_prob
    return reward + discount * (1 - done) * next_value


def critic_loss(q: th.Tensor, target: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
    """
    Squared Bellman residual of an ensemble (eqs. 12 and 15): half the mean square, summed over the critics.

    :param q: shape (N, \\*E)
    :param target: shape (\\*E), detached
    :param mask: shape (\\*E)
    :return: scalar
    """
    if mask is None:
        return 0.5 * len(q) * F.mse_loss(q, target.expand_as(q))
    return 0.5 * masked_mean((q - target).square().sum(dim=0), mask)


def guider_loss(
    kl: th.Tensor,
    log_prob: th.Tensor,
    q: th.Tensor,
    kl_coef: th.Tensor | float,
    ent_coef: th.Tensor | float,
    mask: th.Tensor | None = None,
) -> th.Tensor:
    """
    Guider objective (eq. 13) with SAC's entropy term.

    :param kl: KL(mu || sg pi), shape (\\*E)
    :param log_prob: log mu(a|s), a reparameterised, shape (\\*E)
    :param q: guided critics at (s, a), frozen, shape (N, \\*E)
    :param kl_coef: alpha
    :param ent_coef: beta
    :param mask: shape (\\*E)
    :return: scalar
    """
    return masked_mean(kl_coef * kl + ent_coef * log_prob - q.amin(dim=0), mask)


def learner_loss(
    kl: th.Tensor | float,
    q: th.Tensor,
    kl_coef: th.Tensor | float,
    log_prob: th.Tensor | float = 0.0,
    ent_coef: th.Tensor | float = 0.0,
    mask: th.Tensor | None = None,
) -> th.Tensor:
    """
    Learner objective (eq. 16): follow the guider, climb the learner's own critics; with SAC's entropy term on request.

    :param kl: KL(sg mu || pi), shape (\\*E)
    :param q: critics at (s, a), a from the learner and reparameterised, frozen, shape (N, \\*E)
    :param kl_coef: alpha
    :param log_prob: log pi(a|o), shape (\\*E)
    :param ent_coef: beta, or 0 for the equation as printed
    :param mask: shape (\\*E)
    :return: scalar
    """
    return masked_mean(kl_coef * kl + ent_coef * log_prob - q.amin(dim=0), mask)


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


def dual_loss(log_coef: th.Tensor, violation: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
    """
    Loss of a dual variable in log space; its coefficient rises exactly while the constraint is violated.

    For alpha (eq. 17, with the sign its text describes) the violation is KL - target_kl; for SAC's beta it is
    log mu + target_entropy.

    :param log_coef: logarithm of the coefficient, shape () or (1,)
    :param violation: shape (\\*E); treated as a constant
    :param mask: shape (\\*E)
    :return: scalar
    """
    return -(log_coef.exp() * masked_mean(violation.detach(), mask)).sum()
