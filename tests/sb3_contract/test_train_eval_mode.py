"""SB3's contract: batch normalisation and dropout in features extractors learn in training and nowhere else."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from tests.sb3_contract.helpers import make_gac


class FlattenBatchNormDropoutExtractor(BaseFeaturesExtractor):
    """Concatenate all entries, then batch normalisation and dropout."""

    def __init__(self, observation_space):
        super().__init__(observation_space, get_flattened_obs_dim(observation_space))
        self.batch_norm = nn.BatchNorm1d(self.features_dim)
        self.dropout = nn.Dropout(0.5)

    def forward(self, observations):
        return self.dropout(self.batch_norm(th.cat([value.flatten(1) for value in observations.values()], dim=1)))


ONLINE = ("learner", "guider", "learner_critic", "guider_critic")
TARGETS = ("learner_critic_target", "guider_critic_target")


def _make(**kwargs):
    policy_kwargs = {"features_extractor_class": FlattenBatchNormDropoutExtractor}
    return make_gac(policy_kwargs=policy_kwargs, seed=1, **kwargs)


def _batch_norms(model):
    """Network -> bias and running mean, cloned."""
    layers = {name: getattr(model.policy, name).features_extractor.batch_norm for name in ONLINE + TARGETS}
    return {name: (layer.bias.clone(), layer.running_mean.clone()) for name, layer in layers.items()}


def _assert_unchanged(before, after):
    for name, tensors in before.items():
        for old, new in zip(tensors, after[name], strict=True):
            assert th.equal(old, new), name


def test_training_moves_online_networks_and_copies_statistics_even_where_tau_is_zero():
    model = _make(learning_starts=0, tau=0)
    before = _batch_norms(model)
    model.learn(100)
    after = _batch_norms(model)
    for name in ONLINE:
        (old_bias, old_mean), (bias, mean) = before[name], after[name]
        assert ~th.isclose(old_bias, bias).any(), name
        assert ~th.isclose(old_mean, mean).any(), name
    for name in TARGETS:
        (old_bias, _), (bias, mean) = before[name], after[name]
        online_bias, online_mean = after[name.removesuffix("_target")]
        assert th.equal(old_bias, bias)
        assert not th.equal(online_bias, bias)
        assert th.equal(online_mean, mean)


def test_collecting_rollouts_changes_no_statistics():
    model = _make(learning_starts=10, gradient_steps=0)
    before = _batch_norms(model)
    model.learn(60)
    _assert_unchanged(before, _batch_norms(model))


@pytest.mark.parametrize("trained", [False, True])
def test_predictions_repeat_and_change_no_statistics(trained):
    model = _make()
    if trained:
        model.learn(40)  # leaves the networks in training mode
    before = _batch_norms(model)
    observation = model.get_env().reset()
    for act in (model.predict, model.predict_guider, model.policy.predict, model.actor.predict):
        first, _ = act(observation, deterministic=True)
        for _ in range(3):
            np.testing.assert_array_equal(first, act(observation, deterministic=True)[0])
    _assert_unchanged(before, _batch_norms(model))


def test_targets_stay_in_evaluation_mode():
    model = _make().learn(30)
    for mode in (True, False):
        model.policy.set_training_mode(mode)
        assert model.policy.training is mode
        for name in ONLINE:
            assert getattr(model.policy, name).features_extractor.dropout.training is mode
        for name in TARGETS:
            assert getattr(model.policy, name).features_extractor.dropout.training is False


def test_statistics_are_saved(tmp_path):
    model = _make().learn(40)
    model.save(tmp_path / "model")
    _assert_unchanged(_batch_norms(model), _batch_norms(type(model).load(tmp_path / "model")))


def test_statistics_are_copied_wherever_the_policy_was_moved():
    model = _make().learn(40)
    model.policy.double().float()  # replaces buffers, as a move to another device and back does
    for name in TARGETS:
        getattr(model.policy, name.removesuffix("_target")).features_extractor.batch_norm.running_mean.fill_(7.0)
        assert not (getattr(model.policy, name).features_extractor.batch_norm.running_mean == 7).any()
    model.policy.update_targets(tau=0.5)
    for name in TARGETS:
        assert (getattr(model.policy, name).features_extractor.batch_norm.running_mean == 7).all()
