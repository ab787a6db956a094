"""COSIL as one would write it first, in float64: see :mod:`tests.plain.algorithm_1`."""

from typing import Any

import torch as th

from tests.plain.algorithm_1 import Choice, Coefficient, PlainAlgorithm, Settings
from tests.plain.networks import plain_policy
from tests.plain.replay import Batch


class PlainCOSIL(PlainAlgorithm):
    """
    Reward less the weighted distance to a teacher, and no entropy.

    :param policy: of the model
    :param settings: of the model
    :param teacher: its actor, copied
    """

    n_noises = 2

    def __init__(self, policy: Any, settings: Settings, teacher: Any):
        super().__init__(policy, ["critic", "actor"], settings)
        self.teacher = plain_policy(teacher)
        rate, bounds = settings.teacher_coef_learning_rate, settings.teacher_coef_bounds
        self.alpha = Coefficient("teacher_coef", settings.teacher_coef, rate, bounds)
        self.coefficients = {"teacher_coef": self.alpha}

    @staticmethod
    def distance(student: Any, teacher: Any) -> th.Tensor:
        """KL(student || teacher), of normals before tanh, or sum p log (p / p')."""
        if isinstance(student, Choice):
            p, q = (one.logits.softmax(dim=-1) for one in (student, teacher))
            return (p * (p / q).log()).sum(dim=-1)
        ratio = student.std / teacher.std
        return (0.5 * (ratio**2 + ((student.mean - teacher.mean) / teacher.std) ** 2 - 1) - ratio.log()).sum(dim=-1)

    def step(self, batch: Batch, noise: th.Tensor) -> dict[str, th.Tensor]:
        """
        :param batch: of transitions or sequences
        :param noise: standard normal, of the next action and of the present one
        :return: what is to be logged
        """
        a, critics, targets = self.alpha.value, self.networks["critic"], self.targets["critic_target"]
        (pi, next_pi), (asked, next_asked) = (
            [self.distribution(outputs) for outputs in self.outputs(network, batch)]
            for network in (self.networks["actor"], self.teacher)
        )
        with th.no_grad():
            q, _ = next_pi.value_and_log_prob(self.q(targets, batch, later=True), noise[0])
            future = batch.discounts * (1 - batch.terminated)
            y = batch.rewards + future * (q - a * self.distance(next_pi, next_asked))
        self.fit_critics("critic", batch, y)
        q, _ = pi.value_and_log_prob(self.q(critics, batch), noise[1])
        distance = self.distance(pi, asked)
        actor_loss = batch.mean(a * distance - q)
        self.descend("actor", actor_loss)
        self.logged |= self.alpha.update(batch.mean(distance) - self.settings.target_divergence)
        self.update_targets()
        self.logged |= {"actor_loss": actor_loss, "divergence": batch.mean(distance), "teacher_coef": self.alpha.value}
        described = self.described("actor", pi, batch)
        return self.logged | {name: value for name, value in described.items() if name != "ent_coef"}
