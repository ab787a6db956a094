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
from sb3_gac.checks.values import check_integer, check_positive
from sb3_gac.math.losses import masked_mean
from sb3_gac.networks.actors import Actor
from sb3_gac.networks.critics import CriticEnsemble
from sb3_gac.optim.coefficients import Coefficient, SoftplusDual, make_coefficient

#: Coefficient -> where it starts; and the bounds of all
STARTS = {"temperature": 10.0, "kl_coef": 10.0, "std_kl_coef": 1000.0}
BOUNDS = (1e-8, 1e6)
#: What bounds the policy's fit, of the mean (or of the whole policy, where it has no parts) and of the std
FITS = ("kl", "std_kl")


def check_temperature(name: str, value: Any) -> None:
    """
    :raises ValueError: if it is a number that values can't be divided by; what else it may be is checked where it is made
    """
    if not isinstance(value, str):
        check_positive(name, value, 'or "auto", "auto_<start value>"')


class AsymmetricMPOPolicy(AsymmetricPolicy):
    """Actor on ``partial``, critics on every entry, a target of each. Arguments are those of :class:`AsymmetricPolicy`."""

    roles = Roles("actor", critics=("critic",), target_policies=("actor",))
    actor: Actor
    actor_target: Actor
    critic: CriticEnsemble
    critic_target: CriticEnsemble


class AsymmetricMPOGruPolicy(AsymmetricMPOPolicy):
    """Both networks with a GRU each."""

    default_rnn_type = "gru"


class AsymmetricMPOLstmPolicy(AsymmetricMPOPolicy):
    """Both networks with an LSTM each."""

    default_rnn_type = "lstm"


class AsymmetricMPO(AsymmetricOffPolicyAlgorithm):
    """
    MPO (Abdolmaleki et al. 2018, arXiv 1806.06920 and 1812.02256) with critics that see everything. The target actor's actions
    are weighted by exp(Q / temperature), and the actor becomes likelier to take them as they are weighted, within bounds on
    its KL to the target actor that are held by dual variables: of the mean with the target's std, and of the std with the
    target's mean, in each action dimension. Of discrete actions all are weighted, and one bound holds the whole policy.

    The actor collects the data: it is the policy that is deployed, it is what all other algorithms here collect with, and the
    bounds keep it so near its target that it makes little difference. Samples are kept before tanh, and the likelihood is
    that of the Gaussian there: the density of the action itself differs by a factor that no policy changes, and the KL by
    nothing. Tanh keeps actions in their range, so they are not penalised for leaving it. States are those of the batch.

    Arguments that are not described here are those of :class:`AsymmetricOffPolicyAlgorithm`. There is no entropy term:
    ``ent_coef`` and ``target_entropy`` are refused. A coefficient is "auto" or "auto_<start value>", which learn it, or a
    number that stays; a fixed weight of 0 leaves its KL unbounded.

    :param n_actions: samples of each state, for weights and for the critics' targets; of discrete actions all are taken
    :param temperature: difference of values for which an action counts e times as much; "auto" starts at 10
    :param target_improvement: KL(weighted actions || target actor) that the temperature is learned for
    :param kl_coef: weight of KL(target actor || actor) of the means, or of discrete actions; "auto" starts at 10
    :param target_kl: bound on it, in each action dimension
    :param std_kl_coef: weight of that KL of the stds; "auto" starts at 1000
    :param target_std_kl: bound on it, in each action dimension
    :param dual_learning_rate: Adam's step size for the temperature and the weights
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": AsymmetricMPOPolicy,
        "MultiInputGruPolicy": AsymmetricMPOGruPolicy,
        "MultiInputLstmPolicy": AsymmetricMPOLstmPolicy,
    }
    argument_checks: ClassVar[Mapping[str, Any]] = {
        "n_actions": partial(check_integer, low=1),
        "temperature": check_temperature,
        "target_improvement": check_positive,
        "target_kl": check_positive,
        "target_std_kl": check_positive,
        "dual_learning_rate": check_positive,
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
        """The temperature, and the weights of the KLs, one for each action dimension."""
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
        """See :meth:`GradientSteps.refresh_schedules`; the duals' rate is what the argument says, whatever a file said."""
        for coefficient in self.coefficients.values():
            if coefficient.optimizer is not None:
                coefficient.optimizer.param_groups[0]["lr"] = self.dual_learning_rate
        super().refresh_schedules()

    def update(self, batch: Batch) -> Metrics:
        """Policy evaluation, E-step and M-step, and a step of each dual variable."""
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
        """The target actor's return, with the mean over its actions at the next observations."""
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
        """-E_improved log pi of each part of the policy, and its KL from the target actor by its weights."""
        with th.no_grad():
            candidates = target.now.candidates(batch.q_at_obs(self.policy.critic_target), noise)
            shares, improvement = candidates.improved(temperature)
        loss = th.zeros((), device=self.device)
        for name, fit in fits.items():
            penalty = (self.coefficients[f"{name}_coef"].value * kls[name]).sum(dim=-1)
            loss = loss + masked_mean(penalty - (shares * fit.log_likelihood(candidates)).sum(dim=-1), batch.mask)
        seen = {name: masked_mean(kl.detach().mean(dim=-1), batch.mask) for name, kl in kls.items()}
        return Loss(loss, {"improvement": masked_mean(improvement, batch.mask), **seen})
