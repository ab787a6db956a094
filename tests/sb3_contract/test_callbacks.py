"""SB3's contract: evaluation, checkpoints, early stops and progress bar."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from tests.registry import algorithms, load, make, on_policy
from tests.sb3_contract.helpers import identity, pendulum, vectorized


def _short_pendulum():
    return pendulum(max_episode_steps=10)


@algorithms()
def test_callbacks_of_every_kind(algorithm, tmp_path):
    model = make(algorithm, _short_pendulum())
    checkpoint = CheckpointCallback(save_freq=25, save_path=tmp_path)
    evaluation = EvalCallback(
        _short_pendulum(),
        callback_on_new_best=StopTrainingOnRewardThreshold(reward_threshold=1.0),
        callback_after_eval=StopTrainingOnNoModelImprovement(max_no_improvement_evals=100, min_evals=1),
        best_model_save_path=tmp_path,
        log_path=tmp_path,
        eval_freq=16,
        n_eval_episodes=2,
        warn=False,
    )
    on_event = CheckpointCallback(save_freq=1, save_path=tmp_path, name_prefix="event")
    event = EveryNTimesteps(n_steps=30, callback=on_event)
    max_episodes = StopTrainingOnMaxEpisodes(max_episodes=100)
    callback = CallbackList([checkpoint, evaluation, event, LogEveryNTimesteps(n_steps=32), max_episodes])
    model.learn(50, callback=callback)

    assert model.env.observation_space.contains({key: value[0] for key, value in callback.locals["new_obs"].items()})
    for child in (checkpoint, event, on_event):
        assert child.locals["new_obs"] is callback.locals["new_obs"]
    assert event.num_timesteps == event.n_calls == model.num_timesteps == 50
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [16, 32, 48]
    obs = model.get_env().reset()
    for name in ("rl_model_25_steps", "rl_model_50_steps", "event_30_steps", "best_model"):
        assert load(algorithm, tmp_path / name).predict(obs)[0].shape == (1, 1)

    model.learn(20, callback=[checkpoint, evaluation], progress_bar=True)
    model.learn(20, callback=lambda _locals, _globals: True)
    assert model.num_timesteps == 20


@algorithms()
def test_a_good_evaluation_stops_training(algorithm):
    """One that is not good enough does not: above."""
    stop = StopTrainingOnRewardThreshold(reward_threshold=-1e6)
    evaluation = EvalCallback(_short_pendulum(), callback_on_new_best=stop, eval_freq=13, n_eval_episodes=1, warn=False)
    assert make(algorithm, _short_pendulum()).learn(50, callback=evaluation).num_timesteps == 13


@algorithms()
def test_no_improvement_stops_training(algorithm):
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=1, min_evals=0)
    always_right = identity(-1, 1, eps=10)  # so that no evaluation is better than the first
    model = make(algorithm, identity(-1, 1))
    evaluation = EvalCallback(always_right, callback_after_eval=stop, eval_freq=10, n_eval_episodes=1, warn=False)
    model.learn(100, callback=evaluation)
    assert evaluation.last_mean_reward == 100
    assert model.num_timesteps == 30


@pytest.mark.parametrize("n_envs", [1, 2])
@algorithms()
def test_max_episodes_stop_training(algorithm, n_envs):
    model = make(algorithm, vectorized(_short_pendulum, n_envs))
    model.learn(500, callback=StopTrainingOnMaxEpisodes(max_episodes=2))
    assert model.num_timesteps == 2 * 10 * n_envs


class _Cancel(BaseCallback):
    def __init__(self, value):
        super().__init__()
        self.value = value

    def _on_step(self):
        return self.value


@algorithms()
def test_callbacks_cancel_runs(algorithm):
    model = make(algorithm, pendulum())
    for value in (False, np.bool_(0), th.tensor(0, dtype=th.bool)):
        callback = _Cancel(value)
        model.learn(10, callback=callback)
        assert callback.n_calls == 1


@algorithms()
def test_evaluation_on_several_environments(algorithm):
    several = vectorized(lambda: identity(-1, 1, eps=10), n_envs=3)
    evaluation = EvalCallback(several, eval_freq=10, n_eval_episodes=3, warn=False)
    make(algorithm, identity(-1, 1)).learn(10, callback=evaluation)
    assert evaluation.last_mean_reward == 100.0


@algorithms()
def test_evaluation_synchronizes_vec_normalize_and_refuses_other_environments(algorithm):
    train_env = VecNormalize(vectorized(_short_pendulum))
    eval_env = VecNormalize(vectorized(_short_pendulum), training=False, norm_reward=False)
    train_env.reset()
    original_obs = train_env.get_original_obs()
    model = make(algorithm, train_env)
    model.learn(20, callback=EvalCallback(eval_env, eval_freq=20, warn=False))
    normalized = eval_env.normalize_obs(original_obs)
    for key, value in train_env.normalize_obs(original_obs).items():
        np.testing.assert_allclose(value, normalized[key])
        assert not np.allclose(value, original_obs[key])
    with pytest.warns(UserWarning, match="not of the same type"), pytest.raises(AssertionError, match="VecEnvWrapper"):
        model.learn(20, callback=EvalCallback(_short_pendulum(), eval_freq=10, warn=False))


@algorithms()
def test_checkpoints_hold_replay_buffer_and_vec_normalize(algorithm, tmp_path):
    vec_env = DummyVecEnv([_short_pendulum])
    model = make(algorithm, VecNormalize(vec_env))
    callback = CheckpointCallback(save_freq=30, save_path=tmp_path, save_replay_buffer=True, save_vecnormalize=True)
    model.learn(30, callback=callback)
    env = VecNormalize.load(str(tmp_path / "rl_model_vecnormalize_30_steps.pkl"), vec_env)
    loaded = load(algorithm, tmp_path / "rl_model_30_steps.zip", env=env)
    if not on_policy(algorithm):
        loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_30_steps.pkl")
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.num_timesteps == 50
    if not on_policy(algorithm):
        assert loaded.replay_buffer.pos == 50  # with the step that the checkpoint was written after


@algorithms()
def test_children_know_their_evaluation(algorithm, tmp_path):
    parents = []

    class Child(BaseCallback):
        def _on_step(self):
            parents.append(self.parent.best_mean_reward)
            return True

    evaluation = EvalCallback(
        gym.wrappers.TimeLimit(_short_pendulum(), 5),
        best_model_save_path=tmp_path,
        eval_freq=10,
        callback_on_new_best=CallbackList([Child()]),
        callback_after_eval=CallbackList([Child()]),
        warn=False,
    )
    make(algorithm, pendulum()).learn(10, callback=evaluation)
    assert len(parents) == 2
    assert (tmp_path / "best_model.zip").exists()
