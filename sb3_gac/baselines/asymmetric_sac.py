"""Soft Actor-Critic whose critics see more than its actor: SAC-asym, and with other ``role_keys`` SAC on either view."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from typing_extensions import Unpack

from sb3_gac.base.arguments import OffPolicyArguments
from sb3_gac.base.batch import Batch, Loss, Metrics, Outputs
from sb3_gac.base.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.roles import Roles
from sb3_gac.checks.arguments import ArgumentCheck
from sb3_gac.checks.values import check_integer
from sb3_gac.math.losses import masked_mean, policy_loss
from sb3_gac.networks.actors import Actor
from sb3_gac.networks.critics import CriticEnsemble


class AsymmetricSACPolicy(AsymmetricPolicy):
    """An actor and twin critics, each on the entries of its role. Arguments are those of :class:`AsymmetricPolicy`."""

    roles = Roles("actor", critics=("critic",))
    actor: Actor
    critic: CriticEnsemble
    critic_target: CriticEnsemble


class AsymmetricSACGruPolicy(AsymmetricSACPolicy):
    """The policy of :class:`AsymmetricSACPolicy` with a GRU in each network."""

    default_rnn_type = "gru"


class AsymmetricSACLstmPolicy(AsymmetricSACPolicy):
    """The policy of :class:`AsymmetricSACPolicy` with an LSTM in each network."""

    default_rnn_type = "lstm"


class AsymmetricSAC(AsymmetricOffPolicyAlgorithm):
    """
    SAC with an actor on ``partial`` and critics on every entry (Pinto et al. 2018, arXiv 1710.06542, with SAC's losses).

    ``role_keys={"critic": ["partial"]}`` makes it SAC on the partial view, ``role_keys={"actor": ["partial",
    "privileged"]}`` SAC on the full state. Arguments that are not described here are those of
    :class:`AsymmetricOffPolicyAlgorithm`.

    :param critic_groups: number of groups of equal size that the critics form: the target of a group's critics is the minimum
        over that group, and the actor climbs the mean of the groups' minima. With ``policy_kwargs={"n_critics": 4}`` and 2
        groups there are as many critics as in GAC
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": AsymmetricSACPolicy,
        "MultiInputGruPolicy": AsymmetricSACGruPolicy,
        "MultiInputLstmPolicy": AsymmetricSACLstmPolicy,
    }
    policy: AsymmetricSACPolicy
    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = {"critic_groups": partial(check_integer, low=1)}
    compiled_settings = (*AsymmetricOffPolicyAlgorithm.compiled_settings, "target_entropy", "critic_groups")

    def __init__(
        self,
        policy: str | type[AsymmetricSACPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        critic_groups: int = 1,
        **shared: Unpack[OffPolicyArguments],
    ):
        self.critic_groups = critic_groups
        super().__init__(policy, env, *sb3, **shared)

    def _setup_model(self) -> None:
        super()._setup_model()
        self._check_groups()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if isinstance(getattr(self, "policy", None), AsymmetricSACPolicy):  # not before there is one
            self._check_groups()

    def _check_groups(self) -> None:
        if self.policy.n_critics % self.critic_groups:
            raise ValueError(
                f"critic_groups={self.critic_groups} can't be of the same size with {self.policy.n_critics} critics: give "
                'policy_kwargs={"n_critics": <a multiple of it>}.'
            )

    def update(self, batch: Batch) -> Metrics:
        """SAC's gradient step: the critics' loss is eq. 15 with an entropy term, the actor's loss eq. 16 without a guider."""
        beta = self.coefficients["ent_coef"].value
        noise = th.randn((2, *batch.actions.shape), device=self.device)
        (actor,) = self.outputs(batch, "actor")
        metrics = self.minimize("critic", self.critic_loss, batch, actor, noise[0], beta)
        metrics |= self.minimize("actor", self.actor_loss, batch, actor, noise[1], beta)
        metrics |= self.coefficients["ent_coef"].update(float(self.target_entropy) - metrics["entropy"])
        return metrics | self.coefficient_values()

    def critic_loss(self, batch: Batch, actor: Outputs, noise: th.Tensor, beta: th.Tensor) -> Loss:
        """The critics fit the actor's return and entropy."""
        targets = []
        with th.no_grad():
            for group in self.groups(batch.q_at_next_obs(self.policy.critic_target)):
                next_q, log_prob = actor.later.value_and_log_prob(group, noise)
                targets.append(batch.soft_target(next_q, next_log_prob=log_prob, ent_coef=beta))
            target = th.stack(targets).repeat_interleave(self.policy.n_critics // self.critic_groups, dim=0)
        return self.bellman_loss("critic", batch, target)

    def actor_loss(self, batch: Batch, actor: Outputs, noise: th.Tensor, beta: th.Tensor) -> Loss:
        """The actor climbs the critics, with an entropy term."""
        now = actor.now
        groups = self.groups(batch.q_at_obs(self.policy.critic))
        q, log_prob = now.value_and_log_prob(lambda actions: _mean_of_minima([group(actions) for group in groups]), noise)
        seen = {f"actor_{name}": masked_mean(values, batch.mask) for name, values in now.diagnostics().items()}
        loss = policy_loss(q=q, log_prob=log_prob, ent_coef=beta, mask=batch.mask)
        return Loss(loss, {"entropy": -masked_mean(log_prob, batch.mask), **seen})

    def groups(self, q_function: Callable[[Any], th.Tensor]) -> list[Callable[[Any], th.Tensor]]:
        r"""
        The critics by groups.

        :param q_function: function from actions to the values of N critics, shape (N, \*E)
        :return: for each of G groups, the function from actions to the values of its critics, shape (N / G, \*E)
        """
        if self.critic_groups == 1:
            return [q_function]
        size = self.policy.n_critics // self.critic_groups

        def group(first: int, actions: Any) -> th.Tensor:
            return q_function(actions)[first : first + size]

        return [partial(group, first) for first in range(0, self.policy.n_critics, size)]


def _mean_of_minima(groups: list[th.Tensor]) -> th.Tensor:
    """Mean of the groups' minima; a single group stays as it is, since the policy's loss takes its minimum."""
    return groups[0] if len(groups) == 1 else th.stack([q.amin(dim=0) for q in groups]).mean(dim=0, keepdim=True)
