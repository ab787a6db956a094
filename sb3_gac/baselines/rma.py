"""Rapid Motor Adaptation: learn with a latent of the privileged entries, then estimate the latent from the history."""

import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch as th
import torch.nn.functional as F
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import GymEnv
from typing_extensions import Unpack

from sb3_gac.base.arguments import OffPolicyArguments
from sb3_gac.base.batch import Batch, Loss, Metrics
from sb3_gac.base.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.roles import Roles
from sb3_gac.checks.arguments import ArgumentCheck, unless
from sb3_gac.checks.values import check_integer
from sb3_gac.math.losses import masked_mean, policy_loss
from sb3_gac.networks.actors import Actor
from sb3_gac.networks.adaptation import Adaptation
from sb3_gac.networks.critics import CriticEnsemble
from sb3_gac.networks.encoders import JoinedExtractor, LatentExtractor


class RMAPolicy(AsymmetricPolicy):
    """
    The ``actor`` acts on ``partial`` and a latent z, which its part ``adaptation`` estimates from past observations and
    actions. The ``expert`` has the same layers on the true z, which an encoder computes from all other entries. Critics read
    ``partial`` and z; target critics have a target encoder. In ``role_keys``, "expert" names the encoded entries, and "critic"
    the entries that critics read beside z. Other arguments are those of :class:`AsymmetricPolicy`.

    :param history: number of observation-action pairs that z is estimated from, K
    :param latent_dim: size of z, L
    :param encoder_net_arch: hidden layer sizes of the encoder
    """

    roles = Roles(
        "actor", ("expert",), ("critic",), unprivileged=("critic",), collects="expert", parts=("adaptation",), tied=("expert",)
    )
    actor: Actor
    expert: Actor
    critic: CriticEnsemble
    critic_target: CriticEnsemble

    def __init__(
        self, *args: Any, history: int = 50, latent_dim: int = 8, encoder_net_arch: Sequence[int] = (256, 128), **kwargs: Any
    ):
        check_integer("latent_dim", latent_dim, 1)
        self.history, self.latent_dim, self.encoder_net_arch = history, latent_dim, list(encoder_net_arch)
        super().__init__(*args, **kwargs)

    def own_options(self) -> dict[str, Any]:
        """Constructor arguments of this class alone, see :meth:`AsymmetricPolicy.own_options`."""
        return {name: getattr(self, name) for name in ("history", "latent_dim", "encoder_net_arch")}

    @property
    def adaptation(self) -> Adaptation:
        """The module that estimates z, which is the actor's memory."""
        return self.actor.memory  # type: ignore[return-value]

    def complete_role_keys(self, role_keys: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
        """Add the encoded entries to those of expert and critic, see :meth:`AsymmetricPolicy.complete_role_keys`."""
        self.beside = {"expert": role_keys["actor"], "critic": role_keys["critic"]}
        self.encoded = [key for key in role_keys["expert"] if key not in role_keys["actor"]]
        if not self.encoded:
            raise ValueError(f"RMA encodes entries that its actor does not read, but there are none in {role_keys['expert']}.")
        return role_keys | {role: tuple(dict.fromkeys([*keys, *self.encoded])) for role, keys in self.beside.items()}

    def make_extractor(self, role: str, keys: Sequence[str]) -> BaseFeaturesExtractor:
        """The role's own encoder, joined with that of z for expert and critic, see :meth:`AsymmetricPolicy.make_extractor`."""
        own = super().make_extractor(role, self.beside.get(role, keys))
        if role == "actor":
            return own
        entries = super().make_extractor("expert", self.encoded)
        return JoinedExtractor([own, LatentExtractor(entries, self.encoder_net_arch, self.latent_dim, self.activation_fn)])

    def body_arguments(self, role: str, features_dim: int) -> dict[str, Any]:
        """Arguments of a role's network; the actor's has the adaptation, see :meth:`AsymmetricPolicy.body_arguments`."""
        body = super().body_arguments(role, features_dim)
        if role == "actor":
            memory = Adaptation(features_dim, self.action_space, self.history, self.latent_dim, self.activation_fn)
            body |= {"memory": memory, "features_dim": features_dim + self.latent_dim}
        return body

    def tie_networks(self) -> None:
        """Give the expert the actor's layers and the critics' encoder of z, see :meth:`AsymmetricPolicy.tie_networks`."""
        encoder = self.critic.features_extractor.extractors[-1]  # type: ignore[index]
        self.expert.features_extractor = JoinedExtractor([self.actor.features_extractor, encoder])  # type: ignore[list-item]
        self.expert.latent_net, self.expert.head = self.actor.latent_net, self.actor.head


class RMA(AsymmetricOffPolicyAlgorithm):
    """
    Rapid Motor Adaptation (Kumar et al. 2021, arXiv 2107.04034), on SAC. In phase 1 the expert, an actor with the true z,
    collects data and learns by SAC; the losses of actor and critics train the encoder of z. In phase 2 these networks are
    frozen, the actor collects data with its own estimate of z, and the estimate is fitted to z on the data of phase 2 alone.

    ``predict`` is the actor's with its estimate of z, which is untrained before phase 2; the history is the state of
    ``predict``. Other arguments are those of :class:`AsymmetricOffPolicyAlgorithm`.

    :param history: number of observation-action pairs that z is estimated from, K
    :param phase_1_steps: value of ``num_timesteps`` at which phase 2 begins, above ``learning_starts``; ``None`` for half of
        the steps of the ``learn`` that counts from 0. A ``learn`` that resets ``num_timesteps`` begins with phase 1 again
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": RMAPolicy}
    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = {
        "history": partial(check_integer, low=1),
        "phase_1_steps": unless(None, check_integer, low=1, remedy="or None for half of the steps"),
    }
    compiled_settings = (*AsymmetricOffPolicyAlgorithm.compiled_settings, "target_entropy", "phase")
    samples_histories = True
    policy: RMAPolicy

    def __init__(
        self,
        policy: str | type[RMAPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        history: int = 50,
        phase_1_steps: int | None = None,
        **shared: Unpack[OffPolicyArguments],
    ):
        self.history, self.phase_1_steps = history, phase_1_steps
        self.phase, self.half_of_the_steps = 1, 0
        super().__init__(policy, env, *sb3, **shared)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.phase_1_steps is not None and self.phase_1_steps <= self.learning_starts:
            raise ValueError(f"phase_1_steps must be above learning_starts={self.learning_starts}, got {self.phase_1_steps}.")
        if self.is_recurrent or (self.policy_kwargs or {}).get("share_features_extractor"):
            raise ValueError("RMA remembers and encodes in its own way: leave rnn_type and share_features_extractor out.")

    def _policy_options(self) -> dict[str, Any]:
        return super()._policy_options() | {"history": self.history}

    def warn_of_networks_at_rest(self, total_timesteps: int) -> None:
        """Warn before a training that ends in phase 1, see :meth:`AsymmetricOffPolicyAlgorithm.warn_of_networks_at_rest`."""
        if self.phase_1_steps is not None and self.learning_starts < total_timesteps <= self.phase_1_steps:
            warnings.warn(
                f"RMA ends in phase 1, because phase_1_steps is {self.phase_1_steps} and training ends after "
                f"{total_timesteps} steps: the deployed actor's estimate of z stays untrained. Lower phase_1_steps or leave "
                "it out, raise total_timesteps, or go on by learn(..., reset_num_timesteps=False).",
                stacklevel=3,
            )

    def choose_acting(self, episode_start: np.ndarray) -> list[str]:
        """The policy that acts in each environment: by default the expert in phase 1, and the actor in phase 2."""
        if self._num_timesteps_at_start == 0:
            self.half_of_the_steps = self._total_timesteps // 2
        ends = max(self.half_of_the_steps if self.phase_1_steps is None else self.phase_1_steps, self.learning_starts)
        before, self.phase = self.phase, 1 if self.num_timesteps < ends else 2
        if before < self.phase:
            self.replay_buffer.retire()  # type: ignore[union-attr]
            self._has_warmed_up |= ~episode_start  # the episodes under way are neither policy's
        own = ["expert" if self.phase == 1 else "actor"] * len(episode_start)
        return own if self.behaviour is None else super().choose_acting(episode_start)

    def training_state(self) -> dict[str, Any]:
        """State of the training that checkpoints keep, see :meth:`AsymmetricOffPolicyAlgorithm.training_state`."""
        return {"phase": self.phase, "half_of_the_steps": self.half_of_the_steps}

    @property
    def history_length(self) -> int:
        """Number of steps in the batches' histories, see :attr:`AsymmetricOffPolicyAlgorithm.history_length`."""
        return self.history if self.phase == 2 else 0

    @property
    def at_rest(self) -> frozenset[str]:
        """The networks that the present phase does not train, see :attr:`AsymmetricOffPolicyAlgorithm.at_rest`."""
        return frozenset(["adaptation"] if self.phase == 1 else self.policy.roles.networks)

    def update(self, batch: Batch) -> Metrics:
        """One gradient step: in phase 1 SAC's, with z in place of the privileged entries; in phase 2 the adaptation's."""
        if self.phase == 2:
            return self.minimize("adaptation", self.adaptation_loss, batch)
        ent_coef, beta = self.coefficients["ent_coef"], self.coefficients["ent_coef"].value
        noise = th.randn((2, *batch.actions.shape), device=self.device)
        metrics = self.minimize(("critic", "expert"), self.critic_loss, batch, noise[0], beta)
        metrics |= self.minimize(("actor", "expert"), self.actor_loss, batch, noise[1], beta)
        return metrics | ent_coef.update(float(self.target_entropy) - metrics["entropy"]) | self.coefficient_values()

    def critic_loss(self, batch: Batch, noise: th.Tensor, beta: th.Tensor) -> Loss:
        """The critics, with their encoder of z, fit the expert's return and entropy."""
        with th.no_grad():
            later: Any = self.policy.expert.distribution(batch.next_observations)
            next_q, log_prob = later.value_and_log_prob(batch.q_at_next_obs(self.policy.critic_target), noise)
        return self.bellman_loss("critic", batch, batch.soft_target(next_q, next_log_prob=log_prob, ent_coef=beta))

    def actor_loss(self, batch: Batch, noise: th.Tensor, beta: th.Tensor) -> Loss:
        """The actor's layers and the encoder of z climb the critics, with an entropy term; the critics' z is a constant."""
        now: Any = self.policy.expert.distribution(batch.observations)
        q, log_prob = now.value_and_log_prob(batch.q_at_obs(self.policy.critic), noise)
        entropy = -masked_mean(log_prob, batch.mask)
        return Loss(policy_loss(q=q, log_prob=log_prob, ent_coef=beta, mask=batch.mask), {"entropy": entropy})

    def adaptation_loss(self, batch: Batch) -> Loss:
        """Mean squared error of the actor's estimates of z."""
        actor, expert, histories = self.policy.actor, self.policy.expert, batch.histories
        assert histories is not None
        with th.no_grad():
            z = expert.extract_features(batch.observations, expert.features_extractor)[:, -self.policy.latent_dim :]
            features = actor.extract_features(histories.observations, actor.features_extractor)
        state = self.policy.adaptation.state_of(features, histories.actions, histories.mask)
        return Loss(F.mse_loss(self.policy.adaptation.estimate(state), z), {})
