"""What is told before a training of which nothing can come."""

import warnings

import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from tests.helpers import TwoViewBandit, small_model

SAID = "learn makes no gradient step"


@pytest.mark.parametrize(
    ("arguments", "n_envs", "total", "ends"),
    [({}, 1, 10, 10), ({"train_freq": 4}, 1, 5, 8), ({"train_freq": 2}, 2, 5, 8), ({"learning_starts": 1000}, 1, 30, 30)],
)
def test_a_training_that_ends_within_the_warm_up_is_warned_of(arguments, n_envs, total, ends):
    model = small_model(DummyVecEnv([TwoViewBandit] * n_envs), **arguments)
    starts = arguments.get("learning_starts", 10)
    with pytest.warns(UserWarning, match=f"{SAID}: learning_starts is {starts}, and training ends after {ends} steps") as told:
        model.learn(total)
    assert (model.num_timesteps, model._n_updates) == (ends, 0)
    assert [warning.filename for warning in told if SAID in str(warning.message)] == [__file__]


@pytest.mark.parametrize(
    ("arguments", "total", "reset"),
    [
        ({}, 11, True),
        ({"train_freq": 11}, 5, True),
        ({}, 5, False),  # a piece of a training
        ({}, 0, True),
        ({"gradient_steps": 0}, 5, True),
        ({"train_freq": (1, "episode")}, 5, True),
    ],
)
def test_other_trainings_are_not(arguments, total, reset):
    model = small_model(TwoViewBandit(length=20), **arguments)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", SAID)
        model.learn(total, reset_num_timesteps=reset)
