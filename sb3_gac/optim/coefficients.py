"""
Coefficients of a Lagrangian: fixed, learned as dual variables, or moved by steps.

All have a ``value`` to multiply with, ``update(violation)`` to learn from, and say what of them a file has to keep.
"""

import math
from abc import ABC, abstractmethod
from typing import Any

import torch as th
import torch.nn.functional as F

from sb3_gac.checks.values import check_range
from sb3_gac.math.losses import dual_loss
from sb3_gac.optim.trained import TrainedParameters


class FixedCoefficient:
    """
    A coefficient that stays what it is.

    :param value: the coefficient, not negative
    :param device: where its tensor lives
    """

    #: Names of what a file has to keep: of optimisers, and of tensors
    state_names: tuple[list[str], list[str]] = ([], ["value"])
    optimizer: th.optim.Optimizer | None = None

    def __init__(self, value: float, device: th.device):
        self.value = th.tensor(float(value), device=device)

    def refresh(self, compiled: bool | None = None) -> None:
        """To be called before training: a file's state may have been loaded."""

    def update(self, violation: th.Tensor, mask: th.Tensor | None = None) -> dict[str, th.Tensor]:
        """Nothing to learn, and no loss."""
        return {}

    def go_on_from(self, other: "Coefficient") -> None:
        """It is what it was told to be."""

    def at_bound(self) -> th.Tensor:
        """It has none: zero."""
        return th.zeros_like(self.value)


class AdditiveCoefficient(FixedCoefficient):
    """
    A coefficient that is moved by steps of one size, up or down, and not by gradients.

    :param value: at the start
    :param step: size of a step
    :param bounds: smallest and largest value
    :param device: where its tensor lives
    """

    def __init__(self, value: float, step: float, bounds: tuple[float, float], device: th.device):
        super().__init__(value, device)
        self.step = step
        self.bounds = bounds

    def move(self, direction: float) -> None:
        """
        :param direction: number of steps, negative for down
        """
        self.value.add_(self.step * direction).clamp_(*self.bounds)

    def at_bound(self) -> th.Tensor:
        """1 if the coefficient sits on one of its bounds, else 0, scalar."""
        low, high = self.bounds
        return ((self.value <= low) | (self.value >= high)).float()


class MultiplicativeCoefficient(FixedCoefficient):
    """
    A coefficient that is moved by a factor, up or down, and that starts at nought.

    :param first: what nought becomes when it is first moved up
    :param factor: of a move
    :param largest: value
    :param device: where its tensor lives
    """

    def __init__(self, first: float, factor: float, largest: float, device: th.device):
        super().__init__(0.0, device)
        self.first = first
        self.factor = factor
        self.largest = largest

    def move(self, up: th.Tensor) -> None:
        """
        :param up: whether to, a boolean scalar; otherwise it goes down
        """
        moved = th.where(up, self.value * self.factor, self.value / self.factor)
        risen = th.where(up & (self.value == 0), th.full_like(self.value, self.first), moved)
        self.value.copy_(risen.clamp(max=self.largest))

    def at_bound(self) -> th.Tensor:
        """1 if the coefficient has its largest value, else 0, scalar."""
        return (self.value >= self.largest).float()


class LearnedCoefficient(ABC):
    """
    Positive coefficients f(x), x learned by gradient steps on a dual loss: they rise while constraints are violated.

    :param name: what its loss is named after
    :param initial: start value, inside the bounds
    :param bounds: smallest and largest value
    :param learning_rate: Adam's, on x
    :param device: where its tensor lives
    :param shape: () for one coefficient, (A,) for one of each action dimension
    """

    state_names: tuple[list[str], list[str]] = (["optimizer"], ["parameter"])

    def __init__(
        self,
        name: str,
        initial: float,
        bounds: tuple[float, float],
        learning_rate: float,
        device: th.device,
        shape: tuple[int, ...] = (),
    ):
        self.name = name
        self.bounds = bounds
        self.shape = shape
        low, high, start = (self._inverse(value) for value in (*bounds, initial))
        self._parameter_bounds = low, high
        self.parameter = th.full(shape or (1,), start, device=device, requires_grad=True)
        self.optimizer: th.optim.Optimizer | None = th.optim.Adam([self.parameter], lr=learning_rate, fused=True)
        self._trained = TrainedParameters([self.parameter], self.optimizer)  # type: ignore[list-item]

    @staticmethod
    @abstractmethod
    def _inverse(value: float) -> float:
        """
        :param value: of a coefficient
        :return: x
        """

    @staticmethod
    @abstractmethod
    def _value_and_slope(parameter: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param parameter: x
        :return: coefficient, and its derivative by x
        """

    @property
    def value(self) -> th.Tensor:
        """The coefficients, detached, of the shape that was asked for."""
        return self._value_and_slope(self.parameter.detach())[0].view(self.shape)

    def refresh(self, compiled: bool | None = None) -> None:
        """
        To be called before training: a file's state may have been loaded, or the learning rate set.

        :param compiled: see :meth:`TrainedParameters.refresh`
        """
        self._trained.refresh(compiled)

    def go_on_from(self, other: "Coefficient") -> None:
        """
        Take over another one's value, inside the own bounds, and what its optimiser has gathered, at the own learning rate.

        :param other: learned as well
        """
        assert isinstance(other, LearnedCoefficient)
        assert self.optimizer is not None
        assert other.optimizer is not None
        learning_rate = self.optimizer.param_groups[0]["lr"]
        with th.no_grad():
            self.parameter.copy_(other.parameter).clamp_(*self._parameter_bounds)
        self.optimizer.load_state_dict(other.optimizer.state_dict())
        self.optimizer.param_groups[0]["lr"] = learning_rate
        self.refresh()

    def at_bound(self) -> th.Tensor:
        """1 if the coefficient sits on one of its bounds, else 0; the mean over dimensions, scalar."""
        low, high = self._parameter_bounds
        parameter = self.parameter.detach()
        return ((parameter <= low) | (parameter >= high)).float().mean()

    def update(self, violation: th.Tensor, mask: th.Tensor | None = None) -> dict[str, th.Tensor]:
        r"""
        One gradient step on :func:`sb3_gac.math.losses.dual_loss`: up while the mean violation is positive, down while it is
        negative.

        :param violation: of the constraint per sample, shape (\*E), or (\*E, A) for one coefficient a dimension; or its mean
        :param mask: shape (\*E), 1 for valid samples; ``None`` if all are
        :return: loss to log, detached, scalar
        """
        with th.no_grad():
            mean = self._mean(violation, mask)
            value, slope = self._value_and_slope(self.parameter)
            self._trained.step([-slope * mean])
            self.parameter.clamp_(*self._parameter_bounds)
        return {f"{self.name}_loss": dual_loss(value, mean)}

    def _mean(self, violation: th.Tensor, mask: th.Tensor | None) -> th.Tensor:
        """Of each coefficient, over the samples that count."""
        samples = violation.reshape(-1, *self.shape)
        if mask is None:
            return samples.mean(dim=0)
        counts = (mask.flatten() > 0).view(-1, *(1 for _ in self.shape))
        return samples.where(counts, 0.0).sum(dim=0) / counts.sum().clamp(min=1)


class SoftplusDual(LearnedCoefficient):
    """Dual variables softplus(x): steps are of one size where they are large."""

    @staticmethod
    def _inverse(value: float) -> float:
        return value + math.log(-math.expm1(-value))

    @staticmethod
    def _value_and_slope(parameter: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return F.softplus(parameter), parameter.sigmoid()


class DualVariable(LearnedCoefficient):
    """A dual variable exp(x), as SAC's temperature: steps are relative to its size."""

    state_names = (["optimizer"], ["log_value"])

    @property
    def log_value(self) -> th.Tensor:
        """Its logarithm, shape (1,) of a single one."""
        return self.parameter

    @staticmethod
    def _inverse(value: float) -> float:
        return math.log(value)

    @staticmethod
    def _value_and_slope(parameter: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        value = parameter.exp()
        return value, value


Coefficient = FixedCoefficient | LearnedCoefficient


def make_coefficient(
    name: str,
    spec: str | float,
    auto_value: float,
    bounds: tuple[float, float],
    learning_rate: float,
    device: th.device,
    kind: type[LearnedCoefficient] = DualVariable,
    shape: tuple[int, ...] = (),
) -> Coefficient:
    """
    Build a coefficient from what the user wrote.

    :param name: constructor argument, for error messages
    :param spec: "auto", "auto_<start value>" or a number
    :param auto_value: start value for "auto"
    :param bounds: smallest and largest value of a learned coefficient
    :param learning_rate: of a learned coefficient
    :param device: where its tensor lives
    :param kind: of a learned coefficient: exp(x) or softplus(x)
    :param shape: of a learned coefficient: () for one, (A,) for one of each action dimension
    :raises ValueError: if ``spec`` or ``bounds`` is none of what is allowed
    """
    remedy = f'{name} must be "auto", "auto_<start value>" such as "auto_0.5", or a number >= 0, got {spec!r}.'
    low, high = check_range(f"{name}_bounds", bounds, above=0.0)
    if not (isinstance(spec, str) and spec.startswith("auto")):
        return FixedCoefficient(_parse(spec, remedy, allow_zero=True), device)
    initial = auto_value if spec == "auto" else _parse(spec.removeprefix("auto_"), remedy, allow_zero=False)
    if spec != "auto" and not low <= initial <= high:
        raise ValueError(
            f'The start value of {name}={spec!r} lies outside {name}_bounds={bounds}: give another one, or {name}="auto".'
        )
    return kind(name, min(max(initial, low), high), (low, high), learning_rate, device, shape)


def _parse(text: Any, remedy: str, allow_zero: bool) -> float:
    try:
        number = float(text)
    except (TypeError, ValueError):
        raise ValueError(remedy) from None
    if not math.isfinite(number) or number < 0 or (number == 0 and not allow_zero):
        raise ValueError(remedy)
    return number
