"""Guided Actor-Critic."""

import math
from collections.abc import Callable
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
    critic_loss,
    guided_target,
    guider_loss,
    learner_loss,
    learner_target,
    log_std_loss,
)
from sb3_gac.common.off_policy import AsymmetricOffPolicyAlgorithm, Batch, Metrics, clip_gradients
from sb3_gac.common.roles import RoleKeys
from sb3_gac.gac.actors import GUIDERS
from sb3_gac.gac.policies import GACPolicy, MultiInputPolicy

KL_COEF_START = 1.0


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
        """Critics, guider and learner, beta, alpha; the targets follow in :meth:`train`."""
        metrics = self._update_critics(batch)
        policy_metrics, kl, log_prob = self._update_policies(batch.observations)
        metrics |= policy_metrics
        ent_metrics = self.ent_coef_dual.update(log_prob + float(self.target_entropy))
        kl_metrics = self.kl_coef_dual.update(kl - self.current_target_kl)
        metrics |= {f"ent_coef_{name}": value for name, value in ent_metrics.items() if name == "loss"}
        metrics |= {f"kl_coef_{name}": value for name, value in kl_metrics.items()}
        return metrics | self._policy_diagnostics(kl, log_prob)

    @property
    def current_target_kl(self) -> float:
        """The bound on KL at this point of training."""
        return self.target_kl_schedule(self._current_progress_remaining)

    def _update_critics(self, batch: Batch) -> Metrics:
        """Eqs. 12 and 15."""
        targets = self._critic_targets(batch)
        self.policy.critic_optimizer.zero_grad()
        metrics = self._run_halves([partial(self._critic_gradients, *target, batch) for target in targets.items()])
        self.policy.critic_optimizer.step()
        return metrics | {"critic_loss": th.stack([metrics[f"{name}_loss"] for name in targets]).sum()}

    def _critic_targets(self, batch: Batch) -> dict[str, Callable[[], th.Tensor]]:
        """Critics -> what computes their targets, each of shape (B,); all random numbers are drawn here."""
        policy, next_obs = self.policy, batch.next_observations
        with th.no_grad():
            guider, learner, _ = policy.distributions(next_obs)
            next_kl = self._kl(guider.mean, learner)
            guider_action, guider_log_prob = guider.sample_with_log_prob()
            learner_action, learner_log_prob = learner.sample_with_log_prob()

        def guided() -> th.Tensor:
            next_q = policy.guider_critic_target(next_obs, guider_action)
            coefficients = (self.kl_coef_dual.value, self.ent_coef_dual.value)
            return guided_target(batch.rewards, batch.dones, next_q, next_kl, guider_log_prob, *coefficients, batch.discounts)

        def of_learner() -> th.Tensor:
            next_q = policy.critic_target(next_obs, learner_action)
            return learner_target(
                batch.rewards, batch.dones, next_q, batch.discounts, learner_log_prob, self._learner_ent_coef
            )

        targets = {"guider_critic": guided, "learner_critic": of_learner}
        return {name: target for name, target in targets.items() if name in policy.network_parameters}

    def _critic_gradients(self, name: str, target: Callable[[], th.Tensor], batch: Batch) -> Metrics:
        """Half of the critics' phase: one ensemble's clipped gradients."""
        with th.no_grad():
            y = target()
        q = getattr(self.policy, name)(batch.observations, batch.actions)
        loss = critic_loss(q, y)
        loss.backward()
        grad_norm = self._clip_gradients(name)
        return {f"{name}_loss": loss.detach(), f"{name}_q": q.detach().mean(), f"{name}_grad_norm": grad_norm}

    def _update_policies(self, obs: PyTorchObs) -> tuple[Metrics, th.Tensor, th.Tensor]:
        """
        Eqs. 13 and 16: the gradients of the two objectives meet in no parameter.

        :return: metrics; KL(guider || learner) and the guider's log-probability, detached, each of shape (B,)
        """
        guider, learner, deployment_log_std = self.policy.distributions(obs)
        action, log_prob = guider.sample_with_log_prob()
        learner_sample = learner.sample_with_log_prob()
        kl = self._kl(guider.mean, TanhGaussian(learner.mean.detach(), learner.log_std))

        def guider_objective() -> th.Tensor:
            q = self.policy.guider_critic(obs, action)
            return guider_loss(kl, log_prob, q, self.kl_coef_dual.value, self.ent_coef_dual.value)

        def learner_objective() -> th.Tensor:
            return self._learner_loss(obs, self._kl(guider.mean.detach(), learner), *learner_sample)

        self.policy.actor_optimizer.zero_grad()
        objectives = {"guider": guider_objective, "learner": learner_objective}
        metrics = self._run_halves([partial(self._policy_gradients, *objective) for objective in objectives.items()])
        deployment_loss = log_std_loss(deployment_log_std, learner.log_std)
        deployment_loss.backward()
        self.policy.actor_optimizer.step()
        metrics |= {
            "actor_loss": metrics["learner_loss"],
            "log_std_loss": deployment_loss.detach(),
            "std": learner.log_std.exp().mean(),
            "learner_mean_abs": learner.mean.detach().abs().mean(),
        }
        return metrics, kl.detach(), log_prob.detach()

    def _policy_gradients(self, name: str, objective: Callable[[], th.Tensor]) -> Metrics:
        """Half of the policies' phase: one policy's clipped gradients; the critics stay as they are."""
        loss = objective()
        loss.backward(inputs=self.policy.network_parameters[name])
        return {f"{name}_loss": loss.detach(), f"{name}_grad_norm": self._clip_gradients(name)}

    def _learner_loss(self, obs: PyTorchObs, kl: th.Tensor, action: th.Tensor, log_prob: th.Tensor) -> th.Tensor:
        """
        Eq. 16, with the learner's critics, or the guided ones where it has none.

        :param obs: full observation, B of each entry
        :param kl: KL(sg mu || pi), shape (B,)
        :param action: from the learner, reparameterised, shape (B, A)
        :param log_prob: of that action, shape (B,)
        :return: scalar
        """
        q = self.policy.critic(obs, action)
        kl_weight = float(self.learner_kl_scale) * self.kl_coef_dual.value
        return learner_loss(kl, q, kl_weight, log_prob, self._learner_ent_coef)

    @property
    def _learner_ent_coef(self) -> th.Tensor | float:
        return self.ent_coef_dual.value if self.learner_entropy else 0.0

    def _kl(self, guider_mean: th.Tensor, learner: TanhGaussian) -> th.Tensor:
        """KL(guider || learner) with the std that ``learner`` borrowed, shape (B,)."""
        return kl_shared_std(guider_mean, learner.mean, learner.log_std.exp(), self.kl_reduction)

    def _clip_gradients(self, network: str) -> th.Tensor:
        return clip_gradients(self.policy.network_parameters[network], self.max_grad_norm)

    def _policy_diagnostics(self, kl: th.Tensor, log_prob: th.Tensor) -> Metrics:
        target = self.current_target_kl
        return {
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
