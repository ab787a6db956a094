"""Maximum a Posteriori Policy Optimisation with critics that see everything."""

from collections.abc import Mapping
from functools import partial
from math import prod
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from typing_extensions import Unpack

from sb3_gac.base.arguments import OffPolicyArguments
from sb3_gac.base.batch import Batch, Loss, Metrics, Outputs
from sb3_gac.base.off_policy import AsymmetricOffPolicyAlgorithm
from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.base.roles import Roles
from sb3_gac.checks.arguments import ArgumentCheck
from sb3_gac.checks.values import check_integer, check_positive
from sb3_gac.math.losses import masked_mean
from sb3_gac.networks.actors import Actor
from sb3_gac.networks.critics import CriticEnsemble
from sb3_gac.optim.coefficients import Coefficient, SoftplusDual, make_coefficient

#: Start value of each coefficient, by name, and the bounds of all of them
STARTS = {"temperature": 10.0, "kl_coef": 10.0, "std_kl_coef": 1000.0}
BOUNDS = (1e-8, 1e6)
#: Names of the KLs that bound the policy's fit: of the mean (of the whole policy, if actions are discrete), and of the std
FITS = ("kl", "std_kl")


def check_temperature(name: str, value: Any) -> None:
    """
    Check the type and sign of a number; :func:`make_coefficient` checks a text.

    :param name: name of the argument
    :param value: the argument's value
    :raises ValueError: if the value is neither a text nor a number above 0
    """
    if not isinstance(value, str):
        check_positive(name, value, 'or "auto", "auto_<start value>"')


class AsymmetricMPOPolicy(AsymmetricPolicy):
    """
    An actor on ``partial`` and critics on every entry, each with a target network. Arguments are those of
    :class:`AsymmetricPolicy`.
    """

    roles = Roles("actor", critics=("critic",), target_policies=("actor",))
    actor: Actor
    actor_target: Actor
    critic: CriticEnsemble
    critic_target: CriticEnsemble


class AsymmetricMPOGruPolicy(AsymmetricMPOPolicy):
    """The policy of :class:`AsymmetricMPOPolicy` with a GRU in each network."""

    default_rnn_type = "gru"


class AsymmetricMPOLstmPolicy(AsymmetricMPOPolicy):
    """The policy of :class:`AsymmetricMPOPolicy` with an LSTM in each network."""

    default_rnn_type = "lstm"


class AsymmetricMPO(AsymmetricOffPolicyAlgorithm):
    """
    MPO (Abdolmaleki et al. 2018, arXiv 1806.06920 and 1812.02256) with critics that see everything. Actions of the target
    actor get weights in proportion to exp(Q / temperature), and the actor is fitted to the weighted actions by likelihood. Two
    bounds on KL(target actor || actor) limit the fit in each action dimension, one for the mean (with the target's std) and
    one for the std (with the target's mean); dual variables hold both. With discrete actions every action gets a weight, and
    one bound holds the whole policy.

    The actor collects the data, not its target: the actor is deployed, and the bounds keep it so near to its target that the
    choice makes little difference. Likelihood and KL are those of the Gaussian before tanh: the density of the action itself
    differs by a factor that no policy changes, and its KL is the same. Actions need no penalty for leaving their range, since
    tanh keeps them in it. The E-step takes the states of the batch.

    Arguments that are not described here are those of :class:`AsymmetricOffPolicyAlgorithm`. There is no entropy term:
    ``ent_coef`` and ``target_entropy`` are refused. A coefficient (``temperature``, ``kl_coef``, ``std_kl_coef``) is learned
    with "auto" or "auto_<start value>", and fixed with a number; a fixed weight of 0 leaves its KL unbounded.

    :param n_actions: number of actions sampled in each state, for the weights and for the critics' targets; without effect if
        actions are discrete
    :param temperature: difference in Q for which an action's weight is e times as large; "auto" starts at 10
    :param target_improvement: bound on KL(weighted actions || target actor) that a learned temperature holds
    :param kl_coef: weight of KL(target actor || actor) of the means, or of discrete actions; "auto" starts at 10
    :param target_kl: bound on that KL, in each action dimension
    :param std_kl_coef: weight of KL(target actor || actor) of the stds; "auto" starts at 1000
    :param target_std_kl: bound on that KL, in each action dimension
    :param dual_learning_rate: Adam's step size for the temperature and the two weights
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": AsymmetricMPOPolicy,
        "MultiInputGruPolicy": AsymmetricMPOGruPolicy,
        "MultiInputLstmPolicy": AsymmetricMPOLstmPolicy,
    }
    argument_checks: ClassVar[Mapping[str, ArgumentCheck]] = {
        "n_actions": partial(check_integer, low=1),
        "temperature": check_temperature,
        **dict.fromkeys(("target_improvement", "target_kl", "target_std_kl", "dual_learning_rate"), check_positive),
    }
    restored_arguments = (*AsymmetricOffPolicyAlgorithm.restored_arguments, *STARTS)
    compiled_settings = (
        *AsymmetricOffPolicyAlgorithm.compiled_settings,
        *("n_actions", "target_improvement", "target_kl", "target_std_kl"),
    )
    policy: AsymmetricMPOPolicy

    def __init__(
        self,
        policy: str | type[AsymmetricMPOPolicy],
        env: GymEnv | str | None,
        *sb3: Any,
        n_actions: int = 20,
        temperature: str | float = "auto",
        target_improvement: float = 0.1,
        kl_coef: str | float = "auto",
        target_kl: float = 0.0025,
        std_kl_coef: str | float = "auto",
        target_std_kl: float = 1e-6,
        dual_learning_rate: float = 1e-2,
        **shared: Unpack[OffPolicyArguments],
    ):
        self.n_actions = n_actions
        self.temperature, self.target_improvement = temperature, target_improvement
        self.kl_coef, self.target_kl = kl_coef, target_kl
        self.std_kl_coef, self.target_std_kl = std_kl_coef, target_std_kl
        self.dual_learning_rate = dual_learning_rate
        super().__init__(policy, env, *sb3, **shared)

    def make_coefficients(self) -> dict[str, Coefficient]:
        """The temperature, and the weights of the KLs, one number for each action dimension."""
        box = isinstance(self.action_space, spaces.Box)
        shapes = {"temperature": (), "kl_coef": (prod(self.action_space.shape or ()),)}
        shapes |= {"std_kl_coef": shapes["kl_coef"]} if box else {}
        return {
            name: make_coefficient(
                name, getattr(self, name), STARTS[name], BOUNDS, self.dual_learning_rate, self.device, SoftplusDual, shape
            )
            for name, shape in shapes.items()
        }

    def refresh_schedules(self) -> None:
        """Update what follows schedules; the duals' learning rate follows the argument, not the optimiser state of a file."""
        for coefficient in self.coefficients.values():
            if coefficient.optimizer is not None:
                coefficient.optimizer.param_groups[0]["lr"] = self.dual_learning_rate
        super().refresh_schedules()

    def update(self, batch: Batch) -> Metrics:
        """One gradient step: policy evaluation, E-step and M-step, and a step of each dual variable."""
        temperature = self.coefficients["temperature"]
        noise = th.randn((2, self.n_actions, *batch.actions.shape), device=self.device)
        (actor,) = self.outputs(batch, "actor")
        with th.no_grad():
            (target,) = self.outputs(batch, "actor_target")
        fits = dict(zip(FITS, actor.now.decoupled(target.now), strict=False))
        kls = {name: target.now.kl_by_dimension(fit) for name, fit in fits.items()}
        metrics = self.minimize("critic", self.critic_loss, batch, target, noise[0])
        metrics |= self.minimize("actor", self.actor_loss, batch, fits, kls, target, noise[1], temperature.value)
        metrics |= temperature.update(metrics["improvement"] - self.target_improvement)
        for name, kl in kls.items():
            metrics |= self.coefficients[f"{name}_coef"].update(kl.detach() - getattr(self, f"target_{name}"), batch.mask)
        return metrics | self.coefficient_values()

    def critic_loss(self, batch: Batch, target: Outputs, noise: th.Tensor) -> Loss:
        """The critics fit the target actor's return, with the mean Q over its sampled actions at the next observations."""
        with th.no_grad():
            candidates = target.later.candidates(batch.q_at_next_obs(self.policy.critic_target), noise)
            bellman_target = batch.soft_target(candidates.mean_value)
        return self.bellman_loss("critic", batch, bellman_target)

    def actor_loss(
        self,
        batch: Batch,
        fits: dict[str, Any],
        kls: dict[str, th.Tensor],
        target: Outputs,
        noise: th.Tensor,
        temperature: th.Tensor,
    ) -> Loss:
        """For mean and std, the weighted negative log-likelihood of the target actor's actions plus the weighted KL."""
        with th.no_grad():
            candidates = target.now.candidates(batch.q_at_obs(self.policy.critic_target), noise)
            shares, improvement = candidates.improved(temperature)
        loss = th.zeros((), device=self.device)
        for name, fit in fits.items():
            penalty = (self.coefficients[f"{name}_coef"].value * kls[name]).sum(dim=-1)
            loss = loss + masked_mean(penalty - (shares * fit.log_likelihood(candidates)).sum(dim=-1), batch.mask)
        seen = {name: masked_mean(kl.detach().mean(dim=-1), batch.mask) for name, kl in kls.items()}
        return Loss(loss, {"improvement": masked_mean(improvement, batch.mask), **seen})
