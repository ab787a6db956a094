"""The preset paper-brax: what it has over the paper's table, and that observations are normalised as Brax's SAC does it."""

import math

import numpy as np
import pytest
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

import sb3_gac.presets
from benchmarks.config import normalization, resolve
from benchmarks.suite import RunSpec
from sb3_gac import GAC, PRESETS, TGRL, AsymmetricSAC, OnnxPolicy, export_learner, preset
from sb3_gac.algorithms import ALGORITHMS
from sb3_gac.training.environments import normalized
from tests.helpers import Sampled, TwoViewBandit, small_model

LARGE = spaces.Dict(
    partial=spaces.Box(np.float32([-100, 3, 0]), np.float32([300, 4, 1]), (3,), np.float32),
    privileged=spaces.Box(-5, 50, (2,), np.float32),
)
RECIPE = {"ent_coef", "policy_kwargs", "replay_buffer_kwargs"}


class Shown(DummyVecEnv):
    """Two environments that write down all that a policy is shown."""

    def __init__(self):
        super().__init__([lambda: Sampled(LARGE, length=7)] * 2)
        self.seed(0)
        self.seen = []

    def reset(self):
        self.seen.append({key: value.astype(np.float64) for key, value in super().reset().items()})
        return {key: value.astype(np.float32) for key, value in self.seen[-1].items()}

    def step_wait(self):
        obs, *rest = super().step_wait()
        self.seen.append({key: value.astype(np.float64) for key, value in obs.items()})
        return obs, *rest


def _normalized(env, **kwargs):
    return normalized(env, PRESETS["paper-brax"].normalization("gac"), **kwargs)


def _as_brax(seen):
    """Of running_statistics.update: mean and std of all that was seen, std within [1e-6, 1e6]."""
    return seen.mean(axis=0), np.clip(seen.std(axis=0), 1e-6, 1e6)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_it_is_the_papers_table_and_for_gac_and_sac_what_brax_has(algorithm):
    brax, paper = (preset(name, algorithm=algorithm, task="Ant", noise=0.3) for name in ("paper-brax", "paper"))
    has_recipe = algorithm.startswith("gac") or algorithm == "asymmetric_sac"
    assert {name for name in brax if brax[name] != paper.get(name)} == (RECIPE if has_recipe else set())
    assert set(paper) <= set(brax)
    options = PRESETS["paper-brax"].normalization(algorithm)
    wanted = {"norm_reward": False, "clip_obs": math.inf, "epsilon": 1e-12} if has_recipe else None
    assert options == wanted
    assert PRESETS["paper"].normalization(algorithm) is None


def test_its_runs_are_the_papers_but_for_evaluation():
    assert PRESETS["paper-brax"].run == {**PRESETS["paper"].run, "eval_episodes": 128, "eval_deterministic": False}
    assert PRESETS["paper-brax"].tasks == PRESETS["paper"].tasks


@pytest.mark.parametrize(("cls", "algorithm"), [(GAC, "gac"), (AsymmetricSAC, "asymmetric_sac")])
def test_a_model_of_it_has_braxs_recipe(cls, algorithm):
    arguments = preset("paper-brax", algorithm=algorithm, buffer_size=1000)
    model = cls("MultiInputPolicy", _normalized(Shown()), **arguments)
    assert model.ent_coef_tensor.item() == 1.0
    assert model.policy.deployed.head.softplus_min_std == 0.001
    assert model.policy.deployed.head.log_std.bias.abs().max() == 0, "of LeCun's initialisation"
    assert model.replay_buffer.mask_truncations
    assert model.policy.deployed.net_arch == [256, 256], "the paper's"


def test_policies_and_batches_see_what_braxs_running_statistics_make_of_observations():
    """Each entry by itself: nothing of what is privileged is in the statistics of partial."""
    env = Shown()
    model = small_model(_normalized(env), guider="independent", learning_starts=1000, buffer_size=1000).learn(400)
    seen = {key: np.concatenate([obs[key] for obs in env.seen]) for key in LARGE.spaces}
    assert len(seen["partial"]) == 402, "those that episodes ended with are not among them"
    np.random.seed(0)
    raw = model.replay_buffer.sample(50)
    np.random.seed(0)
    batch = model._sample_batch(50)
    for key, observations in seen.items():
        mean, std = _as_brax(observations)
        for found, before in (
            (model._last_obs[key], env.seen[-1][key]),
            (batch.observations[key].numpy(), raw.observations[key].numpy()),
            (batch.next_observations[key].numpy(), raw.next_observations[key].numpy()),
        ):
            np.testing.assert_allclose(found, (before - mean) / std, rtol=1e-3, atol=1e-3)


def test_nothing_is_clipped():
    env = _normalized(Shown())
    env.reset()
    for _ in range(50):
        env.step(np.zeros((2, 1)))
    far = {"partial": np.float32([[1e6, 3.5, 0.5]]), "privileged": np.float32([[0.0, 0.0]])}
    mean, std = env.obs_rms["partial"].mean, np.sqrt(env.obs_rms["partial"].var)
    np.testing.assert_allclose(env.normalize_obs(far)["partial"], (far["partial"] - mean) / std, rtol=1e-4)
    assert env.normalize_obs(far)["partial"][0, 0] > 1000


@pytest.mark.parametrize("suffix", [".onnx", ".pt"])
def test_the_learners_statistics_are_in_its_file_and_no_others(suffix, tmp_path):
    if suffix == ".onnx":
        pytest.importorskip("onnxruntime", reason="of the extra export")
    policy_kwargs = {"net_arch": [8], "softplus_min_std": 0.001, "initialization": "lecun_uniform"}
    model = small_model(_normalized(Shown()), guider="independent", policy_kwargs=policy_kwargs).learn(60)
    path = export_learner(model, tmp_path / f"learner{suffix}")
    raw = {key: np.stack([space.sample() for _ in range(500)]) for key, space in LARGE.spaces.items()}
    raw["partial"][::10] *= 1000
    expected, _ = model.predict(model.env.normalize_obs(raw), deterministic=True)
    if suffix == ".onnx":
        actions = OnnxPolicy.load(path).act({"partial": raw["partial"]})
    else:
        actions = th.jit.load(str(path))(th.as_tensor(raw["partial"])).numpy()
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert np.ptp(actions) > 0.1


def test_runs_of_a_suite_have_the_presets_normalisation_unless_their_algorithm_says_otherwise():
    def spec(algorithm, preset="paper-brax", definition=None):
        return RunSpec(algorithm, "Ant", 0.1, 0, 1000, 2, preset, 500, 1, definition=definition)

    brax = PRESETS["paper-brax"].normalization("gac")
    assert normalization(spec("gac")) == normalization(spec("gac-share")) == normalization(spec("sac")) == brax
    assert normalization(spec("gac", "paper")) is None
    assert normalization(spec("gpo-clip")) == {"clip_obs": 5.0}
    assert normalization(spec("mine", definition={"class": "gac", "normalize": None})) is None
    assert resolve(spec("sac"))[1]["ent_coef"] == "auto_1.0"


def test_a_teacher_that_saw_normalised_observations_is_refused_where_there_are_none():
    keys = {"actor": ["partial", "privileged"]}
    env = _normalized(DummyVecEnv([TwoViewBandit]))
    teacher = small_model(env, cls=AsymmetricSAC, role_keys=keys).learn(20)
    with pytest.raises(ValueError, match=r'"partial" that was normalised by VecNormalize, but env gives it raw: wrap env'):
        small_model(TwoViewBandit(), cls=TGRL, teacher=teacher)
    assert small_model(env, cls=TGRL, teacher=teacher).learn(20).frozen


def test_a_preset_may_be_over_another(tmp_path, monkeypatch):
    monkeypatch.setattr(sb3_gac.presets, "DIRECTORY", tmp_path)
    below = {
        "run": {"envs": 3, "steps": 7},
        "arguments": {"all": {"gamma": 0.5, "policy_kwargs": {"net_arch": [8]}}, "gac": {"tau": 0.1}},
        "tasks": {"Ant": {"arguments": {"gac": {"target_kl": 0.1}}}},
    }
    above = {
        "extends": "below",
        "run": {"steps": 9},
        "arguments": {"all": {"policy_kwargs": {"n_critics": 3}}, "rma": {"tau": 0.2}},
        "normalize": {"all": {"clip_obs": 1.0}, "gac": {"clip_obs": 2.0}},
    }
    for name, content in {"below": below, "above": above}.items():
        (tmp_path / f"{name}.yml").write_text(yaml.safe_dump(content))
    found = preset("above", task="Ant")
    assert found == {"gamma": 0.5, "tau": 0.1, "target_kl": 0.1, "policy_kwargs": {"net_arch": [8], "n_critics": 3}}
    assert (preset("above", algorithm="rma")["tau"], preset("below", algorithm="rma").get("tau")) == (0.2, None)
    assert PRESETS["above"].run == {"envs": 3, "steps": 9}
    assert [PRESETS["above"].normalization(name) for name in ("gac_share", "rma")] == [{"clip_obs": 2.0}, {"clip_obs": 1.0}]
    (tmp_path / "above.yml").write_text(yaml.safe_dump({"extends": "nowhere"}))
    with pytest.raises(ValueError, match=r"preset must be one of \['above', 'below'\], got 'nowhere'"):
        preset("above")
