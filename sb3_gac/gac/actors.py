"""The two policies: a learner on its own entries, and a guider that is relative to the learner or independent of it."""

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

    :param owns_std: whether the learner's objective trains a Gaussian's std; if not, the learner borrows the guider's std in
        training, and a std of its own, fitted to the guider's, serves ``predict(deterministic=False)`` at deployment
    """

    def __init__(self, *args: Any, owns_std: bool = True, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.owns_std = owns_std

    def output(self, latent: th.Tensor) -> Distribution:
        r"""
        :param latent: last hidden layer of the learner's network, shape (\*E, H)
        :return: action distribution of the deployed learner, shapes (\*E, A); where the learner does not own its std, the
            gradient of the std stops at the layer that outputs it
        """
        return self.head(latent, detach_std=not self.owns_std)

    def deployment_parameters(self) -> list[nn.Parameter]:
        """The parameters that serve at deployment only: those of a std that is fitted to the guider's, else none."""
        return [] if self.owns_std else self.head.deployment_parameters()

    def deployment_losses(self, deployed: Any, learner: Any, mask: th.Tensor | None = None) -> dict[str, th.Tensor]:
        r"""
        The losses that fit :meth:`deployment_parameters`.

        :param deployed: action distribution of the deployed learner, from :meth:`output`, shapes (\*E, A)
        :param learner: the learner's action distribution in training, with the guider's std, shapes (\*E, A)
        :param mask: 1 for valid steps and 0 for padding, shape (\*E); ``None`` if all are valid
        :return: name of a loss -> scalar; empty if there is nothing to fit
        """
        return {} if self.owns_std else self.head.deployment_losses(deployed, learner, mask)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {"owns_std": self.owns_std}


class LearnerAsActor(Actor, Learner):
    """The learner in the form of SB3's ``actor``: a call returns actions, and all else is the learner's own."""

    @classmethod
    def of(cls, learner: Learner) -> "LearnerAsActor":
        """
        :param learner: learner that the actor shares all parameters and attributes with
        :return: actor that is the same network
        """
        actor = cls.__new__(cls)
        object.__setattr__(actor, "__dict__", learner.__dict__)
        return actor


class Guider(RolePolicy):
    """
    The privileged policy in the paper's form: a network of its own, nothing shared with the learner.

    :param max_kl: hard bound on KL(guider || learner) in every state, held by projecting a Gaussian's mean; ``None`` for none
    :param kl_reduction: reduction of the bounded KL over action dimensions, "mean" or "sum"
    """

    #: Whether the guider needs a target network of the learner
    needs_target: ClassVar[bool] = False

    def __init__(self, *args: Any, max_kl: float | None = None, kl_reduction: str = "mean", **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.max_kl = max_kl
        self.kl_reduction = kl_reduction

    @property
    def relation(self) -> tuple[Any, ...] | None:
        """The hard bound, which depends on the learner, see :attr:`RoleModel.relation`."""
        return None if self.max_kl is None else (type(self).__name__, self.max_kl, self.kl_reduction)

    def relative_to(self, learner: Any, output: Any) -> Distribution:
        """
        The guider's action distribution, given the learner's.

        :param learner: the learner's distribution for the same observations, treated as a constant, shapes (B, A)
        :param output: output of the guider's network, from :meth:`distribution`, shapes (B, A)
        :return: action distribution of the guider, shapes (B, A)
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
    The guider as the learner plus a privileged correction delta.

    A Gaussian's mean is moved by delta in units of the std, so that KL = 1/2 ||delta||^2 exactly, and neither the learner's
    drift nor a shrinking std moves the KL. With discrete actions delta is added to the logits. At delta = 0 the guider is the
    learner itself.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.head.shrink(DELTA_INIT_SCALE)

    @property
    def relation(self) -> tuple[Any, ...]:
        """The correction's class and hard bound, see :attr:`RoleModel.relation`."""
        return type(self).__name__, self.max_kl, self.kl_reduction

    def relative_to(self, learner: Any, output: Any) -> Distribution:
        """The learner moved by the correction, see :meth:`Guider.relative_to`."""
        return learner.with_residual(self._bounded(output))


class LaggedOutput(NamedTuple):
    """
    The output of a lagged guider's networks.

    :param base: action distribution of the learner's Polyak average, a constant, shapes (\\*E, A)
    :param correction: privileged correction delta, shapes (\\*E, A)
    """

    base: Any
    correction: Any

    def detach(self) -> "LaggedOutput":
        """The same output as a constant."""
        return LaggedOutput(self.base, self.correction.detach())

    def with_std_of(self, lender: Any) -> "LaggedOutput":
        """The same output with the lender's std, as a constant, see :meth:`TanhGaussian.with_std_of`."""
        return LaggedOutput(self.base, self.correction.with_std_of(lender))


class LaggedGuider(ResidualGuider):
    """
    The guider as the learner's Polyak average plus a privileged correction delta: mean_mu = mean_pi_bar + std delta.

    The learner can absorb the correction, since its average stays behind. The KL depends on the learner, and falls as the
    learner absorbs the correction.
    """

    needs_target = True
    _followed: tuple[Learner] | None = None

    def follow(self, learner: Learner) -> None:
        """
        Set the learner's average, which is no part of this network.

        :param learner: target network of the learner, its Polyak average
        """
        self._followed = (learner,)

    def distribution(self, obs: PyTorchObs) -> Any:
        """The average's distribution and the correction to it, see :meth:`RolePolicy.distribution`."""
        assert self._followed is not None
        with th.no_grad():
            base = self._followed[0].distribution(obs)
        return LaggedOutput(base, super().distribution(obs))

    def relative_to(self, learner: Any, output: LaggedOutput) -> Distribution:
        """The learner's average moved by the correction, see :meth:`Guider.relative_to`."""
        return Guider.relative_to(self, learner, output.base.with_residual(output.correction))


GUIDERS: dict[str, type[Guider]] = {"residual": ResidualGuider, "lagged": LaggedGuider, "independent": Guider}
