"""SB3's contract: ``predict`` on single and batched observations, on every device."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import get_device

from sb3_gac.algorithms import algorithm_class
from sb3_gac.envs import PARTIAL, PRIVILEGED
from tests.registry import LINES, algorithms, make
from tests.sb3_contract.helpers import AsDict, RandomEnv, pendulum, vectorized

GUIDED = [name for name in LINES if hasattr(algorithm_class(name), "predict_guider")]


class SubClassedBox(spaces.Box):
    """A Box by another name."""


def _subclassed_env():
    return AsDict(RandomEnv(SubClassedBox(-1, 1, (2,), np.float32), SubClassedBox(-1, 1, (2,), np.float32)))


def test_environment_with_subclassed_spaces_is_valid():
    check_env(_subclassed_env(), skip_render_check=True)


@algorithms()
def test_subclassed_spaces(algorithm):
    env = _subclassed_env()
    model = make(algorithm, env).learn(20)
    obs, _ = env.reset()
    action, _ = model.predict(obs)
    assert env.action_space.contains(action)


@algorithms()
def test_environment_is_wrapped_by_itself(algorithm):
    model = make(algorithm, pendulum(max_episode_steps=15)).learn(10)
    assert model.get_env().num_envs == 1
    assert model.get_env().env_is_wrapped(Monitor) == [True]
    assert len(model.ep_info_buffer) == 0
    model.learn(20)
    assert len(model.ep_info_buffer) == 1


@algorithms()
def test_environment_is_made_from_its_id(algorithm):
    gym.register("sb3_contract/Pendulum-v0", pendulum)
    try:
        model = make(algorithm, "sb3_contract/Pendulum-v0")
        assert model.learn(20).get_env().env_is_wrapped(Monitor) == [True]
    finally:
        del gym.registry["sb3_contract/Pendulum-v0"]


@pytest.mark.parametrize("device", ["cpu", "cuda", "auto"])
@pytest.mark.parametrize("deterministic", [False, True])
@algorithms()
def test_shapes_of_actions(algorithm, device, deterministic):
    model = make(algorithm, pendulum(), device=device)
    assert model.policy.device.type == get_device(device).type
    env = pendulum()
    obs, _ = env.reset()
    batch = vectorized(pendulum, 3).reset()
    forms = (lambda full: full, lambda full: {PARTIAL: full[PARTIAL]}, lambda full: full[PARTIAL])
    for single, batched in ((form(obs), form(batch)) for form in forms):
        action, state = model.predict(single, deterministic=deterministic)
        assert isinstance(action, np.ndarray)
        assert env.action_space.contains(action)
        assert (state is None) != LINES[algorithm].remembers
        actions, _ = model.predict(batched, deterministic=deterministic)
        assert actions.shape == (3, *env.action_space.shape)
        assert all(env.action_space.contains(action) for action in actions)


@algorithms()
def test_actions_depend_on_partial_alone_and_are_the_same_batched_or_not(algorithm):
    model = make(algorithm, pendulum()).learn(20)
    batch = vectorized(pendulum, 3).reset()
    actions, _ = model.predict(batch, deterministic=True)
    assert len(np.unique(actions)) == 3
    same = [{**batch, PRIVILEGED: -batch[PRIVILEGED]}, {PARTIAL: batch[PARTIAL]}, {**batch, "unknown": 0}, batch[PARTIAL]]
    for observations in same:
        np.testing.assert_array_equal(actions, model.predict(observations, deterministic=True)[0])
    singles = [model.predict({PARTIAL: partial}, deterministic=True)[0] for partial in batch[PARTIAL]]
    np.testing.assert_allclose(actions, np.stack(singles), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("algorithm", GUIDED)
def test_guider_needs_the_privileged_entry_and_uses_it(algorithm):
    model = make(algorithm, pendulum()).learn(20)
    obs, _ = pendulum().reset()
    action, _ = model.predict_guider(obs, deterministic=True)
    assert pendulum().action_space.contains(action)
    np.testing.assert_array_equal(action, model.predict_guider({**obs, "unknown": 0}, deterministic=True)[0])
    moved = {**obs, PRIVILEGED: obs[PRIVILEGED] + 5}
    assert not np.array_equal(action, model.predict_guider(moved, deterministic=True)[0])
    batch = vectorized(pendulum, 3).reset()
    assert model.predict_guider(batch)[0].shape == (3, 1)


@algorithms()
def test_stochastic_actions_vary_and_follow_the_seed(algorithm):
    model = make(algorithm, pendulum())
    obs, _ = pendulum().reset()

    def actions():
        model.set_random_seed(1)
        return [model.predict(obs)[0].item() for _ in range(5)]

    first = actions()
    assert len(set(first)) == 5
    assert actions() == first


@algorithms()
def test_actions_are_unscaled_to_the_environments_range(algorithm):
    model = make(algorithm, pendulum())
    with th.no_grad():
        model.actor.head.mean.bias.fill_(100.0)
    obs, _ = pendulum().reset()
    np.testing.assert_allclose(model.predict(obs, deterministic=True)[0], pendulum().action_space.high)


@algorithms()
def test_gym_and_vec_env_apis_are_not_mixed(algorithm):
    env = gym.wrappers.TimeLimit(pendulum(), 10)
    with pytest.raises(ValueError, match=r"mixing Gym API|the pair \(observation, info\)"):
        make(algorithm, env).predict(env.reset())
