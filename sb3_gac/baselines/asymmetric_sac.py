"""Soft Actor-Critic whose critics see more than its actor: SAC-asym, and with other keys SAC on either view."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_gac.base.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.base.policy import AsymmetricPolicy, BehaviourState
from sb3_gac.base.roles import Roles
from sb3_gac.base.update import Batch, Descent, Metrics, Slope, as_leaves, gradient_of
from sb3_gac.math.distributions import Distribution
from sb3_gac.math.losses import masked_mean, policy_loss, soft_target
from sb3_gac.networks.actors import Actor
from sb3_gac.networks.heads import LOG_STD_BOUNDS
from sb3_gac.optim.compile import compilable


class AsymmetricSACPolicy(AsymmetricPolicy):
    """
    An actor and twin critics, each on the entries of its role, "actor" or "critic".

    :param observation_space: Dict
    :param action_space: Box or Discrete
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden layer sizes: one list, ``{"pi", "qf"}`` or ``{"actor", "critic"}``
    :param activation_fn: between layers
    :param log_std_bounds: smallest and largest log standard deviation before tanh
    :param kwargs: arguments of :class:`AsymmetricPolicy`
    """

    roles = Roles("actor", ("critic",))

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.SiLU,
        log_std_bounds: tuple[float, float] = LOG_STD_BOUNDS,
        **kwargs: Any,
    ):
        super().__init__(observation_space, action_space, net_arch, activation_fn, **kwargs)
        self.constructor_options["log_std_bounds"] = log_std_bounds
        self.actor = Actor(**self._role_kwargs("actor"), log_std_bounds=log_std_bounds)
        shared = self.actor.features_extractor if self.share_features_extractor else None
        self.critic, self.critic_target = self._make_critic_and_target("critic", shared)
        self._finish(lr_schedule)

    @property
    def halves_are_independent(self) -> bool:
        """The actor climbs the critics: one cannot go without the other."""
        return False

    def behaviour_action(
        self,
        observation: dict[str, np.ndarray],
        state: BehaviourState = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, BehaviourState]:
        """The actor's, see :meth:`AsymmetricPolicy.behaviour_action`."""
        obs, _ = self.actor.obs_to_tensor(observation)
        with th.no_grad():
            actions, after = self.actor.remember(obs, state[0] if state else None, episode_start)
            return self._chosen(actions, deterministic), None if after is None else (after,)


class AsymmetricSACGruPolicy(AsymmetricSACPolicy):
    """Both networks with a GRU each."""

    cell = "gru"


class AsymmetricSACLstmPolicy(AsymmetricSACPolicy):
    """Both networks with an LSTM each."""

    cell = "lstm"


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

    def _gradient_step(self, batch: Batch, diagnose: bool = True) -> Metrics:
        """SAC's critics are eq. 15's with the entropy term, its actor eq. 16's without a guider."""
        ent_coef = self.ent_coef_dual.value
        noise = th.randn((2, *batch.actions.shape), device=self.device)
        (now, later), backward = self._policy_pass("actor", batch)
        metrics = self._step("critic", self._fit(batch, later, noise[0], ent_coef))
        slope, log_prob = self._actor_slope(batch, now, noise[1], ent_coef)
        metrics |= self._policy_step("actor", backward, slope)
        metrics |= self.ent_coef_dual.update(log_prob + float(self.target_entropy), batch.mask)
        if diagnose:
            metrics["ent_coef"] = self.ent_coef_dual.value
            metrics["entropy"] = -masked_mean(log_prob, batch.mask)
            diagnostics = now.diagnostics()
            metrics |= {f"actor_{name}": masked_mean(values, batch.mask) for name, values in diagnostics.items()}
        return metrics

    @compilable
    def _fit(self, batch: Batch, later: Distribution, noise: th.Tensor, ent_coef: th.Tensor) -> Descent:
        return self._critic_descent("critic", batch, self._target(batch, later, noise, ent_coef))

    @th.no_grad()
    def _target(self, batch: Batch, later: Distribution, noise: th.Tensor, ent_coef: th.Tensor) -> th.Tensor:
        next_q, log_prob = later.expectation(batch.values_after(self.policy.critic_target), noise)
        return soft_target(
            reward=batch.rewards,
            done=batch.dones,
            next_q=next_q,
            discount=batch.discounts,
            next_log_prob=log_prob,
            ent_coef=ent_coef,
        )

    @compilable
    def _actor_slope(self, batch: Batch, now: Distribution, noise: th.Tensor, ent_coef: th.Tensor) -> tuple[Slope, th.Tensor]:
        """Of the actor's loss; with its log-probability, detached, shape (\\*E)."""
        outputs = as_leaves(now)
        q, log_prob = outputs.expectation(batch.values_at(self.policy.critic), noise)
        loss = policy_loss(q=q, log_prob=log_prob, ent_coef=ent_coef, mask=batch.mask)
        return Slope(gradient_of(loss, outputs), {"actor_loss": loss.detach()}), log_prob.detach()
