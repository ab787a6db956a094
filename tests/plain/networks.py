"""
A model's networks once more, with torch's own layers, in float64.

The one place of the plain computation that knows how the package lays its networks out.
"""

from collections.abc import Sequence
from typing import Any

import torch as th
from torch import nn

from sb3_gac.networks.linear_recurrent_unit import LinearRecurrentUnit

Observation = dict[str, th.Tensor]


class Network(nn.Module):
    """
    Layers on some entries of the observation, then perhaps a recurrent layer, then layers that may see actions, then heads.

    :param keys: of the entries
    :param before: layers up to the recurrent one
    :param cell: recurrent layer, ``None`` for a network that remembers nothing
    :param after: layers up to the heads
    :param heads: name -> last layer
    """

    def __init__(
        self, keys: Sequence[str], before: list[nn.Module], cell: Any, after: list[nn.Module], heads: dict[str, nn.Module]
    ):
        super().__init__()
        self.keys = list(keys)
        self.before, self.cell, self.after = nn.ModuleList(before), cell, nn.ModuleList(after)
        self.heads = nn.ModuleDict(heads)
        self.double()

    def seen(self, obs: Observation) -> th.Tensor:
        """Of observations, (B, ...) each; of sequences from their start on, (T, B, ...) each, as the memory has it."""
        x = th.cat([obs[key] for key in self.keys], dim=-1)
        for layer in self.before:
            x = nn.functional.silu(layer(x))
        return x if self.cell is None else self.cell(x)[0]

    def hidden(self, seen: th.Tensor, actions: th.Tensor | None = None) -> th.Tensor:
        """The last hidden layer."""
        x = seen if actions is None else th.cat([seen, actions], dim=-1)
        for layer in self.after:
            x = nn.functional.silu(layer(x))
        return x


class LinearRecurrence(nn.Module):
    """
    The linear recurrent unit step by step, in complex numbers.

    :param unit: the package's, whose parameters are copied
    """

    def __init__(self, unit: LinearRecurrentUnit):
        super().__init__()
        self.of_unit = nn.ParameterDict({name: value.detach().clone() for name, value in unit.named_parameters()})

    def forward(self, x: th.Tensor, state: th.Tensor | None = None) -> tuple[th.Tensor, th.Tensor]:
        """Outputs and last state, which is complex, of sequences (T, B, F) and of the state before, (B, H)."""
        of = self.of_unit
        factor = th.exp(th.complex(-of["nu_log"].exp(), of["theta_log"].exp()))
        weight = th.complex(*of["input_weight"].chunk(2))
        output_weight = th.complex(*of["output_weight"].chunk(2, dim=1)).conj()  # pairs of numbers: Re(C h) = Re C Re h - ...
        outputs = []
        for row in x:
            added = of["gamma_log"].exp() * (row.to(weight.dtype) @ weight.t())
            state = added if state is None else factor * state + added
            outputs.append((state @ output_weight.t()).real + row @ of["direct_weight"].t() + of["bias"])
        assert state is not None
        return th.stack(outputs), state


def plain_policy(network: Any) -> Network:
    """
    :param network: one of the package's policies
    """
    keys = list(network.observation_space.spaces)
    after = [_linear(layer.weight, layer.bias) for layer in network.latent_net if isinstance(layer, nn.Linear)]
    heads = {name: _linear(layer.weight, layer.bias) for name, layer in network.head.named_children()}
    return Network(keys, *_memory(network.memory, 0), after, heads)


def plain_critics(ensemble: Any) -> nn.ModuleList:
    """
    :param ensemble: one of the package's, of values of an action, or of every action
    """
    keys = list(ensemble.observation_space.spaces)
    critics = nn.ModuleList()
    for i in range(ensemble.n_critics):
        first = ensemble.input
        takes_actions = hasattr(first, "actions_weight")
        weight = th.cat([first.features_weight[i], first.actions_weight[i]]) if takes_actions else first.weight[i]
        after = [_linear(weight.t(), first.bias[i, 0])]
        after += [_linear(layer.weight[i].t(), layer.bias[i, 0]) for layer in ensemble.hidden if hasattr(layer, "weight")]
        weight, bias = ensemble.output.weight[i], ensemble.output.bias[i]
        q = _linear(weight, bias) if takes_actions else _linear(weight.t(), bias[0])
        critics.append(Network(keys, *_memory(ensemble.memory, i), after, {"q": q}))
    return critics


def _memory(memory: Any, member: int) -> tuple[list[nn.Module], Any]:
    if memory is None:
        return [], None
    layers = [layer for layer in memory.hidden if hasattr(layer, "weight")]
    cell = memory.cells[member]
    return [_linear(layer.weight[member].t(), layer.bias[member, 0]) for layer in layers], _cell(cell)


def _cell(cell: Any) -> nn.Module:
    if isinstance(cell, LinearRecurrentUnit):
        return LinearRecurrence(cell)
    copy = (nn.GRU if isinstance(cell, nn.GRU) else nn.LSTM)(cell.input_size, cell.hidden_size)
    copy.load_state_dict(cell.state_dict())
    return copy


def _linear(weight: th.Tensor, bias: th.Tensor) -> nn.Linear:
    layer = nn.Linear(weight.shape[1], weight.shape[0])
    layer.load_state_dict({"weight": weight.detach(), "bias": bias.detach()})
    return layer
