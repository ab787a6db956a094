"""Memories of networks: the base of all memories, and a recurrent layer with hidden layers before it."""

import functools
import itertools
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_gac.networks.layers import EnsembleLinear, in_float32
from sb3_gac.networks.linear_recurrent_unit import LinearRecurrentUnit


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


class GRU(nn.GRU):
    """Torch's GRU, whose state is its last output."""

    states_per_unit = 1

    def unroll(self, x: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param x: input of T steps of B sequences, shape (T, B, F)
        :param state: state before the first step, shape (B, H)
        :return: outputs, shape (T, B, H), and state after the last step, shape (B, H)
        """
        outputs, last = self(x, state[None])
        return outputs, last[0]


class LSTM(nn.LSTM):
    """Torch's LSTM, whose state is its hidden state and its cell state side by side."""

    states_per_unit = 2

    def unroll(self, x: th.Tensor, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param x: input of T steps of B sequences, shape (T, B, F)
        :param state: state before the first step, shape (B, 2 H)
        :return: outputs, shape (T, B, H), and state after the last step, shape (B, 2 H)
        """
        outputs, (hidden, inner) = self(x, tuple(part[None].contiguous() for part in state.chunk(2, dim=-1)))
        return outputs, th.cat([hidden[0], inner[0]], dim=-1)


#: Kinds of recurrent layers. An instance takes sizes of input and state; ``unroll`` takes all steps of a batch
CELLS: dict[str, Any] = {"gru": GRU, "lstm": LSTM, "lru": LinearRecurrentUnit}


class RecurrentCore(Memory):
    """
    Hidden layers and then one recurrent layer, for each member of an ensemble. The hidden layers are batched over members;
    each recurrent layer takes one pass over time, in float32, since errors of a state add up over an episode.

    :param cell: kind of recurrent layer, a name in ``CELLS``
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
        self.state_size = hidden_size * CELLS[cell].states_per_unit

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
            state = features.new_zeros(self.n_members, batch, self.state_size, dtype=th.float32)
        unrolls: list[Any] = [cell.unroll for cell in self.cells]
        members = zip(unrolls, x.unbind(0), state.unbind(0), strict=True)
        results = [in_float32(functools.partial(unroll, state=before), inputs) for unroll, inputs, before in members]
        outputs, states = zip(*results, strict=True)
        return th.stack(outputs), th.stack(states)
