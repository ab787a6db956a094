"""SB3's contract: what is logged, to standard output, files and tensorboard."""

import csv
from unittest import mock

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HParam,
    HumanOutputFormat,
    Logger,
    TensorBoardOutputFormat,
    configure,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import get_latest_run_id
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_gac.algorithms import algorithm_class
from tests.registry import LINES, algorithms, make, on_policy
from tests.sb3_contract.helpers import ACTIONS, AsDict, RandomEnv, pendulum


def _keys(algorithm):
    """SAC's names of what the method has."""
    keys = {"n_updates", "learning_rate", "critic_loss"}
    keys |= set() if on_policy(algorithm) else {"actor_loss"}
    return keys if "temperature" in LINES[algorithm].lacks else keys | {"ent_coef", "ent_coef_loss"}


class _MemoryLogger(Logger):
    """Keep what was recorded."""

    def __init__(self):
        super().__init__("", [])

    def dump(self, step=0):
        pass


def _formats(model):
    return [type(output_format) for output_format in model.logger.output_formats]


def _make(algorithm, env, **arguments):
    """Nothing that is logged ends with a phase."""
    return make(algorithm, env, **LINES[algorithm].one_phase, **arguments)


@algorithms()
def test_sacs_metrics_are_logged_under_sacs_names(algorithm):
    model = _make(algorithm, pendulum()).learn(20)
    logged = model.logger.name_to_value
    assert {f"train/{name}" for name in _keys(algorithm)} <= set(logged)
    assert logged["train/n_updates"] == model._n_updates > 0
    assert all(np.isfinite(value) for value in logged.values())


@algorithms("temperature")
def test_a_fixed_entropy_coefficient_has_no_loss(algorithm):
    logged = _make(algorithm, pendulum(), ent_coef=0.2).learn(20).logger.name_to_value
    assert logged["train/ent_coef"] == pytest.approx(0.2)
    assert "train/ent_coef_loss" not in logged


@algorithms()
def test_output_formats_follow_verbosity_and_tensorboard_log(algorithm, tmp_path, monkeypatch):
    def learned(**arguments):
        return make(algorithm, pendulum(), **arguments).learn(2)

    assert _formats(learned(verbose=0)) == []
    model = learned(verbose=0, tensorboard_log=str(tmp_path))
    assert str(tmp_path) in model.logger.dir
    assert _formats(model) == [TensorBoardOutputFormat]
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path / "new"))
    assert learned(verbose=0).logger.dir == str(tmp_path / "new")
    assert _formats(learned(verbose=1)) == [HumanOutputFormat]
    model = learned(verbose=1, tensorboard_log=str(tmp_path))
    assert _formats(model) == [HumanOutputFormat, TensorBoardOutputFormat]


@algorithms()
def test_logger_of_ones_own_is_kept(algorithm, tmp_path):
    model = _make(algorithm, pendulum(max_episode_steps=10), verbose=1)
    model.learn(10)
    model.set_logger(configure(str(tmp_path), ["stdout", "csv", "tensorboard"]))
    model.learn(40, log_interval=1)
    assert _formats(model) == [HumanOutputFormat, CSVOutputFormat, TensorBoardOutputFormat]
    rows = list(csv.DictReader((tmp_path / "progress.csv").read_text().splitlines()))
    assert {f"train/{name}" for name in _keys(algorithm)} <= set(rows[-1])
    assert [int(row["time/total_timesteps"]) for row in rows] == [10, 20, 30, 40]


@algorithms()
def test_human_output_shows_every_metric_in_full(algorithm, capsys):
    logged = set()
    model = _make(algorithm, pendulum(max_episode_steps=10), verbose=1)
    model.on_step = lambda: logged.update(model.logger.name_to_value)
    model.learn(40, log_interval=1)
    table = capsys.readouterr().out
    assert {f"train/{name}" for name in _keys(algorithm)} <= logged
    for name in (*(name.split("/")[1] for name in logged), "ep_rew_mean"):
        assert f"|    {name} " in table, name
    assert "..." not in table


@algorithms()
def test_no_division_by_zero_where_time_stands_still(algorithm):
    with mock.patch("time.time", return_value=42.0), mock.patch("time.time_ns", return_value=42):
        model = make(algorithm, pendulum(max_episode_steps=10))
        model.set_logger(_MemoryLogger())
        model.learn(10, log_interval=1)
    assert model.logger.name_to_value["time/fps"] > 0


@pytest.mark.parametrize("stats_window_size", [1, 42])
@algorithms()
def test_stats_window_size(algorithm, stats_window_size):
    model = make(algorithm, pendulum(), stats_window_size=stats_window_size).learn(10)
    assert model.ep_info_buffer.maxlen == model.ep_success_buffer.maxlen == stats_window_size


class _SuccessEnv(RandomEnv):
    """Every third episode succeeds."""

    n_episodes = 0

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        if truncated:
            info["is_success"] = self.n_episodes % 3 == 0
            self.n_episodes += 1
        return obs, reward, terminated, truncated, info


@algorithms()
def test_success_rate(algorithm):
    env = AsDict(_SuccessEnv(spaces.Box(-1, 1, (2,), np.float32), ACTIONS, max_episode_steps=5))
    model = make(algorithm, Monitor(env, info_keywords=("is_success",)), stats_window_size=6)
    model.set_logger(_MemoryLogger())
    model.learn(5 * 12, log_interval=1)
    assert model.logger.name_to_value["rollout/success_rate"] == pytest.approx(1 / 3)


# --- tensorboard --------------------------------------------------------------------------------------------------------


class _HParamCallback(BaseCallback):
    def _on_training_start(self):
        hparams = {"algorithm": type(self.model).__name__, "gamma": self.model.gamma, "lr": self.model.learning_rate}
        exclude = ("stdout", "log", "json", "csv")
        self.logger.record("hparams", HParam(hparams, {"rollout/ep_len_mean": 0.0}), exclude=exclude)

    def _on_step(self):
        return True


@algorithms()
def test_tensorboard_runs_are_numbered_and_continued(algorithm, tmp_path):
    name = algorithm_class(algorithm).__name__
    model = _make(algorithm, pendulum(max_episode_steps=10), tensorboard_log=str(tmp_path))
    model.learn(20, callback=_HParamCallback(), log_interval=1)
    model.learn(20, reset_num_timesteps=False, log_interval=1)
    assert get_latest_run_id(str(tmp_path), name) == 1
    for _ in range(2):
        model.learn(10, tb_log_name="several")
    assert get_latest_run_id(str(tmp_path), "several") == 2

    events = EventAccumulator(str(tmp_path / f"{name}_1"))
    events.Reload()
    assert {f"train/{name}" for name in _keys(algorithm) - {"n_updates"}} <= set(events.Tags()["scalars"])
    assert [event.step for event in events.Scalars("rollout/ep_rew_mean")] == list(range(10, 50, 10))


@algorithms()
def test_evaluations_are_logged_at_their_timestep(algorithm, tmp_path):
    model = make(algorithm, pendulum(), tensorboard_log=str(tmp_path), seed=1)
    model.learn(30, callback=EvalCallback(pendulum(10), eval_freq=13, n_eval_episodes=1, warn=False))
    events = EventAccumulator(str(tmp_path / f"{algorithm_class(algorithm).__name__}_1"))
    events.Reload()
    assert [event.step for event in events.Scalars("eval/mean_reward")] == [13, 26]
