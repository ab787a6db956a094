"""RMA's adaptation module as a memory: it estimates a latent of unseen entries from the last observations and actions."""

import itertools

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_gac.networks.layers import Head
from sb3_gac.networks.recurrent import Memory

WIDTH = 32
#: Kernel size and stride of each convolution over time, in steps
CONVOLUTIONS = ((9, 2), (5, 1), (5, 1))


class Adaptation(Memory):
    """
    A memory of the last K pairs of an observation's features and the action that followed, and an estimate of a latent from
    these pairs: two layers for each pair, convolutions over time, and a linear layer (Kumar et al. 2021, arXiv 2107.04034).
    Pairs before an episode's start are zeros. A convolution that is longer than its input is left out; with K = 1 all are left
    out.

    A policy with this memory gets the estimate beside the features of the present observation.

    :param features_dim: number of features of an observation, F
    :param action_space: Box of A dimensions, or Discrete space of A actions
    :param length: number of pairs, K
    :param latent_dim: size of the estimate, L
    :param activation_fn: activation after each layer but the last
    """

    def __init__(
        self,
        features_dim: int,
        action_space: spaces.Space,
        length: int,
        latent_dim: int,
        activation_fn: type[nn.Module] = nn.SiLU,
    ):
        super().__init__()
        self.length = length
        self.n_choices = int(action_space.n) if isinstance(action_space, spaces.Discrete) else 0
        self.action_dim = spaces.flatdim(action_space)
        self.pair_dim = features_dim + self.action_dim
        self.state_size = length * self.pair_dim
        layers = [(nn.Linear(size, WIDTH), activation_fn()) for size in (self.pair_dim, WIDTH)]
        self.per_pair = nn.Sequential(*itertools.chain(*layers))
        self.over_time = nn.Sequential()
        for kernel_size, stride in CONVOLUTIONS:
            if kernel_size <= length:
                self.over_time.extend([nn.Conv1d(WIDTH, WIDTH, kernel_size, stride), activation_fn()])
                length = (length - kernel_size) // stride + 1
        self.output = Head(WIDTH * length, latent_dim)

    def forward(self, features: th.Tensor, state: th.Tensor | None = None) -> tuple[th.Tensor, th.Tensor]:
        """
        One step of acting; :meth:`with_action` then adds the action to the state.

        :param features: features of the step's observation, shape (1, B, F)
        :param state: state before the step, shape (1, B, S); ``None`` at an episode's start
        :return: features and estimate side by side, shape (1, 1, B, F + L), and state after the step, shape (1, B, S)
        """
        now = features[0]
        before = now.new_zeros(len(now), self.state_size) if state is None else state[0]
        after = th.cat([before[:, self.pair_dim :], now, th.zeros_like(before[:, : self.action_dim])], dim=-1)
        return th.cat([now, self.estimate(before)], dim=-1)[None, None], after[None]

    def with_action(self, state: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """The state with the action of the last step, see :meth:`Memory.with_action`."""
        actions = actions.reshape(-1, 1 if self.n_choices else self.action_dim)
        return th.cat([state[:, : -self.action_dim], self._encoded(actions).to(state.dtype)], dim=-1)

    def state_of(self, features: th.Tensor, actions: th.Tensor, mask: th.Tensor) -> th.Tensor:
        """
        The state that acting would have reached.

        :param features: features of the last K observations, the oldest first, shape (K, B, F)
        :param actions: the last K actions, in [-1, 1], shape (K, B, A), or numbers of discrete actions, shape (K, B, 1)
        :param mask: 1 for steps of the episode, 0 for those before its start, shape (K, B)
        :return: state of the memory, shape (B, S)
        """
        pairs = th.cat([features, self._encoded(actions)], dim=-1)
        return th.where(mask[..., None] > 0, pairs, th.zeros_like(pairs)).transpose(0, 1).flatten(1)

    def estimate(self, state: th.Tensor) -> th.Tensor:
        """
        :param state: state of the memory, shape (B, S)
        :return: estimate of the latent, shape (B, L)
        """
        pairs = self.per_pair(state.reshape(-1, self.length, self.pair_dim))
        return self.output(self.over_time(pairs.transpose(1, 2)).flatten(1))

    def _encoded(self, actions: th.Tensor) -> th.Tensor:
        if not self.n_choices:
            return actions.float()
        return (actions.long() == th.arange(self.n_choices, device=actions.device)).float()
