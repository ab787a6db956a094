"""
A network's parameters end to end in one tensor.

An optimiser and a target's Polyak average each cost some calls for every tensor of a network, which at 256 units and less
take as long as their arithmetic.  On one flat tensor each is a single call.  A gradient's norm and its clipping go tensor by
tensor nevertheless, before they are joined: that is what compiles into fast kernels.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import torch as th
from torch import nn


class FlatParameters:
    """
    Makes the parameters views of one flat parameter, which is what an optimiser is given.

    :param parameters: of one network, all of one dtype and on one device
    :param unclipped: how many of the last ones have no say in :meth:`gradient`'s norm and its bound
    :raises ValueError: if they are of several dtypes
    """

    def __init__(self, parameters: Sequence[nn.Parameter], unclipped: int = 0):
        self._lay_out(parameters, unclipped)
        self.flat = nn.Parameter(self._joined(self.parameters))
        self._point_parameters_here()

    def _lay_out(self, parameters: Sequence[nn.Parameter], unclipped: int) -> None:
        dtypes = {parameter.dtype for parameter in parameters}
        if len(dtypes) > 1:
            raise ValueError(f"A network needs trainable parameters of one dtype, but these have {sorted(map(str, dtypes))}.")
        self.parameters = list(parameters)
        ends = list(itertools.accumulate(parameter.numel() for parameter in parameters))
        self._bounds = list(itertools.pairwise([0, *ends]))
        self._n_clipped = len(self.parameters) - unclipped

    def refresh(self) -> None:
        """Start again from the parameters, if a move to another device, a copy or an assignment has parted them from here."""
        start, size = self.flat.data_ptr(), self.flat.element_size()
        here = (
            parameter.data_ptr() == start + low * size
            for parameter, (low, _) in zip(self.parameters, self._bounds, strict=True)
        )
        if not all(here):
            self.flat.data = self._joined(self.parameters)
            self._point_parameters_here()

    def gradient(
        self, outputs: th.Tensor | Sequence[th.Tensor], max_norm: float | None, slopes: Sequence[th.Tensor] | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        A loss's gradient with respect to these parameters, and no others.

        :param outputs: the loss, a scalar, or what it is a function of
        :param max_norm: scale the gradient to a norm of at most this; ``None`` leaves it as it is
        :param slopes: the loss's gradients with respect to outputs that are not itself
        :return: gradient in the order of ``flat``, zero where there is none; its norm before, scalar
        """
        sources = [outputs] if isinstance(outputs, th.Tensor) else list(outputs)
        reached = [index for index, source in enumerate(sources) if source.requires_grad]
        if not reached or not self.parameters:  # all of what they are computed by is frozen
            return th.zeros_like(self.flat), self.flat.new_zeros(())
        found = th.autograd.grad(
            [sources[index] for index in reached],
            self.parameters,
            None if slopes is None else [slopes[index] for index in reached],
            allow_unused=True,
        )
        gradients = [
            th.zeros_like(p) if gradient is None else gradient for gradient, p in zip(found, self.parameters, strict=True)
        ]
        clipped, unclipped = gradients[: self._n_clipped], gradients[self._n_clipped :]
        norm = self.flat.new_zeros(())
        if clipped:
            norm = th.linalg.vector_norm(th.stack([th.linalg.vector_norm(gradient) for gradient in clipped]))
        if max_norm is not None:
            scale = (max_norm / (norm + 1e-6)).clamp(max=1.0)
            clipped = [gradient * scale for gradient in clipped]
        return self._joined([*clipped, *unclipped]), norm

    @staticmethod
    @th.no_grad()
    def _joined(tensors: Sequence[th.Tensor]) -> th.Tensor:
        return th.cat([tensor.reshape(-1) for tensor in tensors]) if tensors else th.empty(0)

    def _point_parameters_here(self) -> None:
        for parameter, (low, high) in zip(self.parameters, self._bounds, strict=True):
            parameter.data = self.flat.data[low:high].view(parameter.shape)


class TrainedParameters(FlatParameters):
    """
    Those parameters of a network that are trainable, of which any may be frozen and unfrozen at any time.

    A frozen one leaves the flat parameter, and nothing moves it: no gradient, no momentum and no weight decay.

    :param parameters: of one network; the trainable ones are of one dtype
    :param unclipped: how many of the last ones have no say in :meth:`gradient`'s norm and its bound
    """

    def __init__(self, parameters: Sequence[nn.Parameter], unclipped: int = 0):
        self.everything = list(parameters)
        self._unclipped = unclipped
        self.trained = self._trainable_now()
        self._trained_at_first = self.trained
        super().__init__(*self._layout())

    def _trainable_now(self) -> list[bool]:
        return [parameter.requires_grad for parameter in self.everything]

    def _layout(self) -> tuple[list[nn.Parameter], int]:
        parameters = [parameter for parameter, trained in zip(self.everything, self.trained, strict=True) if trained]
        return parameters, sum(self.trained[len(self.trained) - self._unclipped :])

    def follow(self, optimizer: th.optim.Optimizer) -> None:
        """
        Lay out anew, if others are trainable than before, and the optimiser's state with them.

        :param optimizer: of the flat parameter; its group says under "trained" which parameters its state is of, as does
            a file that it was loaded from
        """
        trainable = self._trainable_now()
        if trainable != self.trained:
            for parameter in self.parameters:
                if not parameter.requires_grad:
                    parameter.data = parameter.data.clone()
            self.trained = trainable
            self._lay_out(*self._layout())
            self.flat.grad, self.flat.data = None, self._joined(self.parameters)
            self._point_parameters_here()
        group = optimizer.param_groups[0]
        before = group.get("trained", self._trained_at_first)
        if before != trainable and self.flat in optimizer.state:
            self._lay_out_state(optimizer.state[self.flat], before)
        group["trained"] = trainable

    def _lay_out_state(self, state: dict[str, Any], before: list[bool]) -> None:
        """
        Where parameters have joined, their statistics and the others' are not of the same steps: all start anew.

        :param state: of an optimiser, changed in place
        :param before: which parameters it is of
        """
        if any(now and not then for now, then in zip(self.trained, before, strict=True)):
            state.clear()
        sizes = [parameter.numel() for parameter, then in zip(self.everything, before, strict=True) if then]
        stay = [now for now, then in zip(self.trained, before, strict=True) if then]
        for name, value in state.items():
            if isinstance(value, th.Tensor) and value.shape == (sum(sizes),):
                state[name] = self._joined([part for part, stays in zip(value.split(sizes), stay, strict=True) if stays])

    def freeze_as_in(self, optimizer: th.optim.Optimizer) -> None:
        """
        Freeze and unfreeze the parameters as they were when the optimiser was saved.

        :param optimizer: of the flat parameter, with the state that a file held
        """
        for parameter, trained in zip(self.everything, optimizer.param_groups[0].get("trained", self.trained), strict=True):
            parameter.requires_grad_(trained)


class FlatAdam(th.optim.Adam):
    """
    Adam on one flat parameter a group: the same arithmetic and state as ``torch.optim.Adam``'s, whose bookkeeping for any
    number of tensors takes longer than the arithmetic at 256 units and less.

    :param args: of ``torch.optim.Adam``
    :param kwargs: of ``torch.optim.Adam``; ``fused`` is always true
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{**kwargs, "fused": True})

    @th.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """
        One step down each flat parameter's gradient.

        :param closure: not supported
        """
        for group in self.param_groups:
            (flat,) = group["params"]
            state = self.state[flat]
            if not state or group["amsgrad"]:
                super().step()
                return
            state["step"] += 1
            th._fused_adam_(
                [flat],
                [flat.grad],
                [state["exp_avg"]],
                [state["exp_avg_sq"]],
                [],
                [state["step"]],
                lr=group["lr"],
                beta1=group["betas"][0],
                beta2=group["betas"][1],
                weight_decay=group["weight_decay"],
                eps=group["eps"],
                amsgrad=False,
                maximize=group["maximize"],
            )

    step.hooked = True  # type: ignore[attr-defined]  # no profiler range around each step
