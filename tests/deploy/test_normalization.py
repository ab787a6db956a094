"""Normalisation at deployment equals that of training, without the training's environments."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import DeploymentNormalizer

SPACE = spaces.Dict(
    partial=spaces.Box(-np.inf, np.inf, (3,), np.float32),
    privileged=spaces.Box(-np.inf, np.inf, (2,), np.float32),
    proprio=spaces.Box(-np.inf, np.inf, (1,), np.float32),
)


class Drawn(gym.Env):
    """Every observation is drawn anew, each component with a mean and scale of its own."""

    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, observation_space):
        self.observation_space = observation_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._draw(self.observation_space), {}

    def step(self, action):
        return self._draw(self.observation_space), 0.0, False, False, {}

    def _draw(self, space):
        if isinstance(space, spaces.Dict):
            return {key: self._draw(entry) for key, entry in space.items()}
        scale = 1 + np.arange(space.shape[0])
        return (5 * scale + scale * self.np_random.normal(size=space.shape)).astype(np.float32)


def _vec_normalize(space=SPACE, n_steps=30, **kwargs):
    vec_normalize = VecNormalize(DummyVecEnv([lambda: Drawn(space)] * 2), **kwargs)
    vec_normalize.seed(0)
    vec_normalize.reset()
    return _go_on(vec_normalize, n_steps)


def _go_on(vec_normalize, n_steps):
    for _ in range(n_steps):
        vec_normalize.step(np.zeros((2, 1), dtype=np.float32))
    return vec_normalize


@pytest.mark.parametrize("kwargs", [{}, {"clip_obs": 0.5}, {"epsilon": 0.7}])
def test_equals_vec_normalize_batched_single_and_without_the_privileged_entry(kwargs):
    vec_normalize = _vec_normalize(**kwargs)
    normalize = DeploymentNormalizer.from_vec_normalize(vec_normalize)
    raw = vec_normalize.get_original_obs()
    expected = vec_normalize.normalize_obs(raw)["partial"]
    assert np.abs(expected - raw["partial"]).min() > 1e-2
    assert np.array_equal(normalize(raw)["partial"], expected)
    assert np.array_equal(normalize({"partial": raw["partial"]})["partial"], expected)
    assert expected.dtype == normalize(raw)["partial"].dtype == np.float32
    for i in range(2):
        assert np.array_equal(normalize({"partial": raw["partial"][i]})["partial"], expected[i])
    assert (np.abs(expected).max() == 0.5) == ("clip_obs" in kwargs)


def test_other_entries_pass_through_and_the_observation_is_not_written_into():
    vec_normalize = _vec_normalize()
    raw = vec_normalize.get_original_obs()
    before = {key: value.copy() for key, value in raw.items()}
    result = DeploymentNormalizer.from_vec_normalize(vec_normalize)(raw)
    assert result.keys() == raw.keys()
    assert all(np.array_equal(raw[key], before[key]) for key in raw)
    assert all(np.array_equal(result[key], before[key]) for key in ("privileged", "proprio"))


def test_normalises_the_entries_it_is_told():
    vec_normalize = _vec_normalize()
    raw = vec_normalize.get_original_obs()
    result = DeploymentNormalizer.from_vec_normalize(vec_normalize, keys=["partial", "proprio"])(raw)
    expected = vec_normalize.normalize_obs(raw) | {"privileged": raw["privileged"]}
    assert all(np.array_equal(result[key], expected[key]) for key in raw)


@pytest.mark.parametrize(
    ("kwargs", "normalised"),
    [
        ({"norm_obs_keys": ["partial"]}, True),
        ({"norm_obs_keys": ["partial", "privileged"]}, True),
        ({"norm_obs_keys": ["privileged"]}, False),
        ({"norm_obs": False}, False),
    ],
)
def test_does_what_vec_normalize_was_told_to(kwargs, normalised):
    vec_normalize = _vec_normalize(**kwargs)
    raw = vec_normalize.get_original_obs()
    result = DeploymentNormalizer.from_vec_normalize(vec_normalize)({"partial": raw["partial"]})["partial"]
    assert np.array_equal(result, vec_normalize.normalize_obs(raw)["partial"])
    assert np.array_equal(result, raw["partial"]) != normalised


def test_keeps_its_statistics_while_training_goes_on():
    vec_normalize = _vec_normalize(n_steps=5)
    raw = vec_normalize.get_original_obs()
    normalize = DeploymentNormalizer.from_vec_normalize(vec_normalize)
    before = normalize(raw)["partial"]
    vec_normalize.obs_rms["partial"].mean += 1.0  # in place
    vec_normalize.obs_rms["partial"].var *= 2.0
    _go_on(vec_normalize, 20)
    assert np.array_equal(normalize(raw)["partial"], before)
    assert not np.allclose(vec_normalize.normalize_obs(raw)["partial"], before)


def test_is_picklable():
    vec_normalize = _vec_normalize()
    raw = vec_normalize.get_original_obs()
    normalize = DeploymentNormalizer.from_vec_normalize(vec_normalize)
    copy = pickle.loads(pickle.dumps(normalize))
    assert np.array_equal(copy(raw)["partial"], normalize(raw)["partial"])


def test_refuses_statistics_of_another_kind():
    with pytest.raises(ValueError, match="vec_normalize must wrap environments with Dict observations"):
        DeploymentNormalizer.from_vec_normalize(_vec_normalize(SPACE["partial"]))
