"""Two branches at once give, to the bit, what they give in turn; errors come through, and threads are given back."""

import threading

import pytest
import torch as th

from sb3_gac.optim.parallel import halved_threads, has_side_effects, run_side_by_side
from tests.helpers import small_model


@pytest.fixture
def two_threads():
    before = th.get_num_threads()
    th.set_num_threads(2)
    yield
    th.set_num_threads(before)


def _trained(threads, **arguments):
    th.set_num_threads(threads)
    model = small_model(batch_size=64, policy_kwargs={"net_arch": [64, 64]}, **arguments)
    model.learn(60)
    assert model._at_once == (threads > 1)
    return model


@pytest.mark.parametrize("guider", ["residual", "independent"])
def test_training_is_the_same_to_the_bit(two_threads, guider):
    in_turn, at_once = (_trained(threads, guider=guider) for threads in (1, 2))
    for (name, p), q in zip(in_turn.policy.named_parameters(), at_once.policy.parameters(), strict=True):
        assert th.equal(p, q), name
    assert in_turn.kl_coef_dual.value == at_once.kl_coef_dual.value


def test_results_come_in_order_from_two_threads(two_threads):
    names = run_side_by_side([threading.current_thread, threading.current_thread])
    assert names[0] is threading.current_thread()
    assert names[1] is not names[0]
    assert run_side_by_side([lambda: 1, lambda: 2]) == [1, 2]


def test_each_branch_has_half_of_the_threads_and_they_are_given_back(two_threads):
    with halved_threads(True):
        assert run_side_by_side([th.get_num_threads, th.get_num_threads]) == [1, 1]
    assert th.get_num_threads() == 2
    with halved_threads(False):
        assert th.get_num_threads() == 2


@pytest.mark.parametrize("failing", [0, 1])
def test_an_error_in_either_branch_is_raised_after_both_have_ended(two_threads, failing):
    done = []

    def fail():
        raise ZeroDivisionError("branch")

    tasks = [lambda: done.append(True)]
    tasks.insert(failing, fail)
    with pytest.raises(ZeroDivisionError, match="branch"):
        run_side_by_side(tasks)
    assert done == [True]


def test_threads_are_given_back_after_an_error(two_threads):
    model = small_model(learning_starts=1000)
    model.learn(30)
    model.update = None
    with pytest.raises(TypeError):
        model.train(1, 8)
    assert th.get_num_threads() == 2


@pytest.mark.parametrize("layer", [th.nn.Dropout(0.1), th.nn.BatchNorm1d(2)])
def test_branches_keep_their_order_where_a_layer_draws_or_counts(two_threads, layer):
    assert has_side_effects(th.nn.Sequential(th.nn.Linear(2, 2), layer))
    assert not has_side_effects(th.nn.Sequential(th.nn.Linear(2, 2), th.nn.LayerNorm(2)))
