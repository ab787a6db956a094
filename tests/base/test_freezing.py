"""Networks and parts of networks that are frozen do not move, and the rest trains on; unfrozen, they train again."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_gac import GAC, AsymmetricSAC
from sb3_gac.base.update import scale_of
from sb3_gac.optim.trained import TrainedParameters
from tests.helpers import Recall, TwoViewBandit, TwoViewChoice, small_model
from tests.registry import classes

ALGORITHMS = classes("replay", "shared encoder")


class Encoder(BaseFeaturesExtractor):
    """A linear layer, and another one that is frozen from the start if told so."""

    def __init__(self, observation_space: spaces.Dict, frozen: bool = False):
        super().__init__(observation_space, 4)
        self.keys = list(observation_space.spaces)
        self.first = nn.Linear(get_flattened_obs_dim(observation_space), 4)
        self.second = nn.Linear(4, 4).requires_grad_(not frozen)

    def forward(self, observations):
        return self.second(th.tanh(self.first(th.cat([observations[key] for key in self.keys], dim=1))))


ENCODED = {"net_arch": [8], "features_extractor_class": Encoder, "optimizer_kwargs": {"weight_decay": 0.1}}
SHARED = ENCODED | {"share_features_extractor": True}


def _model(cls=GAC, policy_kwargs=ENCODED, **arguments):
    return small_model(cls=cls, policy_kwargs=policy_kwargs, learning_rate=1e-2, **arguments)


def _parameters(module):
    return [parameter.detach().clone() for parameter in module.parameters()]


def _same(module, before):
    return all(th.equal(p, q) for p, q in zip(module.parameters(), before, strict=True))


def _moved(module, before):
    return not any(th.equal(p, q) for p, q in zip(module.parameters(), before, strict=True))


@pytest.mark.parametrize("cls", ALGORITHMS)
@pytest.mark.parametrize("policy_kwargs", [ENCODED, SHARED], ids=["own encoders", "shared encoder"])
def test_an_encoder_frozen_after_learning_stays_and_the_rest_trains_on(cls, policy_kwargs):
    """With its weight decay and the momentum that it has gathered."""
    model = _model(cls, policy_kwargs).learn(20)
    deployed = model.policy.deployed
    encoder = deployed.features_extractor.requires_grad_(False)
    frozen, rest, critics = _parameters(encoder), _parameters(deployed.latent_net), _parameters(model.critic.hidden)
    model.learn(10, reset_num_timesteps=False)
    assert _same(encoder, frozen)
    assert not any(parameter.requires_grad for parameter in encoder.parameters())
    assert _moved(deployed.latent_net, rest)
    assert model.policy.trained[model.policy.roles.deployed].trained[:5] == [False] * 4 + [True]
    encoder.requires_grad_(True)
    model.learn(5, reset_num_timesteps=False)
    assert _moved(encoder, frozen)
    assert critics == [] or not _same(model.critic.hidden, critics)


def _whole_networks(cls):
    roles = small_model(cls=cls).policy.trained
    return [pytest.param(cls, role, id=f"{cls.__name__}-{role}") for role in roles]


@pytest.mark.parametrize(("cls", "role"), [case for cls in (GAC, AsymmetricSAC) for case in _whole_networks(cls)])
@pytest.mark.parametrize("env", [TwoViewBandit, TwoViewChoice])
def test_a_whole_network_frozen_after_construction_stays_and_the_others_train(cls, role, env):
    model = small_model(env(), cls)
    networks = {name: getattr(model.policy, name) for name in model.policy.trained}
    networks[role].requires_grad_(False)
    before = {name: _parameters(network) for name, network in networks.items()}
    model.learn(15)
    assert {name for name, network in networks.items() if _same(network, before[name])} == {role}
    networks[role].requires_grad_(True)
    model.learn(5, reset_num_timesteps=False)
    assert not _same(networks[role], before[role])


@pytest.mark.parametrize("part", ["head.mean", "head.log_std", "latent_net"])
@pytest.mark.parametrize("shared_std", ["learner", "guider"])
def test_parts_of_the_learner(part, shared_std):
    model = small_model(shared_std=shared_std, learning_rate=1e-2).learn(15)
    parts = {name: model.policy.learner.get_submodule(name) for name in ("head.mean", "head.log_std", "latent_net")}
    parts[part].requires_grad_(False)
    before = {name: _parameters(module) for name, module in parts.items()}
    model.learn(5, reset_num_timesteps=False)
    assert {name for name, module in parts.items() if _same(module, before[name])} == {part}


def test_parts_of_a_recurrent_network():
    kwargs = {"net_arch": [8], "rnn_hidden_size": 8, "rnn_net_arch": [8]}
    model = small_model(Recall(), policy="MultiInputGruPolicy", policy_kwargs=kwargs, batch_size=4).learn(20)
    memory = model.policy.learner.memory.requires_grad_(False)
    before, rest = _parameters(memory), _parameters(model.policy.learner.latent_net)
    model.learn(5, reset_num_timesteps=False)
    assert _same(memory, before)
    assert _moved(model.policy.learner.latent_net, rest)


def test_the_target_of_a_frozen_part_goes_on_to_it_and_a_target_may_be_marked_frozen():
    model = _model(tau=0.5).learn(20)
    critic, target = model.policy.guider_critic, model.policy.guider_critic_target
    critic.features_extractor.requires_grad_(False)
    target.requires_grad_(False)
    before = _parameters(target.output)
    model.learn(40, reset_num_timesteps=False)
    for p, q in zip(critic.features_extractor.parameters(), target.features_extractor.parameters(), strict=True):
        th.testing.assert_close(p, q)
    assert _moved(target.output, before)


def test_frozen_in_the_constructor_and_unfrozen_later():
    model = _model(policy_kwargs=ENCODED | {"features_extractor_kwargs": {"frozen": True}})
    layer = model.policy.learner.features_extractor.second
    before = _parameters(layer)
    assert _same(model.learn(15).policy.learner.features_extractor.second, before)
    layer.requires_grad_(True)
    model.learn(5, reset_num_timesteps=False)
    assert _moved(layer, before)


@pytest.mark.parametrize("options", [{"fused": True}, {"foreach": True}], ids=["fast", "torch's own"])
@pytest.mark.parametrize("optimizer_class", [th.optim.Adam, th.optim.AdamW])
def test_freezing_a_part_is_training_without_it(optimizer_class, options):
    """What an optimiser of the other parameters does, with momentum, clipping and weight decay; unfrozen, it starts anew."""
    th.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 2))
    twin = deepcopy(network)
    ours = optimizer_class(network.parameters(), lr=0.01, weight_decay=0.1, **options)
    trained = TrainedParameters(list(network.parameters()), ours)
    assert trained.can_be_compiled == ("fused" in options)
    theirs = [optimizer_class(layer.parameters(), lr=0.01, weight_decay=0.1) for layer in (twin[0], twin[2])]
    for step in range(9):
        if step in (3, 6):
            for one in (network, twin):
                one[0].requires_grad_(step == 6)
            if step == 6:
                theirs[0] = optimizer_class(twin[0].parameters(), lr=0.01, weight_decay=0.1)
        trained.refresh()
        x = th.randn(8, 3)
        gradients = th.autograd.grad(network(x).square().sum(), trained.parameters)
        norm = trained.norm(gradients)
        trained.step(gradients, scale_of([norm], 0.5))
        for optimizer in theirs:
            optimizer.zero_grad()
        twin(x).square().sum().backward()
        th.testing.assert_close(norm, nn.utils.clip_grad_norm_([p for p in twin.parameters() if p.requires_grad], 0.5))
        for optimizer in theirs:
            optimizer.step()
        for p, q in zip(network.parameters(), twin.parameters(), strict=True):
            th.testing.assert_close(p, q)


def test_a_step_of_nothing_has_no_gradient():
    nothing = nn.Parameter(th.zeros(2), requires_grad=False)
    trained = TrainedParameters([nothing], th.optim.Adam([nothing], fused=True))
    assert trained.norm([]).item() == 0.0
    trained.step([], th.ones(()))
    assert not nothing.any()


@pytest.mark.parametrize("optimizer", [(th.optim.SGD, {"momentum": 0.9}), (th.optim.AdamW, {}), (th.optim.RMSprop, {})])
def test_other_optimisers(optimizer):
    optimizer_class, optimizer_kwargs = optimizer
    options = {"optimizer_class": optimizer_class, "optimizer_kwargs": optimizer_kwargs | {"weight_decay": 0.1}}
    model = _model(policy_kwargs=ENCODED | options).learn(15)
    encoder = model.policy.guider_critic.features_extractor.requires_grad_(False)
    before = _parameters(encoder)
    model.learn(5, reset_num_timesteps=False)
    assert _same(encoder, before)
    encoder.requires_grad_(True)
    assert _moved(model.learn(5, reset_num_timesteps=False).policy.guider_critic.features_extractor, before)


@pytest.mark.parametrize("how", ["load", "resume"])
@pytest.mark.parametrize("trained_since", [True, False])
def test_what_is_frozen_is_frozen_after_load_and_resume(how, trained_since, tmp_path):
    model = small_model(learning_rate=1e-2).learn(15)
    model.policy.learner.latent_net.requires_grad_(False)
    if trained_since:
        model.learn(5, reset_num_timesteps=False)
    (model.save if how == "load" else model.save_checkpoint)(tmp_path / "model")
    model.learn(10, reset_num_timesteps=False)
    again = getattr(GAC, how)(tmp_path / "model", env=TwoViewBandit(), device="cpu")
    frozen = [name for name, p in again.policy.named_parameters() if not p.requires_grad]
    assert frozen == ["learner.latent_net.0.weight", "learner.latent_net.0.bias"]
    again.learn(10, reset_num_timesteps=False)
    assert _same(again.policy.learner.latent_net, _parameters(model.policy.learner.latent_net))
    if how == "resume":  # to the bit, with the optimiser's state of what is trained
        assert _same(again.policy, _parameters(model.policy))
    again.policy.learner.requires_grad_(True)
    assert np.isfinite(again.learn(5, reset_num_timesteps=False).policy.learner.head.mean.bias.detach().numpy()).all()
    assert not _same(again.policy.learner.latent_net, _parameters(model.policy.learner.latent_net))
