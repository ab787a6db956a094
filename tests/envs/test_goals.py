"""Goal environments: goals as entries of their own, and appended to others."""

import numpy as np
import pytest
from gymnasium import spaces

from sb3_gac.envs import AppendDesiredGoal, History, SplitDictObservation
from sb3_gac.envs.goals import GOALS
from tests.helpers import Sampled

SPACE = spaces.Dict(
    observation=spaces.Box(-1, 1, (4,), np.float64),
    achieved_goal=spaces.Box(-2, 2, (1, 2), np.float64),
    desired_goal=spaces.Box(-3, 3, (1, 2), np.float64),
    camera=spaces.Box(0, 255, (2, 2), np.uint8),
)
PARTIAL, PRIVILEGED = {"observation": [0, 1]}, {"observation": [2, 3]}


def _split(keep=GOALS):
    env = Sampled(SPACE)
    seen = []

    def observe(observation):
        seen.append(observation)
        return observation

    reset, step = env.reset, env.step
    env.reset = lambda **kwargs: (observe((found := reset(**kwargs))[0]), *found[1:])
    env.step = lambda action: (observe((found := step(action))[0]), *found[1:])
    return SplitDictObservation(env, PARTIAL, PRIVILEGED, keep), seen


def _both_ends(env):
    """After a reset and after a step."""
    yield env.reset(seed=0)[0]
    yield env.step(np.zeros(1, dtype=np.float32))[0]


def test_entries_are_kept_in_their_shapes_floats_in_single_precision():
    env, seen = _split([*GOALS, "camera"])
    for observation in _both_ends(env):
        assert observation in env.observation_space
        assert list(observation) == ["partial", "privileged", *GOALS, "camera"]
        for key, dtype in {"achieved_goal": np.float32, "desired_goal": np.float32, "camera": np.uint8}.items():
            assert observation[key].dtype == dtype
            np.testing.assert_array_equal(observation[key], seen[-1][key].astype(dtype))
    assert env.observation_space["desired_goal"] == spaces.Box(-3, 3, (1, 2), np.float32)


def test_the_desired_goal_is_appended_and_both_goals_are_dropped():
    env, seen = _split([*GOALS, "camera"])
    env = AppendDesiredGoal(env, ["partial", "privileged"])
    low = np.float32([-1, -1, -3, -3])
    assert env.observation_space["partial"] == env.observation_space["privileged"] == spaces.Box(low, -low)
    for observation in _both_ends(env):
        assert observation in env.observation_space
        assert set(observation) == {"partial", "privileged", "camera"}
        goal = seen[-1]["desired_goal"].ravel()
        for key, index in {"partial": slice(0, 2), "privileged": slice(2, 4)}.items():
            np.testing.assert_array_equal(observation[key], np.float32([*seen[-1]["observation"][index], *goal]))


def test_by_default_partial_alone_gets_it_once_whatever_its_history():
    env, seen = _split()
    env = AppendDesiredGoal(History(env, 3))
    observation, _ = env.reset(seed=0)
    assert observation["partial"].shape == (3 * 2 + 2,)
    assert observation["privileged"].shape == (2,)
    np.testing.assert_array_equal(observation["partial"][-2:], np.float32(seen[-1]["desired_goal"].ravel()))


def test_an_entry_of_double_precision_keeps_it():
    doubles = {key: spaces.Box(-1, 1, (2,), np.float64) for key in ("partial", "privileged", *GOALS)}
    env = AppendDesiredGoal(Sampled(spaces.Dict(doubles)))
    for observation in _both_ends(env):
        assert observation in env.observation_space
        assert observation["partial"].dtype == env.observation_space["partial"].dtype == np.float64


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: _split("desired_goal"), "keep must be a list of keys"),
        (lambda: _split(["partial"]), "keep must be a list of keys, other than 'partial'"),
        (lambda: _split(["goal"]), 'no entry "goal"'),
        (lambda: AppendDesiredGoal(_split(())[0]), 'no entry "desired_goal"'),
        (lambda: AppendDesiredGoal(_split()[0], ["state"]), 'no entry "state"'),
        (lambda: _split(None), "keep must be a list of keys"),
        (lambda: AppendDesiredGoal(_split()[0], "partial"), "to must be a list of keys"),
        (lambda: AppendDesiredGoal(_split()[0], None), "to must be a list of keys"),
        (lambda: AppendDesiredGoal(_split([*GOALS, "camera"])[0], ["camera"]), 'floating-point entry "camera"'),
        (lambda: AppendDesiredGoal(Sampled(SPACE), ["achieved_goal"]), 'one-dimensional.*"achieved_goal"'),
    ],
)
def test_refuses_with_the_culprit_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
