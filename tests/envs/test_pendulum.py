"""Pendulum without its velocity: the split against the simulator's own state, noise, time limit, checkers."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_gac.envs import make_pendulum


def _make(**kwargs):
    return gym.make("sb3_gac/Pendulum-v1", **kwargs)


def _clean(env):
    angle, velocity = env.unwrapped.state
    return np.array([np.cos(angle), np.sin(angle), velocity], dtype=np.float32)


def _trace(env, n_steps=7):
    env.action_space.seed(0)
    yield env.reset(seed=0)[0]
    for _ in range(n_steps):
        yield env.step(env.action_space.sample())[0]


@pytest.mark.parametrize(("privileged", "visible"), [("state", [0, 1, 2]), ("velocity", [2])])
def test_split_is_the_simulators_state(privileged, visible):
    env = _make(privileged=privileged)
    for observation in _trace(env):
        assert np.array_equal(observation["partial"], _clean(env)[:2])
        assert np.array_equal(observation["privileged"], _clean(env)[visible])
        assert observation in env.observation_space


def test_noise_is_on_the_angle_alone_and_changes_no_dynamics():
    noisy, clean = _make(noise_std=0.1), _make()
    for seen, wanted in zip(_trace(noisy), _trace(clean), strict=True):
        assert np.array_equal(seen["privileged"], wanted["privileged"])
        assert 0 < np.abs(seen["partial"] - wanted["partial"]).max() < 0.6


def test_time_limit_of_200_steps_is_a_truncation():
    env = _make()
    env.reset(seed=0)
    ends = [env.step(np.zeros(1, np.float32))[2:4] for _ in range(200)]
    assert ends == [(False, False)] * 199 + [(False, True)]


@pytest.mark.filterwarnings("ignore:(?s).*symmetric and normalized")  # torque: 2
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("privileged", ["state", "velocity"])
def test_passes_both_environment_checkers(privileged):
    env = _make(privileged=privileged)
    gymnasium_check_env(env, skip_render_check=True)
    sb3_check_env(env, skip_render_check=True)


def test_is_picklable():
    env = _make(noise_std=0.2)
    env.reset(seed=4)
    copy = pickle.loads(pickle.dumps(env))
    first, second = env.reset(seed=5)[0], copy.reset(seed=5)[0]
    assert all(np.array_equal(first[key], second[key]) for key in ("partial", "privileged"))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [({"privileged": "everything"}, "privileged must be one of .*state"), ({"noise_std": -1}, "noise_std")],
)
def test_refuses_with_the_culprit_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_pendulum(**kwargs)
