"""The trained parameters of a network, and one step of its optimiser."""

from collections.abc import Sequence
from typing import Any, TypeVar

import torch as th
from torch import nn

from sb3_gac.optim.adam import AdamTensors, adam_step, in_order_of, is_plain_adam

T = TypeVar("T")


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
        of_memory = {id(parameter) for parameter in memory}
        #: Whether each parameter belongs to the memory, by position: a copy of the network has other parameters
        self._remembers = [id(parameter) in of_memory for parameter in self.everything]
        self._clips = [index < len(self.everything) - unclipped for index in range(len(self.everything))]
        self._state: object = None
        self.trained: list[bool] = []
        self.adam: list[AdamTensors] | None = None
        self._powers_follow = True
        self.refresh()

    @property
    def can_be_compiled(self) -> bool:
        """Whether :meth:`step` is made of tensor operations alone."""
        return self.adam is not None

    @property
    def _device(self) -> th.device | None:
        return self.everything[0].device if self.everything else None

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
            self.adam = None
            if is_plain_adam(self.optimizer):
                parts = self._parts(self.parameters)
                self.adam = [AdamTensors.gathered(part, self.optimizer, self._device) for part in parts]
        if self.adam is not None:
            for adam, rate in zip(self.adam, self._learning_rates(), strict=True):
                adam.learning_rate.fill_(rate)
                if compiled and not self._powers_follow:
                    adam.bring_up_powers(group["betas"])
            self._powers_follow = self._powers_follow if compiled is None else compiled
        group["trained"] = trained

    def check_memory_scale(self, scale: float) -> None:
        """
        Check that the memory's parameters can have a learning rate of their own.

        :param scale: multiple of the network's learning rate
        :raises ValueError: if the optimiser can have only one learning rate for all parameters
        """
        if scale != 1 and any(self._remembers) and self.adam is None:
            raise ValueError(
                'lr_scales: a learning rate for "memory" goes with torch\'s Adam and AdamW, without amsgrad, foreach or '
                f"fused=False, but the optimiser is {type(self.optimizer).__name__}: leave it out, or choose another "
                "optimizer_class."
            )

    def scale_memory(self, scale: float) -> None:
        """
        Set the learning rate of the memory's parameters.

        :param scale: multiple of the network's learning rate
        :raises ValueError: see :meth:`check_memory_scale`
        """
        self.check_memory_scale(scale)
        self.optimizer.param_groups[0]["memory_lr_scale"] = scale

    def _learning_rates(self) -> list[float]:
        """The learning rate of each of :meth:`_parts`."""
        group = self.optimizer.param_groups[0]
        return [group["lr"], group["lr"] * group.get("memory_lr_scale", 1.0)][: 2 if any(self._remembers) else 1]

    def _parts(self, values: Sequence[T]) -> list[list[T]]:
        """
        :param values: one value for each trained parameter, in their order
        :return: the values of parameters outside of the memory and, if there is a memory, the values of its parameters
        """
        if not any(self._remembers):
            return [list(values)]
        remembers = [own for own, trained in zip(self._remembers, self.trained, strict=True) if trained]
        return [[v for v, own in zip(values, remembers, strict=True) if own is part] for part in (False, True)]

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
            return th.zeros((), device=self._device)
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
