"""Evaluations of the main job, which go on until episodes end."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_gac.train import parse_arguments
from sb3_gac.training.job import learn, prepare
from tests.helpers import Sampled

SMALL = "{learning_starts: 100, batch_size: 8, policy_kwargs: {net_arch: [8]}}"


def make_long(length=25):
    """Whose episodes end, but nobody can know when."""
    entry = spaces.Box(-1, 1, (2,), np.float32)
    return Sampled(spaces.Dict(partial=entry, privileged=entry), length=length)


def make_limited():
    """Whose episodes are known to end."""
    return gym.wrappers.TimeLimit(make_long(), 30)


@pytest.mark.parametrize(("maker", "steps"), [("make_long", ["20"]), ("make_limited", [])], ids=["no limit known", "limited"])
def test_episodes_that_may_never_end_are_warned_of_before_they_are_waited_for(maker, steps, tmp_path):
    env_id = f"{__name__}:{maker}"
    options = ["--env", env_id, "--steps", "200", "--envs", "1", "--episodes", "1", "--overrides", SMALL]
    job = prepare(parse_arguments([*options, "--runs", str(tmp_path)]))
    with job.alone, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        learn(job)
    said = [str(warning.message) for warning in caught if "No episode" in str(warning.message)]
    assert [text.split()[7] for text in said] == steps, said
    assert all(text.startswith(f"No episode of {env_id} has ended") and "max_episode_steps" in text for text in said)
