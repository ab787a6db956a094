"""The adaptation module: its layers, what it remembers while acting, and its estimate, number by number in float64."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_gac.networks.adaptation import Adaptation

BOX, CHOICE = spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(3)
F, L = 4, 5


def _convolutions(module):
    return [(layer.kernel_size[0], layer.stride[0]) for layer in module.over_time if isinstance(layer, nn.Conv1d)]


@pytest.mark.parametrize(
    ("length", "convolutions", "left"),
    [
        (50, [(9, 2), (5, 1), (5, 1)], 13),
        (25, [(9, 2), (5, 1), (5, 1)], 1),
        (13, [(9, 2)], 3),
        (8, [(5, 1)], 4),
        (5, [(5, 1)], 1),
        (4, [], 4),
        (1, [], 1),
    ],
)
def test_convolutions_are_the_papers_as_far_as_the_history_is_long_enough(length, convolutions, left):
    module = Adaptation(F, BOX, length, L)
    assert _convolutions(module) == convolutions
    assert module.output.weight.shape == (L, 32 * left)
    assert module.state_size == length * (F + 2)
    assert module.estimate(th.randn(7, module.state_size)).shape == (7, L)


def _numbers(layer):
    return layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()


def _silu(x):
    return x / (1 + np.exp(-x))


def _convolved(x, layer):
    """Over time, one window after the other: x of shape (T, channels)."""
    (weight, bias), size, stride = _numbers(layer), layer.kernel_size[0], layer.stride[0]
    windows = [x[start : start + size].T for start in range(0, len(x) - size + 1, stride)]
    return np.stack([(weight * window).sum(axis=(1, 2)) + bias for window in windows])


def _estimate(module, pairs):
    """Of one history, shape (K, F + A), the oldest first."""
    x = pairs.astype(np.float64)
    for layer in (module.per_pair[0], module.per_pair[2]):
        weight, bias = _numbers(layer)
        x = _silu(x @ weight.T + bias)
    for layer in module.over_time:
        x = _convolved(x, layer) if isinstance(layer, nn.Conv1d) else _silu(x)
    weight, bias = _numbers(module.output)
    return weight @ x.T.ravel() + bias  # channels first


@pytest.mark.parametrize("length", [50, 7, 1])
def test_the_estimate_is_that_of_the_layers_one_after_the_other(length):
    module = Adaptation(F, BOX, length, L)
    pairs = np.random.default_rng(0).standard_normal((3, length, F + 2)).astype(np.float32)
    actual = module.estimate(th.as_tensor(pairs.reshape(3, -1))).detach()
    np.testing.assert_allclose(actual, [_estimate(module, own) for own in pairs], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("space", [BOX, CHOICE])
@pytest.mark.parametrize("length", [1, 3])
def test_acting_step_by_step_leaves_what_the_last_pairs_are(space, length):
    """In two environments, the second of which has begun an episode two steps ago."""
    module, rng, steps, began = Adaptation(F, space, length, L), np.random.default_rng(0), 6, [0, 4]
    features = th.as_tensor(rng.standard_normal((steps, 2, F)), dtype=th.float32)
    if space is BOX:
        actions = th.as_tensor(rng.uniform(-1, 1, (steps, 2, 2)), dtype=th.float32)
    else:
        actions = th.as_tensor(rng.integers(3, size=(steps, 2)))
    state = None
    for step in range(steps):
        before = module.state_before(state, np.array([step == first for first in began]), 2)
        outputs, after = module(features[step][None], before)
        th.testing.assert_close(outputs[0, 0, :, :F], features[step])
        th.testing.assert_close(outputs[0, 0, :, F:], module.estimate(before[0]))
        module.with_action(after[0], actions[step])  # what was said of another action before does not count
        state = module.with_action(after[0], actions[step]).numpy()
    last = slice(steps - length, steps)
    mask = th.as_tensor([[float(step >= first) for first in began] for step in range(steps)])
    taken = actions if space is BOX else actions[..., None]
    expected = module.state_of(features[last], taken[last], mask[last])
    assert np.array_equal(state, expected.numpy())
    pair = [*features[-1, 0], *(actions[-1, 0] if space is BOX else np.eye(3)[actions[-1, 0]])]
    np.testing.assert_allclose(state[0, -module.pair_dim :], np.array(pair, np.float32))
    assert not state[1].reshape(length, -1)[: max(length - 2, 0)].any(), "zeros before the episode"


def test_what_was_before_an_episode_counts_for_nothing_whatever_it_holds():
    module = Adaptation(F, BOX, 3, L)
    features, actions, mask = th.randn(3, 2, F), th.randn(3, 2, 2), th.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    features[0] = th.nan
    assert not module.state_of(features, actions, mask).isnan().any()


def test_it_begins_with_nothing_and_goes_on_with_what_it_is_given():
    module = Adaptation(F, BOX, 3, L)
    features = th.randn(1, 2, F)
    outputs, after = module(features)
    th.testing.assert_close(outputs[0, 0, :, F:], module.estimate(th.zeros(2, module.state_size)))
    assert not th.allclose(module(features, after)[0], outputs)
