"""Two branches at once give, to the bit, what they give in turn; errors come through, and threads are given back."""

import threading
import time

import pytest
import torch as th

from sb3_gac.optim.parallel import has_side_effects, worker
from tests.helpers import small_model


@pytest.fixture
def two_threads(set_threads):
    set_threads(2)


def _trained(threads, **arguments):
    th.set_num_threads(threads)
    model = small_model(batch_size=64, policy_kwargs={"net_arch": [64, 64]}, **arguments)
    found, loss = set(), model.guider_loss

    def noting(*tensors):
        found.add(threading.current_thread())
        return loss(*tensors)

    model.guider_loss = noting
    model.learn(60)
    assert (found == {threading.current_thread()}) == (threads == 1)
    return model


@pytest.mark.parametrize("guider", ["residual", "lagged", "independent"])
def test_training_is_the_same_to_the_bit(two_threads, guider):
    in_turn, at_once = (_trained(threads, guider=guider) for threads in (1, 2))
    for (name, p), q in zip(in_turn.policy.named_parameters(), at_once.policy.parameters(), strict=True):
        assert th.equal(p, q), name
    assert in_turn.kl_coef_dual.value == at_once.kl_coef_dual.value


def test_what_is_submitted_is_done_in_order_by_another_thread(two_threads):
    done = []
    with worker(True) as beside:
        for number in range(3):
            beside.submit(lambda number=number: done.append((number, threading.current_thread(), th.get_num_threads())))
        beside.wait()
        assert [number for number, _, _ in done] == [0, 1, 2]
        assert threading.current_thread() not in {thread for _, thread, _ in done}
        assert {threads for _, _, threads in done} == {1} == {th.get_num_threads()}
    assert th.get_num_threads() == 2
    with worker(False) as beside:
        assert beside is None
        assert th.get_num_threads() == 2


def _fail():
    raise ZeroDivisionError("branch")


def test_an_error_of_the_worker_is_raised_and_what_follows_it_is_left_out(two_threads):
    done = []

    def submit():
        with worker(True) as beside:
            for task in (lambda: done.append("before"), _fail, lambda: done.append("after")):
                beside.submit(task)

    with pytest.raises(ZeroDivisionError, match="branch"):
        submit()
    assert done == ["before"]


def test_an_error_here_is_raised_when_the_worker_has_ended(two_threads):
    done = []

    def fail_beside():
        with worker(True) as beside:
            beside.submit(lambda: (time.sleep(0.2), done.append("beside")))
            _fail()

    with pytest.raises(ZeroDivisionError, match="branch"):
        fail_beside()
    assert done == ["beside"]


@pytest.mark.parametrize("failing", ["guider", "learner"])
def test_an_error_in_either_branch_of_a_step_is_raised(two_threads, failing):
    model = small_model(learning_starts=10)
    setattr(model, f"{failing}_loss", lambda *tensors: _fail())
    with pytest.raises(ZeroDivisionError, match="branch"):
        model.learn(30)
    assert model._worker is None


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
