"""Memories of networks: the base of all memories, and a recurrent layer with hidden layers before it."""

import itertools
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_gac.networks.layers import EnsembleLinear


class Memory(nn.Module):
    """The memory of a network. Its state is a row of numbers for each observation, zeros at an episode's start."""

    #: Size of the state, S
    state_size: int

    def state_before(self, state: np.ndarray | None, episode_start: np.ndarray | None, batch: int) -> th.Tensor:
        """
        The state before a step of acting, which is zero where an episode starts.

        :param state: state after the last step, shape (B, S); ``None`` if all episodes start
        :param episode_start: true where an episode starts, shape (B,); ``None`` if no episode starts
        :param batch: number of observations, B
        :return: state of the memory, shape (1, B, S)
        :raises ValueError: if ``state`` or ``episode_start`` has another number of rows than B
        """
        if episode_start is not None:
            episode_start = np.atleast_1d(episode_start)  # a single environment's done
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
        Add the actions of a step to the state; a memory of observations alone leaves the state as it is.

        :param state: state after a step of acting, shape (B, S)
        :param actions: actions taken in that step, in [-1, 1], shape (B, \\*action shape), or numbers of discrete actions
        :return: state for the next step, shape (B, S)
        """
        return state


class RecurrentCore(Memory):
    """
    Hidden layers and then one recurrent layer, for each member of an ensemble. The hidden layers are batched over members;
    each recurrent layer takes one pass over time.

    :param cell: kind of recurrent layer, "gru" or "lstm"
    :param features_dim: number of input features, F
    :param net_arch: hidden layer sizes before the recurrent layer
    :param hidden_size: size of the recurrent layer, H
    :param activation_fn: activation after each hidden layer
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
        :param features: features of T steps of B sequences, shape (T, B, F)
        :param state: state before the first step, shape (N, B, S); ``None`` at an episode's start
        :return: outputs of the recurrent layers, shape (N, T, B, H), and state after the last step, shape (N, B, S)
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
        :param cell: GRU or LSTM of one member
        :param x: output of the hidden layers, shape (T, B, F)
        :param state: state before the first step, shape (B, S); an LSTM's hidden and cell state side by side
        :return: outputs, shape (T, B, H), and state after the last step, shape (B, S)
        """
        if isinstance(cell, nn.GRU):
            outputs, last = cell(x, state[None])
            return outputs, last[0]
        outputs, (hidden, inner) = cell(x, tuple(part[None].contiguous() for part in state.chunk(2, dim=-1)))
        return outputs, th.cat([hidden[0], inner[0]], dim=-1)


CELLS: dict[str, Any] = {"gru": nn.GRU, "lstm": nn.LSTM}
