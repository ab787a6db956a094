"""The deployed policy as a file: the same actions as predict, nothing privileged in it, and no torch to run it."""

import json
import subprocess
import sys

import gymnasium as gym
import numpy as np
import onnx
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gac import GAC, AsymmetricSAC, Learner, export_learner
from tests.helpers import Recall, TwoViewBandit, TwoViewChoice, small_model

RECURRENT = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]}


class Scaled(TwoViewBandit):
    """Actions in ranges of their own, of two dimensions."""

    def __init__(self):
        super().__init__(length=5)
        self.action_space = spaces.Box(np.array([[-2.0, 0.0]], np.float32), np.array([[3.0, 0.5]], np.float32))

    def step(self, action):
        return super().step(np.ravel(action))


def _trained(kind, tmp_path):
    if kind == "normalised":
        env = VecNormalize(make_vec_env(TwoViewBandit, 2, env_kwargs={"noise_std": 3.0}, seed=0))
        return small_model(env).learn(60)
    if kind == "recurrent":
        return GAC("MultiInputGruPolicy", Recall(), learning_starts=40, batch_size=4, policy_kwargs=RECURRENT).learn(60)
    if kind == "recurrent, continuous":
        env = Recall(continuous=True)
        return GAC("MultiInputLstmPolicy", env, learning_starts=40, batch_size=4, policy_kwargs=RECURRENT).learn(60)
    return {
        "plain": lambda: small_model(TwoViewBandit(length=5)),
        "ranges": lambda: small_model(Scaled()),
        "discrete": lambda: small_model(TwoViewChoice(length=5)),
        "asymmetric": lambda: small_model(TwoViewBandit(length=5), cls=AsymmetricSAC),
    }[kind]().learn(60)


@pytest.mark.parametrize("suffix", [".onnx", ".pt"])
@pytest.mark.parametrize("kind", ["plain", "ranges", "discrete", "asymmetric", "normalised"])
def test_the_file_acts_as_predict_does(kind, suffix, tmp_path):
    """On 10,000 observations, to 1e-5; with VecNormalize, from raw observations."""
    model = _trained(kind, tmp_path)
    path = export_learner(model, tmp_path / f"learner{suffix}")
    partial = np.random.default_rng(0).normal(scale=3.0, size=(10_000, 2)).astype(np.float32)
    seen = {"partial": partial}
    if (vec_normalize := model.get_vec_normalize_env()) is not None:
        seen = {"partial": vec_normalize._normalize_obs(partial, vec_normalize.obs_rms["partial"]).astype(np.float32)}
    expected, _ = model.predict(seen, deterministic=True)
    if suffix == ".onnx":
        actual = Learner.load(path).act(partial)
    else:
        extra = {"sb3_gac": ""}
        actual = th.jit.load(str(path), _extra_files=extra)(th.as_tensor(partial)).numpy()
        assert json.loads(extra["sb3_gac"])["entries"][0]["name"] == "partial"
    assert actual.shape == expected.shape
    if kind == "discrete":
        assert (actual != expected).mean() < 1e-3, "but where two logits are equal to float precision"
    else:
        np.testing.assert_allclose(actual, expected, atol=1e-5)


@pytest.mark.parametrize("kind", ["recurrent", "recurrent, continuous"])
def test_a_memory_is_carried_and_reset(kind, tmp_path):
    model = _trained(kind, tmp_path)
    learner = Learner.load(export_learner(model, tmp_path / "learner.onnx"))
    script = th.jit.load(str(export_learner(model, tmp_path / "learner.pt")))
    sequence = np.random.default_rng(0).random((20, 500, 4), dtype=np.float32)
    for _ in range(2):
        state, scripted_state = None, th.zeros(500, learner.metadata["state_size"])
        learner.reset()
        for partial in sequence:
            expected, state = model.predict({"partial": partial}, state, deterministic=True)
            scripted, scripted_state = script(th.as_tensor(partial), scripted_state)
            for actual in (learner.act(partial), scripted.numpy()):
                np.testing.assert_allclose(actual, expected, atol=1e-5)
    assert learner.act(sequence[0, 0]).shape == expected.shape[1:]


def test_what_the_file_says_of_itself(tmp_path):
    model = small_model(Scaled()).learn(20)
    learner = Learner.load(export_learner(model, tmp_path / "learner.onnx", units={"partial": "m", "action": "N m"}))
    (entry,), action = learner.metadata["entries"], learner.metadata["action"]
    assert (entry["name"], entry["shape"], entry["dtype"], entry["unit"]) == ("partial", [2], "float32", "m")
    assert (action["shape"], action["low"], action["high"], action["unit"]) == ([1, 2], [-2, 0], [3, 0.5], "N m")
    assert (learner.metadata["algorithm"], learner.metadata["state_size"]) == ("GAC", 0)


def test_nothing_privileged_is_in_the_file(tmp_path):
    """Neither an input for it nor the weights of who sees it: as many numbers as the learner's network has."""
    model = small_model(TwoViewBandit(length=5)).learn(30)
    proto = onnx.load(export_learner(model, tmp_path / "learner.onnx"))
    assert [value.name for value in proto.graph.input] == ["partial"]
    assert b"privileged" not in proto.SerializeToString()
    numbers = sum(int(np.prod(tensor.dims)) for tensor in proto.graph.initializer)
    of_learner = sum(parameter.numel() for parameter in model.policy.learner.parameters())
    assert numbers <= of_learner + 10


def test_the_model_is_left_as_it_was(tmp_path):
    model = small_model(TwoViewBandit(length=5)).learn(30)
    before = [p.clone() for p in model.policy.parameters()]
    export_learner(model, tmp_path / "learner.onnx")
    assert all(th.equal(p, q) for p, q in zip(model.policy.parameters(), before, strict=True))
    model.learn(20, reset_num_timesteps=False)


def test_the_learner_needs_neither_torch_nor_gymnasium(tmp_path):
    path = export_learner(small_model(TwoViewBandit()).learn(20), tmp_path / "learner.onnx")
    program = f"""
import sys
for name in ("torch", "gymnasium", "stable_baselines3", "mujoco"):
    sys.modules[name] = None
import importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *args: None if name == "gymnasium" else find(name, *args)
from sb3_gac.learner import Learner
import numpy as np
print(Learner.load({str(path)!r}).act(np.zeros(2)).shape)
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.stdout.strip() == "(1,)", result.stderr


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ({"partial": np.zeros(2), "privileged": np.zeros(1)}, "nothing else belongs on the robot"),
        ({}, "The policy reads the entries"),
        (np.zeros(3), r'"partial" must have the shape \(2,\)'),
        (np.zeros((1, 1, 2)), r'"partial" must have the shape \(2,\)'),
        (np.array([0.0, np.nan]), '"partial" holds NaN'),
    ],
)
def test_bad_observations(observation, message, tmp_path):
    learner = Learner.load(export_learner(small_model(TwoViewBandit()).learn(20), tmp_path / "learner.onnx"))
    with pytest.raises(ValueError, match=message):
        learner.act(observation)


def test_bad_files(tmp_path):
    with pytest.raises(ValueError, match=r'must end in ".onnx"'):
        export_learner(small_model(TwoViewBandit()), tmp_path / "learner.zip")
    (tmp_path / "other.onnx").write_bytes(b"something else")
    with pytest.raises(ValueError, match="is not an ONNX file"):
        Learner.load(tmp_path / "other.onnx")


def test_public_names_are_found_and_listed():
    import sb3_gac

    assert set(sb3_gac.__all__) <= set(dir(sb3_gac))
    assert all(getattr(sb3_gac, name) is not None for name in sb3_gac.__all__)
    with pytest.raises(AttributeError, match="no attribute 'PPO'"):
        sb3_gac.PPO  # noqa: B018
    assert "sb3_gac/Ant-v5" in gym.registry
