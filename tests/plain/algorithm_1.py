"""
Guided Actor-Critic's Algorithm 1 and SAC with asymmetric critics as one would write them first, in float64.

One network after the other, torch's own layers, densities, optimisers and clipping. Nothing of the package is used.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch as th
from torch import nn

from tests.plain.networks import Network, plain_critics, plain_policy
from tests.plain.replay import Batch

#: Actions, or None for all -> a list of values, one of each critic
Critics = Callable[[Any], list[th.Tensor]]


class Gaussian(NamedTuple):
    """tanh(N(mean, std^2)), shapes (*E, A)."""

    mean: th.Tensor
    std: th.Tensor

    def value_and_log_prob(self, q: Critics, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The smallest critic's value of one action, and its log-density."""
        x = self.mean + self.std * noise
        action = th.tanh(x)
        log_prob = th.distributions.Normal(self.mean, self.std).log_prob(x) - th.log1p(-action.square())
        return th.stack(q(action)).amin(dim=0), log_prob.sum(dim=-1)

    def kl(self, other: "Gaussian", reduction: str) -> th.Tensor:
        """KL(self || other), of one std, which it must not move."""
        normals = [th.distributions.Normal(mean, self.std.detach()) for mean in (self.mean, other.mean)]
        kl = th.distributions.kl_divergence(*normals)
        return kl.sum(dim=-1) if reduction == "sum" else kl.sum(dim=-1) / kl.shape[-1]

    def detach(self) -> "Gaussian":
        return Gaussian(self.mean.detach(), self.std.detach())


class Choice(NamedTuple):
    """One of A actions, logits of shape (*E, A)."""

    logits: th.Tensor

    def value_and_log_prob(self, q: Critics, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Of each action the smallest critic's value, and the log-probability, weighted by how likely it is."""
        distribution = th.distributions.Categorical(logits=self.logits)
        return (distribution.probs * th.stack(q(None)).amin(dim=0)).sum(dim=-1), -distribution.entropy()

    def kl(self, other: "Choice", reduction: str) -> th.Tensor:
        """KL(self || other)."""
        return th.distributions.kl_divergence(*(th.distributions.Categorical(logits=one.logits) for one in (self, other)))

    def detach(self) -> "Choice":
        return Choice(self.logits.detach())


class Coefficient:
    """exp of a number that Adam moves up while its constraint is violated; or a fixed number."""

    def __init__(self, name: str, given: str | float, rate: float, bounds: tuple[float, float] = (1e-8, 1e4)):
        self.name = name
        self.learned = isinstance(given, str)
        self.log_value = th.tensor(float(str(given).removeprefix("auto_")), dtype=th.float64).log().requires_grad_()
        self.log_bounds = th.tensor(bounds, dtype=th.float64).log()
        self.optimizer = th.optim.Adam([self.log_value], lr=rate)

    @property
    def value(self) -> th.Tensor:
        return self.log_value.detach().exp()

    def update(self, mean_violation: th.Tensor) -> dict[str, th.Tensor]:
        if not self.learned:
            return {}
        self.optimizer.zero_grad()
        loss = -self.log_value.exp() * mean_violation.detach()
        loss.backward()
        self.optimizer.step()
        with th.no_grad():
            self.log_value.clamp_(*self.log_bounds)
        return {f"{self.name}_loss": loss}


@dataclass
class Settings:
    """
    Arguments of the algorithms; what they decide by "auto" is written out.

    :param shared_std: whose std guider and learner have
    :param pull: weight of the KL in the learner's objective, as a multiple of alpha
    :param guidance: what is added to that weight, as a multiple of the mean |Q| that the learner climbs
    :param critic_groups: of SAC, each with a minimum of its own
    :param rates: network -> learning rate, where it is not ``learning_rate``
    """

    learning_rate: float
    gamma: float
    tau: float
    log_std_bounds: tuple[float, float]
    softplus_min_std: float | None = None
    ent_coef: str | float = 0.0
    target_entropy: float = 0.0
    target_kl: float = 0.0
    kl_coef: str | float = 0.0
    kl_coef_bounds: tuple[float, float] = (1e-4, 100.0)
    kl_coef_learning_rate: float = 3e-3
    kl_reduction: str = "mean"
    guider: str = "residual"
    max_kl: float | None = None
    shared_std: str = "learner"
    pull: float = 0.0
    guidance: float = 0.0
    learner_entropy: bool = True
    critic_groups: int = 1
    teacher_coef: str | float = 1.0
    teacher_coef_bounds: tuple[float, float] = (1e-4, 100.0)
    teacher_coef_learning_rate: float = 1e-3
    target_divergence: float = 0.0
    max_grad_norm: float | None = None
    target_update_interval: int = 1
    optimizer: type[th.optim.Optimizer] = th.optim.SGD
    rates: dict[str, float] = field(default_factory=dict)


class PlainAlgorithm:
    """
    What all of them share.

    :param policy: of the model, which is copied
    :param names: of its networks that are trained
    :param settings: of the model
    """

    settings_class: type[Settings] = Settings

    def __init__(self, policy: Any, names: list[str], settings: Settings):
        self.settings = settings
        self.networks: dict[str, Any] = {name: self.copied(policy, name) for name in names}
        self.targets = {f"{name}_target": self.copied(policy, f"{name}_target") for name in names if "critic" in name}
        self.optimizers = {
            name: settings.optimizer(network.parameters(), lr=settings.rates.get(name, settings.learning_rate))
            for name, network in self.networks.items()
        }
        self.beta = Coefficient("ent_coef", settings.ent_coef, settings.learning_rate)
        self.coefficients: dict[str, Any] = {"ent_coef": self.beta}
        self.discrete = not hasattr(policy.action_space, "low")
        self.n_steps_done = 0
        self.logged: dict[str, th.Tensor] = {}

    @staticmethod
    def copied(policy: Any, name: str) -> nn.Module:
        """A network of the package's, as it is now."""
        network = getattr(policy, name)
        return plain_critics(network) if "critic" in name else plain_policy(network)

    def seen(self, network: Network, batch: Batch) -> tuple[th.Tensor, th.Tensor]:
        """What a network sees at the observations, and at the next ones."""
        if batch.next_observations is None:
            sequence = network.seen(batch.observations)
            return sequence[:-1], sequence[1:]
        return network.seen(batch.observations), network.seen(batch.next_observations)

    def q(self, critics: Any, batch: Batch, later: bool = False) -> Critics:
        """Of actions, or of all, at the observations or the next ones."""
        seen = [self.seen(critic, batch)[later] for critic in critics]

        def values(actions: Any) -> list[th.Tensor]:
            outputs = [one.heads["q"](one.hidden(x, actions)) for one, x in zip(critics, seen, strict=True)]
            return outputs if actions is None else [output[..., 0] for output in outputs]

        return values

    def fit_critics(self, name: str, batch: Batch, y: th.Tensor | list[th.Tensor]) -> None:
        """Half the mean square of each critic's error, summed up over critics; targets are one for all, or one for each."""
        critics = self.networks[name]
        if self.discrete:
            q = [values.gather(-1, batch.actions.long())[..., 0] for values in self.q(critics, batch)(None)]
        else:
            q = self.q(critics, batch)(batch.actions)
        targets = y if isinstance(y, list) else [y] * len(q)
        errors = [batch.learned * (one - to).square() for one, to in zip(q, targets, strict=True)]
        loss = th.stack([0.5 * batch.mean(error) for error in errors]).sum()
        self.logged[f"{name}_q"] = th.stack([batch.mean(one) for one in q]).mean()
        self.logged[f"{name}_loss"] = loss
        self.descend(name, loss)

    def descend(self, name: str, loss: th.Tensor, unclipped: list[nn.Parameter] | None = None) -> None:
        """One step of one network; the norm that is bounded is that of all its gradients but some."""
        parameters = list(self.networks[name].parameters())
        gradients = th.autograd.grad(loss, parameters, allow_unused=True)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = th.zeros_like(parameter) if gradient is None else gradient
        others = {id(parameter) for parameter in unclipped or []}
        clipped = [parameter for parameter in parameters if id(parameter) not in others]
        self.logged[f"{name}_grad_norm"] = th.cat([parameter.grad.flatten() for parameter in clipped]).norm()
        if self.settings.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(clipped, self.settings.max_grad_norm)
        self.optimizers[name].step()

    def distribution(self, outputs: dict[str, th.Tensor]) -> Gaussian | Choice:
        """A network's own."""
        if "logits" in outputs:
            return Choice(outputs["logits"])
        return Gaussian(outputs["mean"], self.std(outputs["log_std"]))

    def std(self, output: th.Tensor) -> th.Tensor:
        """What a network's last layer says of it."""
        if self.settings.softplus_min_std is None:
            return output.clamp(*self.settings.log_std_bounds).exp()
        return (1 + output.exp()).log() + self.settings.softplus_min_std

    def outputs(self, network: Network, batch: Batch) -> list[dict[str, th.Tensor]]:
        """Of a policy's network, at the observations and at the next ones."""
        hidden = [network.hidden(seen) for seen in self.seen(network, batch)]
        return [{name: head(x) for name, head in network.heads.items()} for x in hidden]

    def described(self, name: str, policy: Any, batch: Batch) -> dict[str, th.Tensor]:
        """What is logged of the deployed policy, and the temperature."""
        if isinstance(policy, Choice):
            of_policy = {"max_prob": policy.logits.softmax(dim=-1).amax(dim=-1)}
        else:
            of_policy = {"std": policy.std.mean(dim=-1), "mean_abs": policy.mean.abs().mean(dim=-1)}
        means = {f"{name}_{quantity}": batch.mean(values) for quantity, values in of_policy.items()}
        return {**means, "ent_coef": self.beta.value}

    def update_targets(self) -> None:
        """tau theta + (1 - tau) theta_bar."""
        self.n_steps_done += 1
        if self.n_steps_done % self.settings.target_update_interval:
            return
        for name, target in self.targets.items():
            network = self.networks[name.removesuffix("_target")]
            for p, p_bar in zip(network.parameters(), target.parameters(), strict=True):
                p_bar.data = self.settings.tau * p.data + (1 - self.settings.tau) * p_bar.data


class PlainGAC(PlainAlgorithm):
    """
    Algorithm 1.

    :param policy: of the model
    :param settings: of the model
    """

    n_noises = 4

    def __init__(self, policy: Any, settings: Settings):
        names = ["guider_critic", "guider", "learner"] + ["learner_critic"] * (policy.learner_critic is not None)
        super().__init__(policy, names, settings)
        self.alpha = Coefficient("kl_coef", settings.kl_coef, settings.kl_coef_learning_rate, settings.kl_coef_bounds)
        self.coefficients["kl_coef"] = self.alpha
        self.theta, self.theta_bar = self.networks["guider_critic"], self.targets["guider_critic_target"]
        self.phi = self.networks.get("learner_critic", self.theta)
        self.phi_bar = self.targets.get("learner_critic_target")
        if settings.guider == "lagged":
            self.targets["learner_target"] = self.copied(policy, "learner_target")

    def policies(self, guider_outputs: dict[str, th.Tensor], learner_outputs: dict[str, th.Tensor]) -> tuple[Any, Any]:
        """mu and pi."""
        settings = self.settings
        mu, pi = self.distribution(guider_outputs), self.distribution(learner_outputs)
        if isinstance(mu, Choice) or isinstance(pi, Choice):
            base = {"residual": pi.logits.detach(), "lagged": guider_outputs.get("base")}.get(settings.guider, 0.0)
            return Choice(base + mu.logits), pi
        std = pi.std if settings.shared_std == "learner" else mu.std
        delta = mu.mean if settings.guider == "residual" else (mu.mean - pi.mean.detach()) / std.detach()
        if settings.guider == "lagged":
            delta = mu.mean + (guider_outputs["base"] - pi.mean.detach()) / std.detach()
        if settings.max_kl is not None:  # KL = sum or mean of delta^2 / 2
            dimensions = delta.shape[-1] if settings.kl_reduction == "mean" else 1
            delta = delta * ((2 * settings.max_kl * dimensions) ** 0.5 / delta.norm(dim=-1, keepdim=True)).clamp(max=1)
        guider_mean = pi.mean.detach() + std.detach() * delta
        if settings.shared_std == "learner":
            return Gaussian(guider_mean, std.detach()), Gaussian(pi.mean, std)
        return Gaussian(guider_mean, std), Gaussian(pi.mean, std.detach())

    def step(self, batch: Batch, noise: th.Tensor) -> dict[str, th.Tensor]:
        """
        :param batch: of transitions or sequences
        :param noise: standard normal, of mu and pi: of their next actions noise[0] and noise[2], of their present ones
            noise[1] and noise[3]; each of shape (*E, A)
        :return: what is to be logged
        """
        settings, reduction = self.settings, self.settings.kl_reduction
        alpha, beta = self.alpha.value, self.beta.value
        beta_of_learner = beta if settings.learner_entropy else 0.0
        guider_outputs, learner_outputs = (self.outputs(self.networks[name], batch) for name in ("guider", "learner"))
        if settings.guider == "lagged":
            for outputs, base in zip(guider_outputs, self.outputs(self.targets["learner_target"], batch), strict=True):
                outputs["base"] = base["logits" if self.discrete else "mean"].detach()
        mu, pi = self.policies(guider_outputs[0], learner_outputs[0])
        future = batch.discounts * (1 - batch.terminated)
        with th.no_grad():
            next_mu, next_pi = self.policies(guider_outputs[1], learner_outputs[1])
            # Eq. 12
            q, log_prob = next_mu.value_and_log_prob(self.q(self.theta_bar, batch, later=True), noise[0])
            y_theta = batch.rewards + future * (q - alpha * next_mu.kl(next_pi, reduction) - beta * log_prob)
            # Eq. 15
            if self.phi_bar is not None:
                q, log_prob = next_pi.value_and_log_prob(self.q(self.phi_bar, batch, later=True), noise[2])
                y_phi = batch.rewards + future * (q - beta_of_learner * log_prob)
        self.fit_critics("guider_critic", batch, y_theta)
        if self.phi_bar is not None:
            self.fit_critics("learner_critic", batch, y_phi)
        # Eq. 13
        kl = mu.kl(pi.detach(), reduction)
        q, log_prob = mu.value_and_log_prob(self.q(self.theta, batch), noise[1])
        guider_loss = batch.mean(alpha * kl + beta * log_prob - q)
        self.descend("guider", guider_loss)
        # Eq. 16, or 14
        learner_loss = self.learner_loss(batch, mu.detach(), pi, noise[3], alpha, beta_of_learner)
        fit, its_parameters = self.fit_of_the_std(batch, guider_outputs[0])
        self.descend("learner", learner_loss + fit, its_parameters)
        # Eq. 17, and SAC's
        self.logged |= self.beta.update(batch.mean(log_prob) + settings.target_entropy)
        self.logged |= self.alpha.update(batch.mean(kl) - settings.target_kl)
        self.update_targets()
        ordered = kl[batch.counts > 0].sort().values
        self.logged |= {"guider_loss": guider_loss, "learner_loss": learner_loss, "entropy": -batch.mean(log_prob)}
        self.logged |= {"kl": batch.mean(kl), "kl_above_target": batch.mean((kl > settings.target_kl).double())}
        self.logged |= {"kl_p95": ordered[math.ceil(0.95 * len(ordered)) - 1], "kl_coef": self.alpha.value}
        return self.logged | self.described("learner", pi, batch)

    def learner_loss(self, batch: Batch, mu: Any, pi: Any, noise: th.Tensor, alpha: Any, beta: Any) -> th.Tensor:
        """Eq. 16; of GACShare phi is theta."""
        q, log_prob = pi.value_and_log_prob(self.q(self.phi, batch), noise)
        kl = mu.kl(pi, self.settings.kl_reduction)
        weight = self.settings.pull * alpha + self.settings.guidance * batch.mean(q.abs()).detach()
        return batch.mean(weight * kl + beta * log_prob - q)

    def fit_of_the_std(self, batch: Batch, guider_outputs: dict[str, th.Tensor]) -> tuple[Any, list[nn.Parameter]]:
        """Where the guider has the std: the learner's own, for deployment, is fitted to it; nothing but its layer moves."""
        learner = self.networks["learner"]
        if "logits" in guider_outputs or self.settings.shared_std == "learner":
            return 0.0, []
        hidden = learner.hidden(self.seen(learner, batch)[0]).detach()
        outputs = learner.heads["log_std"](hidden), guider_outputs["log_std"]
        own, its = (self.std(output).log() for output in outputs)
        return batch.mean((own - its.detach()).square().mean(dim=-1)) / 2, list(learner.heads["log_std"].parameters())


class PlainGACWithoutQ(PlainGAC):
    """Algorithm 1 with eq. 14 for the learner."""

    def learner_loss(self, batch: Batch, mu: Any, pi: Any, noise: th.Tensor, alpha: Any, beta: Any) -> th.Tensor:
        """Eq. 14."""
        return batch.mean(mu.kl(pi, self.settings.kl_reduction))


class PlainSAC(PlainAlgorithm):
    """
    SAC; what its networks see is theirs.

    :param policy: of the model
    :param settings: of the model
    """

    n_noises = 2

    def __init__(self, policy: Any, settings: Settings):
        super().__init__(policy, ["critic", "actor"], settings)

    def step(self, batch: Batch, noise: th.Tensor) -> dict[str, th.Tensor]:
        """
        :param batch: of transitions or sequences
        :param noise: standard normal, of the next action and of the present one
        :return: what is to be logged
        """
        beta, critics, targets = self.beta.value, self.networks["critic"], self.targets["critic_target"]
        now, later = (self.distribution(outputs) for outputs in self.outputs(self.networks["actor"], batch))
        y = []
        for group in self.groups(targets):
            with th.no_grad():
                q, log_prob = later.value_and_log_prob(self.q(group, batch, later=True), noise[0])
                y += [batch.rewards + batch.discounts * (1 - batch.terminated) * (q - beta * log_prob)] * len(group)
        self.fit_critics("critic", batch, y)
        found = [now.value_and_log_prob(self.q(group, batch), noise[1]) for group in self.groups(critics)]
        log_prob = found[0][1]
        actor_loss = batch.mean(beta * log_prob - sum(q for q, _ in found) / len(found))
        self.descend("actor", actor_loss)
        self.logged |= self.beta.update(batch.mean(log_prob) + self.settings.target_entropy)
        self.update_targets()
        self.logged |= {"actor_loss": actor_loss, "entropy": -batch.mean(log_prob)}
        return self.logged | self.described("actor", now, batch)

    def groups(self, critics: Any) -> list[list[nn.Module]]:
        """Of as many critics each."""
        size = len(critics) // self.settings.critic_groups
        return [list(critics)[first : first + size] for first in range(0, len(critics), size)]


class PlainTGRL(PlainAlgorithm):
    """
    Teacher-Guided RL.

    :param policy: of the model
    :param settings: of the model
    :param teacher: its actor, copied
    """

    n_noises = 4

    def __init__(self, policy: Any, settings: Settings, teacher: Any):
        super().__init__(policy, ["reward_critic", "teacher_critic", "actor", "auxiliary"], settings)
        self.teacher = plain_policy(teacher)

    @staticmethod
    def distance(pi: Any, teacher: Any) -> th.Tensor:
        """KL(pi || teacher) before tanh, of any two."""
        if isinstance(pi, Choice):
            return pi.kl(teacher, "sum")
        normals = [th.distributions.Normal(one.mean, one.std) for one in (pi, teacher)]
        return th.distributions.kl_divergence(*normals).sum(dim=-1)

    def step(self, batch: Batch, noise: th.Tensor) -> dict[str, th.Tensor]:
        """
        :param batch: of transitions or sequences
        :param noise: standard normal: of the main actor's next action for either critic, of the actors' present ones
        :return: what is to be logged
        """
        beta, c, nets = self.beta.value, self.settings.teacher_coef, self.networks
        future = batch.discounts * (1 - batch.terminated)
        (pi, next_pi), (pi_r, _), (asked, next_asked) = (
            [self.distribution(outputs) for outputs in self.outputs(network, batch)]
            for network in (nets["actor"], nets["auxiliary"], self.teacher)
        )
        with th.no_grad():
            q_r, log_prob = next_pi.value_and_log_prob(self.q(self.targets["reward_critic_target"], batch, True), noise[0])
            q_i, _ = next_pi.value_and_log_prob(self.q(self.targets["teacher_critic_target"], batch, True), noise[1])
            y_r = batch.rewards + future * (q_r - beta * log_prob)
            y_i = future * (q_i - self.distance(next_pi, next_asked))
        self.fit_critics("reward_critic", batch, y_r)
        self.fit_critics("teacher_critic", batch, y_i)
        q_r, log_prob = pi.value_and_log_prob(self.q(nets["reward_critic"], batch), noise[2])
        q_i, _ = pi.value_and_log_prob(self.q(nets["teacher_critic"], batch), noise[2])
        distance = self.distance(pi, asked)
        actor_loss = batch.mean(beta * log_prob - q_r + c * (distance - q_i))
        self.descend("actor", actor_loss)
        q_r, log_prob_of_auxiliary = pi_r.value_and_log_prob(self.q(nets["reward_critic"], batch), noise[3])
        auxiliary_loss = batch.mean(beta * log_prob_of_auxiliary - q_r)
        self.descend("auxiliary", auxiliary_loss)
        self.logged |= self.beta.update(batch.mean(log_prob) + self.settings.target_entropy)
        self.update_targets()
        self.logged |= {"actor_loss": actor_loss, "auxiliary_loss": auxiliary_loss, "entropy": -batch.mean(log_prob)}
        return self.logged | {"kl_to_teacher": batch.mean(distance), "ent_coef": self.beta.value}
