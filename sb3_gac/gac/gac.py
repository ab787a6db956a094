"""Guided Actor-Critic."""

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
from sb3_gac.base.policy import BehaviourState
from sb3_gac.checks.arguments import ArgumentCheck, PlainSchedule, check_switch, unless
from sb3_gac.checks.entries import check_is_observation
from sb3_gac.checks.values import check_choice, check_not_negative, check_positive, check_schedule
from sb3_gac.gac.actors import GUIDERS
from sb3_gac.gac.policies import SHARED_STDS, GACGruPolicy, GACLstmPolicy, GACPolicy, MultiInputPolicy
from sb3_gac.gac.update import GuidedUpdate
from sb3_gac.math.distributions import KL_REDUCTIONS
from sb3_gac.optim.coefficients import Coefficient, make_coefficient

KL_COEF_START = 1.0


class GAC(GuidedUpdate):
    """
    Guided Actor-Critic: a guider that sees everything collects the data, a learner that sees ``partial`` alone is
    pulled towards it by a KL constraint and by critics of its own. ``predict`` is the learner.

    All arguments that are not described here are those of :class:`AsymmetricOffPolicyAlgorithm`, most of them SAC's.

    :param target_kl: bound on KL(guider || learner), reduced as ``kl_reduction`` says; a number or a schedule
    :param kl_coef: weight alpha of the KL: "auto" (learned, eq. 17), "auto_<start value>" or a number
    :param kl_coef_bounds: smallest and largest value of a learned ``kl_coef``
    :param kl_coef_learning_rate: of a learned ``kl_coef``
    :param kl_reduction: KL over action dimensions: "mean" or "sum"
    :param guider: "residual": learner plus a privileged correction; "independent": a network of its own (the paper's)
    :param max_kl: hard bound on KL for every state, by projecting the guider's mean; ``None`` for none
    :param shared_std: whose standard deviation both policies have, "learner" or "guider"; the other borrows it as a constant.
        "auto" is the guider's, the paper's, unless the guider is residual and the learner has an entropy term
    :param learner_kl_scale: weight of the KL in the learner's objective (eq. 16), as a multiple of ``kl_coef``; "auto"
        is 1, the paper's, with an independent guider and 0 with a residual one, whose KL does not depend on the
        learner: a pull towards it closes no gap, and the learner chases what moves along with it
    :param learner_entropy: SAC's entropy term in the learner's objective and critics; False for eqs. 15 and 16 as printed,
        where nothing but the KL keeps the learner's mean from growing
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": MultiInputPolicy,
        "MultiInputGruPolicy": GACGruPolicy,
        "MultiInputLstmPolicy": GACLstmPolicy,
    }

    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = {
        "target_kl": partial(check_schedule, remedy="for example the default 0.0033, or a schedule of such"),
        "kl_coef_learning_rate": check_positive,
        "kl_reduction": partial(check_choice, choices=KL_REDUCTIONS),
        "guider": partial(check_choice, choices=GUIDERS),
        "max_kl": unless(None, check_positive, remedy="or None for no hard bound"),
        "shared_std": partial(check_choice, choices=("auto", *SHARED_STDS)),
        "learner_kl_scale": unless("auto", check_not_negative, remedy='or "auto"'),
        "learner_entropy": check_switch,
    }
    renamed_arguments: ClassVar[Mapping[str, str]] = {"std_of": "shared_std"}
    restored_arguments = (*GuidedUpdate.restored_arguments, "kl_coef", "kl_coef_bounds", "kl_coef_learning_rate")

    def __init__(
        self,
        policy: str | type[GACPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        target_kl: float | Schedule = 0.0033,
        kl_coef: str | float = "auto",
        kl_coef_bounds: tuple[float, float] = (1e-4, 100.0),
        kl_coef_learning_rate: float = 3e-3,
        kl_reduction: str = "mean",
        guider: str = "residual",
        max_kl: float | None = None,
        shared_std: str = "auto",
        learner_kl_scale: str | float = "auto",
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
        if self.max_kl is not None and not isinstance(self.action_space, spaces.Box):
            raise ValueError("max_kl bounds the KL of Gaussians, that is, of Box actions: leave it None.")

    def _learner_can_train_a_std(self) -> bool:
        return self.learner_entropy

    def _policy_options(self) -> dict[str, Any]:
        own = self.guider == "residual" and self._learner_can_train_a_std()
        return super()._policy_options() | {
            "guider": self.guider,
            "max_kl": self.max_kl,
            "kl_reduction": self.kl_reduction,
            "shared_std": self.shared_std if self.shared_std != "auto" else ("learner" if own else "guider"),
        }

    def make_coefficients(self) -> dict[str, Coefficient]:
        """The entropy temperature, and the weight of the KL."""
        self.target_kl_schedule = PlainSchedule(self.target_kl)
        self.target_kl_tensor = th.zeros((), device=self.device)
        kl_coef = make_coefficient(
            "kl_coef", self.kl_coef, KL_COEF_START, self.kl_coef_bounds, self.kl_coef_learning_rate, self.device
        )
        return super().make_coefficients() | {"kl_coef": kl_coef}

    # --- SB3's contract ---------------------------------------------------------------------------------------------

    def predict_guider(
        self,
        observation: dict[str, np.ndarray],
        state: BehaviourState = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, BehaviourState]:
        """
        The guider's action; needs the full observation. Arguments and result are those of ``predict``.

        :param observation: single or batched
        :param state: what a recurrent guider's last call returned, ``None`` at the start
        :param episode_start: true where an episode starts, shape (B,)
        :param deterministic: mode instead of a sample
        :return: action in the environment's range, and the state for the next call
        :raises ValueError: naming the entry that is missing, does not fit its space, or is not as many as the others
        """
        check_is_observation(observation)
        self.policy.check_seen_by("guider", observation, "predict_guider()")
        self.policy.set_training_mode(False)
        _, vectorized = self.policy.obs_to_tensor(observation)
        scaled_action, after = self.policy.behaviour_action(observation, state, episode_start, deterministic)
        action = self._in_environments_range(scaled_action)
        return (action if vectorized else action.squeeze(axis=0)), after

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "target_kl_tensor"]
