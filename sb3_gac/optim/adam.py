"""
One step of Adam, of tensors that are looked up once in a round of gradient steps instead of once in a step.

With layers of 256 units or fewer, looking them up takes as long as the arithmetic.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch as th


class AdamTensors(NamedTuple):
    """
    The tensors that one step of Adam reads and changes in place.

    :param parameters: parameters of one network
    :param exp_avgs: running mean of each parameter's gradient, of the parameter's shape
    :param exp_avg_sqs: running mean of each gradient's square, of the parameter's shape
    :param counts: number of steps taken so far for each parameter, shape (number of parameters,)
    :param steps: the same numbers as a scalar for each parameter, views of ``counts``, so that one call adds to all
    :param learning_rate: learning rate, scalar
    :param powers: beta1 and beta2 to the power of the number of steps, a scalar of each for every parameter; for compiled
        steps, which would otherwise compute the powers for each element of a parameter
    """

    parameters: list[th.Tensor]
    exp_avgs: list[th.Tensor]
    exp_avg_sqs: list[th.Tensor]
    counts: th.Tensor
    steps: list[th.Tensor]
    learning_rate: th.Tensor
    powers: tuple[list[th.Tensor], list[th.Tensor]]

    def bring_up_powers(self, betas: tuple[float, float]) -> None:
        """
        Compute :attr:`powers` from the number of steps.

        :param betas: the optimiser's beta1 and beta2
        """
        for beta, powers in zip(betas, self.powers, strict=True):
            for power, step in zip(powers, self.steps, strict=True):
                power.copy_(beta**step)

    @classmethod
    def gathered(
        cls, parameters: Sequence[th.Tensor], optimizer: th.optim.Optimizer, device: th.device | None
    ) -> "AdamTensors":
        """
        Look up an optimiser's state of some parameters, which is made where there is none yet.

        :param parameters: parameters of the optimiser
        :param optimizer: Adam or AdamW
        :param device: device of the learning rate
        :return: tensors of these parameters; those of the state are the optimiser's own
        """
        for parameter in parameters:
            state = optimizer.state[parameter]
            if not state:
                state["step"] = th.zeros((), device=parameter.device)
                state["exp_avg"], state["exp_avg_sq"] = th.zeros_like(parameter), th.zeros_like(parameter)
            for name in ("exp_avg", "exp_avg_sq"):  # a file may have them in another order in memory
                (state[name],) = in_order_of([parameter], [state[name]])
        states = [optimizer.state[parameter] for parameter in parameters]
        learning_rate = th.zeros((), device=device)
        counts = th.stack([state["step"] for state in states]) if states else learning_rate.new_zeros(0)
        for state, count in zip(states, counts, strict=True):
            state["step"] = count
        means, squares, steps = ([state[name] for state in states] for name in ("exp_avg", "exp_avg_sq", "step"))
        powers = [step.clone() for step in steps], [step.clone() for step in steps]
        adam = cls(list(parameters), means, squares, counts, steps, learning_rate, powers)
        adam.bring_up_powers(optimizer.param_groups[0]["betas"])
        return adam


def in_order_of(parameters: Sequence[th.Tensor], values: Sequence[th.Tensor]) -> list[th.Tensor]:
    """
    Bring values of parameters into their parameters' order in memory.

    Torch's fused optimisers go through memory and take a value for another element's where the orders differ, as they do for
    the gradient of a convolution whose input has its channels last. Compiled steps go by index, and need no such order.

    :param parameters: tensors in any order in memory
    :param values: one tensor for each parameter, of its shape
    :return: the same values, copied where the order was another
    """
    if th.compiler.is_compiling():
        return list(values)
    pairs = zip(parameters, values, strict=True)
    return [value if _in_one_order(one, value) else th.empty_like(one).copy_(value) for one, value in pairs]


def _in_one_order(one: th.Tensor, other: th.Tensor) -> bool:
    """Whether two tensors of one shape have the same order in memory; strides of dimensions of size 1 mean nothing."""
    if one.is_contiguous() and other.is_contiguous():  # much faster than to look at strides
        return True
    strides = zip(one.stride(), other.stride(), one.shape, strict=True)
    return all(first == second for first, second, size in strides if size > 1)


def is_plain_adam(optimizer: th.optim.Optimizer) -> bool:
    """Whether the optimiser is torch's Adam or AdamW with the options that :func:`adam_step` knows."""
    group = optimizer.param_groups[0]
    plain = type(optimizer) in (th.optim.Adam, th.optim.AdamW) and group["fused"] is True
    return plain and not any(group[name] for name in ("amsgrad", "maximize", "differentiable"))


def adam_step(adam: AdamTensors, gradients: Sequence[th.Tensor], options: dict) -> None:
    """
    One step of Adam, or of AdamW if weight decay is decoupled.

    :param adam: parameters and Adam's state of them, changed in place
    :param gradients: gradient with respect to each of these parameters, in their order
    :param options: options of the optimiser's parameter group: betas, eps, weight decay, learning rate
    """
    decoupled, weight_decay, eps = options["decoupled_weight_decay"], options["weight_decay"], options["eps"]
    beta1, beta2 = options["betas"]
    adam.counts.add_(1)
    if not th.compiler.is_compiling():
        fused = th._fused_adamw_ if decoupled else th._fused_adam_
        fused(
            adam.parameters,
            list(gradients),
            adam.exp_avgs,
            adam.exp_avg_sqs,
            [],
            adam.steps,
            lr=options["lr"],
            beta1=beta1,
            beta2=beta2,
            weight_decay=weight_decay,
            eps=eps,
            amsgrad=False,
            maximize=False,
        )
        return
    moments = zip(adam.parameters, gradients, adam.exp_avgs, adam.exp_avg_sqs, *adam.powers, strict=True)
    for parameter, gradient, mean, square, power1, power2 in moments:
        power1.mul_(beta1)
        power2.mul_(beta2)
        if decoupled:
            parameter.mul_(1 - adam.learning_rate * weight_decay)
        elif weight_decay:
            gradient = gradient + weight_decay * parameter
        mean.lerp_(gradient, 1 - beta1)
        square.lerp_(gradient.square(), 1 - beta2)
        spread = (square / (1 - power2)).sqrt() + eps
        parameter.sub_(adam.learning_rate * mean / (1 - power1) / spread)
