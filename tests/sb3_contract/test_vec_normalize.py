"""SB3's contract: VecNormalize, whose statistics normalise what the replay buffer holds raw."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import VecNormalize, sync_envs_normalization

from tests.registry import algorithms, load, make
from tests.sb3_contract.helpers import pendulum, vectorized


def _normalized(**kwargs):
    return VecNormalize(vectorized(pendulum), clip_obs=10.0, clip_reward=10.0, **kwargs)


@algorithms()
def test_vec_normalize_is_found_in_every_new_environment(algorithm, tmp_path):
    env, eval_env = _normalized(), _normalized(training=False, norm_reward=False)
    model = make(algorithm, env)
    assert model.get_vec_normalize_env() is env
    model.set_env(eval_env)
    assert model.get_vec_normalize_env() is eval_env
    model.learn(10)
    assert eval_env.obs_rms["partial"].count == pytest.approx(1e-4)
    model.set_env(env)
    model.learn(20)
    assert env.obs_rms["partial"].count > 20
    model.save(tmp_path / "model")
    assert load(algorithm, tmp_path / "model", env).get_vec_normalize_env() is env
    model.set_env(vectorized(pendulum))
    assert model.get_vec_normalize_env() is None


@algorithms("replay")
def test_buffer_is_raw_and_batches_are_normalized(algorithm):
    env = _normalized()
    model = make(algorithm, env, learning_starts=60).learn(50)
    partial = model.replay_buffer.observations["partial"][:50, 0]
    np.testing.assert_allclose(np.linalg.norm(partial, axis=1), 1, rtol=1e-5)  # cosine and sine
    model.set_random_seed(0)
    batch = model._sample_batch(50)
    model.set_random_seed(0)
    raw = model.replay_buffer.sample(50)
    for normalized, observations in ((batch.observations, raw.observations), (batch.next_observations, raw.next_observations)):
        expected = env.normalize_obs({key: value.numpy() for key, value in observations.items()})
        for key, value in normalized.items():
            np.testing.assert_allclose(value, expected[key], rtol=1e-5)
            assert not np.allclose(value, observations[key])
    np.testing.assert_allclose(batch.rewards, env.normalize_reward(raw.rewards.numpy().flatten()), rtol=1e-5)


@algorithms()
def test_evaluation_environments_are_synchronized_and_predict_on_their_observations(algorithm):
    env, eval_env = _normalized(), _normalized(training=False, norm_reward=False)
    model = make(algorithm, env).learn(20)
    sync_envs_normalization(env, eval_env)
    obs = eval_env.reset()
    raw = eval_env.get_original_obs()
    action, _ = model.predict(obs, deterministic=True)
    np.testing.assert_array_equal(action, model.predict(env.normalize_obs(raw), deterministic=True)[0])
    assert not np.array_equal(action, model.predict(raw, deterministic=True)[0])
    assert all(th.isfinite(coefficient.value).all() for coefficient in model.coefficients.values())
