"""Guider, learner and four critics: the networks of Guided Actor-Critic for Box and Discrete actions."""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_gac.base.arguments import ConstructorArguments
from sb3_gac.base.policy import AsymmetricPolicy, BehaviourState
from sb3_gac.base.roles import Roles
from sb3_gac.gac.actors import GUIDERS, Learner, LearnerAsActor
from sb3_gac.math.distributions import Distribution
from sb3_gac.networks.critics import CriticEnsemble
from sb3_gac.networks.heads import LOG_STD_BOUNDS

SHARED_STDS = ("learner", "guider")


class ActionDistributions(NamedTuple):
    """
    Both policies for one batch.

    :param guider: shapes (B, A)
    :param learner: as it is in training, shapes (B, A); Gaussians have one std, which is a constant in that of the two
        that borrows it
    :param deployed: the learner by itself, shapes (B, A)
    """

    guider: Any
    learner: Any
    deployed: Any


class GACPolicy(ConstructorArguments, AsymmetricPolicy):
    """
    All networks of GAC and their optimisers. As a policy it is the learner: ``predict`` needs its entries alone.

    :param observation_space: Dict
    :param action_space: Box or Discrete
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden layer sizes: one list, ``{"pi", "qf"}`` or ``{"guider", "learner", "critic"}``
    :param activation_fn: between layers
    :param guider: "residual" or "independent", a key of ``GUIDERS``
    :param role_keys: role -> observation entries, see :func:`sb3_gac.base.roles.resolve_role_keys`
    :param max_kl: hard bound on KL(guider || learner), or ``None``
    :param kl_reduction: how that KL is reduced over action dimensions, "mean" or "sum"
    :param learner_critics: whether the learner has critics of its own
    :param shared_std: whose std both Gaussians have, one of ``SHARED_STDS``; what the other's network says of its own counts
        at most at deployment
    :param log_std_bounds: smallest and largest log standard deviation before tanh
    :param features_extractor_class: encoder, made once per role on the entries of that role
    :param features_extractor_kwargs: keyword arguments for it
    :param share_features_extractor: whether guider and critics see the learner's features of its entries, as they are,
        and encode only the other entries themselves; the learner's loss trains that encoder (saves most of the work
        where ``partial`` is an image)
    :param normalize_images: divide images by 255
    :param optimizer_class: optimiser of policies and critics
    :param optimizer_kwargs: keyword arguments for it, without the learning rate
    :param n_critics: size of each of the two critic ensembles
    """

    learner_critic: CriticEnsemble | None
    learner_critic_target: CriticEnsemble | None

    renamed_arguments: ClassVar[Mapping[str, str]] = {"std_of": "shared_std"}
    roles = Roles("learner", ("guider", "guider_critic", "learner_critic"))

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.SiLU,
        guider: str = "residual",
        max_kl: float | None = None,
        kl_reduction: str = "mean",
        learner_critics: bool = True,
        shared_std: str = "learner",
        log_std_bounds: tuple[float, float] = LOG_STD_BOUNDS,
        **kwargs: Any,
    ):
        super().__init__(observation_space, action_space, net_arch, activation_fn, **kwargs)
        self.constructor_options |= {
            "guider": guider,
            "max_kl": max_kl,
            "kl_reduction": kl_reduction,
            "learner_critics": learner_critics,
            "shared_std": shared_std,
            "log_std_bounds": log_std_bounds,
        }
        owns_std = shared_std == "learner"
        self.learner = Learner(**self._role_kwargs("learner"), log_std_bounds=log_std_bounds, owns_std=owns_std)
        shared = self.learner.features_extractor if self.share_features_extractor else None
        bounds: dict[str, Any] = {"log_std_bounds": log_std_bounds, "max_kl": max_kl, "kl_reduction": kl_reduction}
        self.guider = GUIDERS[guider](**self._role_kwargs("guider", shared), **bounds)
        self.guider_critic, self.guider_critic_target = self._make_critic_and_target("guider_critic", shared)
        self.learner_critic, self.learner_critic_target = None, None
        if learner_critics:
            self.learner_critic, self.learner_critic_target = self._make_critic_and_target("learner_critic", shared)
        self._finish(lr_schedule, unclipped=len(self.learner.deployment_parameters()))

    @property
    def actor(self) -> LearnerAsActor:
        """SB3's name for the policy that acts at evaluation; called, it returns actions."""
        return LearnerAsActor.of(self.learner)

    @property
    def critic(self) -> CriticEnsemble:
        """SB3's name for the critic without the KL term (eq. 15); the guided one in ablations that have no other."""
        return self.guider_critic if self.learner_critic is None else self.learner_critic

    @property
    def critic_target(self) -> CriticEnsemble:
        """Target of :attr:`critic`."""
        return self.guider_critic_target if self.learner_critic_target is None else self.learner_critic_target

    @property
    def halves_are_independent(self) -> bool:
        """Not where the learner climbs the guided critics."""
        return self.learner_critic is not None and super().halves_are_independent

    def distributions(self, obs: PyTorchObs) -> ActionDistributions:
        """
        Both policies' action distributions for one batch.

        :param obs: full observation, B of each entry
        :return: shapes (B, A)
        """
        return self.combine(self.guider.distribution(obs), self.learner.distribution(obs))

    def combine(self, guider_output: Distribution, learner_output: Distribution) -> ActionDistributions:
        """
        :param guider_output: of the guider's network, for some batch
        :param learner_output: of the learner's network, for the same batch
        :return: shapes (B, A)
        """
        guider: Any = guider_output
        learner: Any = learner_output
        if self.learner.owns_std:
            return ActionDistributions(self.guider.relative_to(learner, guider.borrowing(learner)), learner, learner)
        guider = self.guider.relative_to(learner, guider)
        return ActionDistributions(guider, learner.borrowing(guider), learner)

    def behaviour_action(
        self,
        observation: dict[str, np.ndarray],
        state: BehaviourState = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, BehaviourState]:
        """The guider's, see :meth:`AsymmetricPolicy.behaviour_action`; remembered are the learner's state and its own."""
        obs, _ = self.obs_to_tensor(observation)
        of_learner, of_guider = state or (None, None)
        with th.no_grad():
            learner, of_learner = self.learner.remember(obs, of_learner, episode_start)
            guider, of_guider = self.guider.remember(obs, of_guider, episode_start)
            action = self._chosen(self.combine(guider, learner).guider, deterministic)
        return action, None if of_learner is None or of_guider is None else (of_learner, of_guider)


class GACGruPolicy(GACPolicy):
    """All networks with a GRU each."""

    cell = "gru"


class GACLstmPolicy(GACPolicy):
    """All networks with an LSTM each."""

    cell = "lstm"


MultiInputPolicy = GACPolicy
