"""Observation entries of every kind and name: the numbers that networks get of them, and words for those they can't have."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gac import GAC, AsymmetricSAC, OnnxPolicy, export_learner
from sb3_gac.checks.entries import computable
from sb3_gac.networks.encoders import EntryExtractor, module_names
from tests.helpers import Sampled, TwoViewBandit, small_model
from tests.registry import classes

VECTOR = spaces.Box(-1, 1, (2,), np.float32)
IMAGE = spaces.Box(0, 255, (36, 37, 3), np.uint8)
KINDS = {
    "number": spaces.Box(-1, 1, (), np.float32),
    "matrix of float64": spaces.Box(-1, 1, (2, 3), np.float64),
    "half": spaces.Box(-1, 1, (2,), np.float16),
    "flags": spaces.Box(0, 1, (3,), bool),
    "lidar": spaces.Box(0, 1000, (4,), np.uint16),
    "wide": spaces.Box(0, 1000, (2,), np.uint32),
    "wider": spaces.Box(0, 1000, (2,), np.uint64),
    "bytes": spaces.Box(-128, 127, (2,), np.int8),
    "grey": spaces.Box(0, 255, (4, 5), np.uint8),
    "depth": spaces.Box(0, 1, (1, 4, 5), np.float32),
    "choice": spaces.Discrete(3),
    "choice from 1": spaces.Discrete(4, start=1),
    "choice from -2": spaces.Discrete(3, start=-2),
    "choices": spaces.MultiDiscrete([2, 3]),
    "choices from": spaces.MultiDiscrete([3, 4], start=[1, -2]),
    "table": spaces.MultiDiscrete([[3, 4], [2, 2]], start=[[5, 0], [-1, 2]]),
    "bits": spaces.MultiBinary((2, 2)),
}
ALL = spaces.Dict(partial=VECTOR, privileged=VECTOR, **{name.replace(" ", "_"): space for name, space in KINDS.items()})
READS_ALL = [key for key in ALL.spaces if key != "privileged"]
ALGORITHMS = classes("replay", "memory")


def _numbers(space, value):
    """What a network is to get of one value, by hand."""
    if isinstance(space, spaces.Discrete):
        return np.eye(space.n)[int(np.ravel(value)[0]) - space.start]
    if isinstance(space, spaces.MultiDiscrete):
        columns = zip(np.ravel(space.nvec), np.ravel(space.start), np.ravel(value), strict=True)
        return np.concatenate([np.eye(n)[v - start] for n, start, v in columns])
    return np.ravel(value).astype(np.float32)


def _features(observation, row):
    return np.concatenate([_numbers(ALL[key], observation[key][row]) for key in sorted(READS_ALL)])


def _model(cls=GAC, cell="", **arguments):
    roles = {cls.policy_aliases["MultiInputPolicy"].roles.deployed: READS_ALL}
    options = {"policy": f"MultiInput{cell}Policy", "buffer_size": 60, "batch_size": 4, "role_keys": roles}
    if cell:
        options["policy_kwargs"] = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]}
    return small_model(DummyVecEnv([lambda: Sampled(ALL)] * 2), cls, **options | arguments)


def _batch(n=4):
    ALL.seed(3)
    rows = [ALL.sample() for _ in range(n)]
    return {key: np.stack([row[key] for row in rows]) for key in ALL.spaces}


@pytest.mark.parametrize("cell", ["", "Gru"])
@pytest.mark.parametrize("cls", ALGORITHMS)
def test_every_kind_is_trained_on_saved_and_exported(cls, cell, tmp_path):
    model = _model(cls, cell).learn(24)
    assert model._n_updates > 0
    batch = {key: value for key, value in _batch().items() if key in READS_ALL}
    expected, _ = model.predict(batch, deterministic=True)
    for row in range(4):
        single, _ = model.predict({key: value[row] for key, value in batch.items()}, deterministic=True)
        np.testing.assert_allclose(single, expected[row], atol=1e-5)
    model.save(tmp_path / "model")
    np.testing.assert_allclose(cls.load(tmp_path / "model").predict(batch, deterministic=True)[0], expected, atol=1e-6)
    learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx", verify_on=8))
    np.testing.assert_allclose(learner.act(batch), expected, atol=1e-5)
    export_learner(model, tmp_path / "learner.pt", verify_on=8)


def test_networks_get_the_numbers_of_what_predict_is_given():
    policy, batch = _model().policy.deployed, _batch()
    features = policy.extract_features(policy.obs_to_tensor(batch)[0], policy.features_extractor)
    np.testing.assert_allclose(features.numpy(), [_features(batch, row) for row in range(4)], rtol=1e-6)


@pytest.mark.parametrize("cell", ["", "Gru"])
def test_networks_get_the_numbers_of_what_the_buffer_holds(cell):
    model = _model(cell=cell).learn(24)
    policy, buffer = model.policy.deployed, model.replay_buffer
    stored = {(env, tuple(buffer.observations["partial"][row, env])): (row, env) for env in range(2) for row in range(12)}
    observations = buffer.sample(6).observations
    features = policy.extract_features(observations, policy.features_extractor).flatten(0, -2).numpy()
    n_found = 0
    for place, partial in zip(features, observations["partial"].flatten(0, -2).numpy(), strict=True):
        for env in range(2):
            if (env, tuple(partial)) in stored:
                row, _ = stored[env, tuple(partial)]
                held = {key: values[row, env][None] for key, values in buffer.observations.items()}
                np.testing.assert_allclose(place, _features(held, 0), rtol=1e-6)
                n_found += 1
    assert n_found >= 6


def test_every_box_is_normalised_and_exported(tmp_path):
    boxes = {key: space for key, space in ALL.spaces.items() if isinstance(space, spaces.Box)}
    env = VecNormalize(DummyVecEnv([lambda: Sampled(spaces.Dict(ALL.spaces))]), norm_obs_keys=list(boxes))
    model = small_model(env, role_keys={"learner": READS_ALL}, buffer_size=60, batch_size=4).learn(20)
    learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx", verify_on=8))
    batch = _batch()
    expected, _ = model.predict(env.normalize_obs(batch), deterministic=True)
    np.testing.assert_allclose(learner.act({key: batch[key] for key in READS_ALL}), expected, atol=1e-5)


# --- names --------------------------------------------------------------------------------------------------------------

NAMES = [
    "type",
    "keys",
    "items",
    "training",
    "joint.pos",
    "joint_pos",
    "camera/front",
    "left arm",
    "state",
    "action",
    "1",
    "ü",
]
NAMES += ["low", "mean_0", "policy.head.mean.bias", "onnx::Gemm_1", "__class__"]


def test_entries_of_any_name_beside_an_image(tmp_path):
    """All at once: none is taken for another, in training, in a saved model and in a file."""
    space = spaces.Dict({"partial": VECTOR, "front.image": IMAGE, **dict.fromkeys(NAMES, VECTOR)})
    env = VecNormalize(DummyVecEnv([lambda: Sampled(space)]), norm_obs_keys=["low", "1"])
    options = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}}
    model = small_model(env, role_keys={"learner": list(space.spaces)}, buffer_size=60, policy_kwargs=options).learn(14)
    model.save(tmp_path / "model")
    learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx", verify_on=8))
    assert [entry["name"] for entry in learner.metadata["entries"]] == list(space.spaces)
    assert {value.name for value in learner._session.get_inputs()} == set(space.spaces)
    observation = {key: value[None] for key, value in space.sample().items()}
    observation["front.image"] = observation["front.image"].transpose(0, 3, 1, 2)
    seen = env.normalize_obs(observation)
    expected, _ = model.predict(seen, deterministic=True)
    for other in (GAC.load(tmp_path / "model").predict(seen, deterministic=True)[0], learner.act(observation)):
        np.testing.assert_allclose(other, expected, atol=1e-5)
    for name in NAMES:
        changed, _ = model.predict({**seen, name: -seen[name]}, deterministic=True)
        assert not np.array_equal(changed, expected)
        if name not in env.norm_obs_keys:
            np.testing.assert_allclose(learner.act({**observation, name: -observation[name]}), changed, atol=1e-5)


def test_module_names_are_the_entries_own_where_they_can_be():
    """So that models saved with SB3's encoder are read."""
    assert module_names(["partial", "camera/front", "1"]) == {key: key for key in ("partial", "camera/front", "1")}
    assert module_names(["a.b", "a_b", "a.b_", "type", "type_"]) == {
        "a.b": "a_b_",
        "a_b": "a_b",
        "a.b_": "a_b__",
        "type": "type__",
        "type_": "type_",
    }


def test_the_encoder_is_sb3s_for_ordinary_names():
    space = spaces.Dict(camera=spaces.Box(0, 255, (3, 36, 37), np.uint8), gear=spaces.Discrete(3), partial=VECTOR)
    theirs, ours = CombinedExtractor(space, 8), EntryExtractor(space, 8)
    ours.load_state_dict(theirs.state_dict())
    assert ours.features_dim == theirs.features_dim == 8 + 3 + 2
    values = {"camera": th.rand(5, 3, 36, 37), "gear": th.eye(3)[:, None][[0, 1, 2, 0, 1]], "partial": th.rand(5, 2)}
    assert th.equal(ours(values), theirs(values))


# --- what is refused ----------------------------------------------------------------------------------------------------

REFUSED = {
    "text": (spaces.Text(3), "its space is Text. Encode it"),
    "sequence": (spaces.Sequence(VECTOR), "its space is Sequence. Pad it"),
    "graph": (spaces.Graph(VECTOR, None), "its space is Graph. Pad nodes"),
    "tuple": (spaces.Tuple([VECTOR]), "its space is Tuple. Make each of its parts an entry"),
    "dict": (spaces.Dict(a=VECTOR), "its space is Dict. Make each of its parts an entry"),
    "one of": (spaces.OneOf([VECTOR, spaces.Discrete(2)]), "its space is OneOf. Make each of its choices"),
    "empty": (spaces.Box(-1, 1, (0,), np.float32), r"its shape is \(0,\), so that it holds no number. Leave it out"),
    "no rows": (spaces.Box(-1, 1, (3, 0), np.float32), r"its shape is \(3, 0\), so that it holds no number"),
    "long": (spaces.Box(-1, 1, (2,), np.longdouble), "its type is float128, which torch lacks. Make it float64"),
}


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("kind", REFUSED)
def test_other_kinds_are_refused_by_name(kind, cls):
    space, message = REFUSED[kind]
    with pytest.raises(ValueError, match=f'entry "odd one" can\'t be learned from: {message}'):
        small_model(Sampled(spaces.Dict({"partial": VECTOR, "odd one": space})), cls, **dict.fromkeys(cls.frozen_arguments))


@pytest.mark.parametrize("name", ["", 3])
def test_an_entry_needs_a_name(name):
    with pytest.raises(ValueError, match=f"has an entry named {name!r}: name it by a string"):
        small_model(Sampled(spaces.Dict({"partial": VECTOR, name: VECTOR})))


@pytest.mark.parametrize("shape", [(16, 40, 3), (40, 35, 1)])
@pytest.mark.parametrize("role", ["learner", "guider"])
def test_an_image_that_is_too_small_is_named(shape, role):
    space = spaces.Dict(partial=VECTOR, camera=spaces.Box(0, 255, shape, np.uint8))
    roles = {"learner": ["partial", "camera"]} if role == "learner" else None
    message = (
        rf'entry "camera" is an image of {shape[0]} x {shape[1]} pixels, .* needs 36 x 36 at least.*features_extractor_class'
    )
    with pytest.raises(ValueError, match=message):
        small_model(Sampled(space), role_keys=roles)


def test_the_smallest_image_works():
    space = spaces.Dict(partial=spaces.Box(0, 255, (36, 36, 1), np.uint8), privileged=VECTOR)
    assert small_model(Sampled(space), batch_size=4, buffer_size=60).learn(14)._n_updates > 0


@pytest.mark.parametrize("entry", ["number", "table"])
@pytest.mark.parametrize("buffer_class", [DictReplayBuffer, HerReplayBuffer])
def test_what_sb3s_buffers_cannot_hold_is_named(entry, buffer_class):
    space = spaces.Dict({"partial": VECTOR, entry: KINDS[entry]})
    with pytest.raises(ValueError, match=f"{buffer_class.__name__} can't hold the observation's entry \"{entry}\" of shape"):
        small_model(Sampled(space), replay_buffer_class=buffer_class)
    small_model(
        Sampled(spaces.Dict(partial=VECTOR, choice=KINDS["choice from 1"])), replay_buffer_class=DictReplayBuffer
    ).learn(14)


def test_gymnasiums_vector_environments_are_told_apart():
    for make in (gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv):
        envs = make([TwoViewBandit] * 2)
        for give in (small_model, small_model().set_env):
            with pytest.raises(ValueError, match=rf"vector environments \({make.__name__}\).*make_vec_env"):
                give(envs)
        envs.close()


# --- predict ------------------------------------------------------------------------------------------------------------

MIXED = spaces.Dict(
    partial=VECTOR, camera=IMAGE, gear=spaces.Discrete(3, start=1), modes=spaces.MultiDiscrete([2, 2]), level=KINDS["bytes"]
)
PICTURE = np.random.default_rng(0).integers(0, 256, IMAGE.shape, dtype=np.uint8)
GIVEN = {
    "partial": np.float32([0.5, 0.2]),
    "camera": PICTURE,
    "gear": np.int64(1),
    "modes": np.array([0, 1]),
    "level": np.int8([3, 4]),
}


@pytest.fixture(scope="module")
def reads_all():
    """A model without and one with a memory, which both read entries of several kinds."""
    small = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}}
    roles = {"role_keys": {"learner": list(MIXED.spaces)}, "buffer_size": 20}
    recurrent = {**small, "rnn_hidden_size": 8}
    return [
        small_model(Sampled(MIXED), policy_kwargs=small, **roles),
        small_model(Sampled(MIXED), policy="MultiInputGruPolicy", policy_kwargs=recurrent, **roles),
    ]


SAME = {
    "lists": {"partial": [0.5, 0.2], "modes": [0, 1], "level": [3, 4]},
    "numbers of Python's": {"gear": 1},
    "tensors": {key: th.as_tensor(value) for key, value in GIVEN.items()},
    "float64": {"partial": np.float64([0.5, 0.2])},
    "float128": {"partial": np.longdouble([0.5, 0.2])},
    "big-endian": {"partial": np.array([0.5, 0.2], dtype=">f4"), "gear": np.array(1, dtype=">i2")},
    "other integers": {"camera": PICTURE.astype(np.int32), "gear": np.uint8(1), "level": np.int64([3, 4])},
    "whole numbers as floats": {"gear": 1.0, "modes": np.float32([0, 1]), "level": np.float32([3, 4])},
    "channels first": {"camera": PICTURE.transpose(2, 0, 1)},
    "backwards": {"camera": PICTURE[::-1].copy()[::-1], "partial": np.float32([0.2, 0.5])[::-1]},
    "more entries": {"torque": np.array([np.nan]), "remark": "none"},
}


@pytest.mark.parametrize("way", SAME)
def test_whatever_holds_the_numbers_the_action_is_the_same(way, reads_all):
    for model in reads_all:
        expected, _ = model.predict(GIVEN, deterministic=True)
        actual, _ = model.predict(GIVEN | SAME[way], deterministic=True)
        assert actual.shape == expected.shape == (1,)
        np.testing.assert_allclose(actual, expected, atol=1e-6)


@pytest.mark.parametrize("layout", [(0, 1, 2, 3), (0, 3, 1, 2)])
def test_batches_are_read_row_by_row(layout, reads_all):
    batch = {key: np.stack([value, value // 2 if key in ("camera", "level") else value]) for key, value in GIVEN.items()}
    for model in reads_all:
        expected = [
            model.predict({key: value[row] for key, value in batch.items()}, deterministic=True)[0] for row in range(2)
        ]
        actual, _ = model.predict(batch | {"camera": batch["camera"].transpose(layout)}, deterministic=True)
        np.testing.assert_allclose(actual, expected, atol=1e-5)


WRONG = {
    "NaN": ({"partial": np.float32([np.nan, 1])}, 'entry "partial" holds NaN or infinite'),
    "infinite": ({"partial": [1.0, -np.inf]}, 'entry "partial" holds NaN or infinite'),
    "too large": ({"partial": np.array([1e300, 0])}, 'entry "partial" holds values that float32 can\'t hold'),
    "NaN for an integer": ({"level": [np.nan, 1]}, 'entry "level" holds NaN'),
    "too long": ({"partial": np.zeros(3)}, r'entry "partial" has shape \(3,\), expected \(2,\), or \(B, ...\) of it'),
    "too deep": ({"partial": np.zeros((1, 1, 2))}, r'entry "partial" has shape \(1, 1, 2\)'),
    "text": ({"partial": "far"}, 'entry "partial" is of type str, expected numbers of type float32'),
    "nothing": ({"partial": None}, 'entry "partial" is of type NoneType'),
    "ragged": ({"partial": [[1.0], [1.0, 2.0]]}, 'entry "partial" is not an array'),
    "float image": ({"camera": PICTURE / 255}, 'entry "camera" is an image of type float64, expected bytes from 0 to 255'),
    "black float image": ({"camera": PICTURE * np.float32(0)}, 'entry "camera" is an image of type float32'),
    "NaN image": ({"camera": PICTURE * np.nan}, 'entry "camera" holds NaN'),
    "mask": ({"camera": PICTURE > 99}, 'entry "camera" is an image of type bool'),
    "bright image": ({"camera": PICTURE.astype(int) + 1}, 'entry "camera" has type int64 and values that the expected uint8'),
    "other image": ({"camera": PICTURE[:, :36]}, r'entry "camera" has shape \(36, 36, 3\), expected \(3, 36, 37\)'),
    "gear too high": ({"gear": 4}, r'entry "gear" holds 4, which is not in Discrete\(3, start=1\)'),
    "gear too low": ({"gear": 0}, 'entry "gear" holds 0, which is not in'),
    "half a gear": ({"gear": 1.5}, 'entry "gear" has type float64 and values that the expected int64'),
    "no such mode": ({"modes": [0, 2]}, 'entry "modes" holds 2, which is not in MultiDiscrete'),
    "level too high": ({"level": [3, 400]}, 'entry "level" has type int64 and values that the expected int8'),
    "partial batched": ({"partial": np.zeros((1, 2))}, 'entries must each be one by itself, .*"partial" a batch of 1'),
    "gear batched": ({"gear": [1]}, '"gear" a batch of 1'),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_does_not_fit_is_named(wrong, reads_all):
    changed, message = WRONG[wrong]
    for model in reads_all:
        for ask in (model.predict, model.predict_guider):
            with pytest.raises(ValueError, match=message):
                ask(GIVEN | changed)


def test_batches_of_several_sizes_are_named(reads_all):
    batch = {key: np.stack([value] * 3) for key, value in GIVEN.items()}
    for model in reads_all:
        with pytest.raises(ValueError, match=r'"camera" a batch of 2, .*"partial" a batch of 3'):
            model.predict(batch | {"camera": batch["camera"][:2]})


def test_what_reset_returns_is_told_apart(reads_all):
    for model in [*reads_all, small_model(), small_model(cls=AsymmetricSAC)]:
        with pytest.raises(ValueError, match=r"reset\(\)"):
            model.predict(model.get_env().envs[0].reset())


def test_the_guider_names_what_it_lacks(reads_all):
    for model in reads_all:
        with pytest.raises(ValueError, match=r"predict_guider\(\) lacks \['gear'\], which the guider reads"):
            model.predict_guider({key: value for key, value in GIVEN.items() if key != "gear"})
        with pytest.raises(ValueError, match=r"guider reads \[.*'gear'.*pass predict_guider\(\) a dict"):
            model.predict_guider(GIVEN["partial"])


def test_the_learner_on_the_robot_refuses_choices_that_there_are_not(tmp_path):
    space = spaces.Dict(partial=VECTOR, gear=KINDS["choice from 1"], table=KINDS["table"], lidar=KINDS["lidar"])
    model = small_model(Sampled(space), role_keys={"learner": list(space.spaces)}, buffer_size=20)
    learner = OnnxPolicy.load(export_learner(model, tmp_path / "learner.onnx", verify_on=8))
    said = {entry["name"]: entry for entry in learner.metadata["entries"]}
    assert (said["gear"]["smallest"], said["gear"]["largest"], said["gear"]["n"]) == (1, 4, 4)
    assert (said["table"]["smallest"], said["table"]["largest"]) == ([[5, 0], [-1, 2]], [[7, 3], [0, 3]])
    assert (said["lidar"]["dtype"], said["lidar"]["high"]) == ("int32", [1000] * 4)
    given = space.sample()
    np.testing.assert_allclose(learner.act(given), model.predict(given, deterministic=True)[0], atol=1e-5)
    for changed, message in (
        ({"gear": 0}, 'entry "gear" holds values that are not from 1 to 4: 0'),
        ({"gear": 5}, 'entry "gear" holds values that are not from 1 to 4: 5'),
        ({"table": space["table"].start - 1}, 'entry "table" holds values that are not from'),
        ({"lidar": np.full(4, 2**40)}, 'entry "lidar" holds values that its type int32'),
    ):
        with pytest.raises(ValueError, match=message):
            learner.act(given | changed)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32, np.int8, np.int64, np.float16, np.bool_])
def test_what_torch_computes_with_holds_the_same_numbers(dtype):
    """The largest one above all."""
    info = None if dtype is np.bool_ else (np.finfo if np.issubdtype(dtype, np.floating) else np.iinfo)(dtype)
    values = np.array([0, 1] if info is None else [info.min, 0, info.max], dtype)
    assert th.as_tensor(computable(values)).tolist() == values.tolist()
