"""SB3's contract: batch normalisation and dropout in features extractors learn in training and nowhere else."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from tests.registry import LINES, algorithms, load, make, on_policy
from tests.sb3_contract.helpers import pendulum


class FlattenBatchNormDropoutExtractor(BaseFeaturesExtractor):
    """Concatenate all entries, then batch normalisation and dropout."""

    def __init__(self, observation_space):
        super().__init__(observation_space, get_flattened_obs_dim(observation_space))
        self.batch_norm = nn.BatchNorm1d(self.features_dim)
        self.dropout = nn.Dropout(0.5)

    def forward(self, observations):
        return self.dropout(self.batch_norm(th.cat([value.flatten(1) for value in observations.values()], dim=1)))


def _make(algorithm, **kwargs):
    policy_kwargs = {"features_extractor_class": FlattenBatchNormDropoutExtractor}
    return make(algorithm, pendulum(), policy_kwargs=policy_kwargs, seed=1, **LINES[algorithm].one_phase, **kwargs)


def _layers(model, kind):
    """Online name -> layer, target's name -> layer; what several networks hold is there once."""
    layers = {name: layer for name, layer in model.policy.named_modules() if isinstance(layer, kind)}
    targets = {name for name in layers if name.split(".")[0].endswith("_target")}
    return ({name: layer for name, layer in layers.items() if name not in targets}, {name: layers[name] for name in targets})


def _batch_norms(model):
    """The same as :func:`_layers`, with bias and running mean, cloned, in place of layers."""
    return tuple(
        {name: (layer.bias.clone(), layer.running_mean.clone()) for name, layer in layers.items()}
        for layers in _layers(model, nn.BatchNorm1d)
    )


def _online(name):
    """Name of the layer that a target's layer follows."""
    role, rest = name.split(".", 1)
    return f"{role.removesuffix('_target')}.{rest}"


def _assert_unchanged(before, after):
    for old_layers, new_layers in zip(before, after, strict=True):
        for name, tensors in old_layers.items():
            for old, new in zip(tensors, new_layers[name], strict=True):
                assert th.equal(old, new), name


@algorithms()
def test_training_moves_online_networks_and_copies_statistics_even_where_tau_is_zero(algorithm):
    model = _make(algorithm, **({} if on_policy(algorithm) else {"learning_starts": 0, "tau": 0}))
    (before, targets_before), _ = _batch_norms(model), model.learn(40)
    after, targets = _batch_norms(model)
    assert before
    assert bool(targets) == ("critics" not in LINES[algorithm].lacks)
    for name, (old_bias, old_mean) in before.items():
        bias, mean = after[name]
        assert ~th.isclose(old_bias, bias).any(), name
        assert ~th.isclose(old_mean, mean).any(), name
    for name, (old_bias, _) in targets_before.items():
        bias, mean = targets[name]
        assert th.equal(old_bias, bias)
        if _online(name) in after:  # and is no other network's
            online_bias, online_mean = after[_online(name)]
            assert not th.equal(online_bias, bias)
            assert th.equal(online_mean, mean)


@algorithms("replay")
def test_collecting_rollouts_changes_no_statistics(algorithm):
    model = _make(algorithm, gradient_steps=0)
    before = _batch_norms(model)
    model.learn(30)
    _assert_unchanged(before, _batch_norms(model))


@pytest.mark.parametrize("trained", [False, True])
@algorithms()
def test_predictions_repeat_and_change_no_statistics(algorithm, trained):
    model = _make(algorithm)
    if trained:
        model.learn(20)  # leaves the networks in training mode
    before = _batch_norms(model)
    observation = model.get_env().reset()
    guiders = [model.predict_guider] if hasattr(model, "predict_guider") else []
    for act in (model.predict, model.policy.predict, model.actor.predict, *guiders):
        first, _ = act(observation, deterministic=True)
        for _ in range(3):
            np.testing.assert_array_equal(first, act(observation, deterministic=True)[0])
    _assert_unchanged(before, _batch_norms(model))


@algorithms()
def test_targets_stay_in_evaluation_mode(algorithm):
    model = _make(algorithm).learn(20)
    for mode in (True, False):
        model.policy.set_training_mode(mode)
        assert model.policy.training is mode
        online, targets = _layers(model, nn.Dropout)
        assert all(layer.training is mode for layer in online.values())
        assert not any(layer.training for layer in targets.values())


@algorithms()
def test_statistics_are_saved(algorithm, tmp_path):
    model = _make(algorithm).learn(20)
    model.save(tmp_path / "model")
    _assert_unchanged(_batch_norms(model), _batch_norms(load(algorithm, tmp_path / "model")))


@algorithms("critics")
def test_statistics_are_copied_wherever_the_policy_was_moved(algorithm):
    model = _make(algorithm).learn(20)
    model.policy.double().float()  # replaces buffers, as a move to another device and back does
    online, targets = _layers(model, nn.BatchNorm1d)
    assert not any((layer.running_mean == 7).any() for layer in targets.values())
    for layer in online.values():
        layer.running_mean.fill_(7.0)
    model.policy.update_targets(tau=0.5)
    assert all((layer.running_mean == 7).all() for layer in targets.values())
