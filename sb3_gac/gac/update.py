"""One gradient step of Guided Actor-Critic: Algorithm 1."""

import math
from typing import NamedTuple

import torch as th
from stable_baselines3.common.utils import FloatSchedule

from sb3_gac.base.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.base.update import Backward, Batch, Descent, Metrics, Slope, as_leaves, gradient_of
from sb3_gac.gac.policies import ActionDistributions, GACPolicy
from sb3_gac.math.distributions import Distribution
from sb3_gac.math.losses import masked_mean, policy_loss, soft_target
from sb3_gac.optim.coefficients import Coefficient
from sb3_gac.optim.compile import compilable


class StepInputs(NamedTuple):
    """
    What both halves of a gradient step read and neither changes: constants.

    :param batch: of transitions, \\*E = (B,), or of sequences, \\*E = (T, B)
    :param guider: what its network computes on the observations
    :param learner: the same
    :param later: what both networks compute on the next observations
    :param kl_coef: alpha
    :param ent_coef: beta
    """

    batch: Batch
    guider: Distribution
    learner: Distribution
    later: tuple[Distribution, Distribution]
    kl_coef: th.Tensor
    ent_coef: th.Tensor


class GuidedUpdate(AsymmetricOffPolicyAlgorithm):
    """
    Guider and learner each fit their critics (eqs. 12, 15) and then climb them (eqs. 13, 16); then beta and alpha follow.

    The attributes below are set by :class:`sb3_gac.GAC`, where they are described.
    """

    compiled_settings = (
        *AsymmetricOffPolicyAlgorithm.compiled_settings,
        "kl_reduction",
        "learner_pull",
        "learner_entropy",
    )
    policy: GACPolicy
    kl_coef_dual: Coefficient
    kl_reduction: str
    guider: str
    target_kl_schedule: FloatSchedule
    learner_kl_scale: str | float
    learner_entropy: bool

    def _gradient_step(self, batch: Batch, diagnose: bool = True) -> Metrics:
        """The two halves share nothing that either changes, so they may run at once; the targets follow in :meth:`train`."""
        inputs, guider_backward, learner_backward = self._run_policies(batch)
        noise = th.randn((4, *batch.actions.shape), device=self.device)
        (guider_metrics, kl, log_prob), learner_metrics = self._run_halves(
            [
                lambda: self._guider_half(inputs, guider_backward, noise[:2]),
                lambda: self._learner_half(inputs, learner_backward, noise[2:]),
            ]
        )
        metrics = guider_metrics | learner_metrics
        metrics |= self.ent_coef_dual.update(log_prob + float(self.target_entropy), batch.mask)
        metrics |= self.kl_coef_dual.update(kl - self.current_target_kl, batch.mask)
        metrics["kl"] = masked_mean(kl, batch.mask)
        return metrics | self._diagnostics(inputs, kl, log_prob) if diagnose else metrics

    @property
    def current_target_kl(self) -> float:
        """The bound on KL at this point of training."""
        return self.target_kl_schedule(self._current_progress_remaining)

    @property
    def learner_pull(self) -> float:
        """Weight of the KL in the learner's objective, as a multiple of ``kl_coef``."""
        return self._auto_learner_pull() if self.learner_kl_scale == "auto" else float(self.learner_kl_scale)

    def _auto_learner_pull(self) -> float:
        return 0.0 if self.guider == "residual" else 1.0

    def _run_policies(self, batch: Batch) -> tuple[StepInputs, Backward, Backward]:
        """Both forward passes; with the guider's backward pass and the learner's."""
        ((guider, next_guider), guider_backward), ((learner, next_learner), learner_backward) = self._run_halves(
            [lambda: self._policy_pass("guider", batch), lambda: self._policy_pass("learner", batch)]
        )
        coefficients = self.kl_coef_dual.value, self.ent_coef_dual.value
        inputs = StepInputs(batch, guider, learner, (next_guider, next_learner), *coefficients)
        return inputs, guider_backward, learner_backward

    # --- the guider's half ------------------------------------------------------------------------------------------

    def _guider_half(self, inputs: StepInputs, backward: Backward, noise: th.Tensor) -> tuple[Metrics, th.Tensor, th.Tensor]:
        """
        Eqs. 12 and 13.

        :param inputs: of this step
        :param backward: the guider's
        :param noise: standard normal, for the next action and for the present one, shape (2, \\*E, A)
        :return: metrics; KL(guider || learner) and the guider's log-probability, each of shape (\\*E)
        """
        metrics = self._step("guider_critic", self._guider_critic_descent(inputs, noise[0]))
        slope, kl, log_prob = self._guider_slope(inputs, noise[1])
        return metrics | self._policy_step("guider", backward, slope), kl, log_prob

    @compilable
    def _guider_critic_descent(self, inputs: StepInputs, noise: th.Tensor) -> Descent:
        return self._critic_descent("guider_critic", inputs.batch, self._guided_target(inputs, noise))

    @compilable
    def _guider_slope(self, inputs: StepInputs, noise: th.Tensor) -> tuple[Slope, th.Tensor, th.Tensor]:
        """Of eq. 13; with KL(guider || learner) and the guider's log-probability, detached, each of shape (\\*E)."""
        outputs = as_leaves(inputs.guider)
        now = self.policy.combine(outputs, inputs.learner)
        q, log_prob = now.guider.expectation(inputs.batch.values_at(self.policy.guider_critic), noise)
        kl = now.guider.kl_of_means(now.learner, self.kl_reduction)
        loss = policy_loss(
            q=q, log_prob=log_prob, ent_coef=inputs.ent_coef, kl=kl, kl_coef=inputs.kl_coef, mask=inputs.batch.mask
        )
        return Slope(gradient_of(loss, outputs), {"guider_loss": loss.detach()}), kl.detach(), log_prob.detach()

    @th.no_grad()
    def _guided_target(self, inputs: StepInputs, noise: th.Tensor) -> th.Tensor:
        """Eq. 12, shape (\\*E)."""
        batch, later = inputs.batch, self.policy.combine(*inputs.later)
        next_q, log_prob = later.guider.expectation(batch.values_after(self.policy.guider_critic_target), noise)
        next_kl = later.guider.kl_of_means(later.learner, self.kl_reduction)
        return soft_target(
            reward=batch.rewards,
            done=batch.dones,
            next_q=next_q,
            discount=batch.discounts,
            next_log_prob=log_prob,
            ent_coef=inputs.ent_coef,
            next_kl=next_kl,
            kl_coef=inputs.kl_coef,
        )

    # --- the learner's half -----------------------------------------------------------------------------------------

    def _learner_half(self, inputs: StepInputs, backward: Backward, noise: th.Tensor) -> Metrics:
        """
        Eqs. 15 and 16, and the fit of the std for deployment.

        :param inputs: of this step
        :param backward: the learner's
        :param noise: standard normal, for the next action and for the present one, shape (2, \\*E, A)
        :return: metrics
        """
        metrics: Metrics = {}
        if self.policy.learner_critic is not None:
            metrics = self._step("learner_critic", self._learner_critic_descent(inputs, noise[0]))
        return metrics | self._policy_step("learner", backward, self._learner_slope(inputs, noise[1]))

    @compilable
    def _learner_critic_descent(self, inputs: StepInputs, noise: th.Tensor) -> Descent:
        return self._critic_descent("learner_critic", inputs.batch, self._learner_target(inputs, noise))

    @compilable
    def _learner_slope(self, inputs: StepInputs, noise: th.Tensor) -> Slope:
        """Of eq. 16 and of what else the learner is fitted with."""
        outputs = as_leaves(inputs.learner)
        now = self.policy.combine(inputs.guider, outputs)
        loss = self._learner_loss(inputs, now, noise)
        fits = self.policy.learner.deployment_losses(now.deployed, now.learner, inputs.batch.mask)
        losses = {"learner_loss": loss, **fits}
        gradient = gradient_of(loss + sum(fits.values()), outputs)
        return Slope(gradient, {name: value.detach() for name, value in losses.items()})

    @th.no_grad()
    def _learner_target(self, inputs: StepInputs, noise: th.Tensor) -> th.Tensor:
        """Eq. 15, shape (\\*E)."""
        batch = inputs.batch
        learner = self.policy.combine(*inputs.later).learner
        next_q, log_prob = learner.expectation(batch.values_after(self.policy.critic_target), noise)
        return soft_target(
            reward=batch.rewards,
            done=batch.dones,
            next_q=next_q,
            discount=batch.discounts,
            next_log_prob=log_prob,
            ent_coef=self._learner_ent_coef(inputs),
        )

    def _learner_loss(self, inputs: StepInputs, now: ActionDistributions, noise: th.Tensor) -> th.Tensor:
        """
        Eq. 16, with the learner's critics, or the guided ones where it has none.

        :param inputs: of this step
        :param now: the policies on the observations, with the learner's gradients
        :param noise: standard normal, shape (\\*E, A)
        :return: scalar
        """
        q, log_prob = now.learner.expectation(inputs.batch.values_at(self.policy.critic), noise)
        kl: th.Tensor | float = 0.0
        if self.learner_pull:
            kl = self.learner_pull * now.guider.detach().kl_of_means(now.learner, self.kl_reduction)
        ent_coef = self._learner_ent_coef(inputs)
        return policy_loss(q=q, log_prob=log_prob, ent_coef=ent_coef, kl=kl, kl_coef=inputs.kl_coef, mask=inputs.batch.mask)

    def _learner_ent_coef(self, inputs: StepInputs) -> th.Tensor | float:
        return inputs.ent_coef if self.learner_entropy else 0.0

    def _diagnostics(self, inputs: StepInputs, kl: th.Tensor, log_prob: th.Tensor) -> Metrics:
        target, mask = self.current_target_kl, inputs.batch.mask
        counted = kl.flatten() if mask is None else kl[mask > 0]
        learner = self.policy.combine(inputs.guider, inputs.learner).learner
        return {
            "kl_p95": counted.kthvalue(math.ceil(0.95 * counted.numel())).values,
            "kl_above_target": (counted > target).float().mean(),
            "target_kl": kl.new_full((), target),
            "kl_coef": self.kl_coef_dual.value,
            "kl_coef_on_bound": self.kl_coef_dual.on_bound(),
            "ent_coef": self.ent_coef_dual.value,
            "entropy": -masked_mean(log_prob, mask),
            **{f"learner_{name}": masked_mean(values, mask) for name, values in learner.diagnostics().items()},
        }
