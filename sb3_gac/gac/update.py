"""Guided Actor-Critic's gradient step: Algorithm 1, and the loss of each network."""

import torch as th
from stable_baselines3.common.utils import FloatSchedule

from sb3_gac.base.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.base.update import Batch, Loss, Metrics, Outputs, Step
from sb3_gac.gac.policies import ActionDistributions, GACPolicy
from sb3_gac.math.losses import masked_mean, masked_quantile, policy_loss
from sb3_gac.optim.coefficients import Coefficient


class GuidedUpdate(AsymmetricOffPolicyAlgorithm):
    """
    Guider and learner each fit their critics (eqs. 12, 15) and then climb them (eqs. 13, 16); then beta and alpha follow.

    In all losses ``guider`` and ``learner`` are what the two networks computed for the batch before anything was changed,
    alpha is the KL's coefficient, beta the entropy's, and ``noise`` is standard normal, of the actions' shape. The attributes
    below are set by :class:`sb3_gac.GAC`, where they are described.
    """

    compiled_settings = (
        *AsymmetricOffPolicyAlgorithm.compiled_settings,
        "kl_reduction",
        "learner_kl_weight",
        "learner_entropy",
        "target_entropy",
    )
    policy: GACPolicy
    kl_reduction: str
    guider: str
    target_kl_schedule: FloatSchedule
    target_kl_tensor: th.Tensor
    kl_coef_dual: Coefficient
    learner_kl_scale: str | float
    learner_entropy: bool

    def update(self, batch: Batch) -> Metrics:
        """Algorithm 1; the targets follow in :meth:`train`."""
        alpha, beta = self.kl_coef_dual.value, self.ent_coef_dual.value
        noise = th.randn((4, *batch.actions.shape), device=self.device)
        guider, learner = self.outputs(batch, "guider", "learner")
        pi = guider, learner
        metrics = self.side_by_side(
            [
                Step("guider_critic", self.guider_critic_loss, (batch, *pi, noise[0], alpha, beta)),  # eq. 12
                Step("guider", self.guider_loss, (batch, *pi, noise[1], alpha, beta)),  # eq. 13
            ],
            [
                Step("learner_critic", self.learner_critic_loss, (batch, *pi, noise[2], beta)),  # eq. 15
                Step("learner", self.learner_loss, (batch, *pi, noise[3], alpha, beta)),  # eq. 16
            ],
        )
        metrics |= self.ent_coef_dual.update(float(self.target_entropy) - metrics["entropy"])
        metrics |= self.kl_coef_dual.update(metrics["kl"] - self.target_kl_tensor)  # eq. 17
        return metrics | self.coefficient_values() | {"kl_coef_on_bound": self.kl_coef_dual.at_bound()}

    # --- the guider -------------------------------------------------------------------------------------------------

    def guider_critic_loss(
        self, batch: Batch, guider: Outputs, learner: Outputs, noise: th.Tensor, alpha: th.Tensor, beta: th.Tensor
    ) -> Loss:
        """Eq. 12: the guider's return, less what it pays for its distance to the learner."""
        with th.no_grad():
            later = self.policy.action_distributions(guider.later, learner.later)
            next_q, log_prob = later.guider.value_and_log_prob(batch.q_at_next_obs(self.policy.guider_critic_target), noise)
            kl = later.guider.kl_of_means(later.learner, self.kl_reduction)
            target = batch.soft_target(next_q, next_log_prob=log_prob, ent_coef=beta, next_kl=kl, kl_coef=alpha)
        return self.bellman_loss("guider_critic", batch, target)

    def guider_loss(
        self, batch: Batch, guider: Outputs, learner: Outputs, noise: th.Tensor, alpha: th.Tensor, beta: th.Tensor
    ) -> Loss:
        """Eq. 13: climb the guided critics, close to the learner as it is."""
        now = self.policy.action_distributions(self.now("guider", guider, batch), learner.now.detach())
        q, log_prob = now.guider.value_and_log_prob(batch.q_at_obs(self.policy.guider_critic), noise)
        kl = now.guider.kl_of_means(now.learner, self.kl_reduction)
        loss = policy_loss(q=q, log_prob=log_prob, ent_coef=beta, kl=kl, kl_coef=alpha, mask=batch.mask)
        return Loss(loss, self._seen_of_kl(kl.detach(), batch) | {"entropy": -masked_mean(log_prob, batch.mask)})

    def _seen_of_kl(self, kl: th.Tensor, batch: Batch) -> Metrics:
        above = (kl > self.target_kl_tensor).float()
        return {
            "kl": masked_mean(kl, batch.mask),
            "kl_p95": masked_quantile(kl, 0.95, batch.mask),
            "kl_above_target": masked_mean(above, batch.mask),
            "target_kl": self.target_kl_tensor,
        }

    # --- the learner ------------------------------------------------------------------------------------------------

    def learner_critic_loss(self, batch: Batch, guider: Outputs, learner: Outputs, noise: th.Tensor, beta: th.Tensor) -> Loss:
        """Eq. 15: the learner's own return."""
        with th.no_grad():
            policy = self.policy.action_distributions(guider.later, learner.later).learner
            next_q, log_prob = policy.value_and_log_prob(batch.q_at_next_obs(self.policy.critic_target), noise)
            target = batch.soft_target(next_q, next_log_prob=log_prob, ent_coef=beta * self.learner_entropy)
        return self.bellman_loss("learner_critic", batch, target)

    def learner_loss(
        self, batch: Batch, guider: Outputs, learner: Outputs, noise: th.Tensor, alpha: th.Tensor, beta: th.Tensor
    ) -> Loss:
        """Eq. 16, and the fit of what serves at deployment alone."""
        now = self.policy.action_distributions(guider.now.detach(), self.now("learner", learner, batch))
        loss = self.learner_objective(batch, now, noise, alpha, beta)
        fits = self.policy.learner.deployment_losses(now.deployed, now.learner, batch.mask)
        seen = {f"learner_{name}": masked_mean(values, batch.mask) for name, values in now.learner.diagnostics().items()}
        return Loss(loss + sum(fits.values()), {"learner_loss": loss, **fits, **seen})

    def learner_objective(
        self, batch: Batch, now: ActionDistributions, noise: th.Tensor, alpha: th.Tensor, beta: th.Tensor
    ) -> th.Tensor:
        """
        Eq. 16, with the learner's critics, or the guided ones where it has none.

        :param now: the policies at the observations, with the learner's gradient
        :return: scalar
        """
        q, log_prob = now.learner.value_and_log_prob(batch.q_at_obs(self.policy.critic), noise)
        kl = now.guider.detach().kl_of_means(now.learner, self.kl_reduction) if self.learner_kl_weight else 0.0
        weight, ent_coef = self.learner_kl_weight * alpha, beta * self.learner_entropy
        return policy_loss(q=q, log_prob=log_prob, ent_coef=ent_coef, kl=kl, kl_coef=weight, mask=batch.mask)

    # --- coefficients -----------------------------------------------------------------------------------------------

    @property
    def current_target_kl(self) -> float:
        """The bound on KL at this point of training."""
        return self.target_kl_schedule(self._current_progress_remaining)

    @property
    def learner_kl_weight(self) -> float:
        """Weight of the KL in the learner's objective, as a multiple of ``kl_coef``."""
        return self._auto_learner_kl_weight() if self.learner_kl_scale == "auto" else float(self.learner_kl_scale)

    def _auto_learner_kl_weight(self) -> float:
        return 0.0 if self.guider == "residual" else 1.0

    def refresh_schedules(self) -> None:
        super().refresh_schedules()
        self.target_kl_tensor.fill_(self.current_target_kl)
