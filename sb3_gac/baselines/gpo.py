"""Guided Policy Optimization, on-policy: a guider that sees everything acts, and guider and learner share one network."""

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
from sb3_gac.checks.arguments import ArgumentCheck
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
    The network of both policies, with zeros in place of the entries that the learner does not see, and a one as a flag for the
    learner. The flag's weights are the parameter ``is_learner``.

    :param arguments: keyword arguments of :class:`Actor`
    :raises ValueError: if ``net_arch`` has no hidden layer
    """

    def __init__(self, **arguments: Any):
        super().__init__(**arguments)
        if not self.net_arch:
            raise ValueError("net_arch must have a hidden layer, which the policies share.")
        self.is_learner = nn.Parameter(th.zeros(self.net_arch[0]))

    def latent(self, obs: PyTorchObs) -> th.Tensor:
        """The last hidden layer of the learner, see :meth:`RolePolicy.latent`."""
        return self.latent_net[1:](self.first_layer(obs) + self.is_learner)

    def first_layer(self, obs: PyTorchObs) -> th.Tensor:
        r"""
        :param obs: observation with at least the learner's entries, (\*E, ...) of each
        :return: part of the first hidden layer that the learner's entries determine, before the activation, shape (\*E, H)
        """
        return self.latent_net[0](self.extract_features(obs, self.features_extractor))


class SharedGuider(RoleModel):
    """
    The learner's network, with a term in its first hidden layer for the entries that the learner does not see.

    :param learner: network that the guider shares with the learner
    :param observation_space: space of the entries that the guider reads
    :param features_extractor: encoder of the entries that the learner does not see; ``None`` if it sees all of them
    """

    def __init__(
        self, learner: SharedLearner, observation_space: spaces.Dict, features_extractor: BaseFeaturesExtractor | None
    ):
        super().__init__(
            observation_space,
            learner.action_space,
            learner.net_arch,
            features_extractor,
            0 if features_extractor is None else features_extractor.features_dim,
            learner.activation_fn,
            learner.normalize_images,
        )
        self._learner = (learner,)  # in a tuple, so that the learner's parameters do not count as the guider's
        self.privileged: nn.Module | None = None
        if features_extractor is not None:
            self.privileged = nn.Linear(self.features_dim, learner.net_arch[0], bias=False)

    @property
    def relation(self) -> tuple[Any, ...]:
        """The class, since the learner's layers are a part of this network, see :attr:`RoleModel.relation`."""
        return (type(self).__name__,)

    def distribution(self, obs: PyTorchObs) -> Distribution:
        """The guider's action distribution, see :meth:`RolePolicy.distribution`."""
        (learner,) = self._learner
        first = learner.first_layer(obs)
        if self.privileged is not None:
            extractor: Any = self.features_extractor
            first = first + self.privileged(self._encode(obs, extractor._observation_space, extractor))
        return learner.output(learner.latent_net[1:](first))

    def remember(self, obs: PyTorchObs, state: Any, episode_start: Any) -> tuple[Distribution, None]:
        """The guider's action distribution, and no state, see :meth:`RolePolicy.remember`."""
        return self.distribution(obs), None


class GPOPolicy(AsymmetricPolicy):
    """
    One network for learner and guider, and a state-value network. Arguments are those of :class:`AsymmetricPolicy`.
    """

    roles = Roles("learner", actors=("guider",), values=("critic",), collects="guider", tied=("guider",))
    learner: SharedLearner
    guider: SharedGuider
    critic: StateValue

    def make_policy(self, role: str, **arguments: Any) -> Any:
        """The network of the learner or of the guider, see :meth:`AsymmetricPolicy.make_policy`."""
        if role == "learner":
            return SharedLearner(**arguments)
        missing = [key for key in self.role_keys["learner"] if key not in self.role_keys["guider"]]
        if missing:
            raise ValueError(
                f'role_keys["guider"] lacks {missing}: add them, since the guider reads all that the learner reads.'
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
    Base of both forms of GPO: PPO trains a guider that sees everything, and a learner imitates the guider and climbs the same
    advantages (Li & Xie 2025, "Guided Policy Optimization under Partial Observability"). ``predict`` is the learner's.

    In all objectives ``guider`` and ``learner`` are the action distributions at a minibatch's observations. Where the entries
    differ in magnitude, wrap the environments in ``VecNormalize(env, norm_reward=False, clip_obs=5.0)``, as the authors do.
    Arguments that are not described here are those of :class:`AsymmetricOnPolicyAlgorithm`.

    :param learner_rl_coef: weight of the learner's own PPO objective beside its imitation of the guider
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": GPOPolicy}
    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = {"learner_rl_coef": check_not_negative}
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
        """One gradient step of all networks with one loss, since the policies share a network."""
        noise = th.randn(*batch.actions.shape, device=self.device)
        weights = {name: coefficient.value for name, coefficient in self.coefficients.items()}
        batch = batch._replace(advantages=self.advantages(batch))
        metrics = self.minimize(("learner", "guider", "critic"), self.loss, batch, noise, self.clip_range_tensor, weights)
        return metrics | self.coefficient_values()

    def loss(self, batch: Samples, noise: th.Tensor, epsilon: th.Tensor, weights: Weights) -> Loss:
        """The sum of all objectives, with the guider's entropy and the mean squared error of the state value."""
        guider, learner = (getattr(self.policy, role).distribution(batch.observations) for role in ("guider", "learner"))
        guider_loss = self.guider_objective(batch, guider, learner.detach(), epsilon, weights)
        learner_loss = self.learner_objective(batch, guider.detach(), learner, epsilon)
        value_loss = (self.policy.critic(batch.observations) - batch.returns).square().mean()
        entropy = guider.entropy(noise).mean()
        loss = guider_loss + learner_loss - self.ent_coef * entropy + self.vf_coef * value_loss
        kl = guider.detach().kl(learner.detach(), "mean").mean()
        parts = {"guider_loss": guider_loss, "learner_loss": learner_loss, "critic_loss": value_loss}
        return Loss(loss, {"loss": loss, **parts, "entropy": entropy, "kl": kl})

    @abstractmethod
    def guider_objective(self, batch: Samples, guider: Any, learner: Any, epsilon: th.Tensor, weights: Weights) -> th.Tensor:
        """
        The guider's loss.

        :param batch: B transitions, with normalised advantages
        :param guider: action distributions of the guider, with their gradient, shapes (B, A)
        :param learner: action distributions of the learner, as a constant, shapes (B, A)
        :param epsilon: PPO's clip range, the largest distance of a clipped ratio from 1, scalar
        :param weights: name of a coefficient -> its value, scalar
        :return: loss that the guider minimises, scalar
        """

    def learner_objective(self, batch: Samples, guider: Any, learner: Any, epsilon: th.Tensor) -> th.Tensor:
        """The learner's loss: KL(guider || learner), averaged over action dimensions, and PPO's loss on its advantages."""
        log_ratio = (learner.log_prob(batch.actions) - batch.old_log_prob).clamp(max=LARGEST_LOG_RATIO)
        imitation = guider.kl(learner, "mean").mean()
        return imitation + self.learner_rl_coef * clipped_surrogate(log_ratio, batch.advantages, epsilon)


class GPOClip(GPO):
    """
    GPO-clip: the guider's probability ratio to the learner is clipped before PPO's own ratio is, and a KL term brings the
    guider back where it has left the clip range. Arguments that are not described here are those of :class:`GPO`.

    :param delta: largest relative difference of an action's probability under the guider from the learner's, in (0, 1)
    """

    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = {"delta": check_inner_fraction}
    compiled_settings = (*GPO.compiled_settings, "delta")

    def __init__(self, policy: str | type[GPOPolicy], env: GymEnv | str | None, *sb3: Any, delta: float = 0.1, **shared: Any):
        self.delta = delta
        super().__init__(policy, env, *sb3, **shared)

    def guider_objective(self, batch: Samples, guider: Any, learner: Any, epsilon: th.Tensor, weights: Weights) -> th.Tensor:
        """PPO's loss with a ratio that is first clipped near the learner, and a KL term where that clipping takes effect."""
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
    GPO-penalty: PPO for the guider, with a penalty on its KL to the learner whose weight adapts to a target. Arguments that
    are not described here are those of :class:`GPO`.

    The policies share a network. The guider's penalty moves the shared parameters, so the learner moves along; only the
    learner's imitation, of weight 1, moves it back. With a weight above 1 both policies may therefore drift. The authors'
    bound on the weight is 10.

    :param target_kl: KL(guider || learner), averaged over action dimensions, above which the weight rises after a rollout, and
        below which it falls
    :param largest_kl_coef: largest value of that weight
    """

    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = {"target_kl": check_positive, "largest_kl_coef": check_positive}

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
        """The weight of the KL, which is 0 at the start."""
        kl_coef = MultiplicativeCoefficient(FIRST_KL_COEF, KL_COEF_FACTOR, self.largest_kl_coef, self.device)
        return {"kl_coef": kl_coef}

    def take_effect(self, changed: set[str]) -> None:
        """See :meth:`AsymmetricAlgorithm.take_effect`; here is the largest weight of the KL."""
        super().take_effect(changed)
        self.coefficients["kl_coef"].largest = self.largest_kl_coef  # type: ignore[union-attr]

    def guider_objective(self, batch: Samples, guider: Any, learner: Any, epsilon: th.Tensor, weights: Weights) -> th.Tensor:
        """PPO's loss plus the weighted KL to the learner."""
        surrogate = clipped_surrogate(guider.log_prob(batch.actions) - batch.old_log_prob, batch.advantages, epsilon)
        return surrogate + weights["kl_coef"] * guider.kl(learner, "mean").mean()

    def train(self) -> None:
        """The gradient steps of :meth:`AsymmetricOnPolicyAlgorithm.train`, and then a step of the KL's weight."""
        super().train()
        self.logger.record("train/target_kl", self.target_kl)
        self.logger.record("train/kl_coef_on_bound", self.coefficients["kl_coef"].at_bound().item())
        above = th.tensor(self._last_metrics["kl"] > self.target_kl, device=self.device)
        self.coefficients["kl_coef"].move(above)  # type: ignore[union-attr]
