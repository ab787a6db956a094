"""Tanh-squashed diagonal Gaussians: sampling, log-probability, and the KL divergence of two that share a std."""

import math
from typing import NamedTuple

import torch as th
import torch.nn.functional as F

KL_REDUCTIONS = ("mean", "sum")
_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


class TanhGaussian(NamedTuple):
    """
    tanh(N(mean, exp(log_std)^2)), independent per action dimension.

    :param mean: mean before tanh, shape (\\*E, A)
    :param log_std: log standard deviation before tanh, shape (\\*E, A)
    """

    mean: th.Tensor
    log_std: th.Tensor

    @property
    def mode(self) -> th.Tensor:
        """Deterministic action in [-1, 1], shape (\\*E, A)."""
        return th.tanh(self.mean)

    def detach(self) -> "TanhGaussian":
        """The same distribution as a constant."""
        return TanhGaussian(self.mean.detach(), self.log_std.detach())

    def sample(self) -> th.Tensor:
        """Reparameterised action in [-1, 1], shape (\\*E, A)."""
        return th.tanh(self._pre_tanh(th.randn_like(self.mean)))

    def sample_with_log_prob(self, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Reparameterised action and its log-probability.

        :param noise: standard normal, shape (\\*E, A)
        :return: action in [-1, 1], shape (\\*E, A), and log-probability, shape (\\*E)
        """
        pre_tanh = self._pre_tanh(noise)
        return th.tanh(pre_tanh), self._log_prob(pre_tanh, noise)

    def log_prob(self, pre_tanh: th.Tensor) -> th.Tensor:
        """
        Log-density of the action tanh(pre_tanh).

        :param pre_tanh: action before tanh, shape (\\*E, A)
        :return: shape (\\*E)
        """
        return self._log_prob(pre_tanh, (pre_tanh - self.mean) * th.exp(-self.log_std))

    def _pre_tanh(self, noise: th.Tensor) -> th.Tensor:
        return th.addcmul(self.mean, self.log_std.exp(), noise)

    def _log_prob(self, pre_tanh: th.Tensor, standardised: th.Tensor) -> th.Tensor:
        """
        log N(x; mean, std) - log(1 - tanh(x)^2), summed over dimensions, the constants once at the end; with
        log(1 - tanh(x)^2) = 2 (log 2 - x - log(1 + exp(-2 x))), which does not cancel for large |x|.
        """
        log_cosh = pre_tanh + F.softplus(pre_tanh * -2.0)  # but for a constant
        summed = th.addcmul(th.sub(log_cosh, self.log_std, alpha=0.5), standardised, standardised, value=-0.25).sum(dim=-1)
        return 2.0 * summed - pre_tanh.shape[-1] * (_LOG_SQRT_2PI + 2.0 * math.log(2.0))


def kl_shared_std(guider_mean: th.Tensor, learner_mean: th.Tensor, std: th.Tensor, reduction: str = "mean") -> th.Tensor:
    """
    KL(mu || pi) of two diagonal Gaussians with one std; tanh is a bijection, so it is also the KL after it.

    :param guider_mean: shape (\\*E, A)
    :param learner_mean: shape (\\*E, A)
    :param std: shape (\\*E, A); detach it, the KL must not move the std
    :param reduction: over action dimensions, "sum" (the definition) or "mean"
    :return: shape (\\*E)
    """
    per_dimension = 0.5 * ((guider_mean - learner_mean) / std).square()
    return per_dimension.mean(dim=-1) if reduction == "mean" else per_dimension.sum(dim=-1)


def project_to_kl_ball(offset: th.Tensor, max_kl: float, reduction: str = "mean") -> th.Tensor:
    """
    Shrink a mean offset, in units of the shared std, until its KL = 1/2 \\|\\|offset\\|\\|^2 is at most ``max_kl``.

    Differentiable trust region projection (arXiv 2101.09207) for the mean of a Gaussian with a shared std.

    :param offset: (guider mean - learner mean) / std, shape (\\*E, A)
    :param max_kl: radius of the ball, reduced like the KL it bounds
    :param reduction: "mean" or "sum" over action dimensions
    :return: shape (\\*E, A)
    """
    summed_bound = max_kl * (offset.shape[-1] if reduction == "mean" else 1)
    norm = offset.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    return offset * (math.sqrt(2 * summed_bound) / norm).clamp(max=1.0)
