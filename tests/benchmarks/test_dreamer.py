"""DreamerV3 by sheeprl: it sees `partial` alone, acts as the environment takes it, and goes on from its checkpoints."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml
from gymnasium import spaces

pytest.importorskip("sheeprl", reason='DreamerV3 comes with an extra: pip install -e ".[dreamer]"')

from benchmarks.dreamer import LearnersView, Player, command_line, in_hydra, make_env
from benchmarks.external import request_of
from benchmarks.program import Request
from benchmarks.suite import HERE, RunSpec, read_suite
from tests.helpers import TwoViewBandit

SPEC = RunSpec("dreamer-v3", "InvertedDoublePendulum", 0.1, 3, 400, 2, "small", 200, 2)
SMALL = {
    "size": "1M",
    "configuration": {
        "algo.replay_ratio": 0.05,
        "algo.learning_starts": 100,
        "algo.per_rank_batch_size": 2,
        "algo.per_rank_sequence_length": 16,
    },
}


@pytest.fixture
def request_for(tmp_path):
    """Of a run with the arguments that are given."""

    def of(spec=SPEC, **arguments):
        (tmp_path / "checkpoint").mkdir(exist_ok=True)
        (tmp_path / "request.json").write_text(json.dumps(request_of(spec, arguments)))
        return Request(tmp_path / "request.json")

    return of


def test_it_sees_the_learners_view_alone(request_for):
    env = make_env(str(request_for().path))
    whole = request_for().make_env()
    assert "privileged" in whole.observation_space.spaces
    assert env.observation_space == spaces.Dict(partial=whole.observation_space["partial"])
    observation, _ = env.reset(seed=5)
    expected, _ = whole.reset(seed=5)
    assert list(observation) == ["partial"]
    np.testing.assert_array_equal(observation["partial"], expected["partial"])


def test_views_that_are_no_vectors_are_refused():
    env = TwoViewBandit()
    env.observation_space = spaces.Dict(partial=spaces.Box(0, 255, (3, 8, 8), np.uint8))
    with pytest.raises(ValueError, match="partial must be a Box with one axis"):
        LearnersView(env)


class Recorded:
    """In the place of sheeprl's player: what it is told, and actions of 0.5."""

    device = th.device("cpu")

    def __init__(self, actions):
        self.actions, self.seen = actions, []

    def init_states(self, which=None):
        self.seen.append(("begun", which))

    def get_actions(self, observation, greedy):
        self.seen.append((observation["partial"].tolist(), greedy))
        return self.actions


def _env(action_space):
    env = TwoViewBandit()
    env.action_space = action_space
    return env


def test_actions_have_the_environments_bounds_and_states_begin_with_episodes():
    bounded = spaces.Box(np.float32([-3, 0]), np.float32([3, 1]))
    inner = Recorded((th.tensor([[[0.5, 0.5], [-1.0, 0.0]]]),))
    player = Player(inner, _env(bounded))
    observation = {"partial": np.float64([[1], [2]]), "privileged": np.float64([[7], [8]])}
    actions, state = player.predict(observation, None, np.array([True, True]))
    np.testing.assert_allclose(actions, [[1.5, 0.75], [-3.0, 0.5]])
    assert inner.num_envs == 2
    for starts in ([False, False], [False, True]):
        player.predict(observation, state, np.array(starts))
    seen = ([[[1.0], [2.0]]], True)
    assert inner.seen == [("begun", None), seen, seen, ("begun", [1]), seen]


def test_choices_are_numbers():
    one_hot = th.nn.functional.one_hot(th.tensor([[2, 0]]), 3).float()
    actions, _ = Player(Recorded((one_hot,)), _env(spaces.Discrete(3))).predict({"partial": np.zeros((2, 1))})
    assert actions.tolist() == [2, 0]


def test_what_follows_from_the_run_is_the_runs(request_for):
    words = command_line(request_for(**SMALL))
    found = dict(word.split("=", 1) for word in words)
    settings = ("env.num_envs", "seed", "algo.total_steps", "checkpoint.every")
    assert [found[name] for name in settings] == ["2", "3", "400", "200"]
    assert (found["algo"], found["algo.replay_ratio"]) == ("dreamer_v3_5_1M", "0.05")
    assert found["algo.mlp_keys.encoder"] == '["partial"]'
    assert found["checkpoint.resume_from"] == "null"
    assert command_line(request_for())[1] == "algo=dreamer_v3_5_12M"
    assert command_line(request_for(size="200M"))[1] == "algo=dreamer_v3_5"
    assert in_hydra({"a": [1, None, True], "b": "x y"}) == '{a:[1,null,true],b:"x y"}'


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"replay_ratio": 1}, r"unknown \['replay_ratio'\]; they are size and configuration"),
        ({"size": "2M"}, "size: must be one of .*'1M'.*got '2M'"),
        ({"configuration": {"seed": 1}}, r"configuration: \['seed'\] follow from the run's settings"),
    ],
)
def test_arguments_that_mean_nothing_are_refused(request_for, arguments, message):
    with pytest.raises(ValueError, match=message):
        command_line(request_for(**arguments))


@pytest.mark.slow
def test_a_run_that_is_killed_goes_on_from_its_checkpoint(tmp_path):
    definition = {
        "class": "benchmarks.external:Program",
        "command": ["python", "-m", "benchmarks.dreamer"],
        "packages": ["sheeprl"],
        "arguments": SMALL,
    }
    common = {key: getattr(SPEC, key) for key in ("steps", "envs", "preset", "eval_every", "eval_episodes")}
    cell = {"task": SPEC.task, "noises": [0.1], "algorithms": ["mine"], "seeds": [3]}
    path = tmp_path / "suite.yml"
    path.write_text(yaml.safe_dump({**common, "algorithms": {"mine": definition}, "cells": [cell]}))
    (spec,) = read_suite(path)
    assert spec == replace(SPEC, algorithm="mine", definition=definition)
    directory, log = spec.directory(tmp_path), tmp_path / "log.txt"
    command = [sys.executable, "-m", "benchmarks.run", "--suite", str(path), "--index", "0", "--runs", str(tmp_path)]
    where = {"cwd": HERE.parent, "env": {**os.environ, "OMP_NUM_THREADS": "1"}}
    with log.open("w") as file:
        process = subprocess.Popen(command, stdout=file, stderr=file, **where)
        while not list(directory.glob("checkpoint/sheeprl/**/ckpt_200_0.ckpt")):
            assert process.poll() is None, log.read_text()
            time.sleep(0.1)
        process.kill()
        process.wait()
    first = pd.read_csv(directory / "checkpoint/evaluations.csv")
    assert first.timesteps.tolist()[:1] == [200]
    again = subprocess.run(command, capture_output=True, text=True, check=False, **where)
    assert again.returncode == 0, again.stdout + again.stderr
    assert "ckpt_200_0.ckpt" in again.stdout, "what it went on from"
    table = pd.read_csv(directory / "evaluations.csv")
    assert table.timesteps.tolist() == [200, 400]
    assert table.learner[0] == first.learner[0], "taken over, not made again"
    assert list(th.load(directory / "model.pt")) == ["world_model", "actor"]
    assert list((directory / "tensorboard").iterdir())
    assert not (directory / "checkpoint").exists()
