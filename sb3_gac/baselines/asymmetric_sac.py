"""Soft Actor-Critic whose critics see more than its actor: SAC-asym, and with other keys SAC on either view."""

from typing import ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_gac.base.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.roles import Roles
from sb3_gac.base.update import Batch, Loss, Metrics, Outputs
from sb3_gac.math.losses import masked_mean, policy_loss
from sb3_gac.networks.actors import Actor
from sb3_gac.networks.critics import CriticEnsemble


class AsymmetricSACPolicy(AsymmetricPolicy):
    """An actor and twin critics, each on the entries of its role. Arguments are those of :class:`AsymmetricPolicy`."""

    roles = Roles("actor", critics=("critic",))
    actor: Actor
    critic: CriticEnsemble
    critic_target: CriticEnsemble


class AsymmetricSACGruPolicy(AsymmetricSACPolicy):
    """Both networks with a GRU each."""

    default_rnn_type = "gru"


class AsymmetricSACLstmPolicy(AsymmetricSACPolicy):
    """Both networks with an LSTM each."""

    default_rnn_type = "lstm"


class AsymmetricSAC(AsymmetricOffPolicyAlgorithm):
    """
    SAC with an actor on ``partial`` and critics on every entry (Pinto et al. 2018, arXiv 1710.06542, with SAC's losses).

    ``role_keys={"critic": ["partial"]}`` makes it SAC on the partial view, ``role_keys={"actor": ["partial",
    "privileged"]}`` SAC on the full state. Arguments are those of :class:`AsymmetricOffPolicyAlgorithm`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": AsymmetricSACPolicy,
        "MultiInputGruPolicy": AsymmetricSACGruPolicy,
        "MultiInputLstmPolicy": AsymmetricSACLstmPolicy,
    }
    policy: AsymmetricSACPolicy
    compiled_settings = (*AsymmetricOffPolicyAlgorithm.compiled_settings, "target_entropy")

    def update(self, batch: Batch) -> Metrics:
        """SAC's; its critics are eq. 15's with the entropy term, its actor eq. 16's without a guider."""
        beta = self.coefficients["ent_coef"].value
        noise = th.randn((2, *batch.actions.shape), device=self.device)
        (actor,) = self.outputs(batch, "actor")
        metrics = self.minimize("critic", self.critic_loss, batch, actor, noise[0], beta)
        metrics |= self.minimize("actor", self.actor_loss, batch, actor, noise[1], beta)
        metrics |= self.coefficients["ent_coef"].update(float(self.target_entropy) - metrics["entropy"])
        return metrics | self.coefficient_values()

    def critic_loss(self, batch: Batch, actor: Outputs, noise: th.Tensor, beta: th.Tensor) -> Loss:
        """The actor's return, with its entropy."""
        with th.no_grad():
            next_q, log_prob = actor.later.value_and_log_prob(batch.q_at_next_obs(self.policy.critic_target), noise)
            target = batch.soft_target(next_q, next_log_prob=log_prob, ent_coef=beta)
        return self.bellman_loss("critic", batch, target)

    def actor_loss(self, batch: Batch, actor: Outputs, noise: th.Tensor, beta: th.Tensor) -> Loss:
        """Climb the critics, with entropy."""
        now = self.now("actor", actor, batch)
        q, log_prob = now.value_and_log_prob(batch.q_at_obs(self.policy.critic), noise)
        seen = {f"actor_{name}": masked_mean(values, batch.mask) for name, values in now.diagnostics().items()}
        loss = policy_loss(q=q, log_prob=log_prob, ent_coef=beta, mask=batch.mask)
        return Loss(loss, {"entropy": -masked_mean(log_prob, batch.mask), **seen})
