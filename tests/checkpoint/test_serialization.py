"""Values as JSON and arrays, and back."""

import json
from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from sb3_gac.checkpoint.serialization import UntrustedNameError, decode, encode

ARRAYS = hnp.arrays(st.sampled_from([np.float32, np.float64, np.uint8, np.int64, np.bool_]), hnp.array_shapes(min_dims=0))
LEAVES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | ARRAYS
VALUES = st.recursive(
    LEAVES, lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text(), inner), max_leaves=8
)


def _there_and_back(value):
    arrays = {}
    return decode(json.loads(json.dumps(encode(value, arrays))), arrays)


@given(VALUES)
def test_values_come_back(value):
    back = _there_and_back(value)
    np.testing.assert_equal(back, value)
    assert type(back) is type(value)


def test_scalars_deques_and_generators_come_back():
    generator = np.random.default_rng(3)
    generator.standard_normal(5)
    scalar, kept, again = _there_and_back((np.float32(0.1), deque([{"r": 1.0}], maxlen=4), generator))
    assert (type(scalar), scalar) == (np.float32, np.float32(0.1))
    assert kept == deque([{"r": 1.0}], maxlen=4)
    assert kept.maxlen == 4
    assert again.standard_normal() == generator.standard_normal()


def test_classes_and_objects_of_trusted_libraries_come_back():
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2))
    np.random.seed(0)
    noise()
    kind, schedule, same = _there_and_back([nn.ReLU, LinearSchedule(1.0, 0.1, 0.5), noise])
    assert kind is nn.ReLU
    assert schedule(0.75) == LinearSchedule(1.0, 0.1, 0.5)(0.75)
    np.random.seed(1)
    expected = noise()
    np.random.seed(1)
    np.testing.assert_array_equal(same(), expected)


class Mine:
    pass


OTHERS = {"class": Mine, "object": Mine(), "function": lambda x: x, "keys": {1: 2}, "array": np.array([None])}


@pytest.mark.parametrize("value", OTHERS.values(), ids=OTHERS)
def test_what_is_of_other_libraries_is_named(value):
    with pytest.raises((UntrustedNameError, TypeError)):
        encode(value, {})


def test_a_class_under_the_name_of_another_one_is_not_taken_for_it():
    """What a file names must be what comes back."""
    named_alike = type("ReLU", (), {"__module__": nn.ReLU.__module__, "__qualname__": "ReLU"})
    assert _there_and_back(nn.ReLU) is nn.ReLU
    for value in (named_alike, named_alike()):
        with pytest.raises(UntrustedNameError, match="ReLU is not what is found under that name"):
            encode(value, {})


@pytest.mark.parametrize("name", ["os:system", "subprocess:Popen", "builtins:eval", "torch:load", "numpy:nothing"])
@pytest.mark.parametrize("kind", ["class", "object"])
def test_a_file_cannot_name_what_is_not_a_class_of_a_trusted_library(name, kind):
    with pytest.raises(UntrustedNameError, match=name):
        decode({kind: name, "state": {"dict": {}}}, {})


def test_a_module_cannot_be_reached_through_a_trusted_one():
    with pytest.raises(UntrustedNameError):
        decode({"object": "sb3_gac.envs.state:gym.sys.modules", "state": {"dict": {}}}, {})
