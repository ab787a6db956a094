"""The critic ensemble and the encoders are what plain torch layers and SB3's encoders would be."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor

from sb3_gac.common.networks import CriticEnsemble, EnsembleLinear, VectorExtractor, polyak_average
from tests.helpers import small_model

SPACE = spaces.Dict(b=spaces.Box(-1, 1, (3,), np.float32), a=spaces.Box(-np.inf, np.inf, (2,), np.float32))


def _critics(n_critics=3):
    extractor = VectorExtractor(SPACE)
    actions = spaces.Box(-1, 1, (2,))
    return CriticEnsemble(SPACE, actions, [8, 6], extractor, extractor.features_dim, n_critics=n_critics)


def _member(critics, index):
    """One Q-network as plain torch layers."""
    layers = []
    for layer in critics.q_networks:
        if isinstance(layer, EnsembleLinear):
            plain = th.nn.Linear(*layer.weight.shape[1:])
            plain.weight.data = layer.weight[index].detach().T.clone()
            plain.bias.data = layer.bias[index, 0].detach().clone()
            layers.append(plain)
        else:
            layers.append(layer)
    return th.nn.Sequential(*layers)


def test_ensemble_is_so_many_separate_networks():
    critics = _critics()
    obs, actions = {"a": th.randn(5, 2), "b": th.randn(5, 3)}, th.rand(5, 2)
    q = critics(obs, actions)
    assert q.shape == (3, 5)
    x = th.cat([*(obs[key] for key in SPACE.spaces), actions], dim=-1)
    for index in range(3):
        th.testing.assert_close(q[index], _member(critics, index)(x)[:, 0])


def test_ensemble_members_start_different_and_within_torchs_bounds():
    weight = _critics().q_networks[2].weight
    assert not th.equal(weight[0], weight[1])
    assert weight.abs().max() <= 8**-0.5
    assert weight.abs().max() > 0.9 * 8**-0.5


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
