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

from sb3_gac.algorithms import algorithm_class
from sb3_gac.envs import PARTIAL, PRIVILEGED
from tests.registry import algorithms, deployed_role, make
from tests.sb3_contract.helpers import ACTIONS, RandomEnv, Renamed

VECTOR = spaces.Box(-1, 1, (2,), np.float32)


def _mixed_env(channel_last=False):
    image = spaces.Box(0, 255, (36, 36, 1) if channel_last else (1, 36, 36), np.uint8)
    return RandomEnv(spaces.Dict({PARTIAL: image, PRIVILEGED: VECTOR, "phase": spaces.Discrete(4)}), ACTIONS)


def _make(algorithm, env, **kwargs):
    options = {"batch_size": 4, "gamma": 0.5, "seed": 1, **kwargs}
    return make(algorithm, env, policy_kwargs={"features_extractor_kwargs": {"cnn_output_dim": 8}}, **options)


def _evaluate(model, env):
    lengths = evaluate_policy(model, env, n_eval_episodes=2, warn=False, return_episode_rewards=True)[1]
    assert len(lengths) == 2


@pytest.mark.parametrize("channel_last", [False, True])
def test_the_environment_of_mixed_entries_is_valid(channel_last):
    check_env(_mixed_env(channel_last), skip_render_check=True)


def _check_mixed_entries(algorithm, learner, channel_last):
    env = _mixed_env(channel_last)
    model = _make(algorithm, env, role_keys={deployed_role(algorithm): learner}).learn(20)
    assert model._n_updates > 0
    _evaluate(model, env)
    obs, _ = env.reset()
    action, _ = model.predict({key: obs[key] for key in learner}, deterministic=True)
    np.testing.assert_array_equal(action, model.predict(obs, deterministic=True)[0])
    with pytest.raises(ValueError, match="lacks"):
        model.predict({key: obs[key] for key in learner[1:]})


@algorithms()
def test_mixed_entries(algorithm):
    _check_mixed_entries(algorithm, [PARTIAL, "phase"], channel_last=True)


@pytest.mark.parametrize(
    ("learner", "channel_last"), [([PARTIAL], False), (["phase"], True), ([PRIVILEGED, "phase", PARTIAL], False)]
)
def test_other_mixed_entries(learner, channel_last):
    _check_mixed_entries("gac", learner, channel_last)


@algorithms()
def test_names_and_roles_of_entries_do_not_matter(algorithm):
    """The same entries under other names give the same training to the bit."""
    actions = []
    for names in ({}, {PARTIAL: "seen", PRIVILEGED: "unseen"}):
        env = RandomEnv(spaces.Dict({PARTIAL: VECTOR, PRIVILEGED: VECTOR}), ACTIONS)
        env.observation_space.seed(10)
        role_keys = {deployed_role(algorithm): [names.get(PARTIAL, PARTIAL)]}
        model = make(algorithm, Renamed(env, names), seed=1, role_keys=role_keys).learn(20)
        actions.append(model.predict(np.array([0.1, -0.2], np.float32), deterministic=True)[0])
    np.testing.assert_array_equal(*actions)


@algorithms("one entry")
def test_one_entry_is_enough(algorithm):
    env = RandomEnv(spaces.Dict({PARTIAL: VECTOR}), ACTIONS)
    model = make(algorithm, env).learn(20)
    assert model._n_updates > 0
    _evaluate(model, env)


@pytest.fixture(scope="module")
def other_processes():
    """Two environments in processes of their own."""
    env = make_vec_env(_mixed_env, n_envs=2, vec_env_cls=SubprocVecEnv)
    yield env
    env.close()


@algorithms()
def test_environments_in_other_processes(algorithm, other_processes):
    assert _make(algorithm, other_processes).learn(40)._n_updates > 0


def _multi_obs_env(channel_last):
    env = SimpleMultiObsEnv(random_start=True, discrete_actions=False, channel_last=channel_last)
    return gym.wrappers.TimeLimit(Renamed(env, {"img": PARTIAL, "vec": PRIVILEGED}), 20)


def _check_frame_stack(algorithm, channel_last):
    channels_order = {PRIVILEGED: None, PARTIAL: "last" if channel_last else "first"}
    env = VecFrameStack(DummyVecEnv([partial(_multi_obs_env, channel_last)]), n_stack=3, channels_order=channels_order)
    model = _make(algorithm, env).learn(20)
    assert model.observation_space[PARTIAL].shape == (3, 64, 64)
    assert model.observation_space[PRIVILEGED].shape == (15,)
    assert model._n_updates > 0


@algorithms()
def test_frame_stack(algorithm):
    _check_frame_stack(algorithm, channel_last=True)


def test_frame_stack_of_channel_first_images():
    _check_frame_stack("gac", channel_last=False)


def _check_vec_normalize(algorithm, keys):
    env = VecNormalize(DummyVecEnv([_mixed_env]), norm_obs_keys=keys)
    model = _make(algorithm, env).learn(20)
    assert model._n_updates > 0
    _evaluate(model, env)


@algorithms()
def test_vec_normalize_of_chosen_entries(algorithm):
    _check_vec_normalize(algorithm, [PRIVILEGED])


@pytest.mark.parametrize("keys", [[PARTIAL], [PARTIAL, PRIVILEGED]])
def test_vec_normalize_of_other_entries(keys):
    _check_vec_normalize("gac", keys)


@algorithms()
def test_nested_dicts_are_refused(algorithm):
    env = RandomEnv(spaces.Dict({PARTIAL: VECTOR, PRIVILEGED: spaces.Dict({"nested": VECTOR})}), ACTIONS)
    with pytest.raises(NotImplementedError, match=r'entry "privileged".*its space is Dict. Make each of its parts an entry'):
        algorithm_class(algorithm)("MultiInputPolicy", env)
