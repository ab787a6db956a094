"""Guider, learner and four critics: the networks of Guided Actor-Critic for Box and Discrete actions."""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.roles import Roles
from sb3_gac.checks.values import check_choice
from sb3_gac.gac.actors import GUIDERS, Guider, LaggedGuider, Learner, LearnerAsActor
from sb3_gac.math.distributions import Distribution
from sb3_gac.networks.actors import RolePolicy
from sb3_gac.networks.critics import CriticEnsemble

SHARED_STDS = ("learner", "guider")


class ActionDistributions(NamedTuple):
    """
    The action distributions of both policies for one batch.

    :param guider: the guider's distribution, shapes (B, A)
    :param learner: the learner's distribution in training, shapes (B, A); Gaussians of guider and learner have one std, which
        is a constant in the distribution that borrows it
    :param deployed: the learner's distribution at deployment, with a std of its own, shapes (B, A)
    """

    guider: Any
    learner: Any
    deployed: Any


class GACPolicy(AsymmetricPolicy):
    """
    All networks of GAC and their optimisers. As a policy it is the learner: ``predict`` needs the learner's entries alone.

    Arguments that are not described here are those of :class:`AsymmetricPolicy`.

    :param net_arch: hidden layer sizes: one list for all networks, or a dict of lists with the keys "pi" and "qf", or with the
        keys "guider", "learner" and "critic"
    :param guider: kind of guider, a key of ``GUIDERS``: "residual", "lagged" or "independent"
    :param max_kl: hard bound on KL(guider || learner) in every state; ``None`` for none
    :param kl_reduction: reduction of that KL over action dimensions, "mean" or "sum"
    :param learner_critics: whether the learner has critics of its own
    :param shared_std: policy whose std both Gaussians have in training, one of ``SHARED_STDS``; the other network's own std
        serves at most at deployment
    """

    learner_critic: CriticEnsemble | None
    learner_critic_target: CriticEnsemble | None

    renamed_arguments: ClassVar[Mapping[str, str]] = {"std_of": "shared_std"}
    guider: Guider
    learner: Learner
    learner_target: Learner
    guider_critic: CriticEnsemble
    guider_critic_target: CriticEnsemble

    roles = Roles("learner", actors=("guider",), critics=("guider_critic", "learner_critic"), collects="guider")

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
        **kwargs: Any,
    ):
        check_choice("guider", guider, GUIDERS)
        check_choice("shared_std", shared_std, SHARED_STDS)
        self.guider_class = GUIDERS[guider]
        if self.guider_class.needs_target:
            self.roles = self.roles._replace(target_policies=("learner",))  # type: ignore[misc]
        self.learner_critics = learner_critics
        self.owns_std = shared_std == "learner"
        self.guider_options: dict[str, Any] = {"max_kl": max_kl, "kl_reduction": kl_reduction}
        self.own = {"guider": guider, "learner_critics": learner_critics, "shared_std": shared_std, **self.guider_options}
        super().__init__(observation_space, action_space, lr_schedule, net_arch, activation_fn, **kwargs)

    def own_options(self) -> dict[str, Any]:
        """Constructor arguments of this class alone, see :meth:`AsymmetricPolicy.own_options`."""
        return self.own

    def make_policy(self, role: str, **arguments: Any) -> RolePolicy:
        """The network of the learner or of the guider, see :meth:`AsymmetricPolicy.make_policy`."""
        if role == "learner":
            return Learner(**arguments, owns_std=self.owns_std)
        return self.guider_class(**arguments, **self.guider_options)

    def tie_networks(self) -> None:
        """Give a lagged guider the learner's target network, see :meth:`AsymmetricPolicy.tie_networks`."""
        if isinstance(self.guider, LaggedGuider):
            if self.remembers:
                raise ValueError(
                    'guider="lagged" asks an average of the learner, whose memory nobody carries along: use "residual" where '
                    "policies remember."
                )
            self.guider.follow(self.learner_target)

    def has(self, role: str) -> bool:
        """Whether there is a network for the role: the learner's critics may be missing, see :meth:`AsymmetricPolicy.has`."""
        return role != "learner_critic" or self.learner_critics

    def unclipped(self, role: str) -> int:
        """Number of parameters that gradient clipping leaves out: the learner's std, where it serves at deployment only."""
        return len(self.learner.deployment_parameters()) if role == "learner" else 0

    @property
    def actor(self) -> LearnerAsActor:
        """SB3's name for the policy that acts at evaluation; a call returns actions."""
        return LearnerAsActor.of(self.learner)

    @property
    def critic(self) -> CriticEnsemble:
        """SB3's name for the learner's critics (eq. 15); the guided critics in ablations that have no others."""
        return self.guider_critic if self.learner_critic is None else self.learner_critic

    @property
    def critic_target(self) -> CriticEnsemble:
        """Target network of :attr:`critic`."""
        return self.guider_critic_target if self.learner_critic_target is None else self.learner_critic_target

    @property
    def side_branch(self) -> tuple[str, ...]:
        """The guider and its critics, whose steps may run beside the learner's, unless the learner climbs these critics."""
        independent = self.learner_critic is not None and not self.share_features_extractor
        return ("guider", "guider_critic") if independent else ()

    def distributions(self, obs: PyTorchObs) -> ActionDistributions:
        """
        The action distributions of both policies for one batch.

        :param obs: full observation, (B, ...) of each entry
        :return: distributions of guider and learner, shapes (B, A)
        """
        return self.action_distributions(self.guider.distribution(obs), self.learner.distribution(obs))

    def action_distributions(self, guider_output: Distribution, learner_output: Distribution) -> ActionDistributions:
        """
        The action distributions of both policies, from the outputs of their networks.

        :param guider_output: output of the guider's network for a batch
        :param learner_output: output of the learner's network for the same batch
        :return: distributions of guider and learner, shapes (B, A)
        """
        guider: Any = guider_output
        learner: Any = learner_output
        if self.learner.owns_std:
            return ActionDistributions(self.guider.relative_to(learner, guider.with_std_of(learner)), learner, learner)
        guider = self.guider.relative_to(learner, guider)
        return ActionDistributions(guider, learner.with_std_of(guider), learner)

    def acting_distributions(self, outputs: Mapping[str, Any]) -> Mapping[str, Any]:
        """The distributions that guider and deployed learner act by, see :meth:`AsymmetricPolicy.acting_distributions`."""
        both = self.action_distributions(outputs["guider"], outputs["learner"])
        return {"guider": both.guider, "learner": both.deployed}


class GACGruPolicy(GACPolicy):
    """The policy of :class:`GACPolicy` with a GRU in each network."""

    default_rnn_type = "gru"


class GACLstmPolicy(GACPolicy):
    """The policy of :class:`GACPolicy` with an LSTM in each network."""

    default_rnn_type = "lstm"


MultiInputPolicy = GACPolicy
