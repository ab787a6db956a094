"""Previous action, and reward, as part of an observation."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from sb3_gac.envs import PreviousAction
from tests.helpers import Sampled, TwoViewBandit, TwoViewChoice


def test_discrete_actions_are_one_hot():
    env = PreviousAction(TwoViewChoice(length=5))
    check_env(env, skip_render_check=True)
    obs, _ = env.reset(seed=0)
    assert obs["partial"][2:].tolist() == [0, 0, 0]
    assert env.step(1)[0]["partial"][2:].tolist() == [0, 1, 0]
    assert env.step(2)[0]["partial"][2:].tolist() == [0, 0, 1]
    assert env.reset()[0]["partial"][2:].tolist() == [0, 0, 0]


def test_box_actions_and_rewards():
    env = PreviousAction(TwoViewBandit(length=5), reward=True)
    check_env(env, skip_render_check=True)
    env.reset(seed=0)
    obs, reward, *_ = env.step(np.array([0.25], dtype=np.float32))
    assert obs["partial"][2:].tolist() == [0.25, np.float32(reward)]
    assert obs["partial"].dtype == np.float32
    assert obs["privileged"].shape == (1,)


def test_what_it_cannot_do():
    class Other(TwoViewBandit):
        def __init__(self, action_space=None, partial=None):
            super().__init__()
            self.action_space = action_space or self.action_space
            self.observation_space = spaces.Dict(partial=partial or self.observation_space["partial"])

    with pytest.raises(ValueError, match="needs Box or Discrete actions"):
        PreviousAction(Other(spaces.MultiDiscrete([2, 2])))
    with pytest.raises(ValueError, match="one-dimensional, floating-point entry"):
        PreviousAction(Other(partial=spaces.Box(0, 255, (3, 3), np.uint8)))
    with pytest.raises(ValueError, match='no entry "other"'):
        PreviousAction(TwoViewBandit(), key="other")


def test_the_action_itself_is_passed_on():
    class Echo(gym.Wrapper):
        def step(self, action):
            *rest, info = super().step(action)
            return *rest, {**info, "action": action}

    env = PreviousAction(Echo(TwoViewChoice()))
    env.reset()
    assert env.step(2)[-1]["action"] == 2


def test_choices_that_do_not_count_from_zero_are_told_apart():
    """Of three that are numbered 5, 6 and 7."""
    entries = spaces.Dict(partial=spaces.Box(-1, 1, (2,), np.float32), privileged=spaces.Box(-1, 1, (1,), np.float32))
    env = PreviousAction(Sampled(entries, spaces.Discrete(3, start=5)))
    assert env.reset(seed=0)[0]["partial"][2:].tolist() == [0, 0, 0]
    for place, action in enumerate((5, 6, 7)):
        assert env.step(action)[0]["partial"][2:].tolist() == np.eye(3)[place].tolist()
