"""Teacher-Guided RL: an actor imitates a frozen teacher for as long as the imitation raises its return."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from typing_extensions import Unpack

from sb3_gac.base.arguments import OffPolicyArguments
from sb3_gac.base.batch import Batch, Loss, Metrics, Outputs
from sb3_gac.base.comparing import ReturnComparison
from sb3_gac.base.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.roles import Roles
from sb3_gac.checks.arguments import ArgumentCheck
from sb3_gac.checks.values import check_integer, check_not_negative
from sb3_gac.math.losses import masked_mean, policy_loss
from sb3_gac.networks.actors import Actor
from sb3_gac.networks.critics import CriticEnsemble
from sb3_gac.optim.coefficients import AdditiveCoefficient, Coefficient


class TGRLPolicy(AsymmetricPolicy):
    """
    A main and an auxiliary actor on ``partial``, critics of the reward, and critics of the KL to the teacher. ``predict`` is
    the main actor's. Arguments are those of :class:`AsymmetricPolicy`.
    """

    roles = Roles("actor", ("auxiliary",), ("reward_critic", "teacher_critic"), unprivileged=("auxiliary",))
    actor: Actor
    auxiliary: Actor
    reward_critic: CriticEnsemble
    reward_critic_target: CriticEnsemble
    teacher_critic: CriticEnsemble
    teacher_critic_target: CriticEnsemble

    @property
    def critic(self) -> CriticEnsemble:
        """SB3's name for the critics of the reward."""
        return self.reward_critic

    @property
    def critic_target(self) -> CriticEnsemble:
        """Target network of :attr:`critic`."""
        return self.reward_critic_target


class TGRLGruPolicy(TGRLPolicy):
    """The policy of :class:`TGRLPolicy` with a GRU in each network."""

    default_rnn_type = "gru"


class TGRLLstmPolicy(TGRLPolicy):
    """The policy of :class:`TGRLPolicy` with an LSTM in each network."""

    default_rnn_type = "lstm"


class TGRL(ReturnComparison, AsymmetricOffPolicyAlgorithm):  # type: ignore[override]
    """
    A main actor earns reward and stays near to a teacher that sees everything; an auxiliary actor earns reward alone. The
    teacher's weight rises while the main actor's episodes return more, and falls while they return less (Shenfeld et al. 2023,
    arXiv 2307.03186).

    Arguments that are not described here are those of :class:`AsymmetricOffPolicyAlgorithm`.

    :param teacher: model that was trained on the full observation, or the path of a saved one; the teacher is never trained.
        ``None`` serves to load a student that is not trained further
    :param teacher_coef: weight c of the teacher at the start
    :param coef_step: step by which c rises or falls at each comparison
    :param compare_every: environment steps between two comparisons of the actors' returns
    :param window: number of each actor's latest episodes that are compared
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": TGRLPolicy,
        "MultiInputGruPolicy": TGRLGruPolicy,
        "MultiInputLstmPolicy": TGRLLstmPolicy,
    }
    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = {
        "teacher_coef": check_not_negative,
        "coef_step": check_not_negative,
        "compare_every": partial(check_integer, low=1),
        "window": partial(check_integer, low=1),
    }
    frozen_arguments = ("teacher",)
    restored_arguments = (*AsymmetricOffPolicyAlgorithm.restored_arguments, "teacher_coef")
    compiled_settings = (*AsymmetricOffPolicyAlgorithm.compiled_settings, "target_entropy")
    policy: TGRLPolicy

    def __init__(
        self,
        policy: str | type[TGRLPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        teacher: str | Path | BaseAlgorithm | None = None,
        teacher_coef: float = 1.0,
        coef_step: float = 0.01,
        compare_every: int = 1_000,
        window: int = 20,
        **shared: Unpack[OffPolicyArguments],
    ):
        self.teacher = teacher
        self.teacher_coef, self.coef_step = teacher_coef, coef_step
        self.start_comparing("actor", "auxiliary", compare_every, window)
        super().__init__(policy, env, *sb3, **shared)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.recording is not None:
            raise ValueError("TGRL compares its actors' episodes, but no actor acts on a recording: leave recording out.")
        if self.n_steps != 1:
            raise ValueError(f"n_steps must be 1 for TGRL, which needs the KL of every step, got {self.n_steps}.")
        if self.behaviour is not None and self.coef_step:
            self.warn_of_idle_policies("The teacher's weight", self._make_behaviour())

    def make_coefficients(self) -> dict[str, Coefficient]:
        """The entropy temperature and the weight of the teacher."""
        teacher_coef = AdditiveCoefficient(self.teacher_coef, self.coef_step, (0.0, 1e4), self.device)
        return super().make_coefficients() | {"teacher_coef": teacher_coef}

    def take_effect(self, changed: set[str]) -> None:
        """See :meth:`AsymmetricAlgorithm.take_effect`; here is the size of the steps of the teacher's weight."""
        super().take_effect(changed)
        self.coefficients["teacher_coef"].step = self.coef_step  # type: ignore[union-attr]

    # --- algorithm ----------------------------------------------------------------------------------------------------

    def update(self, batch: Batch) -> Metrics:
        """
        One gradient step: the critics, then the actors. The teacher's weight changes outside of gradient steps, see
        :meth:`compare`.
        """
        beta, c = self.coefficients["ent_coef"].value, self.coefficients["teacher_coef"].value
        noise = th.randn((4, *batch.actions.shape), device=self.device)
        actor, auxiliary = self.outputs(batch, "actor", "auxiliary")
        metrics = self.minimize("reward_critic", self.reward_critic_loss, batch, actor, noise[0], beta)
        metrics |= self.minimize("teacher_critic", self.teacher_critic_loss, batch, actor, noise[1])
        metrics |= self.minimize("actor", self.actor_loss, batch, actor, noise[2], beta, c)
        metrics |= self.minimize("auxiliary", self.auxiliary_loss, batch, auxiliary, noise[3], beta)
        metrics |= self.coefficients["ent_coef"].update(float(self.target_entropy) - metrics["entropy"])
        return metrics | self.coefficient_values()

    def reward_critic_loss(self, batch: Batch, actor: Outputs, noise: th.Tensor, beta: th.Tensor) -> Loss:
        """Q_R fits the main actor's return and entropy; both actors climb it."""
        with th.no_grad():
            next_q, log_prob = actor.later.value_and_log_prob(batch.q_at_next_obs(self.policy.reward_critic_target), noise)
            target = batch.soft_target(next_q, next_log_prob=log_prob, ent_coef=beta)
        return self.bellman_loss("reward_critic", batch, target)

    def teacher_critic_loss(self, batch: Batch, actor: Outputs, noise: th.Tensor) -> Loss:
        """Q_I fits the discounted sum of -KL(actor || teacher) from the next observation on, without reward."""
        with th.no_grad():
            next_q, _ = actor.later.value_and_log_prob(batch.q_at_next_obs(self.policy.teacher_critic_target), noise)
            kl = actor.later.kl(self.frozen["teacher"](batch.next_observations))
            target = batch.soft_target(next_q, reward=th.zeros_like(batch.rewards), next_kl=kl, kl_coef=1.0)
        return self.bellman_loss("teacher_critic", batch, target)

    def actor_loss(self, batch: Batch, actor: Outputs, noise: th.Tensor, beta: th.Tensor, c: th.Tensor) -> Loss:
        """The main actor minimises beta log pi - min Q_R + c (KL - min Q_I)."""
        now = actor.now
        q, log_prob = now.value_and_log_prob(batch.q_at_obs(self.policy.reward_critic), noise)
        q_teacher, _ = now.value_and_log_prob(batch.q_at_obs(self.policy.teacher_critic), noise)
        kl = now.kl(self.frozen["teacher"](batch.observations))
        loss = policy_loss(q=q, log_prob=log_prob, ent_coef=beta, mask=batch.mask)
        imitation = policy_loss(q=q_teacher, kl=kl, kl_coef=1.0, mask=batch.mask)
        seen = {"entropy": -masked_mean(log_prob, batch.mask), "kl_to_teacher": masked_mean(kl, batch.mask)}
        return Loss(loss + c * imitation, seen)

    def auxiliary_loss(self, batch: Batch, auxiliary: Outputs, noise: th.Tensor, beta: th.Tensor) -> Loss:
        """The auxiliary actor minimises beta log pi_R - min Q_R."""
        q, log_prob = auxiliary.now.value_and_log_prob(batch.q_at_obs(self.policy.reward_critic), noise)
        return Loss(policy_loss(q=q, log_prob=log_prob, ent_coef=beta, mask=batch.mask), {})

    # --- collecting ---------------------------------------------------------------------------------------------------

    def choose_acting(self, episode_start: np.ndarray) -> list[str]:
        """In each environment, main and auxiliary actor alternate by episode, unless ``behaviour`` says otherwise."""
        if self.behaviour is not None:
            return super().choose_acting(episode_start)
        other = {"actor": "auxiliary", "auxiliary": "actor"}
        # A frozen policy may act until here, where it had a share in ``behaviour`` before
        return [other.get(role, "actor") if starts else role for role, starts in zip(self.acting, episode_start, strict=True)]

    def compare(self, difference: float) -> None:
        """
        Move the teacher's weight by a step: up if the main actor's latest episodes returned more, down if they returned less.

        :param difference: mean return of the main actor's latest episodes, less that of the auxiliary actor's
        """
        self.coefficients["teacher_coef"].move(np.sign(difference))  # type: ignore[union-attr]
        self.logger.record("rollout/main_minus_auxiliary", difference)
