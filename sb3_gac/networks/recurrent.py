"""What networks remember: of a sequence by hidden layers and a recurrent cell, before the rest of the network."""

import itertools
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_gac.networks.layers import EnsembleLinear


class Memory(nn.Module):
    """What a network remembers from one step to the next: a row of numbers each, zeros at an episode's start."""

    #: Numbers in a row, S
    state_size: int

    def state_before(self, state: np.ndarray | None, episode_start: np.ndarray | None, batch: int) -> th.Tensor:
        """
        :param state: as the last :meth:`forward` left it, shape (B, S), or ``None``
        :param episode_start: true where an episode starts, which is without a memory, shape (B,)
        :param batch: B
        :return: shape (1, B, S)
        :raises ValueError: if ``state`` or ``episode_start`` is of another number of observations
        """
        for name, given in (("state", state), ("episode_start", episode_start)):
            if given is not None and len(given) != batch:
                raise ValueError(
                    f"{name} is of {len(given)} observations, but predict() was given {batch}: pass the state that the last "
                    "predict() returned, and one episode_start for each observation."
                )
        device = next(self.parameters()).device
        if state is None:
            return th.zeros(1, batch, self.state_size, device=device)
        kept = th.as_tensor(np.array(state, dtype=np.float32), device=device).reshape(1, batch, self.state_size)
        if episode_start is None:
            return kept
        goes_on = 1.0 - th.as_tensor(np.array(episode_start, dtype=np.float32), device=device).reshape(1, batch, 1)
        return kept * goes_on

    def with_action(self, state: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param state: as a step of acting left it, shape (B, S)
        :param actions: that were then taken, in [-1, 1], shape (B, \\*action shape), or numbers of actions
        :return: what is remembered of both; by a memory of observations alone, the same
        """
        return state


class RecurrentCore(Memory):
    """
    Hidden layers and then one recurrent layer, for each member of an ensemble; the layers are batched over members, each
    recurrent layer takes one pass over time.

    :param cell: "gru" or "lstm"
    :param features_dim: size of what comes in, F
    :param net_arch: hidden layer sizes before the recurrent layer
    :param hidden_size: of the recurrent layer, H
    :param activation_fn: after each hidden layer
    :param n_members: size of the ensemble, N
    """

    def __init__(
        self,
        cell: str,
        features_dim: int,
        net_arch: list[int],
        hidden_size: int,
        activation_fn: type[nn.Module] = nn.SiLU,
        n_members: int = 1,
    ):
        super().__init__()
        self.hidden_size = hidden_size
        self.n_members = n_members
        layers: list[nn.Module] = []
        for in_features, out_features in itertools.pairwise([features_dim, *net_arch]):
            layers += [EnsembleLinear(n_members, in_features, out_features), activation_fn()]
        self.hidden = nn.Sequential(*layers)
        width = [features_dim, *net_arch][-1]
        self.cells = nn.ModuleList(CELLS[cell](width, hidden_size) for _ in range(n_members))
        self.state_size = hidden_size * (2 if cell == "lstm" else 1)

    def forward(self, features: th.Tensor, state: th.Tensor | None = None) -> tuple[th.Tensor, th.Tensor]:
        """
        :param features: shape (T, B, F)
        :param state: before the first step, shape (N, B, S); ``None`` at an episode's start
        :return: outputs, shape (N, T, B, H), and the state after the last step
        """
        steps, batch = features.shape[:2]
        x = self.hidden(features.reshape(1, steps * batch, -1).expand(self.n_members, -1, -1))
        x = x.reshape(self.n_members, steps, batch, -1)
        if state is None:
            state = features.new_zeros(self.n_members, batch, self.state_size)
        results = [self._unroll(*member) for member in zip(self.cells, x.unbind(0), state.unbind(0), strict=True)]
        outputs, states = zip(*results, strict=True)
        return th.stack(outputs), th.stack(states)

    @staticmethod
    def _unroll(cell: Any, x: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param x: shape (T, B, F)
        :param state: shape (B, S); an LSTM's hidden and cell state side by side
        :return: shapes (T, B, H) and (B, S)
        """
        if isinstance(cell, nn.GRU):
            outputs, last = cell(x, state[None])
            return outputs, last[0]
        outputs, (hidden, inner) = cell(x, tuple(part[None].contiguous() for part in state.chunk(2, dim=-1)))
        return outputs, th.cat([hidden[0], inner[0]], dim=-1)


CELLS: dict[str, Any] = {"gru": nn.GRU, "lstm": nn.LSTM}
