"""Guided Actor-Critic: its arguments, Algorithm 1, and the loss of each network."""

from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from typing_extensions import Unpack

from sb3_gac.base.arguments import OffPolicyArguments
from sb3_gac.base.batch import Batch, Loss, Metrics, Outputs
from sb3_gac.base.guider import GuiderPrediction
from sb3_gac.base.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.base.signs import GuidanceSigns
from sb3_gac.checks.arguments import ArgumentCheck, PlainSchedule, check_switch, unless
from sb3_gac.checks.values import check_choice, check_not_negative, check_positive, check_schedule
from sb3_gac.gac.actors import GUIDERS
from sb3_gac.gac.policies import SHARED_STDS, ActionDistributions, GACGruPolicy, GACLstmPolicy, GACPolicy, MultiInputPolicy
from sb3_gac.gac.remedies import REMEDIES
from sb3_gac.math.distributions import KL_REDUCTIONS
from sb3_gac.math.losses import masked_mean, masked_quantile, policy_loss
from sb3_gac.optim.coefficients import Coefficient, make_coefficient
from sb3_gac.schedules import as_schedule

KL_COEF_START = 1.0
#: Start and bounds of the target with target_kl="auto", and the factor that it rises or falls by at a comparison
AUTO_TARGET_KL, AUTO_TARGET_KL_BOUNDS, AUTO_TARGET_KL_FACTOR = 0.0033, (1e-4, 0.05), 1.1
#: Environment steps between two comparisons of the policies' returns, and number of episodes of each policy that count
COMPARE_EVERY, COMPARED_EPISODES = 1_000, 20


class GAC(GuidanceSigns, GuiderPrediction, AsymmetricOffPolicyAlgorithm):  # type: ignore[override]
    """
    Guided Actor-Critic: a guider that sees everything collects the data, and a learner that sees ``partial`` alone learns from
    these data with critics of its own. A KL constraint keeps the two policies close. ``predict`` is the learner's.

    In each gradient step the guider and the learner fit their critics (eqs. 12, 15) and climb them (eqs. 13, 16); then the
    entropy temperature beta and the weight alpha of the KL take a step each.

    All arguments that are not described here are those of :class:`AsymmetricOffPolicyAlgorithm`, most of them SAC's.

    :param target_kl: bound on KL(guider || learner), reduced as ``kl_reduction`` says: a number, a schedule (a function, or a
        text that :mod:`sb3_gac.schedules` describes), or "auto", which adapts the bound to the returns of both policies'
        episodes, see :meth:`compare`; ``behaviour`` must then give each policy a share of the episodes
    :param kl_coef: weight alpha of the KL: "auto" (learned, eq. 17), "auto_<start value>" or a number
    :param kl_coef_bounds: smallest and largest value of a learned ``kl_coef``
    :param kl_coef_learning_rate: Adam's step size for a learned ``kl_coef``
    :param kl_reduction: reduction of the KL over action dimensions, "mean" or "sum"
    :param guider: kind of guider: "residual", the learner plus a privileged correction; "lagged", the learner's Polyak average
        plus a privileged correction; "independent", a network of its own (the paper's)
    :param max_kl: hard bound on the KL in every state, held by projecting the guider's mean; ``None`` for none
    :param shared_std: policy whose standard deviation both policies have, "learner" or "guider"; the other policy borrows it
        as a constant. "auto" is "learner" if the guider is relative to the learner and the learner has an entropy term, else
        "guider", the paper's
    :param learner_kl_scale: weight of the KL in the learner's objective (eq. 16), as a multiple of ``kl_coef``; "auto" is 0
        with a residual guider, whose KL does not depend on the learner, so that a pull towards it closes no gap; with other
        guiders "auto" is 1, the paper's
    :param guidance: weight of a KL term of the learner's objective that does not depend on ``kl_coef``, in units of the mean
        |Q| of the critics that the learner climbs, as TD3+BC weighs imitation; a number or a schedule. Where the guider is far
        from the learner, ``kl_coef`` is small, and this term still pulls as hard as elsewhere
    :param learner_entropy: whether the learner's objective and critics have SAC's entropy term; False for eqs. 15 and 16 as
        printed, where nothing but the KL keeps the learner's mean from growing
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": MultiInputPolicy,
        "MultiInputGruPolicy": GACGruPolicy,
        "MultiInputLstmPolicy": GACLstmPolicy,
    }

    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = {
        "target_kl": unless("auto", check_schedule, remedy='for example the default 0.0033, a schedule of such, or "auto"'),
        "kl_coef_learning_rate": check_positive,
        "kl_reduction": partial(check_choice, choices=KL_REDUCTIONS),
        "guider": partial(check_choice, choices=GUIDERS),
        "max_kl": unless(None, check_positive, remedy="or None for no hard bound"),
        "shared_std": partial(check_choice, choices=("auto", *SHARED_STDS)),
        "learner_kl_scale": unless("auto", check_not_negative, remedy='or "auto"'),
        "guidance": partial(check_schedule, may_be_zero=True),
        "learner_entropy": check_switch,
    }
    renamed_arguments: ClassVar[Mapping[str, str]] = {"std_of": "shared_std"}
    policy_arguments = (*AsymmetricOffPolicyAlgorithm.policy_arguments, "shared_std")
    remedies = REMEDIES
    compiled_settings = (
        *AsymmetricOffPolicyAlgorithm.compiled_settings,
        "kl_reduction",
        "learner_kl_weight",
        "is_guided",
        "learner_entropy",
        "target_entropy",
    )
    restored_arguments = (
        *AsymmetricOffPolicyAlgorithm.restored_arguments,
        "kl_coef",
        "kl_coef_bounds",
        "kl_coef_learning_rate",
    )

    policy: GACPolicy

    def __init__(
        self,
        policy: str | type[GACPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        target_kl: float | str | Schedule = 0.0033,
        kl_coef: str | float = "auto",
        kl_coef_bounds: tuple[float, float] = (1e-4, 100.0),
        kl_coef_learning_rate: float = 3e-3,
        kl_reduction: str = "mean",
        guider: str = "residual",
        max_kl: float | None = None,
        shared_std: str = "auto",
        learner_kl_scale: str | float = "auto",
        guidance: float | str | Schedule = 0.0,
        learner_entropy: bool = True,
        **shared: Unpack[OffPolicyArguments],
    ):
        self.target_kl = target_kl
        self.kl_coef = kl_coef
        self.kl_coef_bounds = kl_coef_bounds
        self.kl_coef_learning_rate = kl_coef_learning_rate
        self.kl_reduction = kl_reduction
        self.guider = guider
        self.max_kl = max_kl
        self.shared_std = shared_std
        self.learner_kl_scale = learner_kl_scale
        self.guidance = guidance
        self.auto_target_kl = AUTO_TARGET_KL
        self.start_comparing("guider", "learner", COMPARE_EVERY, COMPARED_EPISODES)
        self.learner_entropy = learner_entropy
        super().__init__(policy, env, *sb3, **shared)

    # --- set-up -----------------------------------------------------------------------------------------------------

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.shared_std == "learner" and not self._learner_can_train_a_std():
            raise ValueError(
                'shared_std="learner" needs an entropy term in the learner\'s objective, or nothing keeps its std from '
                'falling: leave shared_std "auto", or give GAC or GACShare learner_entropy=True.'
            )
        if self.target_kl == "auto" and (self.recording or self.idle_policies(self._make_behaviour())):
            raise ValueError(
                'target_kl="auto" compares episodes of guider and learner, but one of the two never acts: give each a share, '
                'as in behaviour={"learner": 0.25}, and no recording; or give a number for target_kl.'
            )
        if self.max_kl is not None and not isinstance(self.action_space, spaces.Box):
            raise ValueError("max_kl bounds the KL of Gaussians, which only Box actions have: leave max_kl None.")

    def _learner_can_train_a_std(self) -> bool:
        return self.learner_entropy

    def _policy_options(self) -> dict[str, Any]:
        own = self.guider != "independent" and self._learner_can_train_a_std()
        return super()._policy_options() | {
            "guider": self.guider,
            "max_kl": self.max_kl,
            "kl_reduction": self.kl_reduction,
            "shared_std": self.shared_std if self.shared_std != "auto" else ("learner" if own else "guider"),
        }

    def make_schedules(self) -> None:
        """See :meth:`AsymmetricAlgorithm.make_schedules`; here are those of the target of the KL and of ``guidance``."""
        super().make_schedules()
        self.target_kl_schedule = PlainSchedule(AUTO_TARGET_KL if self.target_kl == "auto" else self.target_kl)
        self.guidance_schedule = PlainSchedule(self.guidance)

    def make_coefficients(self) -> dict[str, Coefficient]:
        """The entropy temperature and the weight of the KL."""
        self.target_kl_tensor, self.guidance_tensor = (th.zeros((), device=self.device) for _ in range(2))
        kl_coef = make_coefficient(
            "kl_coef", self.kl_coef, KL_COEF_START, self.kl_coef_bounds, self.kl_coef_learning_rate, self.device
        )
        return super().make_coefficients() | {"kl_coef": kl_coef}

    # --- the gradient step ------------------------------------------------------------------------------------------

    def update(self, batch: Batch) -> Metrics:
        """
        One gradient step of Algorithm 1; :meth:`train` then moves the target networks.

        In all losses ``guider`` and ``learner`` are the outputs of the two networks for the batch before any parameter was
        changed, alpha is the coefficient of the KL, beta is the entropy temperature, and ``noise`` is standard normal and has
        the actions' shape.

        :param batch: transitions, or sequences of them
        :return: metrics to log under "train/"
        """
        alpha, beta = self.coefficients["kl_coef"].value, self.coefficients["ent_coef"].value
        noise = th.randn((4, *batch.actions.shape), device=self.device)
        pi = self.outputs(batch, "guider", "learner")
        metrics = self.in_branches(
            lambda: (
                self.minimize("guider_critic", self.guider_critic_loss, batch, *pi, noise[0], alpha, beta)  # eq. 12
                | self.minimize("guider", self.guider_loss, batch, *pi, noise[1], alpha, beta)  # eq. 13
            ),
            lambda: (
                self.minimize("learner_critic", self.learner_critic_loss, batch, *pi, noise[2], beta)  # eq. 15
                | self.minimize("learner", self.learner_loss, batch, *pi, noise[3], alpha, beta)  # eq. 16
            ),
        )
        metrics |= self.coefficients["ent_coef"].update(float(self.target_entropy) - metrics["entropy"])
        metrics |= self.coefficients["kl_coef"].update(metrics["kl"] - self.target_kl_tensor)  # eq. 17
        return metrics | self.coefficient_values() | {"kl_coef_on_bound": self.coefficients["kl_coef"].at_bound()}

    # --- the guider -------------------------------------------------------------------------------------------------

    def guider_critic_loss(
        self, batch: Batch, guider: Outputs, learner: Outputs, noise: th.Tensor, alpha: th.Tensor, beta: th.Tensor
    ) -> Loss:
        """Eq. 12: the guided critics fit the guider's return, less alpha times its KL to the learner."""
        with th.no_grad():
            later = self.policy.action_distributions(guider.later, learner.later)
            next_q, log_prob = later.guider.value_and_log_prob(batch.q_at_next_obs(self.policy.guider_critic_target), noise)
            kl = later.guider.kl_of_means(later.learner, self.kl_reduction)
            target = batch.soft_target(next_q, next_log_prob=log_prob, ent_coef=beta, next_kl=kl, kl_coef=alpha)
        return self.bellman_loss("guider_critic", batch, target)

    def guider_loss(
        self, batch: Batch, guider: Outputs, learner: Outputs, noise: th.Tensor, alpha: th.Tensor, beta: th.Tensor
    ) -> Loss:
        """Eq. 13: the guider climbs the guided critics and pays for its KL to the learner, which is a constant here."""
        now = self.policy.action_distributions(guider.now, learner.now.detach())
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
        """Eq. 15: the learner's critics fit the learner's own return."""
        with th.no_grad():
            policy = self.policy.action_distributions(guider.later, learner.later).learner
            next_q, log_prob = policy.value_and_log_prob(batch.q_at_next_obs(self.policy.critic_target), noise)
            target = batch.soft_target(next_q, next_log_prob=log_prob, ent_coef=beta * self.learner_entropy)
        return self.bellman_loss("learner_critic", batch, target)

    def learner_loss(
        self, batch: Batch, guider: Outputs, learner: Outputs, noise: th.Tensor, alpha: th.Tensor, beta: th.Tensor
    ) -> Loss:
        """Eq. 16: the learner climbs its own critics, or the guided critics where it has none of its own."""
        now = self.policy.action_distributions(guider.now.detach(), learner.now)
        q, log_prob = now.learner.value_and_log_prob(batch.q_at_obs(self.policy.critic), noise)
        terms = {"q": q, "log_prob": log_prob, "ent_coef": beta * self.learner_entropy}
        if self.learner_kl_weight or self.is_guided:
            kl = now.guider.detach().kl_of_means(now.learner, self.kl_reduction)
            terms |= {"kl": kl, "kl_coef": self._learner_kl_coef(alpha, q.detach(), batch.mask)}
        return self._with_deployment_losses(policy_loss(**terms, mask=batch.mask), now, batch.mask)

    def _learner_kl_coef(self, alpha: th.Tensor, q: th.Tensor, mask: th.Tensor | None) -> th.Tensor:
        """Weight of the KL: alpha times ``learner_kl_scale``, plus ``guidance`` in units of the critics' mean |Q|."""
        weight = self.learner_kl_weight * alpha
        return weight + self.guidance_tensor * masked_mean(q.amin(dim=0).abs(), mask) if self.is_guided else weight

    def _with_deployment_losses(self, loss: th.Tensor, now: ActionDistributions, mask: th.Tensor | None) -> Loss:
        """
        :param loss: the learner's loss, scalar
        :param now: action distributions at the observations, with the learner's gradient
        :param mask: the batch's mask, shape (T, B), or ``None``
        :return: the loss plus the losses of parameters that serve at deployment only, with the metrics to log
        """
        fits = self.policy.learner.deployment_losses(now.deployed, now.learner, mask)
        seen = {f"learner_{name}": masked_mean(values, mask) for name, values in now.learner.diagnostics().items()}
        return Loss(loss + sum(fits.values()), {"learner_loss": loss, **fits, **seen})

    # --- coefficients -----------------------------------------------------------------------------------------------

    @property
    def current_target_kl(self) -> float:
        """The bound on the KL at the present point of training."""
        return self.auto_target_kl if self.target_kl == "auto" else self.target_kl_schedule(self._current_progress_remaining)

    def compare(self, difference: float) -> None:
        """
        Move the bound of ``target_kl="auto"``, as Teacher-Guided RL moves the weight of its teacher: the guider may go further
        from the learner if its episodes return more than the learner's own, and must come nearer if they return less.

        :param difference: mean return of the guider's latest episodes, less the mean return of the learner's own
        """
        self.logger.record("rollout/guider_minus_learner", difference)
        low, high = AUTO_TARGET_KL_BOUNDS
        moved = self.auto_target_kl * AUTO_TARGET_KL_FACTOR ** float(np.sign(difference))
        self.auto_target_kl = min(max(moved, low), high)

    def training_state(self) -> dict[str, Any]:
        """State of the training that checkpoints keep, see :meth:`ResumableAlgorithm.training_state`."""
        return super().training_state() | {"auto_target_kl": self.auto_target_kl}

    @property
    def learner_kl_weight(self) -> float:
        """Weight of the KL in the learner's objective, as a multiple of ``kl_coef``."""
        return self._auto_learner_kl_weight() if self.learner_kl_scale == "auto" else float(self.learner_kl_scale)

    @property
    def is_guided(self) -> bool:
        """Whether ``guidance`` is a schedule or a number other than 0."""
        return callable(as_schedule(self.guidance)) or float(self.guidance) != 0  # type: ignore[arg-type]

    def _auto_learner_kl_weight(self) -> float:
        return 0.0 if self.guider == "residual" else 1.0

    def refresh_schedules(self) -> None:
        super().refresh_schedules()
        self.target_kl_tensor.fill_(self.current_target_kl)
        self.guidance_tensor.fill_(self.guidance_schedule(self._current_progress_remaining))

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "target_kl_tensor", "guidance_tensor"]
