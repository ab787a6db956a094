"""
Coefficients of a Lagrangian: fixed, learned as dual variables, or moved by steps.

Each coefficient has a ``value``, which multiplies a term of a loss, a method ``update(violation)``, which learns it, and
``state_names``, which name the state that a file has to keep.
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
    A coefficient that never changes.

    :param value: value of the coefficient, not negative
    :param device: device of its tensor
    """

    #: Names of the attributes that a file has to keep: of optimisers, and of tensors
    state_names: tuple[list[str], list[str]] = ([], ["value"])
    optimizer: th.optim.Optimizer | None = None

    def __init__(self, value: float, device: th.device):
        self.value = th.tensor(float(value), device=device)

    def refresh(self, compiled: bool | None = None) -> None:
        """Do nothing: a fixed coefficient has no optimiser whose state may have been loaded."""

    def update(self, violation: th.Tensor, mask: th.Tensor | None = None) -> dict[str, th.Tensor]:
        """Learn nothing, and return no loss."""
        return {}

    def go_on_from(self, other: "Coefficient") -> None:
        """Keep the own value: a fixed coefficient takes over nothing."""

    def at_bound(self) -> th.Tensor:
        """Zero, scalar: a fixed coefficient has no bounds."""
        return th.zeros_like(self.value)


class AdditiveCoefficient(FixedCoefficient):
    """
    A coefficient that rises or falls by steps of one size, without gradients.

    :param value: value at the start
    :param step: size of a step
    :param bounds: smallest and largest value
    :param device: device of its tensor
    """

    def __init__(self, value: float, step: float, bounds: tuple[float, float], device: th.device):
        super().__init__(value, device)
        self.step = step
        self.bounds = bounds

    def move(self, direction: float) -> None:
        """
        Move the coefficient, inside its bounds.

        :param direction: number of steps, negative for down
        """
        self.value.add_(self.step * direction).clamp_(*self.bounds)

    def at_bound(self) -> th.Tensor:
        """1 if the coefficient sits on one of its bounds, else 0, scalar."""
        low, high = self.bounds
        return ((self.value <= low) | (self.value >= high)).float()


#: Share of its first value below which a coefficient that falls by a factor is 0
NOTHING = 1e-6


class MultiplicativeCoefficient(FixedCoefficient):
    """
    A coefficient that starts at 0, and rises or falls by a factor, without gradients.

    One that has fallen below a millionth of ``first`` is 0 again: it acts on nothing, and from 0 it rises at once.

    :param first: value after the first move up from 0
    :param factor: factor by which a move up multiplies, and a move down divides
    :param largest: largest value
    :param device: device of its tensor
    """

    def __init__(self, first: float, factor: float, largest: float, device: th.device):
        super().__init__(0.0, device)
        self.first = first
        self.factor = factor
        self.largest = largest

    def move(self, up: th.Tensor) -> None:
        """
        Move the coefficient by the factor, up to its largest value.

        :param up: whether the coefficient rises, boolean scalar; it falls otherwise
        """
        moved = th.where(up, self.value * self.factor, self.value / self.factor)
        risen = th.where(up & (self.value == 0), th.full_like(self.value, self.first), moved)
        self.value.copy_(th.where(risen < NOTHING * self.first, th.zeros_like(risen), risen.clamp(max=self.largest)))

    def at_bound(self) -> th.Tensor:
        """1 if the coefficient has its largest value, else 0, scalar."""
        return (self.value >= self.largest).float()


class LearnedCoefficient(ABC):
    """
    Positive coefficients f(x), where gradient steps on a dual loss learn x. A coefficient rises while its constraint is
    violated.

    :param name: name of the coefficient, from which its loss is named
    :param initial: start value, inside the bounds
    :param bounds: smallest and largest value
    :param learning_rate: Adam's step size for x
    :param device: device of the tensors
    :param shape: () for one coefficient, (A,) for one coefficient for each action dimension
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
        :param value: value of a coefficient
        :return: x with f(x) equal to the value
        """

    @staticmethod
    @abstractmethod
    def _value_and_slope(parameter: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param parameter: x, shape (1,) or (A,)
        :return: the coefficients f(x) and their derivatives with respect to x, of the same shape
        """

    @property
    def value(self) -> th.Tensor:
        """The coefficients, detached, of the shape that the constructor was given."""
        return self._value_and_slope(self.parameter.detach())[0].view(self.shape)

    def refresh(self, compiled: bool | None = None) -> None:
        """
        Bring the optimiser up to date, before training, after a file's state was loaded or the learning rate was set.

        :param compiled: whether the next steps are compiled, see :meth:`TrainedParameters.refresh`
        """
        self._trained.refresh(compiled)

    def go_on_from(self, other: "Coefficient") -> None:
        """
        Take over the value and the optimiser state of another coefficient, but keep the own bounds and learning rate.

        :param other: learned coefficient of the same kind
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
        """1 if the coefficient sits on one of its bounds, else 0; for several coefficients the mean over them, scalar."""
        low, high = self._parameter_bounds
        parameter = self.parameter.detach()
        return ((parameter <= low) | (parameter >= high)).float().mean()

    def update(self, violation: th.Tensor, mask: th.Tensor | None = None) -> dict[str, th.Tensor]:
        r"""
        One gradient step on :func:`sb3_gac.math.losses.dual_loss`: a coefficient rises while the mean violation of its
        constraint is positive, and falls while the mean is negative.

        :param violation: violation of the constraint in each sample, shape (\*E), or (\*E, A) with one coefficient for each
            action dimension; or the mean violation, scalar
        :param mask: 1 for valid samples and 0 for padding, shape (\*E); ``None`` if all are valid
        :return: name of the loss -> loss to log, detached, scalar
        """
        with th.no_grad():
            mean = self._mean(violation, mask)
            value, slope = self._value_and_slope(self.parameter)
            self._trained.step([-slope * mean])
            self.parameter.clamp_(*self._parameter_bounds)
        return {f"{self.name}_loss": dual_loss(value, mean)}

    def _mean(self, violation: th.Tensor, mask: th.Tensor | None) -> th.Tensor:
        """Mean violation for each coefficient, over the valid samples."""
        samples = violation.reshape(-1, *self.shape)
        if mask is None:
            return samples.mean(dim=0)
        counts = (mask.flatten() > 0).view(-1, *(1 for _ in self.shape))
        return samples.where(counts, 0.0).sum(dim=0) / counts.sum().clamp(min=1)


class SoftplusDual(LearnedCoefficient):
    """Dual variables softplus(x): where they are large, their steps do not depend on their size."""

    @staticmethod
    def _inverse(value: float) -> float:
        return value + math.log(-math.expm1(-value))

    @staticmethod
    def _value_and_slope(parameter: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return F.softplus(parameter), parameter.sigmoid()


class DualVariable(LearnedCoefficient):
    """Dual variables exp(x), as SAC's temperature is one: their steps are in proportion to their size."""

    state_names = (["optimizer"], ["log_value"])

    @property
    def log_value(self) -> th.Tensor:
        """Logarithm of the coefficients, shape (A,), or (1,) for a single coefficient."""
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
    Build a coefficient from a constructor argument.

    :param name: name of the constructor argument, for error messages and the name of the loss
    :param spec: value of the argument: "auto", "auto_<start value>" or a number
    :param auto_value: start value for "auto"
    :param bounds: smallest and largest value of a learned coefficient
    :param learning_rate: Adam's step size for a learned coefficient
    :param device: device of the coefficient's tensors
    :param kind: class of a learned coefficient: exp(x) or softplus(x)
    :param shape: shape of a learned coefficient: () for one, (A,) for one for each action dimension
    :return: fixed coefficient if ``spec`` is a number, else a learned coefficient
    :raises ValueError: if ``spec`` has another form or a start value outside the bounds, or if ``bounds`` are not two numbers
        above 0 in ascending order
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
