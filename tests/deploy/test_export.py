"""The deployed policy as a file: the same actions as predict, nothing privileged in it, and no torch to run it."""

import json
import shutil
import subprocess
import sys
import warnings
from contextlib import nullcontext
from functools import partial

import gymnasium as gym
import numpy as np
import onnx
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_gac
from sb3_gac import GAC, DeploymentNormalizer, OnnxPolicy, export_learner
from sb3_gac.deploy.__main__ import main as export
from sb3_gac.deploy.verification import ExportError, draw_observations
from sb3_gac.envs import History
from sb3_gac.networks.encoders import VectorExtractor
from tests.helpers import Recall, Sampled, TwoViewBandit, TwoViewChoice, small_model, unlike_each_other
from tests.registry import LINES, make
from tests.sb3_contract.helpers import Renamed

VECTOR = spaces.Box(-1, 1, (2,), np.float32)
IMAGE = spaces.Dict(partial=spaces.Box(0, 255, (3, 36, 36), np.uint8), privileged=VECTOR)
SEVERAL = spaces.Dict(partial=VECTOR, privileged=VECTOR, proprio=spaces.Box(-np.inf, np.inf, (3,), np.float32))
CNN = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}}
SHARED, READS_TWO = {"share_features_extractor": True}, {"learner": ["partial", "proprio"]}
RECURRENT = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]}


class Scaled(TwoViewBandit):
    """Actions in ranges of their own, of two dimensions."""

    def __init__(self):
        super().__init__(length=5)
        self.action_space = spaces.Box(np.array([[-2.0, 0.0]], np.float32), np.array([[3.0, 0.5]], np.float32))

    def step(self, action):
        return super().step(np.ravel(action))


def _normalised():
    return VecNormalize(make_vec_env(TwoViewBandit, 2, env_kwargs={"noise_std": 3.0}, seed=0), epsilon=0.3)


def _recurrent(cell, env, **policy_kwargs):
    options = {"learning_starts": 40, "batch_size": 4, "seed": 0, "device": "cpu"}
    return GAC(f"MultiInput{cell}Policy", env, policy_kwargs=RECURRENT | policy_kwargs, **options)


KINDS = {
    **{name: partial(make, name, TwoViewBandit(length=5)) for name, line in LINES.items() if not line.remembers},
    "ranges": lambda: small_model(Scaled()),
    "discrete": lambda: small_model(TwoViewChoice(length=5)),
    "normalised": lambda: small_model(_normalised()),
    "image": lambda: small_model(Sampled(IMAGE), policy_kwargs=CNN),
    "image, shared encoder": lambda: small_model(Sampled(IMAGE), policy_kwargs=CNN | SHARED),
    "history": lambda: small_model(History(Sampled(SEVERAL), 3, actions=True), role_keys=READS_TWO),
}
WITH_MEMORY = {
    **{name: partial(make, name, TwoViewBandit(length=5)) for name, line in LINES.items() if line.remembers},
    "recurrent": lambda: _recurrent("Gru", Recall()),
    "recurrent, continuous": lambda: _recurrent("Lstm", Recall(continuous=True)),
    "recurrent, linear": lambda: _recurrent("Gru", Recall(continuous=True), rnn_type="lru"),
    "recurrent, normalised": lambda: _recurrent("Lstm", _normalised()),
    "recurrent, image": lambda: _recurrent("Gru", Sampled(IMAGE), **CNN | SHARED),
}


def _normalised_as_in_training(model, raw):
    vec_normalize = model.get_vec_normalize_env()
    if vec_normalize is None:
        return raw
    return vec_normalize.normalize_obs(raw | {"privileged": np.zeros((len(raw["partial"]), 1))})


def _drawn(model, n, seed):
    """Observations of the learner; of those that are normalised, a tenth are so large that they are clipped."""
    raw = draw_observations(model.policy.deployed, None, n, seed)
    vec_normalize = model.get_vec_normalize_env()
    if vec_normalize is not None:
        raw["partial"][::10] *= 1000
        clipped = np.abs(_normalised_as_in_training(model, raw)["partial"]) == vec_normalize.clip_obs
        assert 0.02 < clipped.mean() < 0.2
        assert clipped[:, 0].any()
        assert clipped[:, 1].any()
    return raw


@pytest.mark.parametrize("suffix", [".onnx", ".pt"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_file_acts_as_predict_does(kind, suffix, tmp_path):
    """On 10,000 observations, to 1e-5 or, if discrete, but for ties; with VecNormalize, from raw observations."""
    model = KINDS[kind]().learn(40)
    path = export_learner(model, tmp_path / f"learner{suffix}")
    raw = _drawn(model, 10_000, seed=1)
    expected, _ = model.predict(_normalised_as_in_training(model, raw), deterministic=True)
    if suffix == ".onnx":
        actual = OnnxPolicy.load(path).act(raw)
    else:
        extra = {"sb3_gac": ""}
        actual = th.jit.load(str(path), _extra_files=extra)(*map(th.as_tensor, raw.values())).numpy()
        assert [entry["name"] for entry in json.loads(extra["sb3_gac"])["entries"]] == list(raw)
    assert actual.shape == expected.shape
    if kind == "discrete":
        logits = model.policy.deployed.distribution(model.policy.obs_to_tensor(raw)[0]).logits.detach()
        first, second = logits.topk(2).values.T.numpy()
        assert (actual == expected)[first - second > 1e-5].all()
        assert (first - second > 1e-5).mean() > 0.99
    else:
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", WITH_MEMORY)
def test_a_memory_is_carried_and_reset(kind, tmp_path):
    """500 sequences of 20 observations, twice."""
    model = WITH_MEMORY[kind]().learn(60)
    unlike_each_other(model.policy, scale=0.2 if "image" in kind or "linear" in kind or kind in LINES else 1.0)
    learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx"))
    script = th.jit.load(str(export_learner(model, tmp_path / "learner.pt")))
    sequence = [_drawn(model, 500, seed=step) for step in range(20)]
    for _ in range(2):
        state, scripted_state = None, th.zeros(500, learner.metadata["memory"]["size"])
        learner.reset()
        for raw in sequence:
            expected, state = model.predict(_normalised_as_in_training(model, raw), state, deterministic=True)
            scripted, scripted_state = script(th.as_tensor(raw["partial"]), scripted_state)
            for actual in (learner.act(raw), scripted.numpy()):
                np.testing.assert_allclose(actual, expected, atol=1e-5)
    forgetful, _ = model.predict(_normalised_as_in_training(model, sequence[-1]), deterministic=True)
    assert not np.allclose(forgetful, expected, atol=1e-3), "the memory has a say"
    single = sequence[0]["partial"][0]
    with pytest.raises(ValueError, match=r"remembers 500 observations, but got 1: call reset\(\)"):
        learner.act(single)
    learner.reset()
    assert learner.act(single).shape == expected.shape[1:]


def test_what_the_file_says_of_itself(tmp_path):
    model = small_model(Scaled()).learn(20)
    path = export_learner(model, tmp_path / "learner.onnx", units={"partial": "m", "action": "N m"})
    said = OnnxPolicy.load(path).metadata
    nothing = [None, None]
    partial = {"name": "partial", "shape": [2], "dtype": "float32", "unit": "m", "low": nothing, "high": nothing}
    assert said["entries"] == [partial]
    action = {"name": "action", "shape": [1, 2], "dtype": "float32", "unit": "N m", "low": [-2, 0], "high": [3, 0.5]}
    assert said["action"] == action | {
        "meaning": "the deterministic action, between low and high, for the environment's step()"
    }
    assert (said["version"], said["algorithm"]) == (sb3_gac.__version__, "GAC")
    assert (said["memory"], said["normalised"]) == (None, [])
    strict_json = onnx.load(path).metadata_props[0].value
    json.loads(strict_json, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def test_what_a_file_with_memory_and_choices_says(tmp_path):
    said = OnnxPolicy.load(export_learner(WITH_MEMORY["recurrent"]().learn(60), tmp_path / "learner.onnx")).metadata
    assert said["memory"] == {"input": "state", "output": "next_state", "size": 8, "initial": 0.0}
    assert said["action"]["n"] == 3
    assert said["action"]["meaning"].startswith("number of the most probable action")


def test_entries_of_any_name(tmp_path):
    """As those of the file's own inputs and outputs, and such as torch's buffers can't have."""
    names = {"partial": "action", "privileged": "robot.state"}
    env = VecNormalize(make_vec_env(lambda: Renamed(TwoViewBandit(), names), 1))
    model = small_model(env, role_keys={"learner": list(names.values())}).learn(30)
    learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx", units={"action": "m", "action_": "N"}))
    assert (learner.metadata["entries"][0]["unit"], learner.metadata["action"]["unit"]) == ("m", "N")
    raw = {"action": np.ones(2), "robot.state": np.ones(1)}
    expected, _ = model.predict(env.normalize_obs(raw), deterministic=True)
    np.testing.assert_allclose(learner.act(raw), expected, atol=1e-5)


def test_statistics_that_were_not_loaded_are_asked_for(tmp_path):
    model = KINDS["normalised"]().learn(20)
    expected = export_learner(model, tmp_path / "learner.onnx").read_bytes()
    model.save(tmp_path / "model")
    loaded = GAC.load(tmp_path / "model", device="cpu")
    with pytest.raises(ValueError, match=r"VecNormalize normalised, but was loaded without it.*pass normalizer="):
        export_learner(loaded, tmp_path / "other.onnx")
    normalizer = DeploymentNormalizer.from_vec_normalize(model.get_vec_normalize_env())
    assert export_learner(loaded, tmp_path / "other.onnx", normalizer).read_bytes() == expected
    loaded = GAC.load(tmp_path / "model", env=model.get_vec_normalize_env(), device="cpu")
    assert export_learner(loaded, tmp_path / "other.onnx").read_bytes() == expected


def test_a_file_is_compared_on_what_the_policy_may_see():
    """Normalised entries spread about their mean by twice the std, and some reach the clip; others over their space."""
    model = small_model(_normalised()).learn(60)
    normalizer = DeploymentNormalizer.from_vec_normalize(model.get_vec_normalize_env())
    drawn = normalizer(draw_observations(model.policy.deployed, normalizer, 2_000))["partial"]
    assert ((np.median(np.abs(drawn), axis=0) > 1.3) & (np.median(np.abs(drawn), axis=0) < 1.8)).all()  # 1.35, and outliers
    for end in (-10.0, 10.0):
        assert 0.015 < (drawn == end).mean() < 0.05  # of a tenth, 62% lie beyond either end: 3.1% beyond each
    np.testing.assert_allclose(drawn.mean(axis=0), 0.0, atol=0.3)
    of_space = draw_observations(small_model(Sampled(SEVERAL)).policy.deployed, None, 2_000)["partial"]
    assert of_space.min() < -0.99
    assert of_space.max() > 0.99


def test_a_file_that_acts_otherwise_is_not_written(tmp_path):
    """Here for an encoder that branches on values, of which a file keeps the branch that the example took."""
    options = {"features_extractor_class": Branching, "net_arch": [16]}
    model = small_model(TwoViewBandit(), policy_kwargs=options).learn(20)
    for name in ("learner.onnx", "learner.pt"):
        with pytest.raises(ExportError, match=rf"exported {name} differ from those of predict\(\) by up to \d"):
            export_learner(model, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_memory_that_is_not_carried_on_is_noticed(tmp_path, monkeypatch):
    model = WITH_MEMORY["recurrent, continuous"]().learn(50)
    unlike_each_other(model.policy)
    monkeypatch.setattr(OnnxPolicy, "_remembered", lambda self, n: np.zeros((n, self._memory["size"]), np.float32))
    with pytest.raises(ExportError, match="differ from those of predict"):
        export_learner(model, tmp_path / "learner.onnx")


@pytest.mark.parametrize("kind", ["gac", "ranges"])
@pytest.mark.parametrize(("error", "is_written"), [(1e-4, False), (2e-6, True)])
def test_how_much_actions_may_differ(kind, error, is_written, tmp_path, monkeypatch):
    """In units of half their range."""
    model, act = KINDS[kind](), OnnxPolicy.act
    half = (model.action_space.high - model.action_space.low) / 2
    monkeypatch.setattr(OnnxPolicy, "act", lambda self, observation: act(self, observation) + error * half)
    with nullcontext() if is_written else pytest.raises(ExportError):
        export_learner(model, tmp_path / "learner.onnx")
    assert (tmp_path / "learner.onnx").exists() == is_written


class Branching(VectorExtractor):
    """Turns features around in large batches."""

    def forward(self, observations):
        features = super().forward(observations)
        return features if len(features) < 100 else -features


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


@pytest.mark.parametrize("missing", [["torch"], ["torch", "stable_baselines3", "gymnasium", "mujoco"]])
def test_the_learner_needs_neither_torch_nor_gymnasium(missing, tmp_path):
    path = export_learner(small_model(TwoViewBandit()).learn(20), tmp_path / "learner.onnx")
    program = f"""
import sys, importlib.util
for name in {missing}:
    sys.modules[name] = None  # importing it fails
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *args: None if name in {missing} else find(name, *args)
from sb3_gac.learner import OnnxPolicy
import numpy as np
print(OnnxPolicy.load({str(path)!r}).act(np.zeros(2)).shape)
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.stdout.strip() == "(1,)", result.stderr


def test_one_module_is_all_that_the_robot_needs(tmp_path):
    path = export_learner(small_model(TwoViewBandit()).learn(20), tmp_path / "learner.onnx")
    shutil.copy(sys.modules[OnnxPolicy.__module__].__file__, tmp_path / "learner.py")
    without = "import sys; sys.modules['sb3_gac'] = sys.modules['torch'] = None"
    program = f"{without}; from learner import OnnxPolicy; OnnxPolicy.load({str(path)!r})"
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (
            {"partial": np.zeros(2), "privileged": np.zeros(1)},
            r"not read: \['privileged'\]. Nothing else belongs on the robot",
        ),
        ({}, r"The policy reads the entries \['partial'\]; missing: \['partial'\]"),
        (np.zeros(3), r'"partial" must have the shape \(2,\)'),
        (np.zeros((1, 1, 2)), r'"partial" must have the shape \(2,\)'),
        (np.array([0.0, np.nan]), '"partial" holds NaN'),
        (np.array(["a", "b"]), '"partial" must be of type float32, but is <U1'),
        (np.array([0.0, -1e300]), '"partial" holds NaN or infinite values, or values beyond float32'),
        (np.array([0.0, np.inf]), '"partial" holds NaN'),
        ([[0.0], [0.0, 1.0]], '"partial" is no array of numbers'),
        ((np.zeros(2), {}), '"partial" is no array of numbers'),
    ],
)
def test_bad_observations(observation, message, tmp_path):
    learner = OnnxPolicy.load(export_learner(small_model(TwoViewBandit()).learn(20), tmp_path / "learner.onnx"))
    with pytest.raises(ValueError, match=message):
        learner.act(observation)


def test_entries_of_several_kinds_together(tmp_path):
    """Each must be of the type and as many as the others."""
    space = spaces.Dict(image=spaces.Box(0, 255, (3, 36, 36), np.uint8), gear=spaces.Discrete(3), privileged=VECTOR)
    model = small_model(Sampled(space), role_keys={"learner": ["image", "gear"]}, policy_kwargs=CNN).learn(30)
    learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx"))
    assert learner.metadata["entries"][1]["layout"] == "channels first"
    rows = [space.sample() for _ in range(5)]
    batch = {key: np.stack([row[key] for row in rows]) for key in ("image", "gear")}
    np.testing.assert_allclose(learner.act(batch), model.predict(batch, deterministic=True)[0], atol=1e-5)
    assert learner.act({key: rows[0][key] for key in batch}).shape == (1,)
    with pytest.raises(ValueError, match=r"their rows are \{'gear': None, 'image': 5\}"):
        learner.act(batch | {"gear": 1})
    with pytest.raises(ValueError, match='"image" must be of type uint8, but is float64: values would be lost'):
        learner.act(batch | {"image": batch["image"] / 255})


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (2, 3), np.float64),
        spaces.Box(-np.inf, np.inf, (2,), np.float16),
        spaces.Box(np.float32(-3.4e38), np.float32(3.4e38), (2,), np.float32),
        spaces.Box(0, 9, (2,), np.int32),
        spaces.Discrete(4),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(3),
    ],
    ids=str,
)
def test_entries_of_any_kind(space, tmp_path):
    """Verified at export, on observations of that kind."""
    model = small_model(Sampled(spaces.Dict(partial=space, privileged=VECTOR)))
    learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx"))
    export_learner(model, tmp_path / "learner.pt")
    drawn = draw_observations(model.policy.learner, None, 1)["partial"][0]
    np.testing.assert_allclose(learner.act(drawn), model.predict({"partial": drawn}, deterministic=True)[0], atol=1e-5)


def test_no_action_that_is_not_finite_reaches_the_robot(tmp_path):
    """Numbers that float32 holds may still overflow in the network."""
    model = small_model(TwoViewBandit())
    with th.no_grad():
        model.policy.deployed.latent_net[0].weight.fill_(-1.5)  # SiLU of -inf is NaN
    learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx"))
    with pytest.raises(ValueError, match=r"no finite action for so large values: the largest of each entry are .*3\.\d*e\+38"):
        learner.act(np.array([3e38, 3e38], np.float32))
    assert learner.act(np.array([3e30, 3e30], np.float32)).shape == (1,)


def test_numbers_of_any_size_and_integers_of_either_sign_are_taken_where_they_fit(tmp_path):
    entries = spaces.Dict(
        partial=spaces.Box(0, 255, (2,), np.uint8), far=spaces.Box(-1, 1, (2,), np.float64), privileged=VECTOR
    )
    env = VecNormalize(DummyVecEnv([lambda: Sampled(entries)]), norm_obs_keys=["far"])
    reads = {"learner": ["partial", "far"]}
    for envs, takes_far_values in ((env, True), (Sampled(entries), False)):
        model = small_model(envs, role_keys=reads)
        learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx", verify_on=4))
        good = {"partial": np.array([3, 250], np.uint8), "far": np.array([0.5, -0.5])}
        expected = learner.act(good)
        np.testing.assert_array_equal(learner.act(good | {"partial": [3, 250]}), expected)
        for values in ([-1, 3], [3, 256]):
            with pytest.raises(ValueError, match='"partial" holds values that its type uint8 can'):
                learner.act(good | {"partial": values})
        with nullcontext() if takes_far_values else pytest.raises(ValueError, match=r'"far" holds NaN .* beyond float32'):
            assert np.isfinite(learner.act(good | {"far": np.array([1e300, 0.0])})).all(), "normalised, it is clipped"


def test_bad_files(tmp_path):
    for number in (0, 2.5):
        with pytest.raises(ValueError, match=f"verify_on must be an integer >= 1, got {number}"):
            export_learner(small_model(TwoViewBandit()), tmp_path / "learner.onnx", verify_on=number)
    with pytest.raises(ValueError, match=r"units names \['torque'\], but the policy reads \['partial'\] and gives 'action'"):
        export_learner(small_model(TwoViewBandit()), tmp_path / "learner.onnx", units={"torque": "N m"})
    with pytest.raises(ValueError, match=r'must end in ".onnx"'):
        export_learner(small_model(TwoViewBandit()), tmp_path / "learner.zip")
    (tmp_path / "other.onnx").write_bytes(b"something else")
    with pytest.raises(ValueError, match="is not an ONNX file"):
        OnnxPolicy.load(tmp_path / "other.onnx")


def test_a_folder_that_is_not_there_is_made(tmp_path):
    path = tmp_path / "robots" / "first" / "learner.onnx"
    model = small_model(TwoViewBandit())
    with pytest.raises(ValueError, match="units names"):
        export_learner(model, path, units={"torque": "N m"})
    assert not path.parent.parent.exists(), "where nothing is written, nothing is made"
    assert OnnxPolicy.load(export_learner(model, path)).act(np.zeros(2)).shape == (1,)


def test_a_file_that_is_not_there_or_of_another_kind_is_told_with_what_to_do(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no file .*learner\.onnx: sb3_gac\.export_learner writes one\.$"):
        OnnxPolicy.load(tmp_path / "learner.onnx")
    model = small_model(TwoViewBandit())
    export_learner(model, tmp_path / "learner.onnx")
    with pytest.raises(FileNotFoundError, match=r"There is .*learner\.onnx\.$"):
        OnnxPolicy.load(str(tmp_path / "learner"))
    scripted = export_learner(model, tmp_path / "learner.pt")
    with pytest.raises(ValueError, match=r"learner\.pt is no ONNX file: torch\.jit\.load\(.*learner\.pt.\) reads TorchScript"):
        OnnxPolicy.load(scripted)
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"model\.zip is no ONNX file: GAC\.load"):
        OnnxPolicy.load(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="is not an ONNX file"):
        OnnxPolicy.load(tmp_path)


@pytest.mark.parametrize("shape", [(36, 40, 3), (36, 36, 1)])
def test_images_are_taken_as_cameras_and_predict_have_them(shape, tmp_path):
    """Channels last, single or batched, and channels first as the policy has them."""
    camera = spaces.Dict(partial=spaces.Box(0, 255, shape, np.uint8), privileged=VECTOR)
    model = small_model(Sampled(camera), policy_kwargs=CNN).learn(30)
    learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx"))
    images = np.stack([camera["partial"].sample() for _ in range(4)])
    expected, _ = model.predict({"partial": images}, deterministic=True)
    assert np.ptp(expected) > 0, "they are told apart"
    np.testing.assert_allclose(learner.act(images), expected, atol=1e-5)
    np.testing.assert_allclose(learner.act({"partial": images[2]}), expected[2], atol=1e-5)
    np.testing.assert_allclose(learner.act(images.transpose(0, 3, 1, 2)), expected, atol=1e-5)
    with pytest.raises(ValueError, match='"partial" must have the shape'):
        learner.act(images.transpose(0, 2, 1, 3)[:, :-1])


def test_public_names_are_found_and_listed():
    assert set(sb3_gac.__all__) <= set(dir(sb3_gac))
    assert all(getattr(sb3_gac, name) is not None for name in sb3_gac.__all__)
    with pytest.raises(AttributeError, match="no attribute 'PPO'"):
        sb3_gac.PPO  # noqa: B018
    assert "sb3_gac/Ant-v5" in gym.registry


def test_statistics_of_what_the_policy_does_not_read_are_not_asked_for(tmp_path):
    env = VecNormalize(DummyVecEnv([TwoViewBandit]), norm_obs_keys=["privileged"])
    small_model(env).learn(20).save(tmp_path / "model")
    export_learner(GAC.load(tmp_path / "model", device="cpu"), tmp_path / "learner.pt")


def _reads_two(env):
    return GAC("MultiInputPolicy", env, role_keys=READS_TWO, policy_kwargs={"net_arch": [8]}, learning_starts=10, device="cpu")


def test_a_normalizer_that_leaves_out_an_entry_is_refused(tmp_path):
    env = VecNormalize(DummyVecEnv([lambda: Sampled(SEVERAL)]))
    model = _reads_two(env).learn(20)
    with pytest.raises(ValueError, match=r"normalizer leaves \['proprio'\] as they are.*\['partial', 'proprio'\]\)"):
        export_learner(model, tmp_path / "learner.pt", DeploymentNormalizer.from_vec_normalize(env))
    assert not list(tmp_path.iterdir())
    export_learner(model, tmp_path / "learner.pt", DeploymentNormalizer.from_vec_normalize(env, ["partial", "proprio"]))


def test_a_normalizer_of_what_the_policy_read_raw_is_refused(tmp_path):
    env = VecNormalize(DummyVecEnv([lambda: Sampled(SEVERAL)]), norm_obs_keys=["partial"])
    other = VecNormalize(DummyVecEnv([lambda: Sampled(SEVERAL)]))
    model = _reads_two(env).learn(20)
    with pytest.raises(ValueError, match=r"normalizer changes \['proprio'\], but the policy learned from them as the env"):
        export_learner(model, tmp_path / "learner.pt", DeploymentNormalizer.from_vec_normalize(other, ["partial", "proprio"]))


def test_statistics_of_another_training_are_refused(tmp_path):
    """Of the model's environments, or given, or in a file: what the policy sees would be on another scale."""
    env = VecNormalize(DummyVecEnv([lambda: Sampled(SEVERAL)]))
    model = _reads_two(env).learn(20)
    model.save(tmp_path / "model")
    env.save(str(tmp_path / "right.pkl"))
    fresh = VecNormalize(DummyVecEnv([lambda: Sampled(SEVERAL)]))
    fresh.obs_rms["partial"].mean += 5
    fresh.save(str(tmp_path / "wrong.pkl"))
    other = DeploymentNormalizer.from_vec_normalize(fresh, ["partial", "proprio"])
    loaded = type(model).load(tmp_path / "model", env=fresh, device="cpu")
    said = r'other statistics of "partial" than the VecNormalize that the model was trained with'
    for one, given in ((loaded, None), (model, other)):
        with pytest.raises(ValueError, match=said):
            export_learner(one, tmp_path / "learner.pt", given)
    with pytest.raises(SystemExit, match=f"--vec-normalize: .*wrong.pkl has {said}"):
        export([str(tmp_path / "model.zip"), str(tmp_path / "learner.pt"), "--vec-normalize", str(tmp_path / "wrong.pkl")])
    assert not (tmp_path / "learner.pt").exists()
    export_learner(model, tmp_path / "learner.pt")


def test_a_memory_is_exported_without_torchs_warning_of_other_batch_sizes(tmp_path):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        export_learner(WITH_MEMORY["recurrent"](), tmp_path / "learner.onnx", verify_on=4)
    assert not [warning for warning in told if "batch_size other than 1" in str(warning.message)]
