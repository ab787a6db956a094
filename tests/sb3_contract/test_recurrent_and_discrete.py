"""
SB3's contract for recurrent policies and for discrete actions.

Not here: HerReplayBuffer. It relabels goals, which bandits with a choice of actions do not have, and a recurrent policy, which
learns from sequences, refuses it as it does every buffer without them (tests/gac/test_recurrent.py).
"""

from functools import partial

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_gac import GAC, AsymmetricSAC
from tests.helpers import Recall, TwoViewChoice, small_model

GRU = {"policy": "MultiInputGruPolicy", "policy_kwargs": {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": []}}
KINDS = {
    "discrete": (partial(TwoViewChoice, length=4), {}),
    "recurrent": (partial(Recall, continuous=True), GRU),
    "recurrent and discrete": (Recall, GRU),
}
kinds = pytest.mark.parametrize("kind", KINDS)
algorithms = pytest.mark.parametrize("cls", [GAC, AsymmetricSAC])


def _env(kind, n_envs=2, seed=0):
    return make_vec_env(KINDS[kind][0], n_envs, seed=seed)


def _model(kind, cls=GAC, env=None, **arguments):
    return small_model(_env(kind) if env is None else env, cls=cls, **{**KINDS[kind][1], "batch_size": 4, **arguments})


def _parameters(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


@kinds
@algorithms
def test_learned_saved_loaded_and_learned_on_equal_seeds_give_equal_results(kind, cls, tmp_path):
    def learned_on(seed):
        model = _model(kind, cls, seed=seed).learn(40)
        model.save(tmp_path / "model")
        model.save_replay_buffer(tmp_path / "buffer")
        loaded = cls.load(tmp_path / "model", env=_env(kind, seed=1))
        loaded.load_replay_buffer(tmp_path / "buffer")
        assert th.equal(_parameters(loaded), _parameters(model))
        loaded.set_random_seed(seed)
        loaded.learn(40, reset_num_timesteps=False)
        assert (loaded.num_timesteps, loaded.replay_buffer.size()) == (80, 40)
        assert loaded._n_updates > model._n_updates > 0
        return _parameters(loaded)

    first = learned_on(0)
    assert th.equal(first, learned_on(0))
    assert not th.equal(first, learned_on(1))


@kinds
@algorithms
def test_training_goes_on_after_load_as_if_it_had_not_stopped(kind, cls, tmp_path):
    model = _model(kind, cls).learn(40)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = cls.load(tmp_path / "model", env=_env(kind))
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.set_logger(model.logger)
    for one in (model, loaded):
        one.set_random_seed(3)
        one.train(gradient_steps=3, batch_size=4)
    assert th.equal(_parameters(model), _parameters(loaded))
    for name in ("ent_coef_dual", "kl_coef_dual") if cls is GAC else ("ent_coef_dual",):
        assert th.equal(getattr(model, name).value, getattr(loaded, name).value)


@kinds
@algorithms
def test_eval_callback_and_tensorboard(kind, cls, tmp_path):
    model = _model(kind, cls, tensorboard_log=str(tmp_path))
    callback = EvalCallback(
        _env(kind), eval_freq=10, n_eval_episodes=3, log_path=tmp_path, best_model_save_path=tmp_path, verbose=0, warn=False
    )
    model.learn(40, callback=callback, log_interval=1)
    evaluations = np.load(tmp_path / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [20, 40]
    assert (evaluations["ep_lengths"] == 4).all()
    assert evaluate_policy(cls.load(tmp_path / "best_model"), _env(kind), n_eval_episodes=3, warn=False)[0] <= 4
    events = EventAccumulator(str(tmp_path / f"{cls.__name__}_1")).Reload()
    assert {"eval/mean_reward", "rollout/ep_rew_mean", "train/actor_loss", "train/ent_coef"} <= set(events.Tags()["scalars"])
    assert all(np.isfinite(event.value) for tag in events.Tags()["scalars"] for event in events.Scalars(tag))


@kinds
@algorithms
def test_behind_vec_normalize(kind, cls, tmp_path):
    env = VecNormalize(_env(kind), norm_obs_keys=["partial"])
    model = _model(kind, cls, env).learn(40)
    assert model._n_updates > 0
    assert env.obs_rms["partial"].count > 40
    model.save(tmp_path / "model")
    env.save(tmp_path / "statistics")
    test_env = VecNormalize.load(tmp_path / "statistics", _env(kind, 3))
    test_env.training = test_env.norm_reward = False
    loaded = cls.load(tmp_path / "model", env=test_env)
    assert loaded.get_vec_normalize_env() is test_env
    assert loaded.learn(30)._n_updates > 0
    returns, _ = evaluate_policy(loaded, test_env, n_eval_episodes=6, return_episode_rewards=True, warn=False)
    assert len(returns) == 6


@kinds
@algorithms
def test_other_environments_take_the_place_of_the_first(kind, cls):
    model = _model(kind, cls).learn(22)  # in the middle of an episode
    with pytest.raises(AssertionError, match="filled by 2 environments, but the model has 3"):
        model.set_env(_env(kind, 3))
    model.set_env(_env(kind, seed=5))
    assert model._last_obs is None
    before = model._n_updates
    assert model.learn(20, reset_num_timesteps=False)._n_updates > before
    assert model.replay_buffer.endings[10].tolist() == [4, 4], "the episodes under way were cut"


@kinds
@algorithms
@pytest.mark.parametrize("n_envs", [1, 3])
def test_evaluate_policy_takes_any_number_of_environments(kind, cls, n_envs):
    model = _model(kind, cls)
    returns, lengths = evaluate_policy(
        model, _env(kind, n_envs), n_eval_episodes=5, deterministic=False, return_episode_rewards=True, warn=False
    )
    assert len(returns) == 5
    assert lengths == [4] * 5
