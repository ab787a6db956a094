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

from sb3_gac import GAC
from tests.sb3_contract.helpers import identity, make_gac, pendulum, vectorized


def _short_pendulum():
    return pendulum(max_episode_steps=20)


def test_callbacks_of_every_kind(tmp_path):
    model = make_gac(_short_pendulum())
    checkpoint = CheckpointCallback(save_freq=50, save_path=tmp_path)
    evaluation = EvalCallback(
        _short_pendulum(),
        callback_on_new_best=StopTrainingOnRewardThreshold(reward_threshold=1.0),
        callback_after_eval=StopTrainingOnNoModelImprovement(max_no_improvement_evals=100, min_evals=1),
        best_model_save_path=tmp_path,
        log_path=tmp_path,
        eval_freq=32,
        warn=False,
    )
    on_event = CheckpointCallback(save_freq=1, save_path=tmp_path, name_prefix="event")
    event = EveryNTimesteps(n_steps=60, callback=on_event)
    max_episodes = StopTrainingOnMaxEpisodes(max_episodes=100)
    callback = CallbackList([checkpoint, evaluation, event, LogEveryNTimesteps(n_steps=64), max_episodes])
    model.learn(100, callback=callback)

    assert model.env.observation_space.contains({key: value[0] for key, value in callback.locals["new_obs"].items()})
    for child in (checkpoint, event, on_event):
        assert child.locals["new_obs"] is callback.locals["new_obs"]
    assert event.num_timesteps == event.n_calls == model.num_timesteps == 100
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [32, 64, 96]
    obs = model.get_env().reset()
    for name in ("rl_model_50_steps", "rl_model_100_steps", "event_60_steps", "best_model"):
        assert GAC.load(tmp_path / name).predict(obs)[0].shape == (1, 1)

    model.learn(40, callback=None)
    model.learn(40, callback=[checkpoint, evaluation], progress_bar=True)
    model.learn(40, callback=lambda _locals, _globals: True)
    assert model.num_timesteps == 40


@pytest.mark.parametrize(("threshold", "n_steps"), [(-1e6, 32), (1.0, 100)])
def test_a_good_evaluation_stops_training(threshold, n_steps):
    stop = StopTrainingOnRewardThreshold(reward_threshold=threshold)
    model = make_gac(_short_pendulum(), train_freq=1)
    model.learn(100, callback=EvalCallback(_short_pendulum(), callback_on_new_best=stop, eval_freq=32, warn=False))
    assert model.num_timesteps == n_steps


def test_no_improvement_stops_training():
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=1, min_evals=0)
    always_right = identity(-1, 1, eps=10)  # so that no evaluation is better than the first
    model = make_gac(identity(-1, 1), gradient_steps=0)
    evaluation = EvalCallback(always_right, callback_after_eval=stop, eval_freq=10, n_eval_episodes=1, warn=False)
    model.learn(100, callback=evaluation)
    assert evaluation.last_mean_reward == 100
    assert model.num_timesteps == 30


@pytest.mark.parametrize("n_envs", [1, 2])
def test_max_episodes_stop_training(n_envs):
    model = make_gac(vectorized(_short_pendulum, n_envs), train_freq=1)
    model.learn(500, callback=StopTrainingOnMaxEpisodes(max_episodes=2))
    assert model.num_timesteps == 2 * 20 * n_envs


class _Cancel(BaseCallback):
    def __init__(self, value):
        super().__init__()
        self.value = value

    def _on_step(self):
        return self.value


@pytest.mark.parametrize("value", [False, np.bool_(0), th.tensor(0, dtype=th.bool)])
def test_callbacks_cancel_runs(value):
    callback = _Cancel(value)
    make_gac(learning_starts=1, buffer_size=1, batch_size=1).learn(10, callback=callback)
    assert callback.n_calls == 1


def test_evaluation_on_several_environments():
    evaluation = EvalCallback(vectorized(lambda: identity(-1, 1, eps=10), n_envs=3), eval_freq=30, warn=False)
    make_gac(identity(-1, 1)).learn(60, callback=evaluation)
    assert evaluation.last_mean_reward == 100.0


def test_evaluation_synchronizes_vec_normalize_and_refuses_other_environments():
    train_env = VecNormalize(vectorized(_short_pendulum))
    eval_env = VecNormalize(vectorized(_short_pendulum), training=False, norm_reward=False)
    train_env.reset()
    original_obs = train_env.get_original_obs()
    model = make_gac(train_env)
    model.learn(50, callback=EvalCallback(eval_env, eval_freq=50, warn=False))
    normalized = eval_env.normalize_obs(original_obs)
    for key, value in train_env.normalize_obs(original_obs).items():
        np.testing.assert_allclose(value, normalized[key])
        assert not np.allclose(value, original_obs[key])
    with pytest.warns(UserWarning, match="not of the same type"), pytest.raises(AssertionError, match="VecEnvWrapper"):
        model.learn(50, callback=EvalCallback(_short_pendulum(), eval_freq=20, warn=False))


def test_checkpoints_hold_replay_buffer_and_vec_normalize(tmp_path):
    vec_env = DummyVecEnv([_short_pendulum])
    model = make_gac(VecNormalize(vec_env))
    callback = CheckpointCallback(save_freq=40, save_path=tmp_path, save_replay_buffer=True, save_vecnormalize=True)
    model.learn(40, callback=callback)
    env = VecNormalize.load(str(tmp_path / "rl_model_vecnormalize_40_steps.pkl"), vec_env)
    loaded = GAC.load(tmp_path / "rl_model_40_steps.zip", env=env)
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_40_steps.pkl")
    loaded.learn(40, reset_num_timesteps=False)
    assert loaded.num_timesteps == 80
    assert loaded.replay_buffer.pos == 80  # with the step that the checkpoint was written after


def test_children_know_their_evaluation(tmp_path):
    parents = []

    class Child(BaseCallback):
        def _on_step(self):
            parents.append(self.parent.best_mean_reward)
            return True

    evaluation = EvalCallback(
        gym.wrappers.TimeLimit(_short_pendulum(), 10),
        best_model_save_path=tmp_path,
        eval_freq=32,
        callback_on_new_best=CallbackList([Child()]),
        callback_after_eval=CallbackList([Child()]),
        warn=False,
    )
    make_gac().learn(32, callback=evaluation)
    assert len(parents) == 2
    assert (tmp_path / "best_model.zip").exists()
