"""A wrapper that changes an environment's action space."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_gac.envs.wrappers import reset_with


class FlattenMultiDiscrete(gym.ActionWrapper):
    """
    Make a MultiDiscrete action Discrete: its combinations are numbered, and the last component counts fastest.

    :param env: environment with MultiDiscrete actions
    :raises ValueError: if the environment's actions are of another kind
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        space = env.action_space
        if not isinstance(space, spaces.MultiDiscrete):
            raise ValueError(f"FlattenMultiDiscrete needs MultiDiscrete actions, but the environment has {space}.")
        self._counts = space.nvec.ravel()
        self._start, self._shape, self._dtype = space.start, space.shape, space.dtype
        self.action_space = spaces.Discrete(int(np.prod(self._counts, dtype=np.int64)))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        :param seed: seed of the environment, ``None`` to go on with its random numbers
        :param options: options of the environment's reset
        :return: observation, info
        """
        return reset_with(self.env, seed, options)

    def action(self, action: Any) -> np.ndarray:
        """
        :param action: number of a combination, from 0
        :return: the combination in the shape and type of the environment's actions
        """
        combination = np.array(np.unravel_index(int(action), self._counts), dtype=self._dtype)
        return combination.reshape(self._shape) + self._start
