"""
A network's parameters end to end in one tensor.

An optimiser, a gradient norm, its clipping and a target's Polyak average each cost some calls for every tensor of a
network, which at 256 units and less take as long as their arithmetic.  On one flat tensor each is a single call.
"""

import itertools
from collections.abc import Sequence

import torch as th
from torch import nn


class FlatParameters:
    """
    Makes the parameters views of one flat parameter, which is what an optimiser is given.

    :param parameters: of one network, all of one dtype and on one device
    :param unclipped: how many of the last ones have no say in :meth:`clip_gradient`
    :raises ValueError: if there are none, or of several dtypes
    """

    def __init__(self, parameters: Sequence[nn.Parameter], unclipped: int = 0):
        dtypes = {parameter.dtype for parameter in parameters}
        if len(dtypes) != 1:
            raise ValueError(f"A network needs trainable parameters of one dtype, but these have {sorted(map(str, dtypes))}.")
        self.parameters = list(parameters)
        ends = list(itertools.accumulate(parameter.numel() for parameter in parameters))
        self._bounds = list(itertools.pairwise([0, *ends]))
        self._clipped_end = ends[len(parameters) - unclipped - 1]
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

    def backward(self, loss: th.Tensor) -> None:
        """
        Leave the gradient of the loss with respect to these parameters, and no others, in ``flat.grad``.

        :param loss: scalar
        """
        gradients = th.autograd.grad(loss, self.parameters, allow_unused=True, materialize_grads=True)
        self.flat.grad = self._joined(gradients)

    def clip_gradient(self, max_norm: float | None) -> th.Tensor:
        """
        Scale the gradient in place to a norm of at most ``max_norm``, without waiting for the device.

        :param max_norm: ``None`` leaves the gradient as it is
        :return: norm before clipping, scalar
        """
        assert self.flat.grad is not None
        gradient = self.flat.grad[: self._clipped_end]
        norm = th.linalg.vector_norm(gradient)
        if max_norm is not None:
            gradient.mul_((max_norm / (norm + 1e-6)).clamp_(max=1.0))
        return norm

    @staticmethod
    @th.no_grad()
    def _joined(tensors: Sequence[th.Tensor]) -> th.Tensor:
        return th.cat([tensor.reshape(-1) for tensor in tensors])

    def _point_parameters_here(self) -> None:
        for parameter, (low, high) in zip(self.parameters, self._bounds, strict=True):
            parameter.data = self.flat.data[low:high].view(parameter.shape)
