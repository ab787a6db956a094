"""
The four programs, one after the other, on a task whose returns are worked out by hand.

An episode of Toy returns a + 1000 noise + (its seed - 10,000), for the action a.  What is deployed always answers
a = target_update_interval + 10 (its own seed) + 2 (the seed of its training environments) + batch_size
+ learning_starts / 1000 + PROGRESS at its number of steps, and its guider one more.  So, for a run with seed s that is
evaluated from the seeds 10,000 to 10,002:

=========  =====  ===========================================================  =======================
algorithm  noise  return, but for PROGRESS                                     final
=========  =====  ===========================================================  =======================
toy-gac    0.1    3 + 12 s + 40 (the preset's, for this task and class) + 2    150 + 12 s
                  (the suite's) + 100 + 1 = 146 + 12 s
toy-asym   0.1    5 + 12 s + 20 (the preset's) + 4 (its own) + 100 + 1         134 + 12 s
toy-gac    0.2    3 + 12 s + 50 (the preset's, at this noise) + 2 + 200 + 1    260 + 12 s
toy-asym   0.2    5 + 12 s + 50 + 4 + 200 + 1                                  264 + 12 s
=========  =====  ===========================================================  =======================

Seeds 0, 1, 2, 5, 10: mean 3.6, median 2, interquartile mean (1 + 2 + 5) / 3.
"""

import contextlib
import io
import itertools
import json
import sys
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import yaml
from gymnasium import spaces

import benchmarks.aggregate
import benchmarks.launch
import benchmarks.report
import benchmarks.run
import benchmarks.suite
import sb3_gac.presets
from sb3_gac import GAC, AsymmetricSAC

PROGRESS = {10: 2, 20: 30, 30: 4}  # the last is neither the best nor the mean
SUITE = {
    "steps": 30,
    "preset": "toy",
    "eval_every": 10,
    "eval_episodes": 3,
    "overrides": {"learning_starts": 2000},
    "cells": [{"task": "Toy", "noises": [0.1, 0.2], "algorithms": ["toy-gac", "toy-asym"], "seeds": [0, 1, 2, 5, 10]}],
}
PRESET = {
    "run": {"envs": 2},
    "arguments": {"all": {"batch_size": 20, "learning_starts": 1000, "policy_kwargs": {"net_arch": [1]}}},
    "tasks": {"Toy": {"arguments": {f"{__name__}:ToyGAC": {"batch_size": 40}}, "noises": {0.2: {"all": {"batch_size": 50}}}}},
}
ALGORITHMS = {
    "toy-gac": {"class": f"{__name__}:ToyGAC", "target_update_interval": 3},
    "toy-asym": {"class": f"{__name__}:ToyAsym", "target_update_interval": 5, "learning_starts": 4000},
}


class Toy(gym.Env):
    """One step per episode; the observation is the seed that the environment was last reset with."""

    metadata: ClassVar = {"render_modes": ["rgb_array"]}

    def __init__(self, noise_std=0.0):
        box = spaces.Box(-np.inf, np.inf, (1,), np.float32)
        self.observation_space = spaces.Dict(partial=box, privileged=box)
        self.action_space = spaces.Box(-10_000, 10_000, (1,), np.float32)
        self.noise_std, self.seed = noise_std, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seed = self.seed if seed is None else seed
        return self._observation(), {}

    def step(self, action):
        reward = float(action[0]) + 1000 * self.noise_std + self.seed - 10_000
        return self._observation(), reward, True, False, {}

    def _observation(self):
        return dict.fromkeys(self.observation_space, np.float32([self.seed]))


class _Constant:
    """Answers with what it was made with."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        trained_in = self._last_obs["partial"][0, 0]
        made_with = self.target_update_interval + 10 * self.seed + self.batch_size + self.learning_starts / 1000
        value = made_with + 2 * trained_in + PROGRESS[self.num_timesteps]
        return np.full((len(observation["partial"]), 1), value), None


class ToyGAC(_Constant, GAC):
    def predict_guider(self, *arguments, **options):
        action, state = self.predict(*arguments, **options)
        return action + 1, state


class ToyAsym(_Constant, AsymmetricSAC):
    pass


class InThisProcess:
    """An engine that knows the toys."""

    cpus = 1

    def run(self, command, log):
        with pytest.MonkeyPatch.context() as context:
            context.setattr(sys, "argv", command[2:])
            benchmarks.run.main()
        return 0


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Directory of what the programs leave, and what each of them says."""
    root = tmp_path_factory.mktemp("golden")
    for name, content in (("toy", PRESET), ("algorithms", ALGORITHMS), ("suite", SUITE)):
        (root / f"{name}.yml").write_text(yaml.safe_dump(content))
    with pytest.MonkeyPatch.context() as context:
        context.setattr(benchmarks.suite, "HYPERPARAMS", root)
        context.setattr(sb3_gac.presets, "DIRECTORY", root)
        context.setattr(benchmarks.launch, "LocalEngine", InThisProcess)
        context.setattr(benchmarks.run, "provenance", lambda: {"commit": "abc", "versions": {}, "cpus": 1})
        context.setitem(gym.registry, "sb3_gac/Toy-v0", gym.envs.registration.EnvSpec("sb3_gac/Toy-v0", entry_point=Toy))
        shared = [root / "suite.yml", "--runs", root / "runs"]
        _program(context, benchmarks.launch, *shared, status=0)
        _program(context, benchmarks.aggregate, *shared, "--out", root / "toy", "--reference", "toy-asym")
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            _program(context, benchmarks.report, root / "toy", "--runs", root / "runs")
    return root, said.getvalue()


def _program(context, module, *arguments, status=None):
    context.setattr(sys, "argv", [module.__name__, *map(str, arguments)])
    if status is None:
        module.main()
        return
    with pytest.raises(SystemExit) as end:
        module.main()
    assert end.value.code == status


@pytest.fixture(scope="module")
def cells(made):
    """(algorithm, noise) -> what was aggregated."""
    root, _ = made
    return {(cell["algorithm"], cell["noise"]): cell for cell in json.loads((root / "toy.json").read_text())["cells"]}


FINAL = {
    ("toy-gac", 0.1): [150, 162, 174, 210, 270],
    ("toy-asym", 0.1): [134, 146, 158, 194, 254],
    ("toy-gac", 0.2): [260, 272, 284, 320, 380],
    ("toy-asym", 0.2): [264, 276, 288, 324, 384],
}


def test_every_run_returns_what_its_noise_seed_algorithm_and_layers_of_arguments_make_it_return(cells):
    assert {key: cell["final"] for key, cell in cells.items()} == FINAL
    assert all(cell["seeds"] == [0, 1, 2, 5, 10] for cell in cells.values())


def test_every_evaluation_is_kept_by_run_and_in_order(made):
    root, _ = made
    tidy = pd.read_csv(root / "toy.csv")
    assert len(tidy) == 2 * 2 * 5 * 3
    one = tidy[(tidy.algorithm == "toy-gac") & (tidy.noise == 0.2) & (tidy.seed == 2)]
    assert one.timesteps.tolist() == [10, 20, 30]
    assert one.learner.tolist() == [256 + 24 + 2, 256 + 24 + 30, 256 + 24 + 4]
    assert one.guider.tolist() == [283, 311, 285]
    assert tidy[tidy.algorithm == "toy-asym"].guider.isna().all()
    assert tidy.seed.tolist()[::6] == 2 * [0, 1, 2, 5, 10], "a noise's runs before those of the next, a seed's before the next"
    alone = pd.read_csv(root / "runs/toy-30/Toy-noise0.2/toy-gac/seed2/evaluations.csv")
    assert alone.learner.tolist() == one.learner.tolist()


@pytest.mark.parametrize(
    ("key", "mean", "final_iqm", "area_iqm", "steps"),
    [  # 12 (1 + 2 + 5) / 3 = 32; the mean of PROGRESS is 12; mean curves are at 43.2 + 2, 30 and 4
        (("toy-gac", 0.1), 193.2, 182, 146 + 12 + 32, 10),
        (("toy-asym", 0.1), 177.2, 166, 130 + 12 + 32, 20),
        (("toy-gac", 0.2), 303.2, 292, 256 + 12 + 32, 20),
        (("toy-asym", 0.2), 307.2, 296, 260 + 12 + 32, 20),
    ],
)
def test_scores_of_cells(cells, key, mean, final_iqm, area_iqm, steps):
    cell = cells[key]
    assert (cell["final_mean"], cell["final_iqm"][0], cell["area_iqm"][0]) == (mean, final_iqm, area_iqm)
    assert cell["steps_to_reference"] == steps, "to what toy-asym returns in the end, 177.2 and 307.2"
    assert cell.get("guider_mean") == (mean + 1 if key[0] == "toy-gac" else None)


def test_the_interval_is_that_of_95_percent(cells):
    """
    Of all 5^5 resamples of 150, 162, 174, 210 and 270, 0.7% have an interquartile mean of 150, 2.9% of at most 154 and 7.7%
    of at most 158; 5.5% have at least 234, 2.9% at least 250 and 0.7% one of 270.
    """
    resamples = np.sort(list(itertools.product(FINAL["toy-gac", 0.1], repeat=5)))
    means = resamples[:, 1:4].mean(axis=1)
    shares = [(means <= low).mean() for low in (150, 154, 158)] + [(means >= high).mean() for high in (234, 250, 270)]
    assert shares == pytest.approx([0.007, 0.029, 0.077, 0.055, 0.029, 0.007], abs=0.002)
    assert cells["toy-gac", 0.1]["final_iqm"] == [182, 154, 250]


def test_scores_over_all_cells(made):
    """
    At noise 0.1, the lowest point of a mean curve is toy-asym's first, 130 + 43.2 + 2 = 175.2, the best end toy-gac's 193.2;
    at 0.2, toy-gac's first, 301.2, and toy-asym's end, 307.2. So finals are (x - 175.2) / 18 and (x - 301.2) / 6: of toy-gac,
    -21, -11, -1, 29 and 79 fifteenths, and -103, -73, -43, 47 and 197, whose middle six have the mean 0; of toy-asym -103,
    -73, -43, 47 and 197 forty-fifths, and -279, -189, -99, 171 and 621, whose middle six have the mean -100 / 45 / 6.
    """
    results = json.loads((made[0] / "toy.json").read_text())
    assert [(cell["low"], cell["high"]) for cell in results["compared"]["cells"]] == [(175.2, 193.2), (301.2, 307.2)]
    scores = {name: point for name, (point, *_) in results["normalised_iqm"].items()}
    assert scores == pytest.approx({"toy-gac": 0.0, "toy-asym": -0.370}, abs=1e-9)
    # Pairs with toy-gac ahead: 2 + 3 + 3 + 4 + 5 of 25 at noise 0.1, 0 + 1 + 2 + 3 + 4 at 0.2
    ahead = {name: point for name, (point, *_) in results["probability_of_improvement"].items()}
    assert ahead == {"toy-gac over toy-asym": 0.54, "toy-asym over toy-gac": 0.46}


def test_what_is_reported(made):
    root, said = made
    # Student's t of five by hand: 193.2 and 307.2, and 2.7764 times 48.45 / sqrt(5) to both sides
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in said.splitlines()]
    assert table[2] == ["Toy", "0.1", "toy-gac", "150, 162, 174, 210, 270", "193 [133, 253]", "182 [154, 250]", "194", ""]
    assert table[5][:5] == ["Toy", "0.2", "toy-asym", "264, 276, 288, 324, 384", "307 [247, 367]"]
    assert table[5][6] == "", "no guider"
    assert [row[:2] for row in table[9:]] == [
        ["normalised IQM", "toy-gac"],
        ["normalised IQM", "toy-asym"],
        ["probability of improvement", "toy-gac over toy-asym"],
        ["probability of improvement", "toy-asym over toy-gac"],
    ]
    assert [row[2].split()[0] for row in table[9:]] == ["0.00", "-0.37", "0.54", "0.46"]
    page = (root / "toy.html").read_text()
    assert "182 [154, 250]" in page
    assert "runs/toy-30/Toy-noise0.2/toy-asym/seed10" in page


def test_what_launch_shows_of_a_run_is_its_last_return(made):
    root, _ = made
    timing = json.loads((root / "runs/toy-30/Toy-noise0.1/toy-asym/seed5/timing.json").read_text())
    assert (timing["steps"], timing["learner"]) == (30, 194)
