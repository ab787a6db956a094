"""The two policies: a learner on its own entries, and a guider relative to it or independent of it."""

from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_gac.common.actors import DeployedPolicy, RolePolicy
from sb3_gac.common.distributions import TanhGaussian, project_to_kl_ball

DELTA_INIT_SCALE = 0.01


class Learner(DeployedPolicy):
    """
    The deployed policy: a mean on the learner's entries.

    In training it borrows the guider's std. Its own log-std head, fitted to the guider's, serves
    ``predict(deterministic=False)`` where there is no guider.
    """

    def forward(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """
        :param obs: observation with at least the learner's entries, B of each
        :return: mean before tanh, and the deployment log std, whose gradient stops at its head; both (B, A)
        """
        latent = self.latent(obs)
        return self.mean(latent), self.bounded_log_std(latent.detach())


class Guider(RolePolicy):
    """
    The privileged policy in the paper's form: mean and std from its own network, nothing shared with the learner.

    :param max_kl: hard bound on KL(guider || learner), or ``None``: the mean is projected onto that ball
    :param kl_reduction: how the bounded KL is reduced over action dimensions
    """

    def __init__(self, *args: Any, max_kl: float | None = None, kl_reduction: str = "mean", **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.max_kl = max_kl
        self.kl_reduction = kl_reduction

    def forward(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """
        :param obs: observation with at least the guider's entries, B of each
        :return: what :meth:`relative_to` makes a mean of, and the log std before tanh; both (B, A)
        """
        latent = self.latent(obs)
        return self.mean(latent), self.bounded_log_std(latent)

    def relative_to(self, learner_mean: th.Tensor, output: th.Tensor, log_std: th.Tensor) -> TanhGaussian:
        """
        :param learner_mean: the learner's mean for the same observations; treated as a constant, shape (B, A)
        :param output: of :meth:`forward`, shape (B, A)
        :param log_std: of :meth:`forward`, shape (B, A)
        :return: action distribution, shapes (B, A)
        """
        return TanhGaussian(self._guided_mean(output, learner_mean.detach(), log_std.detach().exp()), log_std)

    def _guided_mean(self, output: th.Tensor, learner_mean: th.Tensor, std: th.Tensor) -> th.Tensor:
        if self.max_kl is None:
            return output
        offset = project_to_kl_ball((output - learner_mean) / std, self.max_kl, self.kl_reduction)
        return learner_mean + std * offset

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        raise TypeError("The guider is defined relative to the learner: use GAC.predict_guider().")

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {"max_kl": self.max_kl, "kl_reduction": self.kl_reduction}


class ResidualGuider(Guider):
    """
    The guider as the learner plus a privileged correction delta in units of the std: KL = 1/2 ||delta||^2 exactly.

    Neither the learner's drift nor a shrinking std moves the KL; delta = 0 is the learner itself.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        with th.no_grad():
            self.mean.weight.mul_(DELTA_INIT_SCALE)
            self.mean.bias.mul_(DELTA_INIT_SCALE)

    def _guided_mean(self, output: th.Tensor, learner_mean: th.Tensor, std: th.Tensor) -> th.Tensor:
        delta = output if self.max_kl is None else project_to_kl_ball(output, self.max_kl, self.kl_reduction)
        return learner_mean + std * delta


GUIDERS: dict[str, type[Guider]] = {"residual": ResidualGuider, "independent": Guider}
