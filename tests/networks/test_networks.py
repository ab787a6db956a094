"""The critic ensemble and the encoders are what plain torch layers and SB3's encoders would be."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor

from sb3_gac.networks.critics import CriticEnsemble
from sb3_gac.networks.encoders import VectorExtractor
from sb3_gac.networks.layers import EnsembleLinear
from sb3_gac.optim.polyak import polyak_average
from tests.helpers import Sampled, small_model

SPACE = spaces.Dict(b=spaces.Box(-1, 1, (3,), np.float32), a=spaces.Box(-np.inf, np.inf, (2,), np.float32))


def _critics(net_arch, n_critics=3):
    extractor = VectorExtractor(SPACE)
    return CriticEnsemble(SPACE, spaces.Box(-1, 1, (2,)), net_arch, extractor, extractor.features_dim, n_critics=n_critics)


def _linear(weight, bias):
    """A plain torch layer from weights of shape (in, out)."""
    layer = th.nn.Linear(*weight.shape)
    layer.weight.data, layer.bias.data = weight.detach().T.clone(), bias.detach().clone()
    return layer


def _member(critics, index):
    """One Q-network as plain torch layers."""
    layers = []
    if critics.input is not None:
        weight = th.cat([critics.input.features_weight[index], critics.input.actions_weight[index]])
        layers.append(_linear(weight, critics.input.bias[index, 0]))
    for layer in critics.hidden:
        is_linear = isinstance(layer, EnsembleLinear)
        layers.append(_linear(layer.weight[index], layer.bias[index, 0]) if is_linear else layer)
    return th.nn.Sequential(*layers, _linear(critics.output.weight[index].T, critics.output.bias[index]))


@pytest.mark.parametrize("net_arch", [[8, 6], [8], []])
def test_ensemble_is_so_many_separate_networks(net_arch):
    """Values, and gradients with respect to actions."""
    critics = _critics(net_arch)
    obs, actions = {"a": th.randn(5, 2), "b": th.randn(5, 3)}, th.rand(5, 2, requires_grad=True)
    q = critics(obs, actions)
    assert q.shape == (3, 5)
    x = th.cat([*(obs[key] for key in SPACE.spaces), actions], dim=-1)
    plain = th.stack([_member(critics, index)(x)[:, 0] for index in range(3)])
    th.testing.assert_close(q, plain)
    gradients = [th.autograd.grad(values.square().sum(), actions)[0] for values in (q, plain)]
    th.testing.assert_close(*gradients)


@pytest.mark.parametrize("net_arch", [[8, 6], [8], []])
def test_several_actions_of_each_observation_are_valued_as_if_they_came_one_by_one(net_arch):
    """Of observations and of sequences of them; and their gradients."""
    critics = _critics(net_arch)
    for leading in ((5,), (4, 5)):
        obs, actions = {"a": th.randn(*leading, 2), "b": th.randn(*leading, 3)}, th.rand(7, *leading, 2, requires_grad=True)
        q = critics(obs, actions)
        assert q.shape == (3, 7, *leading)
        one_by_one = th.stack([critics(obs, each) for each in actions], dim=1)
        th.testing.assert_close(q, one_by_one)
        gradients = [th.autograd.grad(values.square().sum(), actions)[0] for values in (q, one_by_one)]
        th.testing.assert_close(*gradients)


def test_the_observations_part_of_the_first_layer_is_computed_once_for_all_their_actions(monkeypatch):
    critics, products = _critics([8]), []
    bmm = th.bmm
    monkeypatch.setattr(th, "bmm", lambda x, weight: products.append(x.shape) or bmm(x, weight))
    critics({"a": th.randn(5, 2), "b": th.randn(5, 3)}, th.rand(7, 5, 2))
    assert products == [(3, 5, 5), (3, 35, 2)]


def test_ensemble_members_start_different_and_within_torchs_bounds():
    critics = _critics([64, 64])
    first = (critics.input.features_weight, critics.input.actions_weight, critics.input.bias)
    weights = [(5 + 2, first), (64, (critics.hidden[1].weight, critics.output.weight))]
    for in_features, tensors in weights:
        for weight in tensors:
            assert not th.equal(weight[0], weight[1])
            assert 0.8 * in_features**-0.5 < weight.abs().max() <= in_features**-0.5


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
def test_vectors_are_joined_as_sb3_joins_them(dtype):
    obs = {"a": th.randn(5, 2, dtype=dtype), "b": th.randn(5, 3, dtype=dtype)}
    expected = CombinedExtractor(SPACE)({key: value.float() for key, value in obs.items()})
    actual = VectorExtractor(SPACE)(obs)
    assert actual.dtype == th.float32
    assert th.equal(actual, expected)


@pytest.mark.parametrize(
    "entry",
    [spaces.Box(0, 255, (2, 2), np.uint8), spaces.Discrete(3), spaces.Box(-1, 1, (2, 2)), spaces.Box(-1, 1, (2,), np.float64)],
    ids=str,
)
def test_other_entries_go_through_sb3s_encoder(entry):
    assert VectorExtractor.fits(SPACE)
    assert not VectorExtractor.fits(spaces.Dict(a=SPACE["a"], b=entry))


def test_a_user_who_asks_for_an_encoder_gets_it():
    class Mine(CombinedExtractor):
        pass

    model = small_model(policy_kwargs={"features_extractor_class": Mine})
    assert isinstance(model.policy.learner.features_extractor, Mine)


@pytest.mark.parametrize("tau", [0.0, 0.25, 1.0])
def test_polyak_average(tau):
    parameters, targets = [th.tensor([1.0, 2.0]), th.tensor([[4.0]])], [th.tensor([5.0, 6.0]), th.tensor([[0.0]])]
    polyak_average(parameters, targets, tau)
    assert targets[0].tolist() == pytest.approx([5 - 4 * tau, 6 - 4 * tau])
    assert targets[1].item() == pytest.approx(4 * tau)
    assert parameters[0].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    "first",
    [
        spaces.Discrete(3),
        spaces.Discrete(3, start=2),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(2),
        spaces.Box(-1, 1, (2, 3), np.float32),
        spaces.Box(-1, 1, (), np.float32),
    ],
    ids=str,
)
def test_a_network_without_a_memory_takes_sequences_step_by_step(first):
    """Policies and critics, whatever the kind of the entry that they see first."""
    space = spaces.Dict(partial=first, privileged=spaces.Box(-1, 1, (2,), np.float32))
    policy = small_model(Sampled(space)).policy
    shape = (1,) if isinstance(first, spaces.Discrete) else first.shape
    drawn = {key: np.stack([entry.sample() for _ in range(12)]) for key, entry in space.spaces.items()}
    flat = {"partial": th.as_tensor(drawn["partial"]).view(12, *shape), "privileged": th.as_tensor(drawn["privileged"])}
    sequence = {key: entry.unflatten(0, (4, 3)) for key, entry in flat.items()}
    actions = th.rand(12, 1)
    for role in ("learner", "guider"):
        outputs = zip(getattr(policy, role).distribution(sequence), getattr(policy, role).distribution(flat), strict=True)
        for at_once, one_by_one in outputs:
            th.testing.assert_close(at_once, one_by_one.unflatten(0, (4, 3)))
    q = policy.critic(sequence, actions.unflatten(0, (4, 3)))
    th.testing.assert_close(q, policy.critic(flat, actions).unflatten(1, (4, 3)))
