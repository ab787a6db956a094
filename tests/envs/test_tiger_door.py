"""The environment beside the arrays of sb3_gac.tabular, which have the same game."""

from itertools import product

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sb3_gac.envs.state import env_state, restore_env_state
from sb3_gac.tabular import expected_return, tiger_door

ENV = "sb3_gac/TigerDoor-v0"
UNHEARD = 2


def _state_of(observation):
    """Index in the arrays: the door, after what was heard."""
    door = observation["privileged"][:2].argmax()
    return int(door if observation["partial"].argmax() == UNHEARD else door + 2)


@pytest.fixture
def env():
    return gym.make(ENV)


def test_it_keeps_to_gymnasiums_interface(env):
    check_env(env.unwrapped, skip_render_check=True)


def test_rewards_transitions_and_what_is_seen_are_those_of_the_arrays(env):
    process = tiger_door()
    met = set()
    for seed, listens, action in product(range(8), (0, 1), range(3)):
        observation, _ = env.reset(seed=seed)
        for _ in range(listens):
            observation, *_ = env.step(2)
        state = _state_of(observation)
        assert observation["partial"].argmax() == [UNHEARD, 0, 1][process.observations[state]]
        after, reward, terminated, truncated, _ = env.step(action)
        assert reward == process.rewards[state, action]
        assert terminated == (process.transitions[state, action].sum() == 0)
        assert not truncated
        if not terminated:
            assert process.transitions[state, action, _state_of(after)] == 1
        met.add((state, action))
    assert len(met) == 12


def test_who_listens_first_gets_0_9_and_who_guesses_half_of_1(env):
    returns = {"listens": [], "guesses": []}
    for seed in range(200):
        env.reset(seed=seed)
        returns["guesses"].append(env.step(0)[1])
        env.reset(seed=seed)
        observation, cost, *_ = env.step(2)
        returns["listens"].append(cost + env.step(int(observation["partial"].argmax()))[1])
    assert np.mean(returns["listens"]) == pytest.approx(0.9)
    assert np.mean(returns["guesses"]) == pytest.approx(0.5, abs=0.1)
    process = tiger_door()
    assert expected_return(process, np.eye(3)[[2, 2, 0, 1]]) == pytest.approx(0.9)


def test_who_only_listens_is_cut_off(env):
    env.reset(seed=0)
    assert [env.step(2)[3] for _ in range(20)] == [False] * 19 + [True]


def test_the_middle_of_an_episode_is_written_down_and_restored(env):
    env.reset(seed=3)
    env.step(2)
    state = env_state(env)
    other = gym.make(ENV)
    other.reset(seed=4)
    restore_env_state(other, state)
    for one, two in ((env.step(0), other.step(0)), (env.reset(), other.reset()), (env.reset(), other.reset())):
        np.testing.assert_equal(one, two)
