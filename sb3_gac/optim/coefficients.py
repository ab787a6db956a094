"""Coefficients of a Lagrangian: learned (a dual variable with bounds and its own optimiser) or fixed."""

import math
from typing import Any

import torch as th

from sb3_gac.checks.values import check_range
from sb3_gac.math.losses import dual_loss
from sb3_gac.optim.flat import FlatAdam


class FixedCoefficient:
    """
    A coefficient that stays what it is.

    :param value: the coefficient, not negative
    :param device: where its tensor lives
    """

    def __init__(self, value: float, device: th.device):
        self.value = th.tensor(float(value), device=device)
        self.optimizer: th.optim.Optimizer | None = None
        self.state_names: tuple[list[str], list[str]] = ([], ["value"])

    def update(self, violation: th.Tensor, mask: th.Tensor | None = None) -> dict[str, th.Tensor]:
        """Nothing to learn, and no loss."""
        return {}

    def go_on_from(self, other: "Coefficient") -> None:
        """It is what it was told to be."""

    def on_bound(self) -> th.Tensor:
        """It has none: zero."""
        return th.zeros_like(self.value)


class DualVariable:
    """
    A positive coefficient learned in log space by gradient steps on :func:`dual_loss`, kept inside bounds.

    :param name: what its loss is named after
    :param initial: start value, inside the bounds
    :param bounds: smallest and largest value
    :param learning_rate: Adam's, on the logarithm
    :param device: where its tensor lives
    """

    def __init__(self, name: str, initial: float, bounds: tuple[float, float], learning_rate: float, device: th.device):
        self.name = name
        self.bounds = bounds
        self._log_bounds = (math.log(bounds[0]), math.log(bounds[1]))
        self.log_value = th.full((1,), math.log(initial), device=device, requires_grad=True)
        self.optimizer: th.optim.Optimizer | None = FlatAdam([self.log_value], lr=learning_rate)
        self.state_names: tuple[list[str], list[str]] = (["optimizer"], ["log_value"])

    @property
    def value(self) -> th.Tensor:
        """The coefficient, detached, scalar."""
        return self.log_value.detach().exp().squeeze(0)

    def go_on_from(self, other: "Coefficient") -> None:
        """
        Take over another one's value, inside the own bounds, and what its optimiser has gathered, at the own learning rate.

        :param other: learned as well
        """
        assert isinstance(other, DualVariable)
        assert self.optimizer is not None
        assert other.optimizer is not None
        learning_rate = self.optimizer.param_groups[0]["lr"]
        with th.no_grad():
            self.log_value.copy_(other.log_value).clamp_(*self._log_bounds)
        self.optimizer.load_state_dict(other.optimizer.state_dict())
        self.optimizer.param_groups[0]["lr"] = learning_rate

    def on_bound(self) -> th.Tensor:
        """1 if the coefficient sits on one of its bounds, else 0, scalar."""
        low, high = self._log_bounds
        log_value = self.log_value.detach().squeeze(0)
        return ((log_value <= low) | (log_value >= high)).float()

    def update(self, violation: th.Tensor, mask: th.Tensor | None = None) -> dict[str, th.Tensor]:
        """
        One gradient step: up while the mean violation is positive, down while it is negative.

        :param violation: constraint violation per sample, shape (\\*E)
        :param mask: shape (\\*E), 1 for valid samples; ``None`` if all are
        :return: loss to log, detached, scalar
        """
        assert self.optimizer is not None
        with th.no_grad():
            loss = dual_loss(self.log_value, violation, mask)
            self.log_value.grad = loss.view(1)  # d/dx (-exp(x) v) = -exp(x) v: the gradient is the loss itself
            self.optimizer.step()
            self.log_value.clamp_(*self._log_bounds)
        return {f"{self.name}_loss": loss}


Coefficient = FixedCoefficient | DualVariable


def make_coefficient(
    name: str,
    spec: str | float,
    auto_value: float,
    bounds: tuple[float, float],
    learning_rate: float,
    device: th.device,
) -> Coefficient:
    """
    Build a coefficient from what the user wrote.

    :param name: constructor argument, for error messages
    :param spec: "auto", "auto_<start value>" or a number
    :param auto_value: start value for "auto"
    :param bounds: smallest and largest value of a learned coefficient
    :param learning_rate: of a learned coefficient
    :param device: where its tensor lives
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
    return DualVariable(name, min(max(initial, low), high), (low, high), learning_rate, device)


def _parse(text: Any, remedy: str, allow_zero: bool) -> float:
    try:
        number = float(text)
    except (TypeError, ValueError):
        raise ValueError(remedy) from None
    if not math.isfinite(number) or number < 0 or (number == 0 and not allow_zero):
        raise ValueError(remedy)
    return number
