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

from sb3_gac.algorithms import algorithm_class
from tests.helpers import Recall, TwoViewChoice
from tests.registry import LINES, load, load_all, make, on_policy, parameters, save_all

GRU = {"policy": "MultiInputGruPolicy", "batch_size": 4}
KINDS = {
    "discrete": (partial(TwoViewChoice, length=4), {}),
    "recurrent": (partial(Recall, continuous=True), GRU),
    "recurrent and discrete": (Recall, GRU),
}
WITH_MEMORY = [name for name, line in LINES.items() if "memory" not in line.lacks]
kinds = pytest.mark.parametrize(
    ("kind", "algorithm"),
    [
        *(("discrete", name) for name in LINES),
        *(("recurrent", name) for name in WITH_MEMORY),
        *(("recurrent and discrete", name) for name in ("gac", "asymmetric_mpo")),  # the one and the other way to do both
    ],
)


def _env(kind, n_envs=2, seed=0):
    return make_vec_env(KINDS[kind][0], n_envs, seed=seed)


def _model(kind, algorithm, env=None, **arguments):
    return make(algorithm, _env(kind) if env is None else env, **{**KINDS[kind][1], "seed": 0, **arguments})


@kinds
def test_learned_saved_loaded_and_learned_on_equal_seeds_give_equal_results(kind, algorithm, tmp_path):
    def learned_on(seed):
        model = _model(kind, algorithm, seed=seed).learn(20)
        save_all(model, tmp_path)
        loaded = load_all(algorithm, tmp_path, _env(kind, seed=1))
        assert th.equal(parameters(loaded), parameters(model))
        loaded.set_random_seed(seed)
        loaded.learn(20, reset_num_timesteps=False)
        assert loaded.num_timesteps == 40
        assert on_policy(algorithm) or loaded.replay_buffer.size() == 20
        assert loaded._n_updates > model._n_updates > 0
        return parameters(loaded)

    first = learned_on(0)
    assert th.equal(first, learned_on(0))
    if algorithm == "gac":
        assert not th.equal(first, learned_on(1))


@kinds
def test_training_goes_on_after_load_as_if_it_had_not_stopped(kind, algorithm, tmp_path):
    model = _model(kind, algorithm).learn(20)
    save_all(model, tmp_path)
    loaded = load_all(algorithm, tmp_path, _env(kind))
    model.set_env(_env(kind))
    for one in (model, loaded):
        one.set_random_seed(3)
        one.learn(20, reset_num_timesteps=False)
    assert th.equal(parameters(model), parameters(loaded))
    assert model._n_updates == loaded._n_updates > 0
    for name, coefficient in model.coefficients.items():
        assert th.equal(coefficient.value, loaded.coefficients[name].value), name


@kinds
def test_eval_callback_and_tensorboard(kind, algorithm, tmp_path):
    model = _model(kind, algorithm, tensorboard_log=str(tmp_path))
    callback = EvalCallback(
        _env(kind), eval_freq=10, n_eval_episodes=3, log_path=tmp_path, best_model_save_path=tmp_path, verbose=0, warn=False
    )
    model.learn(40, callback=callback, log_interval=1)
    evaluations = np.load(tmp_path / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [20, 40]
    assert (evaluations["ep_lengths"] == 4).all()
    assert evaluate_policy(load(algorithm, tmp_path / "best_model"), _env(kind), n_eval_episodes=3, warn=False)[0] <= 4
    events = EventAccumulator(str(tmp_path / f"{algorithm_class(algorithm).__name__}_1")).Reload()
    assert {"eval/mean_reward", "rollout/ep_rew_mean", "train/critic_loss"} <= set(events.Tags()["scalars"])
    assert all(np.isfinite(event.value) for tag in events.Tags()["scalars"] for event in events.Scalars(tag))


@kinds
def test_behind_vec_normalize(kind, algorithm, tmp_path):
    env = VecNormalize(_env(kind), norm_obs_keys=["partial"])
    model = _model(kind, algorithm, env).learn(20)
    assert model._n_updates > 0
    assert env.obs_rms["partial"].count > 20
    model.save(tmp_path / "model")
    env.save(tmp_path / "statistics")
    test_env = VecNormalize.load(tmp_path / "statistics", _env(kind, 3))
    test_env.training = test_env.norm_reward = False
    loaded = load(algorithm, tmp_path / "model", test_env)
    assert loaded.get_vec_normalize_env() is test_env
    assert loaded.learn(30)._n_updates > 0
    returns, _ = evaluate_policy(loaded, test_env, n_eval_episodes=6, return_episode_rewards=True, warn=False)
    assert len(returns) == 6


@kinds
def test_other_environments_take_the_place_of_the_first(kind, algorithm):
    at_once = {} if on_policy(algorithm) else {"train_freq": 1}
    model = _model(kind, algorithm, **at_once).learn(22)  # in the middle of an episode
    if not on_policy(algorithm):
        with pytest.raises(AssertionError, match="filled by 2 environments, but the model has 3"):
            model.set_env(_env(kind, 3))
    model.set_env(_env(kind, seed=5))
    assert model._last_obs is None
    before = model._n_updates
    assert model.learn(20, reset_num_timesteps=False)._n_updates > before
    if not on_policy(algorithm):
        assert model.replay_buffer.endings[10].tolist() == [4, 4], "the episodes under way were cut"


@kinds
def test_evaluate_policy_takes_any_number_of_environments(kind, algorithm):
    model = _model(kind, algorithm)
    for n_envs in (1, 3):
        returns, lengths = evaluate_policy(
            model, _env(kind, n_envs), n_eval_episodes=5, deterministic=False, return_episode_rewards=True, warn=False
        )
        assert len(returns) == 5
        assert lengths == [4] * 5
