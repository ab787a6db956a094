"""Evaluation of guider and learner: same seeds, what is logged and saved, and the three warnings."""

import json
import os
import re
import warnings
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import ConvertCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import (
    GAC,
    AsymmetricSAC,
    ExactCheckpointCallback,
    GPOPenalty,
    GuiderLearnerEvalCallback,
    SeededEvalCallback,
)
from tests.helpers import Sampled

EPISODE_LENGTH = 5


class Paid(gym.Env):
    """The reward is the action plus a bonus drawn at reset, which only the privileged entry shows."""

    observation_space = spaces.Dict(
        partial=spaces.Box(-np.inf, np.inf, (2,), np.float32), privileged=spaces.Box(-np.inf, np.inf, (1,), np.float32)
    )
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, spread=1.0):
        self.spread = spread
        self.starts = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.bonus = 0, self.spread * self.np_random.uniform(-1, 1)
        observation = self._observe()
        self.starts.append(np.concatenate([*observation.values()]).tolist())
        return observation, {}

    def step(self, action):
        self.steps += 1
        return self._observe(), float(action[0]) + self.bonus, False, self.steps == EPISODE_LENGTH, {}

    def checkpoint_state(self):
        return {"steps": self.steps, "bonus": self.bonus}

    def restore_checkpoint_state(self, state):
        self.steps, self.bonus = state["steps"], state["bonus"]

    def _observe(self):
        partial = self.np_random.normal(3.0, 2.0, 2).astype(np.float32)
        return {"partial": partial, "privileged": np.float32([self.bonus])}


class RecurrentCore(KVWriter):
    """A log in a list."""

    def __init__(self):
        self.rows = []

    def write(self, key_values, key_excluded, step=0):
        self.rows.append({**key_values, "step": step})


def _vec_env(n_envs=1):
    return DummyVecEnv([lambda: Monitor(Paid()) for _ in range(n_envs)])


def _model(env, **kwargs):
    arguments = {"learning_starts": 1, "batch_size": 8, "buffer_size": 200, "seed": 0, "device": "cpu"} | kwargs
    return GAC("MultiInputPolicy", env, guider="independent", policy_kwargs={"net_arch": [8]}, **arguments)


def _callback(eval_env, **kwargs):
    return GuiderLearnerEvalCallback(
        eval_env, **{"eval_freq": 10, "n_eval_episodes": 4, "patience": 100, "verbose": 0} | kwargs
    )


def _mean_return(predict, env, seed=10_000):
    env.seed(seed)
    return evaluate_policy(type("Policy", (), {"predict": staticmethod(predict)}), env, n_eval_episodes=4)[0]


# --- evaluation ------------------------------------------------------------------------------------------------------


def test_logs_both_returns_at_every_evaluation():
    model, memory = _model(_vec_env()), RecurrentCore()
    model.set_logger(Logger(None, [memory]))
    model.learn(30, callback=_callback(_vec_env()), log_interval=1)
    evaluations = [row for row in memory.rows if "eval/mean_reward" in row]
    assert [row["step"] for row in evaluations] == [10, 20, 30]
    assert all(np.isfinite(row["eval/guider_mean_reward"]) for row in evaluations)
    assert len([row for row in memory.rows if "eval/guider_mean_reward" in row]) == 3


@pytest.mark.parametrize("n_envs", [1, 2])
def test_returns_are_those_of_the_two_policies_from_the_same_seeds(n_envs):
    model = _model(_vec_env(), learning_starts=100)  # does not learn
    callback = _callback(_vec_env(n_envs), eval_seed=77)
    model.learn(20, callback=callback)
    guider = _mean_return(model.predict_guider, _vec_env(n_envs), seed=77)
    learner = _mean_return(model.predict, _vec_env(n_envs), seed=77)
    assert guider != pytest.approx(learner)
    assert [row["timesteps"] for row in callback.history] == [10, 20]
    for row in callback.history:
        assert row["guider"] == pytest.approx(guider)
        assert row["learner"] == pytest.approx(learner)
    assert callback.last_mean_reward == pytest.approx(learner)


def test_statistics_reach_evaluations_that_show_images_with_their_channels_last():
    """The model turns images around outside of its VecNormalize."""
    space = spaces.Dict(partial=spaces.Box(0, 255, (36, 36, 3), np.uint8), privileged=spaces.Box(5, 9, (2,), np.float32))

    def make(**options):
        env = DummyVecEnv([lambda: Monitor(Sampled(deepcopy(space)))])
        return VecNormalize(env, norm_obs_keys=["privileged"], norm_reward=False, **options)

    eval_env = make(training=False)
    model = _model(make(), learning_starts=100)
    model.learn(12, callback=_callback(eval_env))
    assert (eval_env.obs_rms["privileged"].mean > 5).all(), "as in training after ten steps, and not 0"


@pytest.mark.parametrize("n_envs", [1, 2])
def test_both_policies_start_from_the_same_observations_at_every_evaluation(n_envs):
    eval_env = _vec_env(n_envs)
    _model(_vec_env()).learn(30, callback=_callback(eval_env))
    starts = [env.unwrapped.starts for env in eval_env.envs]
    n_resets = 1 + 4 // n_envs  # one more than there are episodes
    for of_env in starts:
        chunks = [of_env[i : i + n_resets] for i in range(0, len(of_env), n_resets)]
        assert len(chunks) == 3 * 2
        assert all(chunk == chunks[0] for chunk in chunks)
        assert len({tuple(start) for start in chunks[0]}) == n_resets
    assert starts[0] != starts[-1] or n_envs == 1


def test_sampled_actions_are_the_same_at_every_evaluation_and_training_does_not_see_them():
    def trained(**options):
        model = _model(_vec_env(), learning_rate=0.0, kl_coef=1.0, ent_coef=0.1)
        callback = _callback(_vec_env(), **options)
        return model.learn(30, callback=callback if options else None), callback.history

    model, sampled = trained(deterministic=False)
    _, likeliest = trained(deterministic=True)
    for name in ("learner", "guider"):
        assert len({row[name] for row in sampled}) == 1
        assert sampled[0][name] != pytest.approx(likeliest[0][name])
    alone, _ = trained()
    np.testing.assert_array_equal(model.replay_buffer.actions, alone.replay_buffer.actions)


def test_a_model_without_a_guider_is_named():
    model = AsymmetricSAC("MultiInputPolicy", Paid(), buffer_size=100, policy_kwargs={"net_arch": [4]}, device="cpu")
    with pytest.raises(TypeError, match="a guider, which AsymmetricSAC does not have: use SeededEvalCallback"):
        model.learn(10, callback=GuiderLearnerEvalCallback(Paid(), eval_freq=5))
    callback = SeededEvalCallback(Monitor(Paid()), eval_freq=5, n_eval_episodes=1, verbose=0)
    model.learn(10, callback=callback)
    assert [row["timesteps"] for row in callback.history] == [5, 10]


def test_works_under_vec_normalize():
    env = VecNormalize(_vec_env())
    eval_env = VecNormalize(_vec_env(), training=False, norm_reward=False)
    model = _model(env, learning_starts=100)
    callback = _callback(eval_env)
    model.learn(20, callback=callback)
    for key, statistics in env.obs_rms.items():
        assert np.array_equal(statistics.mean, eval_env.obs_rms[key].mean)
        assert statistics.count == pytest.approx(21, abs=0.1)  # evaluation does not count
    assert env.obs_rms["partial"].mean == pytest.approx(3, abs=1.5)
    assert callback.history[-1]["guider"] == pytest.approx(_mean_return(model.predict_guider, eval_env))
    assert callback.history[-1]["learner"] == pytest.approx(_mean_return(model.predict, eval_env))


def test_a_single_environment_will_do():
    callback = _callback(Monitor(Paid()), n_eval_episodes=1)
    _model(_vec_env()).learn(10, callback=callback)
    assert len(callback.history) == 1


def test_evaluation_does_not_change_training():
    with_callback, without = (_model(_vec_env()).learn(20, callback=callback) for callback in (_callback(_vec_env()), None))
    for first, second in zip(with_callback.policy.parameters(), without.policy.parameters(), strict=True):
        assert th.equal(first, second)


# --- files -----------------------------------------------------------------------------------------------------------


def test_saves_both_evaluations_and_the_best_model(tmp_path):
    logs, best = tmp_path / "some" / "logs", tmp_path / "best"
    model = _model(_vec_env(), learning_starts=12)
    callback = _callback(_vec_env(), log_path=str(logs), best_model_save_path=str(best))
    model.learn(30, callback=callback)
    saved = np.load(logs / "guider_evaluations.npz")
    of_sb3 = np.load(logs / "evaluations.npz")
    assert saved["timesteps"].tolist() == of_sb3["timesteps"].tolist() == [10, 20, 30]
    assert saved["learner"] == pytest.approx(of_sb3["results"].mean(axis=1))
    assert of_sb3["results"].shape == (3, 4)
    assert np.isfinite(saved["guider"]).all()
    for name in ("kl", "target_kl", "kl_coef", "kl_coef_on_bound", "learner_mean_abs"):
        assert np.isnan(saved[name]).tolist() == [True, False, False]  # no gradient step before the first evaluation
    assert saved["target_kl"][1:] == pytest.approx(0.0033)
    assert callback.best_mean_reward == saved["learner"].max()
    observation, _ = Paid().reset(seed=0)
    assert Paid.action_space.contains(GAC.load(best / "best_model").predict({"partial": observation["partial"]})[0])


def test_writes_nothing_without_a_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _model(_vec_env()).learn(10, callback=_callback(_vec_env()))
    assert os.listdir(tmp_path) == []


def test_stops_training_when_a_child_callback_says_so():
    model = _model(_vec_env())
    callback = _callback(_vec_env(), callback_on_new_best=StopTrainingOnRewardThreshold(-1000.0))
    model.learn(30, callback=callback)
    assert model.num_timesteps == 10
    assert len(callback.history) == 1


# --- warnings --------------------------------------------------------------------------------------------------------


class Scripted:
    """A model whose two policies, and what its gradient steps log, are set by hand."""

    def __init__(self):
        self.logger = Logger(None, [])
        self.num_timesteps = 0
        self.actions = {}
        self._env = DummyVecEnv([Paid])

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.full((1, 1), self.actions["learner"]), state

    def predict_guider(self, observation, state=None, episode_start=None, deterministic=False):
        return np.full((1, 1), self.actions["guider"]), state

    def get_env(self):
        return self._env

    def get_vec_normalize_env(self):
        return None


HEALTHY = {"guider": 1.0, "learner": 0.9, "kl": 0.01, "target_kl": 0.01, "kl_coef": 1.0, "kl_coef_on_bound": 0.0}
UNHEALTHY = {
    "kl": ({"kl": 0.021}, "does not keep up"),
    "kl, target 0": ({"target_kl": 0.0}, "does not keep up"),
    "bound": ({"kl_coef_on_bound": 1.0, "kl_coef": 100.0}, r"kl_coef sits on a bound \(1e\+02\)"),
    "gap": ({"learner": 0.7}, "the guider returns 5 and the learner 3.5"),
    "gap, negative returns": ({"guider": -1.0, "learner": -1.5}, "the guider returns -5 and the learner -7.5"),
}


def _evaluator(spread=0.0, **kwargs):
    """A function that evaluates once, with ``HEALTHY`` changed as it is told, and returns the warnings."""
    model = Scripted()
    callback = _callback(DummyVecEnv([lambda: Paid(spread)]), eval_freq=1, warn=False, **kwargs)
    callback.init_callback(model)

    def evaluate(**changed):
        state = HEALTHY | changed
        model.actions = {name: state.pop(name) for name in ("guider", "learner")}
        for name, value in state.items():
            model.logger.record(f"train/{name}", value)
        callback.on_rollout_start()
        model.logger.dump()  # as at the end of an episode: forgets what was logged
        model.num_timesteps += 1
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert callback.on_step()
        return [str(warning.message) for warning in caught]

    return evaluate


@pytest.mark.parametrize("patience", [1, 3])
@pytest.mark.parametrize(("sick", "message"), UNHEALTHY.values(), ids=UNHEALTHY.keys())
def test_warns_once_after_patience_evaluations_in_a_row(sick, message, patience):
    evaluate = _evaluator(patience=patience)
    for _ in range(2):  # a second time after it has been healthy again
        assert [evaluate(**sick) for _ in range(patience - 1)] == [[]] * (patience - 1)
        (warning,) = evaluate(**sick)
        assert re.match(rf"After \d+ steps, .*{message}", warning)
        assert evaluate(**sick) == []
        assert evaluate() == []


@pytest.mark.parametrize(("sick", "message"), UNHEALTHY.values(), ids=UNHEALTHY.keys())
def test_a_healthy_evaluation_in_between_starts_the_count_again(sick, message):
    evaluate = _evaluator(patience=2)
    assert [evaluate(**sick), evaluate(), evaluate(**sick), evaluate()] == [[]] * 4


@pytest.mark.parametrize(
    "healthy",
    [
        {},
        {"kl": 0.02},  # twice the target, no more
        {"kl_coef_on_bound": 0.5},
        {"learner": 0.85},  # a gap of 0.15 within the tolerance of 0.2
        {"learner": 2.0},  # better than the guider
        {"guider": -1.0, "learner": -1.1},
    ],
)
def test_says_nothing_while_all_is_well(healthy):
    evaluate = _evaluator(patience=1)
    assert [evaluate(**healthy) for _ in range(2)] == [[], []]


def test_gap_must_exceed_tolerance_and_two_standard_errors():
    assert len(_evaluator(patience=1, gap_tolerance=0.2)(learner=0.7)) == 1
    assert _evaluator(patience=1, gap_tolerance=0.4)(learner=0.7) == []
    assert _evaluator(patience=1, spread=2.0)(learner=0.7) == []


def test_says_nothing_before_there_were_gradient_steps():
    callback = _callback(_vec_env(), eval_freq=2, patience=1, gap_tolerance=1e6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "learn makes no gradient step")
        _model(_vec_env(), learning_starts=100).learn(6, callback=callback)
    assert len(callback.history) == 3
    assert "kl" not in callback.history[-1]


@pytest.mark.parametrize("deterministic", [True, False])
def test_both_policies_act_as_they_are_asked_to(deterministic):
    asked = []

    class Noting(Scripted):
        def predict(self, *args, deterministic=False, **kwargs):
            asked.append(("learner", deterministic))
            return super().predict(*args, **kwargs)

        def predict_guider(self, *args, deterministic=False, **kwargs):
            asked.append(("guider", deterministic))
            return super().predict_guider(*args, **kwargs)

    model = Noting()
    model.actions = {"guider": 0.0, "learner": 0.0}
    callback = _callback(_vec_env(), eval_freq=1, deterministic=deterministic)
    callback.init_callback(model)
    assert callback.on_step()
    assert set(asked) == {("learner", deterministic), ("guider", deterministic)}


@pytest.mark.parametrize("whose", ["guider", "learner"])
def test_the_spread_of_either_policys_returns_may_explain_a_gap(whose):
    steady = {"guider": np.full(4, 5.0), "learner": np.full(4, 3.0)}
    callback = _callback(_vec_env(), patience=1)
    callback.model, callback.num_timesteps = _model(_vec_env()), 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        callback._warn_if_not_following(*(steady | {whose: steady[whose] + np.array([-8, 8, -8, 8])}).values())
    with pytest.warns(UserWarning, match="the guider returns 5 and the learner 3"):
        callback._warn_if_not_following(*steady.values())


def test_a_weight_that_holds_nobody_any_more_is_told_of_gpo_in_its_own_words():
    small = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 8, "batch_size": 8, "device": "cpu", "seed": 0}
    model = GPOPenalty("MultiInputPolicy", _vec_env(), target_kl=1e-9, largest_kl_coef=0.01, **small)
    callback = _callback(_vec_env(), eval_freq=8, patience=2, gap_tolerance=1e6)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(200, callback=callback)
    said = [str(warning.message) for warning in caught if "kl" in str(warning.message)]
    assert any("the learner does not keep up. Raise largest_kl_coef." in message for message in said)
    assert any("kl_coef sits on a bound (0.01), and KL" in message and "Raise largest_kl_coef." in message for message in said)
    assert not any("max_kl" in message or "kl_coef_bounds" in message for message in said)


# --- a training that goes on -----------------------------------------------------------------------------------------


def _files(folder):
    return {path.name: dict(np.load(path)) for path in folder.glob("*.npz")}


def _interrupted(folder):
    """A training of 40 steps whose process ended after 30, with a checkpoint after 24; evaluations are in the folder."""
    evaluation, checkpoint = _callback(_vec_env(), log_path=str(folder)), ExactCheckpointCallback(folder, every=24)
    stop = ConvertCallback(lambda scope, _: scope["self"].num_timesteps < 30)
    _model(_vec_env()).learn(40, callback=[evaluation, checkpoint, stop])
    return GAC.resume(folder, _vec_env(), device="cpu")


def test_a_resumed_training_goes_on_with_the_files_of_evaluations(tmp_path):
    whole = _callback(_vec_env(), log_path=str(tmp_path / "whole"))
    _model(_vec_env()).learn(40, callback=whole)
    resumed, rest = _interrupted(tmp_path / "parts"), _callback(_vec_env(), log_path=str(tmp_path / "parts"))
    assert _files(tmp_path / "parts")["evaluations.npz"]["timesteps"].tolist() == [10, 20, 30]  # 30 is after the checkpoint
    resumed.learn(resumed.steps_left, reset_num_timesteps=False, callback=rest)
    assert [row["timesteps"] for row in rest.history] == [10, 20, 30, 40]
    assert rest.best_mean_reward == whole.best_mean_reward
    expected, found = _files(tmp_path / "whole"), _files(tmp_path / "parts")
    assert set(found) == set(expected) == {"evaluations.npz", "guider_evaluations.npz"}
    for name in ("timesteps", "results", "ep_lengths"):
        np.testing.assert_array_equal(found["evaluations.npz"][name], expected["evaluations.npz"][name])
    for name in ("timesteps", "guider", "learner"):
        np.testing.assert_array_equal(found["guider_evaluations.npz"][name], expected["guider_evaluations.npz"][name])


def test_a_worse_model_does_not_replace_the_best_one_after_a_resume(tmp_path):
    folders = {"log_path": str(tmp_path), "best_model_save_path": str(tmp_path)}
    resumed = _interrupted(tmp_path)
    rows = dict(np.load(tmp_path / "evaluations.npz"))
    rows["results"][0] = 1e6
    np.savez(tmp_path / "evaluations.npz", **rows)
    callback = SeededEvalCallback(_vec_env(), eval_freq=10, n_eval_episodes=4, verbose=0, **folders)
    resumed.learn(resumed.steps_left, reset_num_timesteps=False, callback=callback)
    assert callback.best_mean_reward == 1e6
    assert not (tmp_path / "best_model.zip").exists()


def test_evaluations_in_a_row_are_counted_on_after_a_resume():
    before, after = (GuiderLearnerEvalCallback(_vec_env(), patience=3) for _ in range(2))
    before._in_a_row["gap"], before._watched["train/kl"] = 2, 0.5
    before._since_evaluation["train/kl"] = [0.25, np.float64(0.75)]
    after.restore_checkpoint_state(json.loads(json.dumps(before.checkpoint_state())))
    assert (after._in_a_row, after._watched) == ({"kl": 0, "bound": 0, "gap": 2}, {"train/kl": 0.5})
    assert after._since_evaluation == {"train/kl": [0.25, 0.75]}
    after.restore_checkpoint_state({"history": [{"timesteps": 5, "learner": 1.0}]})  # of an earlier version
    assert after.history == [{"timesteps": 5, "learner": 1.0}]


def test_a_new_training_starts_its_files_anew(tmp_path):
    for _ in range(2):
        callback = _callback(_vec_env(), log_path=str(tmp_path))
        _model(_vec_env()).learn(20, callback=callback)
        assert [row["timesteps"] for row in callback.history] == [10, 20]
    assert {tuple(file["timesteps"]) for file in _files(tmp_path).values()} == {(10, 20)}


def test_a_callback_that_goes_on_itself_reads_no_file(tmp_path):
    model, callback = _model(_vec_env()), _callback(_vec_env(), log_path=str(tmp_path))
    for _ in range(2):
        model.learn(20, callback=callback, reset_num_timesteps=False)
    assert [row["timesteps"] for row in callback.history] == [10, 20, 30, 40]
    assert _files(tmp_path)["evaluations.npz"]["timesteps"].tolist() == [10, 20, 30, 40]


def test_evaluations_of_another_number_of_episodes_are_refused_and_kept(tmp_path):
    resumed, before = _interrupted(tmp_path), _files(tmp_path)["evaluations.npz"]["results"]
    callback = _callback(_vec_env(), log_path=str(tmp_path), n_eval_episodes=3)
    with pytest.raises(ValueError, match="evaluations of 4 episodes, but n_eval_episodes is 3: give the former number"):
        resumed.learn(resumed.steps_left, reset_num_timesteps=False, callback=callback)
    np.testing.assert_array_equal(_files(tmp_path)["evaluations.npz"]["results"], before)


def test_a_file_of_evaluations_that_is_cut_off_is_a_warning(tmp_path):
    resumed, path = _interrupted(tmp_path), tmp_path / "evaluations.npz"
    path.write_bytes(path.read_bytes()[:100])
    callback = _callback(_vec_env(), log_path=str(tmp_path))
    with pytest.warns(UserWarning, match=r"evaluations.npz can't be read, and evaluations start anew there: BadZipFile"):
        resumed.learn(resumed.steps_left, reset_num_timesteps=False, callback=callback)
