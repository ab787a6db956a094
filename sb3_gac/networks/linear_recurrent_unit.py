"""The linear recurrent unit of Orvieto et al. (2023), Resurrecting recurrent neural networks for long sequences."""

import math

import torch as th
import torch.nn.functional as F
from torch import nn

#: Bounds of the initial |lambda|: the units forget over 10 to 1000 steps
SMALLEST_DECAY, LARGEST_DECAY = 0.9, 0.999
#: Steps that one matrix product computes
CHUNK = 16


class LinearRecurrentUnit(nn.Module):
    """
    Damped oscillators that add up the input, and a linear output (arXiv 2303.06349, equations 1 and 4 to 7)::

        h_t = lambda * h_(t-1) + gamma * B x_t        lambda = exp(-exp(nu_log) + i exp(theta_log))
        y_t = Re(C h_t) + D x_t + b

    The H numbers of h are complex, and ``*`` is a product by element. As |lambda| < 1 for all parameters, gradients through
    time never explode, and as the recurrence is linear, matrix products compute many of its steps at once. A memory whose
    first input is 32 steps old is thereby learned in a fraction of a GRU's gradient steps. Complex numbers are pairs of real
    ones, which all formats of exported policies have.

    :param in_features: size of the input, F
    :param hidden_size: number of complex numbers in the state, and size of the output, H
    """

    states_per_unit = 2

    def __init__(self, in_features: int, hidden_size: int):
        super().__init__()
        self.hidden_size = hidden_size
        square = th.empty(hidden_size).uniform_(SMALLEST_DECAY**2, LARGEST_DECAY**2)  # of |lambda|: uniform on a ring
        self.nu_log = nn.Parameter((-square.log() / 2).log())
        self.theta_log = nn.Parameter(th.empty(hidden_size).uniform_(0, 2 * math.pi).log())
        self.gamma_log = nn.Parameter((1 - square).log() / 2)  # the state's variance is then the input's
        self.input_weight = nn.Parameter(th.randn(2 * hidden_size, in_features) * (2 * in_features) ** -0.5)
        self.output_weight = nn.Parameter(th.randn(hidden_size, 2 * hidden_size) * hidden_size**-0.5)
        self.direct_weight = nn.Parameter(th.randn(hidden_size, in_features) * in_features**-0.5)
        self.bias = nn.Parameter(th.zeros(hidden_size))

    def unroll(self, x: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param x: input of T steps of B sequences, shape (T, B, F)
        :param state: state before the first step, real parts before imaginary parts, shape (B, 2 H)
        :return: outputs, shape (T, B, H), and state after the last step, shape (B, 2 H)
        """
        states = self._states(x, state)
        outputs = F.linear(states, self.output_weight) + F.linear(x, self.direct_weight, self.bias)
        return outputs, states[-1]

    def _states(self, x: th.Tensor, state: th.Tensor) -> th.Tensor:
        """
        :return: state after each step, shape (T, B, 2 H)
        """
        units = self.hidden_size
        weight = self.input_weight * self.gamma_log.exp().repeat(2)[:, None]
        added = F.linear(x, weight).unflatten(-1, (2, units)).permute(3, 2, 0, 1)  # (H, 2, T, B)
        before = state.unflatten(-1, (2, units)).permute(2, 1, 0)[:, :, None]  # (H, 2, 1, B)
        parts = added.split(CHUNK, dim=2)
        weights = self._weights(parts[0].shape[2])  # a shorter last part has the first of them
        results = []
        for part in parts:
            steps = part.shape[2]
            known = th.cat([before, part], dim=2).flatten(1, 2)
            product = weights[:, :, :steps, :, : steps + 1].flatten(3, 4).flatten(1, 2)
            results.append(th.bmm(product, known).unflatten(1, (2, steps)))
            before = results[-1][:, :, -1:]
        return th.cat(results, dim=2).permute(2, 3, 1, 0).flatten(2, 3)

    def _weights(self, steps: int) -> th.Tensor:
        """
        The weights of a state and of what the following steps add, in the state after each of these steps.

        :param steps: number of steps, T
        :return: powers of lambda as real matrices, shape (H, 2, T, 2, T + 1): unit; real or imaginary part after step t; the
            same of the state before (0) and of what step s adds (s = 1 to T). The power is t - s, and zero for s > t
        """
        number = th.arange(steps + 1, device=self.nu_log.device)
        power = number[1:, None] - number  # (T, T + 1)
        age = power.clamp(min=0)[None]
        size = (-age * self.nu_log.exp()[:, None, None]).exp() * (power >= 0)
        angle = age * self.theta_log.exp()[:, None, None]
        real, imaginary = size * angle.cos(), size * angle.sin()
        return th.stack([th.stack([real, -imaginary], dim=2), th.stack([imaginary, real], dim=2)], dim=1)
