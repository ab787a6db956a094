"""SB3's contract: Dict observations of images, vectors and discrete entries, stacked, normalised, in other processes."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_gac import GAC
from sb3_gac.envs import PARTIAL, PRIVILEGED
from tests.sb3_contract.helpers import ACTIONS, RandomEnv, Renamed, make_gac

VECTOR = spaces.Box(-1, 1, (2,), np.float32)


def _mixed_env(channel_last=False):
    image = spaces.Box(0, 255, (36, 36, 1) if channel_last else (1, 36, 36), np.uint8)
    return RandomEnv(spaces.Dict({PARTIAL: image, PRIVILEGED: VECTOR, "phase": spaces.Discrete(4)}), ACTIONS)


def _make(env, **kwargs):
    options = {"buffer_size": 250, "train_freq": 8, "gamma": 0.5, "seed": 1, **kwargs}
    return make_gac(env, policy_kwargs={"features_extractor_kwargs": {"cnn_output_dim": 8}}, **options)


def _evaluate(model, env):
    lengths = evaluate_policy(model, env, n_eval_episodes=2, warn=False, return_episode_rewards=True)[1]
    assert len(lengths) == 2


@pytest.mark.parametrize("channel_last", [False, True])
@pytest.mark.parametrize("learner", [[PARTIAL], ["phase"], [PARTIAL, "phase"], [PRIVILEGED, "phase", PARTIAL]])
def test_mixed_entries(channel_last, learner):
    env = _mixed_env(channel_last)
    check_env(env, skip_render_check=True)
    model = _make(env, role_keys={"learner": learner}).learn(40)
    assert model._n_updates > 0
    _evaluate(model, env)
    obs, _ = env.reset()
    action, _ = model.predict({key: obs[key] for key in learner}, deterministic=True)
    np.testing.assert_array_equal(action, model.predict(obs, deterministic=True)[0])
    with pytest.raises(ValueError, match="lacks"):
        model.predict({key: obs[key] for key in learner[1:]})


def test_names_and_roles_of_entries_do_not_matter():
    """The same entries under other names give the same training to the bit."""
    actions = []
    for names in ({}, {PARTIAL: "seen", PRIVILEGED: "unseen"}):
        env = RandomEnv(spaces.Dict({PARTIAL: VECTOR, PRIVILEGED: VECTOR}), ACTIONS)
        env.observation_space.seed(10)
        model = make_gac(Renamed(env, names), seed=1, role_keys={"learner": [names.get(PARTIAL, PARTIAL)]}).learn(60)
        actions.append(model.predict(np.array([0.1, -0.2], np.float32), deterministic=True)[0])
    np.testing.assert_array_equal(*actions)


def test_one_entry_is_enough():
    env = RandomEnv(spaces.Dict({PARTIAL: VECTOR}), ACTIONS)
    model = make_gac(env).learn(40)
    assert model._n_updates > 0
    _evaluate(model, env)


def test_environments_in_other_processes():
    env = make_vec_env(_mixed_env, n_envs=2, vec_env_cls=SubprocVecEnv)
    model = _make(env, train_freq=5).learn(60)
    env.close()
    assert model._n_updates > 0


def _multi_obs_env(channel_last):
    env = SimpleMultiObsEnv(random_start=True, discrete_actions=False, channel_last=channel_last)
    return gym.wrappers.TimeLimit(Renamed(env, {"img": PARTIAL, "vec": PRIVILEGED}), 20)


@pytest.mark.parametrize("channel_last", [False, True])
def test_frame_stack(channel_last):
    channels_order = {PRIVILEGED: None, PARTIAL: "last" if channel_last else "first"}
    env = VecFrameStack(DummyVecEnv([partial(_multi_obs_env, channel_last)]), n_stack=3, channels_order=channels_order)
    model = _make(env, buffer_size=64).learn(40)
    assert model.observation_space[PARTIAL].shape == (3, 64, 64)
    assert model.observation_space[PRIVILEGED].shape == (15,)
    _evaluate(model, env)


@pytest.mark.parametrize("keys", [[PRIVILEGED], [PARTIAL], [PARTIAL, PRIVILEGED]])
def test_vec_normalize_of_chosen_entries(keys):
    env = VecNormalize(DummyVecEnv([_mixed_env]), norm_obs_keys=keys)
    model = _make(env, buffer_size=100).learn(40)
    assert model._n_updates > 0
    _evaluate(model, env)


def test_nested_dicts_are_refused():
    env = RandomEnv(spaces.Dict({PARTIAL: VECTOR, PRIVILEGED: spaces.Dict({"nested": VECTOR})}), ACTIONS)
    with pytest.raises(NotImplementedError, match=r'entry "privileged".*its space is Dict. Make each of its parts an entry'):
        GAC("MultiInputPolicy", env)
