"""Guided Actor-Critic."""

import math
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs, Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_gac.common.checks import check_choice, check_not_negative, check_positive
from sb3_gac.common.distributions import KL_REDUCTIONS, TanhGaussian, kl_shared_std
from sb3_gac.common.dual import Coefficient, make_coefficient
from sb3_gac.common.losses import (
    guided_target,
    guider_loss,
    learner_loss,
    learner_target,
    log_std_loss,
)
from sb3_gac.common.off_policy import AsymmetricOffPolicyAlgorithm, Batch, Metrics
from sb3_gac.common.roles import RoleKeys
from sb3_gac.gac.actors import GUIDERS
from sb3_gac.gac.policies import ActionDistributions, ActorOutputs, GACPolicy, MultiInputPolicy

KL_COEF_START = 1.0


def _on_both(network: th.nn.Module, batch: Batch) -> tuple[ActorOutputs, ActorOutputs]:
    """A policy's outputs on the observations, and, as constants, on the next ones."""
    now = network(batch.observations)
    with th.no_grad():
        return now, network(batch.next_observations)


class GAC(AsymmetricOffPolicyAlgorithm):
    """
    Guided Actor-Critic: a guider that sees everything collects the data, a learner that sees ``partial`` alone is
    pulled towards it by a KL constraint and by critics of its own. ``predict`` is the learner.

    The arguments up to ``target_entropy``, and from ``stats_window_size`` on, are those of SB3's SAC.

    :param policy: "MultiInputPolicy", or a subclass of :class:`GACPolicy`
    :param env: environment with Dict observations and Box actions
    :param learning_rate: of policies, critics and the entropy temperature; a number or a schedule
    :param buffer_size: transitions kept
    :param learning_starts: steps of uniform warm-up
    :param batch_size: transitions per gradient step
    :param tau: Polyak coefficient of the target critics
    :param gamma: discount factor
    :param train_freq: steps, or (n, "step" | "episode"), between two rounds of training
    :param gradient_steps: gradient steps per round; -1 for as many as there were environment steps
    :param action_noise: added to the guider's actions
    :param replay_buffer_class: default :class:`CompactDictReplayBuffer`, which stores each observation once
    :param replay_buffer_kwargs: keyword arguments for it
    :param optimize_memory_usage: of other replay buffers, see SB3
    :param n_steps: rewards summed up in a critic's target before it bootstraps
    :param ent_coef: entropy temperature beta: "auto", "auto_<start value>" or a number
    :param target_update_interval: gradient steps between two updates of the targets
    :param target_entropy: "auto" for -0.5 per action dimension (the paper's), "sac" for -1 per dimension, or a number
    :param target_kl: bound on KL(guider || learner), reduced as ``kl_reduction`` says; a number or a schedule
    :param kl_coef: weight alpha of the KL: "auto" (learned, eq. 17), "auto_<start value>" or a number
    :param kl_coef_bounds: smallest and largest value of a learned ``kl_coef``
    :param kl_coef_learning_rate: of a learned ``kl_coef``
    :param kl_reduction: KL over action dimensions: "mean" or "sum"
    :param guider: "residual": learner plus a privileged correction; "independent": a network of its own (the paper's)
    :param guider_lr_scale: the guider's learning rate as a multiple of ``learning_rate``
    :param max_kl: hard bound on KL for every state, by projecting the guider's mean; ``None`` for none
    :param learner_kl_scale: weight of the KL in the learner's objective (eq. 16), as a multiple of ``kl_coef``; "auto"
        is 1, the paper's, with an independent guider and 0 with a residual one, whose KL does not depend on the
        learner: a pull towards it closes no gap, and the learner chases what moves along with it
    :param learner_entropy: SAC's entropy term in the learner's objective and critics, without which its mean drifts
        into saturation; False for eqs. 15 and 16 as printed
    :param max_grad_norm: bound on the gradient norm of each network; ``None`` for none
    :param role_keys: role -> observation entries, by default ``partial`` for the learner and all for the others
    :param stats_window_size: episodes averaged in rollout statistics
    :param tensorboard_log: log directory, ``None`` for no log
    :param policy_kwargs: keyword arguments of :class:`GACPolicy`
    :param verbose: 0 silent, 1 information, 2 debug
    :param seed: of the pseudo-random generators
    :param device: "auto", "cpu", "cuda", ...
    :param _init_setup_model: build the networks at construction
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": MultiInputPolicy}
    policy: GACPolicy

    def __init__(
        self,
        policy: str | type[GACPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        target_kl: float | Schedule = 0.0033,
        kl_coef: str | float = "auto",
        kl_coef_bounds: tuple[float, float] = (1e-4, 100.0),
        kl_coef_learning_rate: float = 3e-3,
        kl_reduction: str = "mean",
        guider: str = "residual",
        guider_lr_scale: float = 1.0,
        max_kl: float | None = None,
        learner_kl_scale: str | float = "auto",
        learner_entropy: bool = True,
        max_grad_norm: float | None = 1.0,
        role_keys: RoleKeys | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,
            env,
            ent_coef=ent_coef,
            target_entropy=target_entropy,
            target_update_interval=target_update_interval,
            max_grad_norm=max_grad_norm,
            role_keys=role_keys,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
        )
        self.target_kl = target_kl
        self.kl_coef = kl_coef
        self.kl_coef_bounds = kl_coef_bounds
        self.kl_coef_learning_rate = kl_coef_learning_rate
        self.kl_reduction = kl_reduction
        self.guider = guider
        self.guider_lr_scale = guider_lr_scale
        self.max_kl = max_kl
        self.learner_kl_scale = learner_kl_scale
        self.learner_entropy = learner_entropy
        if _init_setup_model:
            self._setup_model()

    # --- set-up -----------------------------------------------------------------------------------------------------

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if not callable(self.target_kl):
            check_positive("target_kl", self.target_kl, remedy="for example the default 0.0033")
        check_positive("kl_coef_learning_rate", self.kl_coef_learning_rate)
        check_positive("guider_lr_scale", self.guider_lr_scale)
        check_choice("kl_reduction", self.kl_reduction, KL_REDUCTIONS)
        check_choice("guider", self.guider, GUIDERS)
        if self.max_kl is not None:
            check_positive("max_kl", self.max_kl, remedy="or None for no hard bound")
        if self.learner_kl_scale == "auto":
            self.learner_kl_scale = 0.0 if self.guider == "residual" else 1.0
        check_not_negative("learner_kl_scale", self.learner_kl_scale, remedy='or "auto"')

    def _policy_options(self) -> dict[str, Any]:
        return super()._policy_options() | {
            "guider": self.guider,
            "guider_lr_scale": self.guider_lr_scale,
            "max_kl": self.max_kl,
            "kl_reduction": self.kl_reduction,
        }

    def _setup_coefficients(self) -> None:
        super()._setup_coefficients()
        self.target_kl_schedule = FloatSchedule(self.target_kl)
        self.kl_coef_dual: Coefficient = make_coefficient(
            "kl_coef", self.kl_coef, KL_COEF_START, self.kl_coef_bounds, self.kl_coef_learning_rate, self.device
        )

    # --- one gradient step (Algorithm 1) ----------------------------------------------------------------------------

    def _gradient_step(self, batch: Batch) -> Metrics:
        """
        Guider and learner each fit their critics (eqs. 12, 15) and then climb them (eqs. 13, 16); then beta and alpha.

        The halves share nothing that either changes, so they may run at once. The targets follow in :meth:`train`.
        """
        now, later = self._run_policies(batch)
        noise = th.randn((4, *now.learner.mean.shape), device=self.device)
        guider_half = partial(self._guider_half, batch, now, later, noise[:2])
        learner_half = partial(self._learner_half, batch, now, later, noise[2:])
        (metrics, kl, log_prob), learner_metrics = self._run_halves([guider_half, learner_half])
        ent_metrics = self.ent_coef_dual.update(log_prob + float(self.target_entropy))
        kl_metrics = self.kl_coef_dual.update(kl - self.current_target_kl)
        metrics |= learner_metrics
        metrics |= {f"ent_coef_{name}": value for name, value in ent_metrics.items() if name == "loss"}
        metrics |= {f"kl_coef_{name}": value for name, value in kl_metrics.items()}
        return metrics | self._policy_diagnostics(now, kl, log_prob)

    @property
    def current_target_kl(self) -> float:
        """The bound on KL at this point of training."""
        return self.target_kl_schedule(self._current_progress_remaining)

    def _run_policies(self, batch: Batch) -> tuple[ActionDistributions, ActionDistributions]:
        """Both policies on the observations, and, as constants, on the next ones."""
        guider, learner = self._run_halves(
            [partial(_on_both, self.policy.guider, batch), partial(_on_both, self.policy.learner, batch)]
        )
        now, later = (self.policy.combine(*outputs) for outputs in zip(guider, learner, strict=True))
        return now, later

    def _guider_half(
        self, batch: Batch, now: ActionDistributions, later: ActionDistributions, noise: th.Tensor
    ) -> tuple[Metrics, th.Tensor, th.Tensor]:
        """
        Eqs. 12 and 13.

        :param batch: B transitions
        :param now: the policies on the observations
        :param later: the policies on the next observations
        :param noise: standard normal, for the next action and for the present one, shape (2, B, A)
        :return: metrics; KL(guider || learner) and the guider's log-probability, detached, each of shape (B,)
        """
        metrics = self._fit_critics("guider_critic", batch, self._guided_target(batch, later, noise[0]))
        action, log_prob = now.guider.sample_with_log_prob(noise[1])
        kl = self._kl(now.guider, now.learner.detach())
        q = self.policy.guider_critic(batch.observations, action)
        loss = guider_loss(kl, log_prob, q, self.kl_coef_dual.value, self.ent_coef_dual.value)
        return metrics | self._descend("guider", loss), kl.detach(), log_prob.detach()

    @th.no_grad()
    def _guided_target(self, batch: Batch, later: ActionDistributions, noise: th.Tensor) -> th.Tensor:
        """Eq. 12, shape (B,)."""
        action, log_prob = later.guider.sample_with_log_prob(noise)
        next_q = self.policy.guider_critic_target(batch.next_observations, action)
        next_kl = self._kl(later.guider, later.learner)
        coefficients = (self.kl_coef_dual.value, self.ent_coef_dual.value)
        return guided_target(batch.rewards, batch.dones, next_q, next_kl, log_prob, *coefficients, batch.discounts)

    def _learner_half(self, batch: Batch, now: ActionDistributions, later: ActionDistributions, noise: th.Tensor) -> Metrics:
        """
        Eqs. 15 and 16, and the fit of the std for deployment. Arguments are those of :meth:`_guider_half`.
        """
        metrics: Metrics = {}
        if self.policy.learner_critic is not None:
            metrics = self._fit_critics("learner_critic", batch, self._learner_target(batch, later, noise[0]))
        loss = self._learner_loss(batch.observations, now, noise[1])
        deployment_loss = log_std_loss(now.deployment_log_std, now.learner.log_std)
        metrics |= self._descend("learner", loss, deployment_loss)
        return metrics | {"log_std_loss": deployment_loss.detach()}

    @th.no_grad()
    def _learner_target(self, batch: Batch, later: ActionDistributions, noise: th.Tensor) -> th.Tensor:
        """Eq. 15, shape (B,)."""
        action, log_prob = later.learner.sample_with_log_prob(noise)
        next_q = self.policy.critic_target(batch.next_observations, action)
        return learner_target(batch.rewards, batch.dones, next_q, batch.discounts, log_prob, self._learner_ent_coef)

    def _learner_loss(self, obs: PyTorchObs, now: ActionDistributions, noise: th.Tensor) -> th.Tensor:
        """
        Eq. 16, with the learner's critics, or the guided ones where it has none.

        :param obs: full observation, B of each entry
        :param now: the policies on it
        :param noise: standard normal, shape (B, A)
        :return: scalar
        """
        action, log_prob = now.learner.sample_with_log_prob(noise)
        q = self.policy.critic(obs, action)
        kl: th.Tensor | float = 0.0
        if self.learner_kl_scale:
            kl = float(self.learner_kl_scale) * self._kl(now.guider.detach(), now.learner)
        return learner_loss(kl, q, self.kl_coef_dual.value, log_prob, self._learner_ent_coef)

    @property
    def _learner_ent_coef(self) -> th.Tensor | float:
        return self.ent_coef_dual.value if self.learner_entropy else 0.0

    def _kl(self, guider: TanhGaussian, learner: TanhGaussian) -> th.Tensor:
        """KL(guider || learner) with the std that ``learner`` borrowed, shape (B,)."""
        return kl_shared_std(guider.mean, learner.mean, learner.log_std.exp(), self.kl_reduction)

    def _policy_diagnostics(self, now: ActionDistributions, kl: th.Tensor, log_prob: th.Tensor) -> Metrics:
        target = self.current_target_kl
        return {
            "std": now.learner.log_std.exp().mean(),
            "learner_mean_abs": now.learner.mean.detach().abs().mean(),
            "kl": kl.mean(),
            "kl_p95": kl.kthvalue(math.ceil(0.95 * kl.numel())).values,
            "kl_above_target": (kl > target).float().mean(),
            "target_kl": kl.new_full((), target),
            "kl_coef": self.kl_coef_dual.value,
            "ent_coef": self.ent_coef_dual.value,
            "entropy": -log_prob.mean(),
        }

    # --- SB3's contract ---------------------------------------------------------------------------------------------

    def predict_guider(
        self,
        observation: dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The guider's action; needs the full observation. Arguments and result are those of ``predict``.

        :param observation: single or batched
        :param state: passed through
        :param episode_start: ignored
        :param deterministic: mode instead of a sample
        :return: action in the environment's range, and ``state``
        """
        self.policy.set_training_mode(False)
        scaled_action, vectorized = self.policy.behaviour_action(observation, deterministic)
        action = self.policy.unscale_action(scaled_action)
        return (action if vectorized else action.squeeze(axis=0)), state

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "GAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "GAC":
        """See SB3's ``OffPolicyAlgorithm.learn``."""
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _dual_names(self) -> list[str]:
        return [*super()._dual_names(), "kl_coef_dual"]
