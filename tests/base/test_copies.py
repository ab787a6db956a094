"""A deep copy of a model, and a model that was given another's parameters: each trains by itself."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th

from tests.helpers import TwoViewBandit
from tests.registry import LINES, algorithms, make


def _tensors(model):
    """All that gradient steps change: parameters, coefficients, and the states of optimisers."""
    found = dict(model.policy.state_dict())
    for name, coefficient in model.coefficients.items():
        found[name] = coefficient.value
    for role, network in model.policy.trained.items():
        states = list(network.optimizer.state.values())
        found |= {f"{role}, {number}, {name}": value for number, state in enumerate(states) for name, value in state.items()}
    return {name: value.detach().clone() for name, value in found.items()}


def _assert_same(tensors, others):
    assert tensors.keys() == others.keys()
    for name, value in tensors.items():
        assert th.equal(value, others[name]), name


def _goes_on(model):
    np.random.seed(1)
    th.manual_seed(1)
    model.learn(20, reset_num_timesteps=False)
    return _tensors(model)


def _check(model):
    model.learn(30)
    copy, before = deepcopy(model), _tensors(model)
    of_copy = _goes_on(copy)
    _assert_same(_tensors(model), before)
    with pytest.raises(AssertionError):
        _assert_same(of_copy, before)
    _assert_same(_goes_on(model), of_copy)


@algorithms()
def test_a_deep_copy_trains_as_the_original_would_and_leaves_it_alone(algorithm):
    _check(make(algorithm, TwoViewBandit(length=5), seed=0, **LINES[algorithm].one_phase))


@pytest.mark.parametrize("rnn_type", ["gru", "lru"])
@algorithms("memory")
def test_so_does_a_deep_copy_with_a_memory(algorithm, rnn_type):
    env = TwoViewBandit(length=5)
    policy_kwargs = {"rnn_type": rnn_type, "rnn_hidden_size": 4, "rnn_net_arch": []}
    _check(make(algorithm, env, policy="MultiInputGruPolicy", policy_kwargs=policy_kwargs, seed=0))


@algorithms()
def test_parameters_that_were_handed_on_are_not_shared(algorithm):
    """Neither are the states of optimisers, of which torch keeps what it is given."""
    model, other = (make(algorithm, TwoViewBandit(length=5), seed=seed, **LINES[algorithm].one_phase) for seed in (0, 1))
    model.learn(30)
    before = _tensors(model)
    other.learn(30)
    other.set_parameters(model.get_parameters())
    _assert_same(other.policy.state_dict(), model.policy.state_dict())
    other.learn(30, reset_num_timesteps=False)
    _assert_same(_tensors(model), before)
