"""Guided Policy Optimization: on-policy; a guider that sees everything acts, and one network is both policies."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, TypeAlias

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples as Samples
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs
from torch import nn
from typing_extensions import Unpack

from sb3_gac.base.arguments import OnPolicyArguments
from sb3_gac.base.batch import Loss, Metrics
from sb3_gac.base.guider import GuiderPrediction
from sb3_gac.base.on_policy import AsymmetricOnPolicyAlgorithm
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.roles import Roles, role_space
from sb3_gac.checks.values import check_inner_fraction, check_not_negative, check_positive
from sb3_gac.math.distributions import Distribution
from sb3_gac.math.losses import clipped_surrogate
from sb3_gac.networks.actors import Actor
from sb3_gac.networks.role_model import RoleModel
from sb3_gac.networks.values import StateValue
from sb3_gac.optim.coefficients import Coefficient, MultiplicativeCoefficient

Weights: TypeAlias = Mapping[str, th.Tensor]
LARGEST_LOG_RATIO = 10.0
FIRST_KL_COEF, KL_COEF_FACTOR = 0.1, 1.2


class SharedLearner(Actor):
    """
    The network of both policies, with nought in place of what the learner does not see, and a one that says so.

    :param arguments: of :class:`Actor`
    :raises ValueError: if it has no hidden layer
    """

    def __init__(self, **arguments: Any):
        super().__init__(**arguments)
        if not self.net_arch:
            raise ValueError("net_arch must have a hidden layer, which the policies share.")
        self.is_learner = nn.Parameter(th.zeros(self.net_arch[0]))

    def latent(self, obs: PyTorchObs) -> th.Tensor:
        """See :meth:`RolePolicy.latent`."""
        return self.latent_net[1:](self.first_layer(obs) + self.is_learner)

    def first_layer(self, obs: PyTorchObs) -> th.Tensor:
        r"""
        :param obs: observation with at least the learner's entries, (\*E, ...) of each
        :return: what they make of the first hidden layer, before its activation, shape (\*E, H)
        """
        return self.latent_net[0](self.extract_features(obs, self.features_extractor))


class SharedGuider(RoleModel):
    """
    The learner's network, and what the entries that the learner does not see add to its first hidden layer.

    :param learner: whose network it is
    :param observation_space: the entries that this role reads
    :param features_extractor: encoder of those that the learner does not see; ``None`` if it sees all of them
    """

    rest_extractor = memory = None

    def __init__(
        self, learner: SharedLearner, observation_space: spaces.Dict, features_extractor: BaseFeaturesExtractor | None
    ):
        super().__init__(
            observation_space,
            learner.action_space,
            features_extractor=features_extractor,
            normalize_images=learner.normalize_images,
        )
        self._learner = (learner,)  # in a tuple: its parameters are its own
        self.privileged: nn.Module | None = None
        if features_extractor is not None:
            self.privileged = nn.Linear(features_extractor.features_dim, learner.net_arch[0], bias=False)

    def distribution(self, obs: PyTorchObs) -> Distribution:
        """See :meth:`RolePolicy.distribution`."""
        (learner,) = self._learner
        first = learner.first_layer(obs)
        if self.privileged is not None:
            extractor: Any = self.features_extractor
            first = first + self.privileged(self._encode(obs, extractor._observation_space, extractor))
        return learner.output(learner.latent_net[1:](first))

    def remember(self, obs: PyTorchObs, state: Any, episode_start: Any) -> tuple[Distribution, None]:
        """See :meth:`RolePolicy.remember`."""
        return self.distribution(obs), None


class GPOPolicy(AsymmetricPolicy):
    """
    One network for learner and guider, and a value of the state. Arguments are those of :class:`AsymmetricPolicy`.
    """

    roles = Roles("learner", actors=("guider",), values=("critic",), collects="guider")
    learner: SharedLearner
    guider: SharedGuider
    critic: StateValue

    def make_policy(self, role: str, **arguments: Any) -> Any:
        """See :meth:`AsymmetricPolicy.make_policy`."""
        if role == "learner":
            return SharedLearner(**arguments)
        missing = [key for key in self.role_keys["learner"] if key not in self.role_keys["guider"]]
        if missing:
            raise ValueError(
                f'role_keys["guider"] lacks {missing}: the guider is the learner\'s network, and sees what it sees.'
            )
        beside = [key for key in self.role_keys["guider"] if key not in self.role_keys["learner"]]
        space = role_space(self.observation_space, self.role_keys["guider"])  # type: ignore[arg-type]
        return SharedGuider(self.learner, space, self.make_extractor("guider", beside) if beside else None)

    @property
    def actor(self) -> SharedLearner:
        """SB3's name for the policy that acts at evaluation."""
        return self.learner


class GPO(GuiderPrediction, AsymmetricOnPolicyAlgorithm):  # type: ignore[misc]
    """
    What both forms share: PPO for a guider that sees everything; a learner that imitates it and climbs the same advantages
    (Li & Xie 2025, "Guided Policy Optimization under Partial Observability"). ``predict`` is the learner.

    In all objectives ``guider`` and ``learner`` are the policies at a minibatch's observations. For observations of different
    sizes use ``VecNormalize(env, norm_reward=False, clip_obs=5.0)``, as the authors do. Arguments that are not described here
    are those of :class:`AsymmetricOnPolicyAlgorithm`.

    :param learner_rl_coef: weight of the learner's own PPO objective beside its imitation of the guider
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": GPOPolicy}
    argument_checks: ClassVar[Mapping[str, Any]] = {"learner_rl_coef": check_not_negative}
    compiled_settings = (*AsymmetricOnPolicyAlgorithm.compiled_settings, "learner_rl_coef")
    policy: GPOPolicy  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[GPOPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        learner_rl_coef: float = 2.0,
        **shared: Unpack[OnPolicyArguments],
    ):
        self.learner_rl_coef = learner_rl_coef
        super().__init__(policy, env, *sb3, **shared)

    # --- algorithm ----------------------------------------------------------------------------------------------------

    def update(self, batch: Samples) -> Metrics:
        """One step of all networks; policies share one, so their objectives are one loss."""
        noise = th.randn(*batch.actions.shape, device=self.device)
        weights = {name: coefficient.value for name, coefficient in self.coefficients.items()}
        batch = batch._replace(advantages=self.advantages(batch))
        metrics = self.minimize(("learner", "guider", "critic"), self.loss, batch, noise, self.clip_range_tensor, weights)
        return metrics | self.coefficient_values()

    def loss(self, batch: Samples, noise: th.Tensor, epsilon: th.Tensor, weights: Weights) -> Loss:
        """All objectives together, with the guider's entropy and the value's mean squared error."""
        guider, learner = (getattr(self.policy, role).distribution(batch.observations) for role in ("guider", "learner"))
        guider_loss = self.guider_objective(batch, guider, learner.detach(), epsilon, weights)
        learner_loss = self.learner_objective(batch, guider.detach(), learner, epsilon)
        value_loss = (self.policy.critic(batch.observations) - batch.returns).square().mean()
        entropy = guider.entropy(noise).mean()
        loss = guider_loss + learner_loss - self.ent_coef * entropy + self.vf_coef * value_loss
        kl = guider.detach().kl(learner.detach(), "mean").mean()
        parts = {"guider_loss": guider_loss, "imitation_loss": learner_loss, "critic_loss": value_loss}
        return Loss(loss, {**parts, "entropy": entropy, "kl": kl})

    @abstractmethod
    def guider_objective(self, batch: Samples, guider: Any, learner: Any, epsilon: th.Tensor, weights: Weights) -> th.Tensor:
        """
        :param batch: B transitions, with normalised advantages
        :param guider: with its gradient, shapes (B, A)
        :param learner: as a constant, shapes (B, A)
        :param epsilon: how far a ratio may count
        :param weights: values of the coefficients
        :return: what the guider minimises, scalar
        """

    def learner_objective(self, batch: Samples, guider: Any, learner: Any, epsilon: th.Tensor) -> th.Tensor:
        """Imitate the guider, and climb its advantages."""
        log_ratio = (learner.log_prob(batch.actions) - batch.old_log_prob).clamp(max=LARGEST_LOG_RATIO)
        imitation = guider.kl(learner, "mean").mean()
        return imitation + self.learner_rl_coef * clipped_surrogate(log_ratio, batch.advantages, epsilon)


class GPOClip(GPO):
    """
    GPO-clip: the guider's ratio to the learner is clipped before PPO's own, and a KL brings it back where it has left the
    learner's vicinity. Arguments that are not described here are those of :class:`GPO`.

    :param delta: how far the guider's probability of an action may be from the learner's, as a share of it
    """

    argument_checks: ClassVar[Mapping[str, Any]] = {"delta": check_inner_fraction}
    compiled_settings = (*GPO.compiled_settings, "delta")

    def __init__(self, policy: str | type[GPOPolicy], env: GymEnv | str | None, *sb3: Any, delta: float = 0.1, **shared: Any):
        self.delta = delta
        super().__init__(policy, env, *sb3, **shared)

    def guider_objective(self, batch: Samples, guider: Any, learner: Any, epsilon: th.Tensor, weights: Weights) -> th.Tensor:
        """PPO whose ratio is clipped near the learner first, and a KL where the guider has left the learner's vicinity."""
        log_prob, log_learner = guider.log_prob(batch.actions), learner.log_prob(batch.actions)
        log_distance = log_prob - log_learner
        nearby = log_distance.clamp(math.log(1 - self.delta), math.log(1 + self.delta))
        surrogate = clipped_surrogate(
            log_prob - batch.old_log_prob, batch.advantages, epsilon, clipped_from=log_learner + nearby - batch.old_log_prob
        )
        has_left = (log_distance != nearby).float()
        return surrogate + (has_left * guider.kl(learner, "mean")).mean()


class GPOPenalty(GPO):
    """
    GPO-penalty: PPO for the guider, with a KL to the learner whose weight follows a target. Arguments that are not described
    here are those of :class:`GPO`.

    Both policies share a network. The guider's KL moves what they share towards the learner, which moves along; the learner's
    imitation, of weight 1, moves it back. So a weight above 1 lets both drift: the authors' bound is 10.

    :param target_kl: KL(guider || learner), as a mean over action dimensions, above which its weight rises after a rollout,
        and below which it falls
    :param largest_kl_coef: bound on that weight
    """

    argument_checks: ClassVar[Mapping[str, Any]] = {"target_kl": check_positive, "largest_kl_coef": check_positive}

    def __init__(
        self,
        policy: str | type[GPOPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        target_kl: float = 0.001,
        largest_kl_coef: float = 1.0,
        **shared: Any,
    ):
        self.target_kl = target_kl
        self.largest_kl_coef = largest_kl_coef
        super().__init__(policy, env, *sb3, **shared)

    def make_coefficients(self) -> dict[str, Coefficient]:
        """The weight of the KL, nought at the start."""
        kl_coef = MultiplicativeCoefficient(FIRST_KL_COEF, KL_COEF_FACTOR, self.largest_kl_coef, self.device)
        return {"kl_coef": kl_coef}

    def guider_objective(self, batch: Samples, guider: Any, learner: Any, epsilon: th.Tensor, weights: Weights) -> th.Tensor:
        """PPO, and a KL to the learner."""
        surrogate = clipped_surrogate(guider.log_prob(batch.actions) - batch.old_log_prob, batch.advantages, epsilon)
        return surrogate + weights["kl_coef"] * guider.kl(learner, "mean").mean()

    def train(self) -> None:
        """See :meth:`AsymmetricOnPolicyAlgorithm.train`; then the KL's weight takes a step."""
        super().train()
        above = th.tensor(self._last_metrics["kl"] > self.target_kl, device=self.device)
        self.coefficients["kl_coef"].move(above)  # type: ignore[union-attr]
