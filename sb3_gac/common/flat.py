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
    :raises ValueError: if there are none, or of several dtypes
    """

    def __init__(self, parameters: Sequence[nn.Parameter], unclipped: int = 0):
        dtypes = {parameter.dtype for parameter in parameters}
        if len(dtypes) != 1:
            raise ValueError(f"A network needs trainable parameters of one dtype, but these have {sorted(map(str, dtypes))}.")
        self.parameters = list(parameters)
        ends = list(itertools.accumulate(parameter.numel() for parameter in parameters))
        self._bounds = list(itertools.pairwise([0, *ends]))
        self._n_clipped = len(self.parameters) - unclipped
        self.flat = nn.Parameter(self._joined(self.parameters))
        self._point_parameters_here()

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
        found = th.autograd.grad(outputs, self.parameters, slopes, allow_unused=True)
        gradients = [
            th.zeros_like(p) if gradient is None else gradient for gradient, p in zip(found, self.parameters, strict=True)
        ]
        clipped, unclipped = gradients[: self._n_clipped], gradients[self._n_clipped :]
        norm = th.linalg.vector_norm(th.stack([th.linalg.vector_norm(gradient) for gradient in clipped]))
        if max_norm is not None:
            scale = (max_norm / (norm + 1e-6)).clamp(max=1.0)
            clipped = [gradient * scale for gradient in clipped]
        return self._joined([*clipped, *unclipped]), norm

    @staticmethod
    @th.no_grad()
    def _joined(tensors: Sequence[th.Tensor]) -> th.Tensor:
        return th.cat([tensor.reshape(-1) for tensor in tensors])

    def _point_parameters_here(self) -> None:
        for parameter, (low, high) in zip(self.parameters, self._bounds, strict=True):
            parameter.data = self.flat.data[low:high].view(parameter.shape)


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
