"""MPO with asymmetric critics as one would write it first, in float64, one sample after the other, without the package."""

from dataclasses import dataclass
from typing import Any

import torch as th
from torch.distributions import Categorical, Normal, kl_divergence

from tests.plain.algorithm_1 import Choice, Critics, Gaussian, PlainAlgorithm, Settings
from tests.plain.replay import Batch


@dataclass
class MPOSettings(Settings):
    """Arguments of MPO."""

    n_actions: int = 20
    temperature: str | float = 10.0
    target_improvement: float = 0.1
    std_kl_coef: str | float = 1000.0
    target_std_kl: float = 1e-6
    dual_learning_rate: float = 1e-2


class Dual:
    """softplus of numbers that Adam moves down the dual, coefficient times what is left of the bound; or a fixed number."""

    def __init__(self, name: str, given: str | float, rate: float, shape: tuple[int, ...] = ()):
        self.name, self.learned = name, isinstance(given, str)
        start = th.tensor(float(str(given).removeprefix("auto_")), dtype=th.float64)
        self.fixed = None if self.learned else start
        self.rho = (start.exp() - 1).log().expand(shape).clone().requires_grad_()
        self.optimizer = th.optim.Adam([self.rho], lr=rate)

    @property
    def value(self) -> th.Tensor:
        return (1 + self.rho.exp()).log().detach() if self.fixed is None else self.fixed

    def update(self, left: th.Tensor) -> dict[str, th.Tensor]:
        if not self.learned:
            return {}
        self.optimizer.zero_grad()
        loss = ((1 + self.rho.exp()).log() * left.detach()).sum()
        loss.backward()
        self.optimizer.step()
        return {f"{self.name}_loss": loss}


class PlainMPO(PlainAlgorithm):
    """
    MPO.

    :param policy: of the model
    :param settings: of the model
    """

    settings_class = MPOSettings

    def __init__(self, policy: Any, settings: MPOSettings):
        super().__init__(policy, ["critic", "actor"], settings)
        self.targets["actor_target"] = self.copied(policy, "actor_target")
        self.mpo, self.n_noises = settings, 2 * settings.n_actions
        n_dimensions = 1 if self.discrete else policy.action_space.shape[0]
        names = {"temperature": (), "kl_coef": (n_dimensions,), "std_kl_coef": (n_dimensions,)}
        if self.discrete:
            del names["std_kl_coef"]
        rate = settings.dual_learning_rate
        self.coefficients = {name: Dual(name, getattr(settings, name), rate, shape) for name, shape in names.items()}

    @staticmethod
    def tried(policy: Any, q: Critics, noise: th.Tensor) -> list[tuple[Any, th.Tensor, th.Tensor]]:
        """Actions, the smallest critic's value of each, and how likely each is, of what is tried."""
        if isinstance(policy, Choice):
            values, probs = th.stack(q(None)).amin(dim=0), policy.logits.softmax(dim=-1)
            return [(a, values[..., a], probs[..., a]) for a in range(probs.shape[-1])]
        actions = [policy.mean + policy.std * one for one in noise]
        return [(x, th.stack(q(th.tanh(x))).amin(dim=0), th.tensor(1 / len(noise))) for x in actions]

    def step(self, batch: Batch, noise: th.Tensor) -> dict[str, th.Tensor]:
        """
        :param batch: of transitions or sequences
        :param noise: standard normal: of the target actor's next actions, and of its present ones
        :return: what is to be logged
        """
        noise, eta = noise.unflatten(0, (2, -1)), self.coefficients["temperature"].value
        q, later_q = (self.q(self.targets["critic_target"], batch, later) for later in (False, True))
        with th.no_grad():
            old, next_old = (self.distribution(one) for one in self.outputs(self.targets["actor_target"], batch))
            v = sum(probability * value for _, value, probability in self.tried(next_old, later_q, noise[0]))
            y = batch.rewards + batch.discounts * (1 - batch.terminated) * v
            tried = self.tried(old, q, noise[1])
            unnormalised = [probability * (value / eta).exp() for _, value, probability in tried]
            weights = [one / sum(unnormalised) for one in unnormalised]
            improvement = sum(w * (w / p).log() for w, (_, _, p) in zip(weights, tried, strict=True))
        self.fit_critics("critic", batch, y)
        new = self.distribution(self.outputs(self.networks["actor"], batch)[0])
        loss: Any = 0.0
        kls = {}
        for name, (old_one, new_one) in self.parts(old, new).items():
            likelihood = sum(w * self.log_prob(new_one, x) for w, (x, _, _) in zip(weights, tried, strict=True))
            kl = kl_divergence(old_one, new_one)
            kl = kl[..., None] if self.discrete else kl
            weighted = (self.coefficients[f"{name}_coef"].value * kl).sum(dim=-1)
            loss = loss + batch.mean(weighted - likelihood)
            kls[name] = kl.detach()[batch.counts > 0].mean(dim=0)
        self.descend("actor", loss)
        mean_improvement = batch.mean(improvement)
        self.logged |= self.coefficients["temperature"].update(self.mpo.target_improvement - mean_improvement)
        for name, kl in kls.items():
            self.logged |= self.coefficients[f"{name}_coef"].update(getattr(self.mpo, f"target_{name}") - kl)
        self.update_targets()
        self.logged |= {"actor_loss": loss, "improvement": mean_improvement, **{name: kl.mean() for name, kl in kls.items()}}
        return self.logged | {name: one.value.mean() for name, one in self.coefficients.items()}

    def parts(self, old: Any, new: Any) -> dict[str, tuple[Any, Any]]:
        """What is fitted: the mean at the old std, and the std at the old mean."""
        if isinstance(new, Choice):
            return {"kl": (Categorical(logits=old.logits), Categorical(logits=new.logits))}
        assert isinstance(new, Gaussian)
        before = Normal(old.mean, old.std)
        return {"kl": (before, Normal(new.mean, old.std)), "std_kl": (before, Normal(old.mean, new.std))}

    @staticmethod
    def log_prob(distribution: Any, action: Any) -> th.Tensor:
        """Of an action before tanh, or of the number of one."""
        if isinstance(distribution, Categorical):
            return distribution.logits[..., action]
        return distribution.log_prob(action).sum(dim=-1)
