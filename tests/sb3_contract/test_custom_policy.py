"""SB3's contract: network sizes, activations, optimisers, features extractors and policy classes of one's own."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_gac.algorithms import algorithm_class
from tests.helpers import optimizers_of
from tests.registry import algorithms, load, make
from tests.sb3_contract.helpers import pendulum


def _hidden_sizes(network):
    """Output sizes of the weights before the heads."""
    if hasattr(network, "latent_net"):
        return [layer.out_features for layer in network.latent_net if isinstance(layer, nn.Linear)]
    weights = [layer.weight for layer in network.hidden if hasattr(layer, "weight")]
    return [weight.shape[-1] for weight in ([] if network.input is None else [network.input.features_weight, *weights])]


@pytest.mark.parametrize(
    ("net_arch", "policy_sizes", "critic_sizes"),
    [
        ([], [], []),
        ([4], [4], [4]),
        ([4, 6], [4, 6], [4, 6]),
        ({"pi": [8, 4], "qf": [6]}, [8, 4], [6]),
        ({"pi": [], "qf": [6, 3]}, [], [6, 3]),
    ],
)
def test_net_arch(net_arch, policy_sizes, critic_sizes):
    model = make("gac", pendulum(), policy_kwargs={"net_arch": net_arch}).learn(20)
    assert model._n_updates > 0
    for network in (model.policy.learner, model.policy.guider):
        assert _hidden_sizes(network) == policy_sizes
    for critic, target in model.policy.pairs.values():
        assert _hidden_sizes(critic) == _hidden_sizes(target) == critic_sizes


@algorithms()
def test_net_arch_of_policies_and_critics(algorithm):
    model = make(algorithm, pendulum(), policy_kwargs={"net_arch": {"pi": [8, 4], "qf": [6]}}).learn(20)
    assert model._n_updates > 0
    assert _hidden_sizes(model.actor) == [8, 4]
    critics = [network for role in model.policy.roles.critics for network in model.policy.pairs.get(role, ())]
    assert all(_hidden_sizes(network) == [6] for network in critics)


@pytest.mark.parametrize("net_arch", [{"pi": [8]}, {"vf": [8], "pi": [8]}])
@algorithms()
def test_unknown_net_arch_is_refused(algorithm, net_arch):
    with pytest.raises(ValueError, match="net_arch"):
        make(algorithm, pendulum(), policy_kwargs={"net_arch": net_arch})


def _check_optimizers(algorithm, optimizer_class, optimizer_kwargs, path):
    policy_kwargs = {"optimizer_class": optimizer_class, "optimizer_kwargs": optimizer_kwargs}
    model = make(algorithm, pendulum(), policy_kwargs=policy_kwargs).learn(20)
    model.save(path)
    for one in (model, load(algorithm, path)):
        for optimizer in optimizers_of(one.policy):
            assert type(optimizer) is optimizer_class
            for name, value in (optimizer_kwargs or {}).items():
                assert optimizer.param_groups[0][name] == value


@algorithms()
def test_optimizer(algorithm, tmp_path):
    _check_optimizers(algorithm, th.optim.SGD, {"momentum": 0.9}, tmp_path / "model")


@pytest.mark.parametrize(
    ("optimizer_class", "optimizer_kwargs"),
    [
        (th.optim.AdamW, None),
        (th.optim.AdamW, {"weight_decay": 0.0}),
        (th.optim.Adam, {"foreach": True}),
        (RMSpropTFLike, None),
    ],
)
def test_other_optimizers(tmp_path, optimizer_class, optimizer_kwargs):
    _check_optimizers("gac", optimizer_class, optimizer_kwargs, tmp_path / "model")


@algorithms()
def test_every_parameter_but_the_targets_has_one_optimizer(algorithm):
    policy = make(algorithm, pendulum()).policy
    optimized = [parameter for optimizer in optimizers_of(policy) for parameter in optimizer.param_groups[0]["params"]]
    targets = {id(parameter) for _, target in policy.pairs.values() for parameter in target.parameters()}
    assert len(optimized) == len({id(parameter) for parameter in optimized})
    assert {id(parameter) for parameter in policy.parameters()} - targets == {id(parameter) for parameter in optimized}


@algorithms()
def test_activation_function(algorithm):
    model = make(algorithm, pendulum(), policy_kwargs={"activation_fn": nn.Tanh}).learn(20)
    assert not any(isinstance(layer, nn.SiLU | nn.ReLU) for layer in model.policy.modules())
    for role in model.policy.roles.networks:
        network = getattr(model.policy, role)
        assert network is None or role == "guider" or any(isinstance(layer, nn.Tanh) for layer in network.modules()), role


class Scaled(BaseFeaturesExtractor):
    """A linear layer on all entries."""

    def __init__(self, observation_space: spaces.Dict, features_dim: int = 3):
        super().__init__(observation_space, features_dim)
        self.linear = nn.Linear(get_flattened_obs_dim(observation_space), features_dim)

    def forward(self, observations):
        return self.linear(th.cat(list(observations.values()), dim=1))


OWN_EXTRACTOR = {"features_extractor_class": Scaled, "features_extractor_kwargs": {"features_dim": 5}}


@algorithms()
def test_features_extractors_of_ones_own_are_trained(algorithm):
    model = make(algorithm, pendulum(), policy_kwargs=OWN_EXTRACTOR)
    targets = {id(module) for _, target in model.policy.pairs.values() for module in target.modules()}
    extractors = [one for one in model.policy.modules() if isinstance(one, Scaled) and id(one) not in targets]
    assert model.actor.features_extractor in extractors
    before = [one.linear.weight.clone() for one in extractors]
    model.learn(40)
    assert not any(th.allclose(old, one.linear.weight) for old, one in zip(before, extractors, strict=True))


def test_features_extractor_is_made_on_the_entries_of_each_role():
    model = make("gac", pendulum(), policy_kwargs=OWN_EXTRACTOR)
    roles = {"learner": 2, "guider": 3, "guider_critic": 3, "learner_critic": 3}
    before = {role: getattr(model.policy, role).features_extractor.linear.weight.clone() for role in roles}
    model.learn(40)
    for role, n_inputs in roles.items():
        weight = getattr(model.policy, role).features_extractor.linear.weight
        assert weight.shape == (5, n_inputs)
        assert not th.allclose(before[role], weight), role


@algorithms()
def test_policy_class_of_ones_own(algorithm, tmp_path):
    own = type("OwnPolicy", (algorithm_class(algorithm).policy_aliases["MultiInputPolicy"],), {})
    model = make(algorithm, pendulum(), policy=own).learn(20)
    assert type(model.policy) is own
    model.save(tmp_path / "model")
    loaded = load(algorithm, tmp_path / "model")
    assert type(loaded.policy).__name__ == "OwnPolicy"
    obs, _ = pendulum().reset()
    np.testing.assert_array_equal(*(one.predict(obs, deterministic=True)[0] for one in (model, loaded)))
