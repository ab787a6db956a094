"""SB3's contract: goal environments with HerReplayBuffer, where the learner reads entries of its own choice."""

import numpy as np
import pytest
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise

from sb3_gac import GAC
from tests.sb3_contract.helpers import make_gac, sample_observations

LEARNER = ["observation", "desired_goal"]


def _env(**kwargs):
    return BitFlippingEnv(n_bits=4, continuous=True, **kwargs)


def _make(env, her_kwargs=None, **kwargs):
    options = {"n_sampled_goal": 2, "goal_selection_strategy": "future", **(her_kwargs or {})}
    her = {"replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": options, "role_keys": {"learner": LEARNER}}
    return make_gac(env, train_freq=4, **her, **kwargs)


@pytest.mark.parametrize("image", [False, True])
def test_goal_environments(image):
    policy_kwargs = {"features_extractor_kwargs": {"cnn_output_dim": 8}} if image else {}
    model = _make(make_vec_env(lambda: _env(image_obs_space=image)), policy_kwargs=policy_kwargs).learn(60)
    assert model._n_updates > 0
    env = Monitor(_env(image_obs_space=image))
    evaluate_policy(model, env, n_eval_episodes=2)
    obs, _ = env.reset()
    action, _ = model.predict({key: obs[key] for key in LEARNER}, deterministic=True)
    np.testing.assert_array_equal(action, model.predict(obs, deterministic=True)[0])


@pytest.mark.parametrize("strategy", ["final", "episode", "future"])
def test_goal_selection_with_several_environments_and_noise(strategy):
    noise = NormalActionNoise(np.zeros(4), 0.1 * np.ones(4))
    env = make_vec_env(_env, n_envs=2)
    model = _make(env, {"goal_selection_strategy": strategy}, gradient_steps=2, action_noise=noise).learn(60)
    assert isinstance(model.action_noise, VectorizedActionNoise)
    assert model._n_updates > 0


def test_model_and_buffer_are_saved_and_loaded(tmp_path):
    env = make_vec_env(_env, n_envs=2)
    model = _make(env, seed=0).learn(60)
    observations = sample_observations(env, 5)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = GAC.load(tmp_path / "model", env=env, custom_objects={"learning_rate": 2e-5}, verbose=2)
    assert (loaded.verbose, loaded.learning_rate) == (2, 2e-5)
    np.testing.assert_array_equal(*(one.predict(observations, deterministic=True)[0] for one in (model, loaded)))
    loaded.load_replay_buffer(tmp_path / "buffer.pkl", truncate_last_traj=False)
    for key, value in model.replay_buffer.observations.items():
        np.testing.assert_array_equal(value, loaded.replay_buffer.observations[key])
    assert loaded.learn(60, reset_num_timesteps=False)._n_updates > model._n_updates


def test_full_buffer():
    model = _make(make_vec_env(_env, n_envs=2), buffer_size=40, learning_starts=8).learn(100)
    assert model.replay_buffer.full


def test_buffer_needs_an_environment(tmp_path):
    _make(make_vec_env(_env)).save(tmp_path / "model")
    with pytest.raises(AssertionError, match="HerReplayBuffer"):
        GAC.load(tmp_path / "model")
