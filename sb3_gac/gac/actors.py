"""The two policies: a learner on its own entries, and a guider relative to it, to its average, or independent of it."""

from typing import Any, ClassVar, NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gac.math.distributions import Distribution, TanhGaussian, project_to_kl_ball
from sb3_gac.networks.actors import Actor, DeployedPolicy, RolePolicy

DELTA_INIT_SCALE = 0.01


class Learner(DeployedPolicy):
    """
    The deployed policy.

    :param owns_std: whether a Gaussian's std is trained by the learner's objective; if not, it borrows the guider's in
        training, and its own, fitted to that, serves ``predict(deterministic=False)`` where there is no guider
    """

    def __init__(self, *args: Any, owns_std: bool = True, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.owns_std = owns_std

    def output(self, latent: th.Tensor) -> Distribution:
        r"""
        :param latent: shape (\*E, H)
        :return: at deployment; the gradient of a std that is fitted stops at its own layer; shapes (\*E, A)
        """
        return self.head(latent, detach_std=not self.owns_std)

    def deployment_parameters(self) -> list[nn.Parameter]:
        """Those that serve at deployment only."""
        return [] if self.owns_std else self.head.deployment_parameters()

    def deployment_losses(self, deployed: Any, learner: Any, mask: th.Tensor | None = None) -> dict[str, th.Tensor]:
        r"""
        :param deployed: what :meth:`output` returned, shapes (\*E, A)
        :param learner: with the std that it has in training, shapes (\*E, A)
        :param mask: shape (\*E)
        :return: name -> scalar, what :meth:`deployment_parameters` are fitted with
        """
        return {} if self.owns_std else self.head.deployment_losses(deployed, learner, mask)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {"owns_std": self.owns_std}


class LearnerAsActor(Actor, Learner):
    """The learner under SB3's name: called, it returns actions, and all else is the learner's own."""

    @classmethod
    def of(cls, learner: Learner) -> "LearnerAsActor":
        """
        :param learner: whose parameters and attributes it shares
        """
        actor = cls.__new__(cls)
        object.__setattr__(actor, "__dict__", learner.__dict__)
        return actor


class Guider(RolePolicy):
    """
    The privileged policy in the paper's form: a network of its own, nothing shared with the learner.

    :param max_kl: hard bound on KL(guider || learner), or ``None``: a Gaussian's mean is projected onto that ball
    :param kl_reduction: how the bounded KL is reduced over action dimensions
    """

    #: Whether it needs a target of the learner
    needs_target: ClassVar[bool] = False

    def __init__(self, *args: Any, max_kl: float | None = None, kl_reduction: str = "mean", **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.max_kl = max_kl
        self.kl_reduction = kl_reduction

    def relative_to(self, learner: Any, output: Any) -> Distribution:
        """
        :param learner: its distribution for the same observations; treated as a constant, shapes (B, A)
        :param output: of :meth:`distribution`, shapes (B, A)
        :return: the guider's action distribution, shapes (B, A)
        """
        if self.max_kl is None:
            return output
        offset = (output.mean - learner.mean.detach()) / output.log_std.detach().exp()
        return learner.with_residual(self._bounded(output._replace(mean=offset)))

    def _bounded(self, correction: Any) -> Any:
        if self.max_kl is None:
            return correction
        assert isinstance(correction, TanhGaussian)
        return correction._replace(mean=project_to_kl_ball(correction.mean, self.max_kl, self.kl_reduction))

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        raise TypeError("The guider is defined relative to the learner: use GAC.predict_guider().")

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {"max_kl": self.max_kl, "kl_reduction": self.kl_reduction}


class ResidualGuider(Guider):
    """
    The guider as the learner plus a privileged correction delta: in units of the std, so that KL = 1/2 ||delta||^2
    exactly, or of the logits.

    Neither the learner's drift nor a shrinking std moves that KL; delta = 0 is the learner itself.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.head.shrink(DELTA_INIT_SCALE)

    def relative_to(self, learner: Any, output: Any) -> Distribution:
        """See :meth:`Guider.relative_to`."""
        return learner.with_residual(self._bounded(output))


class LaggedOutput(NamedTuple):
    """
    What a lagged guider's networks compute.

    :param base: the lagged learner's distribution, a constant, shapes (\\*E, A)
    :param correction: delta, shapes (\\*E, A)
    """

    base: Any
    correction: Any

    def detach(self) -> "LaggedOutput":
        """The same as a constant."""
        return LaggedOutput(self.base, self.correction.detach())

    def with_std_of(self, lender: Any) -> "LaggedOutput":
        """See :meth:`TanhGaussian.with_std_of`."""
        return LaggedOutput(self.base, self.correction.with_std_of(lender))


class LaggedGuider(ResidualGuider):
    """
    The guider as the learner's Polyak average plus a privileged correction, m_mu = m_pi_bar + std delta: the learner can
    absorb the correction, and the KL, which tells how far it has, depends on the learner.
    """

    needs_target = True
    _followed: tuple[Learner] | None = None

    def follow(self, learner: Learner) -> None:
        """
        :param learner: the average, which is no part of this network
        """
        self._followed = (learner,)

    def distribution(self, obs: PyTorchObs) -> Any:
        """See :meth:`RolePolicy.distribution`."""
        assert self._followed is not None
        with th.no_grad():
            base = self._followed[0].distribution(obs)
        return LaggedOutput(base, super().distribution(obs))

    def relative_to(self, learner: Any, output: LaggedOutput) -> Distribution:
        """See :meth:`Guider.relative_to`."""
        return Guider.relative_to(self, learner, output.base.with_residual(output.correction))


GUIDERS: dict[str, type[Guider]] = {"residual": ResidualGuider, "lagged": LaggedGuider, "independent": Guider}
