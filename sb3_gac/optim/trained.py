"""
The trained parameters of a network, and one step of its optimiser.

Adam's state of each parameter is looked up once in a round of gradient steps instead of once in a step: with layers of 256
units or fewer, looking it up takes as long as the arithmetic.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import torch as th
from torch import nn

T = TypeVar("T")


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


class TrainedParameters:
    """
    The trainable parameters of a network. Any of them may be frozen and unfrozen at any time.

    No gradient, momentum or weight decay moves a frozen parameter, and the optimiser forgets its state of that parameter.

    :param parameters: all parameters of one network
    :param optimizer: optimiser of these parameters, in one group; a step of torch's Adam or AdamW is faster, if their options
        allow it
    :param unclipped: number of parameters, from the last one backwards, that gradient clipping leaves out
    :param memory: parameters, among these, whose learning rate :meth:`scale_memory` multiplies
    """

    def __init__(
        self,
        parameters: Sequence[nn.Parameter],
        optimizer: th.optim.Optimizer,
        unclipped: int = 0,
        memory: Sequence[nn.Parameter] = (),
    ):
        self.everything = list(parameters)
        self.optimizer = optimizer
        self._memory = {id(parameter) for parameter in memory}
        self._clips = [index < len(self.everything) - unclipped for index in range(len(self.everything))]
        self._state: object = None
        self.trained: list[bool] = []
        self._powers_follow = True
        self.refresh()

    @property
    def can_be_compiled(self) -> bool:
        """Whether :meth:`step` is made of tensor operations alone."""
        return self.adam is not None

    def refresh(self, compiled: bool | None = None) -> None:
        """
        Look up which parameters are trained, and the optimiser's state. A call is due before training and before saving, since
        parameters may have been frozen, and a file's state may have been loaded.

        :param compiled: whether the next steps are compiled; ``None`` if no steps follow
        """
        trained = [parameter.requires_grad for parameter in self.everything]
        group = self.optimizer.param_groups[0]
        if trained != self.trained or self.optimizer.state is not self._state:
            self.trained, self._state = trained, self.optimizer.state
            self.parameters = [p for p in self.everything if p.requires_grad]
            self.clipped = [clips for clips, p in zip(self._clips, self.everything, strict=True) if p.requires_grad]
            for parameter in self.everything:
                if not parameter.requires_grad:
                    self.optimizer.state.pop(parameter, None)
                    parameter.grad = None  # torch's own step would apply a gradient that is left
            self.adam = list(map(self._gathered, self._parts(self.parameters))) if _is_plain_adam(self.optimizer) else None
        if self.adam is not None:
            for adam, rate in zip(self.adam, self._learning_rates(), strict=True):
                adam.learning_rate.fill_(rate)
                if compiled and not self._powers_follow:
                    adam.bring_up_powers(group["betas"])
            self._powers_follow = self._powers_follow if compiled is None else compiled
        group["trained"] = trained

    def scale_memory(self, scale: float) -> None:
        """
        Set the learning rate of the memory's parameters.

        :param scale: multiple of the network's learning rate
        :raises ValueError: if the optimiser can have only one learning rate for all parameters
        """
        if scale != 1 and self._memory and self.adam is None:
            raise ValueError(
                'lr_scales: a learning rate for "memory" goes with torch\'s Adam and AdamW, without amsgrad, foreach or '
                f"fused=False, but the optimiser is {type(self.optimizer).__name__}: leave it out, or choose another "
                "optimizer_class."
            )
        self.optimizer.param_groups[0]["memory_lr_scale"] = scale

    def _learning_rates(self) -> list[float]:
        """The learning rate of each of :meth:`_parts`."""
        group = self.optimizer.param_groups[0]
        return [group["lr"], group["lr"] * group.get("memory_lr_scale", 1.0)][: 2 if self._memory else 1]

    def _parts(self, values: Sequence[T]) -> list[list[T]]:
        """
        :param values: one value for each trained parameter, in their order
        :return: the values of parameters outside of the memory and, if there is a memory, the values of its parameters
        """
        if not self._memory:
            return [list(values)]
        remembers = [id(parameter) in self._memory for parameter in self.parameters]
        return [[v for v, own in zip(values, remembers, strict=True) if own is part] for part in (False, True)]

    def _gathered(self, parameters: list[nn.Parameter]) -> AdamTensors:
        for parameter in parameters:
            state = self.optimizer.state[parameter]
            if not state:
                state["step"] = th.zeros((), device=parameter.device)
                state["exp_avg"], state["exp_avg_sq"] = th.zeros_like(parameter), th.zeros_like(parameter)
            for name in ("exp_avg", "exp_avg_sq"):  # a file may have them in another order in memory
                (state[name],) = in_order_of([parameter], [state[name]])
        states = [self.optimizer.state[parameter] for parameter in parameters]
        learning_rate = th.zeros((), device=self.everything[0].device if self.everything else None)
        counts = th.stack([state["step"] for state in states]) if states else learning_rate.new_zeros(0)
        for state, count in zip(states, counts, strict=True):
            state["step"] = count
        means, squares, steps = ([state[name] for state in states] for name in ("exp_avg", "exp_avg_sq", "step"))
        powers = [step.clone() for step in steps], [step.clone() for step in steps]
        adam = AdamTensors(list(parameters), means, squares, counts, steps, learning_rate, powers)
        adam.bring_up_powers(self.optimizer.param_groups[0]["betas"])
        return adam

    def freeze_as_saved(self) -> None:
        """Freeze and unfreeze the parameters as they were when the optimiser's state was saved."""
        for parameter, trained in zip(
            self.everything, self.optimizer.param_groups[0].get("trained", self.trained), strict=True
        ):
            parameter.requires_grad_(trained)

    def in_present_layout(self, state: dict[str, Any]) -> dict[str, Any]:
        """
        Bring an optimiser's state into the layout of this version.

        :param state: ``state_dict`` of an optimiser, from this version or from one that laid all parameters out in one tensor
        :return: the same state with an entry for each parameter
        """
        groups = state.get("param_groups", ())
        if len(groups) != 1 or len(groups[0]["params"]) == len(self.everything):
            return state
        (group,) = groups
        trained = group.get("trained", [True] * len(self.everything))
        indices = [index for index, was_trained in enumerate(trained) if was_trained]
        shapes = [self.everything[index].shape for index in indices]
        entries: dict[int, dict[str, th.Tensor]] = {index: {} for index in indices} if state["state"] else {}
        for name, value in state["state"].get(0, {}).items():
            flat = value.dim() == 1 and len(value) == sum(shape.numel() for shape in shapes)
            parts = value.split([shape.numel() for shape in shapes]) if flat else [value.clone() for _ in shapes]
            for index, part, shape in zip(indices, parts, shapes, strict=True):
                entries[index][name] = part.reshape(shape).clone() if flat else part
        return {"state": entries, "param_groups": [{**group, "params": list(range(len(self.everything)))}]}

    def norm(self, gradients: Sequence[th.Tensor]) -> th.Tensor:
        """
        :param gradients: gradient with respect to each trained parameter, in their order
        :return: norm of the gradients that clipping counts, scalar
        """
        clipped = self._clipped(gradients)
        if not clipped:
            return th.zeros((), device=self.everything[0].device if self.everything else None)
        # One call for all norms is faster than one for each, but torch's compiler can't compile _foreach_norm
        norms = list(map(th.linalg.vector_norm, clipped)) if th.compiler.is_compiling() else th._foreach_norm(clipped)
        return th.linalg.vector_norm(th.stack(norms))

    def _clipped(self, gradients: Sequence[th.Tensor]) -> list[th.Tensor]:
        return [gradient for gradient, clips in zip(gradients, self.clipped, strict=True) if clips]

    def step(self, gradients: Sequence[th.Tensor], scale: th.Tensor | None = None) -> None:
        """
        One step of the optimiser.

        :param gradients: gradient with respect to each trained parameter, in their order
        :param scale: factor for the gradients that clipping counts, scalar; ``None`` for no clipping
        """
        if not gradients:
            return
        gradients = in_order_of(self.parameters, gradients)
        if scale is not None and any(self.clipped):
            scaled = iter(th._foreach_mul(self._clipped(gradients), scale))
            gradients = [next(scaled) if clips else g for g, clips in zip(gradients, self.clipped, strict=True)]
        with th.no_grad():
            if self.adam is not None:
                for adam, own, rate in zip(self.adam, self._parts(gradients), self._learning_rates(), strict=True):
                    if own:
                        adam_step(adam, own, {**self.optimizer.param_groups[0], "lr": rate})
            else:
                for parameter, gradient in zip(self.parameters, gradients, strict=True):
                    parameter.grad = gradient
                self.optimizer.step()


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


def _is_plain_adam(optimizer: th.optim.Optimizer) -> bool:
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
