"""COSIL: Soft Actor-Critic with a penalty on the KL to a frozen teacher in place of the entropy term."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs
from typing_extensions import Unpack

from sb3_gac.base.arguments import OffPolicyArguments
from sb3_gac.base.batch import Batch, Loss, Metrics, Outputs
from sb3_gac.base.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.roles import Roles
from sb3_gac.checks.arguments import ArgumentCheck, unless
from sb3_gac.checks.values import check_not_negative, check_positive
from sb3_gac.math.distributions import Distribution
from sb3_gac.math.losses import masked_mean, policy_loss
from sb3_gac.networks.actors import Actor
from sb3_gac.networks.critics import CriticEnsemble
from sb3_gac.networks.heads import resolve_target_divergence
from sb3_gac.optim.coefficients import Coefficient, make_coefficient

TEACHER_COEF_START = 1.0


class COSILPolicy(AsymmetricPolicy):
    """
    A student and its critics, all on ``partial`` unless ``role_keys`` gives the critics more. Arguments are those of
    :class:`AsymmetricPolicy`.
    """

    roles = Roles("actor", critics=("critic",), unprivileged=("critic",))
    actor: Actor
    critic: CriticEnsemble
    critic_target: CriticEnsemble


class COSILGruPolicy(COSILPolicy):
    """The policy of :class:`COSILPolicy` with a GRU in each network."""

    default_rnn_type = "gru"


class COSILLstmPolicy(COSILPolicy):
    """The policy of :class:`COSILPolicy` with an LSTM in each network."""

    default_rnn_type = "lstm"


class COSIL(AsymmetricOffPolicyAlgorithm):
    """
    A student earns reward and stays near to a teacher that sees everything; a dual variable holds the distance between them
    (Nguyen et al. 2022, arXiv 2211.01991).

    The objective is E sum gamma^t (r - teacher_coef D), where D is KL(student || teacher), summed over action dimensions, of
    their action distributions in the same step. There is no entropy term: ``ent_coef`` and ``target_entropy`` are refused.
    By default the critics read the student's entries. With ``n_steps`` above 1 the D of the steps in between is left out, as
    SAC leaves out their entropies.

    Arguments that are not described here are those of :class:`AsymmetricOffPolicyAlgorithm`.

    :param teacher: model that was trained on the full observation, or the path of a saved one; the teacher is never trained.
        ``None`` serves to load a student that is not trained further
    :param target_divergence: mean D that a learned ``teacher_coef`` holds the student to, in nats: a number >= 0, or "auto",
        which :func:`sb3_gac.networks.heads.resolve_target_divergence` describes
    :param teacher_coef: weight of D: "auto" (learned; rises while D is above its target), "auto_<start value>" or a number
    :param teacher_coef_bounds: smallest and largest value of a learned ``teacher_coef``
    :param teacher_coef_learning_rate: Adam's step size for a learned ``teacher_coef``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": COSILPolicy,
        "MultiInputGruPolicy": COSILGruPolicy,
        "MultiInputLstmPolicy": COSILLstmPolicy,
    }
    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = {
        "target_divergence": unless("auto", check_not_negative, remedy='or "auto"'),
        "teacher_coef_learning_rate": check_positive,
    }
    frozen_arguments = ("teacher",)
    restored_arguments = (
        *AsymmetricOffPolicyAlgorithm.restored_arguments,
        "teacher_coef",
        "teacher_coef_bounds",
        "teacher_coef_learning_rate",
    )
    compiled_settings = (*AsymmetricOffPolicyAlgorithm.compiled_settings, "target_divergence")
    policy: COSILPolicy

    def __init__(
        self,
        policy: str | type[COSILPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        teacher: str | Path | BaseAlgorithm | None = None,
        target_divergence: str | float = "auto",
        teacher_coef: str | float = "auto",
        teacher_coef_bounds: tuple[float, float] = (1e-4, 100.0),
        teacher_coef_learning_rate: float = 1e-3,
        **shared: Unpack[OffPolicyArguments],
    ):
        self.teacher = teacher
        self.target_divergence = target_divergence
        self.teacher_coef = teacher_coef
        self.teacher_coef_bounds = teacher_coef_bounds
        self.teacher_coef_learning_rate = teacher_coef_learning_rate
        super().__init__(policy, env, *sb3, **shared)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        self.target_divergence = resolve_target_divergence(self.target_divergence, self.action_space)

    def make_coefficients(self) -> dict[str, Coefficient]:
        """The weight of D; there is no entropy temperature."""
        spec, rate = self.teacher_coef, self.teacher_coef_learning_rate
        weight = make_coefficient("teacher_coef", spec, TEACHER_COEF_START, self.teacher_coef_bounds, rate, self.device)
        return {"teacher_coef": weight}

    def update(self, batch: Batch) -> Metrics:
        """One gradient step: the critics, the student, and the weight of D."""
        weight = self.coefficients["teacher_coef"]
        alpha = weight.value
        noise = th.randn((2, *batch.actions.shape), device=self.device)
        (student,) = self.outputs(batch, "actor")
        metrics = self.minimize("critic", self.critic_loss, batch, student, noise[0], alpha)
        metrics |= self.minimize("actor", self.actor_loss, batch, student, noise[1], alpha)
        metrics |= weight.update(metrics["divergence"] - float(self.target_divergence))
        return metrics | self.coefficient_values() | {"teacher_coef_on_bound": weight.at_bound()}

    def critic_loss(self, batch: Batch, student: Outputs, noise: th.Tensor, alpha: th.Tensor) -> Loss:
        """The critics fit r + gamma (1 - done) (min Q_bar - alpha D), with Q_bar and D at the next observation."""
        with th.no_grad():
            next_q, _ = student.later.value_and_log_prob(batch.q_at_next_obs(self.policy.critic_target), noise)
            divergence = self.divergence(student.later, batch.next_observations)
            target = batch.soft_target(next_q, next_kl=divergence, kl_coef=alpha)
        return self.bellman_loss("critic", batch, target)

    def actor_loss(self, batch: Batch, student: Outputs, noise: th.Tensor, alpha: th.Tensor) -> Loss:
        """The student minimises alpha D - min Q."""
        now = student.now
        q, _ = now.value_and_log_prob(batch.q_at_obs(self.policy.critic), noise)
        divergence = self.divergence(now, batch.observations)
        seen = {f"actor_{name}": masked_mean(values, batch.mask) for name, values in now.diagnostics().items()}
        loss = policy_loss(q=q, kl=divergence, kl_coef=alpha, mask=batch.mask)
        return Loss(loss, {"divergence": masked_mean(divergence, batch.mask), **seen})

    def divergence(self, student: Distribution, observations: PyTorchObs) -> th.Tensor:
        r"""
        :param student: action distributions of the student, shapes (\*E, A)
        :param observations: full observations of the same steps, (\*E, ...) of each entry
        :return: D = KL(student || teacher), in nats, shape (\*E)
        """
        return student.kl(self.frozen["teacher"](observations))
