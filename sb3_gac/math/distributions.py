"""
Action distributions: tanh-squashed diagonal Gaussians, for which guider and learner share a std, and categorical
distributions.

Both classes have the same methods, so that one update serves both: the expected value and log-probability of an action
(estimated by one sample, or exact), several candidate actions, KL divergences, a distribution moved by a correction, and a
distribution with the std of another.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import torch as th
import torch.nn.functional as F

KL_REDUCTIONS = ("mean", "sum")
#: Function from actions, or from None for all actions, to the values of the critics in an ensemble
QFunction: TypeAlias = Callable[[Any], th.Tensor]
_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


class Candidates(NamedTuple):
    """
    K candidate actions in each state, over which expectations are taken: samples of a policy, or all discrete actions.

    :param values: value of each action, the minimum over critics, shape (\\*E, K)
    :param log_shares: logarithm of each action's weight in an expectation, shape (\\*E, K), or () if all weights are equal
    :param pre_tanh: samples before tanh, shape (K, \\*E, A); ``None`` for discrete actions
    """

    values: th.Tensor
    log_shares: th.Tensor
    pre_tanh: th.Tensor | None = None

    @property
    def mean_value(self) -> th.Tensor:
        """Expected value of the policy's action, as the value of an ensemble of one critic, shape (1, \\*E)."""
        return (self.log_shares.exp() * self.values).sum(dim=-1)[None]

    def improved(self, temperature: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        A better policy on the same actions: the weight of each is in proportion to its former weight times exp(value /
        temperature).

        :param temperature: difference in value for which an action's weight is e times as large, scalar
        :return: weights, shape (\\*E, K), and KL(better policy || policy), shape (\\*E)
        """
        log_weights = (self.log_shares + self.values / temperature).log_softmax(dim=-1)
        weights = log_weights.exp()
        return weights, (weights * (log_weights - self.log_shares)).sum(dim=-1)


class TanhGaussian(NamedTuple):
    """
    The distribution of tanh(x) with x from N(mean, exp(log_std)^2), independent for each action dimension.

    :param mean: mean before tanh, shape (\\*E, A)
    :param log_std: log standard deviation before tanh, shape (\\*E, A)
    """

    mean: th.Tensor
    log_std: th.Tensor

    @property
    def mode(self) -> th.Tensor:
        """Action of the deterministic policy, tanh(mean), in [-1, 1], shape (\\*E, A)."""
        return th.tanh(self.mean)

    def detach(self) -> "TanhGaussian":
        """The same distribution as a constant."""
        return TanhGaussian(self.mean.detach(), self.log_std.detach())

    def sample(self) -> th.Tensor:
        """Reparameterised action in [-1, 1], shape (\\*E, A)."""
        return self.action(self.draw())

    def draw(self) -> th.Tensor:
        """A sampled action before tanh, as :meth:`log_prob` and :meth:`action` take it, shape (\\*E, A)."""
        return self._pre_tanh(th.randn_like(self.mean))

    @staticmethod
    def action(drawn: th.Tensor) -> th.Tensor:
        """
        The action for a sample before tanh.

        :param drawn: action before tanh, from :meth:`draw`, shape (\\*E, A)
        :return: action in [-1, 1], shape (\\*E, A)
        """
        return th.tanh(drawn)

    def entropy(self, noise: th.Tensor) -> th.Tensor:
        """
        :param noise: standard normal noise, shape (\\*E, A)
        :return: estimate of the entropy by one sample, in nats, shape (\\*E)
        """
        return -self.sample_with_log_prob(noise)[1]

    def sample_with_log_prob(self, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        A reparameterised action and its log-probability.

        :param noise: standard normal noise, shape (\\*E, A)
        :return: action in [-1, 1], shape (\\*E, A), and log-probability, shape (\\*E)
        """
        pre_tanh = self._pre_tanh(noise)
        return th.tanh(pre_tanh), self._log_prob(pre_tanh, noise)

    def value_and_log_prob(self, q_function: QFunction, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Value and log-probability of the policy's action, estimated by one sample.

        :param q_function: function from actions, shape (\\*E, A), to the values of N critics, shape (N, \\*E)
        :param noise: standard normal noise, shape (\\*E, A)
        :return: values of one sample, shape (N, \\*E), and its log-probability, shape (\\*E)
        """
        action, log_prob = self.sample_with_log_prob(noise)
        return q_function(action), log_prob

    def candidates(self, q_function: QFunction, noise: th.Tensor) -> Candidates:
        """
        :param q_function: function from actions, shape (K, \\*E, A), to the values of N critics, shape (N, K, \\*E)
        :param noise: standard normal noise, shape (K, \\*E, A)
        :return: K samples in each state, with equal weights
        """
        pre_tanh = self._pre_tanh(noise)
        values = q_function(th.tanh(pre_tanh)).amin(dim=0).movedim(0, -1)
        return Candidates(values, values.new_full((), -math.log(len(noise))), pre_tanh)

    def log_likelihood(self, candidates: Candidates) -> th.Tensor:
        """
        Log-density of samples before tanh. The log-density of the actions differs by the sum of log(1 - tanh(x)^2), which no
        policy changes.

        :param candidates: samples of any policy
        :return: log-density of each sample, shape (\\*E, K)
        """
        assert candidates.pre_tanh is not None
        standardised = (candidates.pre_tanh - self.mean) * th.exp(-self.log_std)
        return (-0.5 * standardised.square() - self.log_std - _LOG_SQRT_2PI).sum(dim=-1).movedim(0, -1)

    def kl(self, other: "TanhGaussian", reduction: str = "sum") -> th.Tensor:
        """
        KL(self || other) of any two distributions. Tanh is a bijection, so the KL is the same before and after tanh.

        :param other: distribution with shapes (\\*E, A)
        :param reduction: reduction over action dimensions, "sum" (the definition) or "mean"
        :return: KL, in nats, shape (\\*E)
        """
        return _reduced(self.kl_by_dimension(other), reduction)

    def kl_by_dimension(self, other: "TanhGaussian") -> th.Tensor:
        """KL(self || other) of each action dimension, shape (\\*E, A)."""
        log_ratio = other.log_std - self.log_std
        distance = (self.mean - other.mean) * th.exp(-other.log_std)
        return log_ratio + 0.5 * (th.expm1(-2 * log_ratio) + distance.square())  # expm1 does not cancel for nearly equal stds

    def decoupled(self, anchor: "TanhGaussian") -> tuple["TanhGaussian", ...]:
        """
        Two distributions, of which one depends on this mean alone and the other on this std alone.

        :param anchor: another distribution, as a constant, shapes (\\*E, A)
        :return: this mean with the anchor's std, and the anchor's mean with this std
        """
        return TanhGaussian(self.mean, anchor.log_std), TanhGaussian(anchor.mean, self.log_std)

    def kl_of_means(self, other: "TanhGaussian", reduction: str = "mean") -> th.Tensor:
        """
        KL(self || other) of two distributions with the std of ``other``, whose gradient moves the means alone, see
        :func:`kl_shared_std`.

        :param other: distribution with shapes (\\*E, A)
        :param reduction: reduction over action dimensions, "sum" or "mean"
        :return: KL, in nats, shape (\\*E)
        """
        return kl_shared_std(self.mean, other.mean, other.log_std.detach().exp(), reduction)

    def with_residual(self, correction: "TanhGaussian") -> "TanhGaussian":
        """
        This distribution, as a constant, with its mean moved by a correction and with the correction's std.

        :param correction: correction whose mean counts in units of its std, shapes (\\*E, A)
        :return: corrected distribution, shapes (\\*E, A)
        """
        mean = self.mean.detach() + correction.log_std.detach().exp() * correction.mean
        return TanhGaussian(mean, correction.log_std)

    def with_std_of(self, lender: "TanhGaussian") -> "TanhGaussian":
        """This mean with the lender's std, as a constant."""
        return TanhGaussian(self.mean, lender.log_std.detach())

    def diagnostics(self) -> dict[str, th.Tensor]:
        """Name of a metric -> its values, whose average is logged, detached, shape (\\*E)."""
        return {"std": self.log_std.detach().exp().mean(dim=-1), "mean_abs": self.mean.detach().abs().mean(dim=-1)}

    def log_prob(self, pre_tanh: th.Tensor) -> th.Tensor:
        """
        Log-density of the action tanh(pre_tanh).

        :param pre_tanh: action before tanh, shape (\\*E, A)
        :return: log-density, shape (\\*E)
        """
        return self._log_prob(pre_tanh, (pre_tanh - self.mean) * th.exp(-self.log_std))

    def _pre_tanh(self, noise: th.Tensor) -> th.Tensor:
        return th.addcmul(self.mean, self.log_std.exp(), noise)

    def _log_prob(self, pre_tanh: th.Tensor, standardised: th.Tensor) -> th.Tensor:
        """
        log N(x; mean, std) - log(1 - tanh(x)^2), summed over dimensions; constants are added once, at the end.

        log(1 - tanh(x)^2) is computed as 2 (log 2 - x - log(1 + exp(-2 x))), which does not cancel for large |x|.
        """
        # Half of the log-density, doubled at the end: so the term of tanh is added without a factor, in one pass less
        log_cosh = pre_tanh + F.softplus(pre_tanh * -2.0)  # without its constant, -log 2
        summed = th.addcmul(th.sub(log_cosh, self.log_std, alpha=0.5), standardised, standardised, value=-0.25).sum(dim=-1)
        return 2.0 * summed - pre_tanh.shape[-1] * (_LOG_SQRT_2PI + 2.0 * math.log(2.0))


class Categorical(NamedTuple):
    """
    A categorical distribution over A actions.

    :param logits: unnormalised log-probabilities, shape (\\*E, A)
    """

    logits: th.Tensor

    @property
    def mode(self) -> th.Tensor:
        """The likeliest action, int64, shape (\\*E)."""
        return self.logits.argmax(dim=-1)

    def detach(self) -> "Categorical":
        """The same distribution as a constant."""
        return Categorical(self.logits.detach())

    def sample(self) -> th.Tensor:
        """A sampled action, int64, shape (\\*E)."""
        gumbel = -th.empty_like(self.logits).exponential_().log()
        return (self.logits + gumbel).argmax(dim=-1)

    def draw(self) -> th.Tensor:
        """A sampled action's number, as :meth:`log_prob` and :meth:`action` take it, int64, shape (\\*E, 1)."""
        return self.sample()[..., None]

    @staticmethod
    def action(drawn: th.Tensor) -> th.Tensor:
        """
        The action's number without the last dimension.

        :param drawn: number of an action, from :meth:`draw`, shape (\\*E, 1)
        :return: number of the action, shape (\\*E)
        """
        return drawn.squeeze(-1)

    def log_prob(self, drawn: th.Tensor) -> th.Tensor:
        """
        :param drawn: number of an action, shape (\\*E, 1)
        :return: log-probability of the action, shape (\\*E)
        """
        return self.logits.log_softmax(dim=-1).gather(-1, drawn.long()).squeeze(-1)

    def entropy(self, noise: th.Tensor) -> th.Tensor:
        """
        :param noise: noise of the Gaussian's method, without effect here
        :return: exact entropy, in nats, shape (\\*E)
        """
        log_probs = self.logits.log_softmax(dim=-1)
        return -(log_probs.exp() * log_probs).sum(dim=-1)

    def value_and_log_prob(self, q_function: QFunction, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Exact expected value and log-probability of the policy's action, with the minimum over critics of each action's value.

        :param q_function: function from ``None`` to the values of all actions by N critics, shape (N, \\*E, A)
        :param noise: noise of the Gaussian's method, without effect here
        :return: expected value, shape (1, \\*E), and expected log-probability, shape (\\*E)
        """
        log_probs = self.logits.log_softmax(dim=-1)
        probs = log_probs.exp()
        return (probs * q_function(None).amin(dim=0)).sum(dim=-1)[None], (probs * log_probs).sum(dim=-1)

    def candidates(self, q_function: QFunction, noise: th.Tensor) -> Candidates:
        """
        :param q_function: function from ``None`` to the values of all actions by N critics, shape (N, \\*E, A)
        :param noise: noise of the Gaussian's method, without effect here
        :return: all A actions, weighted by their probabilities
        """
        return Candidates(q_function(None).amin(dim=0), self.logits.log_softmax(dim=-1))

    def log_likelihood(self, candidates: Candidates) -> th.Tensor:
        """Log-probabilities of all actions, shape (\\*E, A)."""
        return self.logits.log_softmax(dim=-1)

    def kl(self, other: "Categorical", reduction: str = "sum") -> th.Tensor:
        """KL(self || other), in nats, shape (\\*E); ``reduction`` has no effect, since there are no action dimensions."""
        log_probs = self.logits.log_softmax(dim=-1)
        return (log_probs.exp() * (log_probs - other.logits.log_softmax(dim=-1))).sum(dim=-1)

    def kl_by_dimension(self, other: "Categorical") -> th.Tensor:
        """KL(self || other) as that of a single action dimension, shape (\\*E, 1)."""
        return self.kl(other)[..., None]

    def decoupled(self, anchor: "Categorical") -> tuple["Categorical", ...]:
        """This distribution alone, since it has no mean and std to tell apart."""
        return (self,)

    def kl_of_means(self, other: "Categorical", reduction: str = "sum") -> th.Tensor:
        """KL(self || other), in nats, shape (\\*E), since there is no std to share."""
        return self.kl(other)

    def with_residual(self, correction: "Categorical") -> "Categorical":
        """This distribution, as a constant, with the correction's logits added to its own."""
        return Categorical(self.logits.detach() + correction.logits)

    def with_std_of(self, lender: "Categorical") -> "Categorical":
        """This distribution itself, since there is no std to borrow."""
        return self

    def diagnostics(self) -> dict[str, th.Tensor]:
        """Name of a metric -> its values, whose average is logged, detached, shape (\\*E)."""
        return {"max_prob": self.logits.detach().softmax(dim=-1).amax(dim=-1)}


Distribution: TypeAlias = TanhGaussian | Categorical


def kl_shared_std(guider_mean: th.Tensor, learner_mean: th.Tensor, std: th.Tensor, reduction: str = "mean") -> th.Tensor:
    """
    KL(mu || pi) of two diagonal Gaussians with one std. Tanh is a bijection, so the KL is the same before and after tanh.

    :param guider_mean: the guider's mean before tanh, shape (\\*E, A)
    :param learner_mean: the learner's mean before tanh, shape (\\*E, A)
    :param std: standard deviation of both policies, shape (\\*E, A); detached by the caller, since the KL must not move the
        std
    :param reduction: reduction over action dimensions, "sum" (the definition) or "mean"
    :return: KL, in nats, shape (\\*E)
    """
    return _reduced(0.5 * ((guider_mean - learner_mean) / std).square(), reduction)


def _reduced(per_dimension: th.Tensor, reduction: str) -> th.Tensor:
    return per_dimension.mean(dim=-1) if reduction == "mean" else per_dimension.sum(dim=-1)


def project_to_kl_ball(offset: th.Tensor, max_kl: float, reduction: str = "mean") -> th.Tensor:
    """
    Shrink a mean offset, in units of the shared std, until its KL = 1/2 \\|\\|offset\\|\\|^2 is at most ``max_kl``.

    Differentiable trust region projection (arXiv 2101.09207) for the mean of a Gaussian with a shared std.

    :param offset: (guider mean - learner mean) / std, shape (\\*E, A)
    :param max_kl: largest KL, reduced over action dimensions as ``reduction`` says
    :param reduction: reduction over action dimensions, "mean" or "sum"
    :return: offset inside the ball, shape (\\*E, A)
    """
    summed_bound = max_kl * (offset.shape[-1] if reduction == "mean" else 1)
    norm = offset.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    return offset * (math.sqrt(2 * summed_bound) / norm).clamp(max=1.0)
