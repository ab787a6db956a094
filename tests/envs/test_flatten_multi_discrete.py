"""Combinations of MultiDiscrete actions, numbered."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from sb3_gac.envs import FlattenMultiDiscrete


class _Echo(gym.Env):
    def __init__(self, space):
        self.action_space = space
        self.observation_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return np.zeros(1, dtype=np.float32), 0.0, False, False, {"action": action}


@given(nvec=st.lists(st.integers(1, 5), min_size=1, max_size=4), start=st.integers(-2, 3))
def test_every_combination_has_one_number(nvec, start):
    env = FlattenMultiDiscrete(_Echo(spaces.MultiDiscrete(nvec, start=[start] * len(nvec))))
    assert env.action_space == spaces.Discrete(int(np.prod(nvec)))
    seen = {tuple(env.step(number)[-1]["action"]) for number in range(env.action_space.n)}
    assert len(seen) == env.action_space.n


def test_the_last_component_counts_fastest_and_shapes_are_kept():
    env = FlattenMultiDiscrete(_Echo(spaces.MultiDiscrete([[2, 3], [4, 5]])))
    assert np.array_equal(env.step(7)[-1]["action"], [[0, 0], [1, 2]])


def test_other_actions_are_refused():
    with pytest.raises(ValueError, match=r"needs MultiDiscrete actions, but the environment has Discrete\(3\)"):
        FlattenMultiDiscrete(_Echo(spaces.Discrete(3)))
