"""Flat parameters: one tensor and its views, through everything that may part them."""

from copy import deepcopy

import pytest
import torch as th
from torch import nn

from sb3_gac.optim.flat import FlatAdam, FlatParameters
from tests.helpers import small_model


@pytest.fixture
def network():
    th.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 2))


def _joined(tensors):
    return th.cat([tensor.detach().flatten() for tensor in tensors])


@pytest.mark.parametrize("optimizer_class", [th.optim.Adam, FlatAdam])
def test_an_optimiser_of_the_flat_parameter_does_what_one_of_all_parameters_does(network, optimizer_class):
    twin = deepcopy(network)
    flat = FlatParameters(list(network.parameters()))
    ours = optimizer_class([flat.flat], lr=0.01, weight_decay=0.1)
    theirs = th.optim.Adam(twin.parameters(), lr=0.01, weight_decay=0.1)
    for _ in range(5):
        x = th.randn(8, 3)
        flat.flat.grad, norm = flat.gradient(network(x).square().sum(), max_norm=0.5)
        ours.step()
        theirs.zero_grad()
        twin(x).square().sum().backward()
        expected = nn.utils.clip_grad_norm_(twin.parameters(), 0.5)
        theirs.step()
        th.testing.assert_close(norm, expected)
        for p, q in zip(network.parameters(), twin.parameters(), strict=True):
            th.testing.assert_close(p, q)


def test_the_gradient_is_that_of_these_parameters_alone_and_zero_where_there_is_none(network):
    first, last = network[0], network[2]
    flat = FlatParameters(list(last.parameters()))
    gradient, _ = flat.gradient((last.weight * th.arange(8.0).view(2, 4)).sum(), max_norm=None)
    assert gradient.tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 0, 0]
    assert all(p.grad is None for p in (*first.parameters(), *last.parameters()))


@pytest.mark.parametrize(("max_norm", "expected"), [(2.5, [1.5, 2.0]), (10.0, [3.0, 4.0]), (None, [3.0, 4.0])])
def test_clipping_scales_to_the_bound_and_never_up(max_norm, expected):
    flat = FlatParameters([nn.Parameter(th.zeros(2))])
    gradient, norm = flat.gradient((flat.parameters[0] * th.tensor([3.0, 4.0])).sum(), max_norm)
    assert norm.item() == pytest.approx(5.0)
    assert gradient.tolist() == pytest.approx(expected, rel=1e-6)


def _moved(network):
    network.double().float()


def _assigned(network):
    nn.utils.vector_to_parameters(th.arange(26.0), network.parameters())


@pytest.mark.parametrize("part", [_moved, _assigned])
def test_starts_again_from_the_parameters_when_they_have_been_parted(network, part):
    flat = FlatParameters(list(network.parameters()))
    parameter = flat.flat
    part(network)
    before = _joined(network.parameters())
    flat.refresh()
    assert flat.flat is parameter, "an optimiser holds it"
    assert th.equal(flat.flat, before)
    with th.no_grad():
        flat.flat.add_(1)
    assert th.equal(_joined(network.parameters()), before + 1)


def test_refresh_changes_nothing_where_nothing_was_parted(network):
    flat = FlatParameters(list(network.parameters()))
    storage = flat.flat.data_ptr()
    flat.refresh()
    assert flat.flat.data_ptr() == storage


def test_parameters_of_several_dtypes_are_refused():
    with pytest.raises(ValueError, match="one dtype"):
        FlatParameters([nn.Parameter(th.zeros(2)), nn.Parameter(th.zeros(2, dtype=th.float64))])


def test_a_copied_policy_trains_on(network):
    """A deep copy parts parameters and flat tensors; the next round of training joins them."""
    model = small_model(learning_starts=1000)
    model.learn(64)
    model.policy = deepcopy(model.policy)
    before = {name: p.detach().clone() for name, p in model.policy.named_parameters()}
    model.train(1, 16)
    for name in (
        "learner.head.mean.weight",
        "guider.head.mean.bias",
        "learner_critic.output.bias",
        "guider_critic_target.output.bias",
    ):
        assert not th.equal(before[name], model.policy.get_parameter(name)), name


def _after_steps(optimizer, parameter, gradients):
    for gradient in gradients:
        parameter.grad = gradient.clone()
        optimizer.step()
    return parameter.detach()


@pytest.mark.parametrize("options", [{}, {"betas": (0.5, 0.9), "eps": 0.1}, {"amsgrad": True}, {"maximize": True}])
def test_flat_adam_is_adam_to_the_bit_and_goes_on_from_its_state(options):
    gradients = th.randn(6, 5, generator=th.Generator().manual_seed(0))
    ours, theirs = (nn.Parameter(th.ones(5)) for _ in range(2))
    flat = FlatAdam([ours], lr=0.1, **options)
    adam = th.optim.Adam([theirs], lr=0.1, fused=True, **options)
    assert th.equal(_after_steps(flat, ours, gradients[:3]), _after_steps(adam, theirs, gradients[:3]))
    again = FlatAdam([ours], lr=0.1, **options)
    again.load_state_dict(deepcopy(adam.state_dict()))
    for optimizer in (again, adam):  # as a schedule does
        optimizer.param_groups[0]["lr"] = 0.01
    assert th.equal(_after_steps(again, ours, gradients[3:]), _after_steps(adam, theirs, gradients[3:]))
