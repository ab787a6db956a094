"""A step of a network's optimiser is torch's own, with its clipping, whatever is frozen or comes from an earlier file."""

from copy import deepcopy

import pytest
import torch as th
from torch import nn

from sb3_gac.base.update import scale_of
from sb3_gac.optim.trained import TrainedParameters

ADAMS = [th.optim.Adam, th.optim.AdamW]
OPTIONS = {
    "usual": {},
    "other": {"betas": (0.7, 0.95), "eps": 0.05, "weight_decay": 0.3},
    "largest squares": {"amsgrad": True},
    "uphill": {"maximize": True, "weight_decay": 0.3},
}


def _parameters(*shapes, seed=0):
    generator = th.Generator().manual_seed(seed)
    return [nn.Parameter(th.randn(*shape, generator=generator)) for shape in shapes]


def _gradients(parameters, step, scale=1.0):
    generator = th.Generator().manual_seed(step)
    return [scale * th.randn(p.shape, generator=generator) for p in parameters]


def _plain_step(optimizer, parameters, gradients):
    for p, gradient in zip(parameters, gradients, strict=True):
        p.grad = gradient
    optimizer.step()


def _as_if_compiling(monkeypatch):
    """The operations that a compiler is shown, one after the other."""
    monkeypatch.setattr(th.compiler, "is_compiling", lambda: True)


@pytest.mark.parametrize("optimizer_class", ADAMS)
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("compiling", [False, True])
def test_a_step_is_that_of_torchs_adam(optimizer_class, options, compiling, monkeypatch):
    """With its rate changed on the way."""
    ours = _parameters((3, 2), (2,))
    theirs = deepcopy(ours)
    trained = TrainedParameters(ours, optimizer_class(ours, lr=0.1, fused=True, **options))
    plain = optimizer_class(theirs, lr=0.1, foreach=False, **options)
    assert trained.can_be_compiled == ("amsgrad" not in options and "maximize" not in options)
    for step in range(6):
        if step == 3:
            for optimizer in (trained.optimizer, plain):
                optimizer.param_groups[0]["lr"] = 0.01
        trained.refresh()
        with monkeypatch.context() as patch:
            if compiling and trained.can_be_compiled:
                _as_if_compiling(patch)
            trained.step(_gradients(ours, step), None)
        _plain_step(plain, theirs, _gradients(theirs, step))
    th.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("bound", [None, 0.5])
def test_a_gradient_counts_by_index_whatever_its_order_in_memory(options, bound):
    """Torch's fused optimisers go through memory: they took a value for another element's, without a word."""
    ours, theirs = (_parameters((3, 2, 4, 5), (2, 3), (2, 1, 4)) for _ in range(2))
    ours[1].data = ours[1].data.t().contiguous().t()
    trained, plain = (
        TrainedParameters(parameters, th.optim.AdamW(parameters, lr=0.1, fused=True, **options))
        for parameters in (ours, theirs)
    )
    for step in range(4):
        gradients = _gradients(ours, step)
        moved = [gradients[0].contiguous(memory_format=th.channels_last), *gradients[1:]]
        assert moved[0].stride() != gradients[0].stride()
        for network, own in ((trained, moved), (plain, gradients)):
            network.refresh()
            network.step(own, None if bound is None else th.tensor(bound))
    th.testing.assert_close(ours, theirs)


def test_moments_of_a_file_count_by_index_whatever_their_order_in_memory():
    ours, theirs = _parameters((3, 2, 4, 5)), _parameters((3, 2, 4, 5))
    networks = [TrainedParameters(parameters, th.optim.Adam(parameters, lr=0.1, fused=True)) for parameters in (ours, theirs)]
    for network in networks:
        network.refresh()
        network.step(_gradients(ours, 0))
    state = networks[0].optimizer.state_dict()
    for moments in state["state"].values():
        moments |= {
            name: value.contiguous(memory_format=th.channels_last) for name, value in moments.items() if value.dim() == 4
        }
    networks[0].optimizer.load_state_dict(state)
    for network in networks:
        network.refresh()
        network.step(_gradients(ours, 1))
    th.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("compiling", [False, True])
def test_a_memory_has_a_learning_rate_of_its_own(compiling, monkeypatch):
    """As with two groups of torch's own, its rate changed on the way."""
    ours = _parameters((3, 2), (2,), (4,))
    theirs = deepcopy(ours)
    trained = TrainedParameters(ours, th.optim.Adam(ours, lr=0.1, fused=True), memory=[ours[1]])
    trained.scale_memory(0.25)
    plain = th.optim.Adam([{"params": [theirs[0], theirs[2]], "lr": 0.1}, {"params": [theirs[1]], "lr": 0.025}])
    for step in range(4):
        if step == 2:
            trained.scale_memory(0.5)
            plain.param_groups[1]["lr"] = 0.05
        trained.refresh()
        with monkeypatch.context() as patch:
            if compiling:
                _as_if_compiling(patch)
            trained.step(_gradients(ours, step), None)
        _plain_step(plain, theirs, _gradients(theirs, step))
    th.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("scale", [1e-3, 10.0], ids=["small", "large"])
@pytest.mark.parametrize("unclipped", [0, 1, 3])
def test_the_norm_of_the_clipped_alone_is_bounded_and_a_small_one_is_left_alone(scale, unclipped):
    ours = _parameters((3, 2), (2,), (4,))
    theirs = deepcopy(ours)
    trained = TrainedParameters(ours, th.optim.SGD(ours, lr=1.0), unclipped)
    norm = trained.norm(_gradients(ours, 1, scale))
    trained.step(_gradients(ours, 1, scale), scale_of([norm], 0.5))
    for p, gradient in zip(theirs, _gradients(theirs, 1, scale), strict=True):
        p.grad = gradient
    clipped = theirs[: 3 - unclipped]
    expected = nn.utils.clip_grad_norm_(clipped, 0.5) if clipped else th.zeros(())
    th.testing.assert_close(norm, expected)
    th.optim.SGD(theirs, lr=1.0).step()
    th.testing.assert_close(ours, theirs)


@pytest.mark.parametrize(
    ("optimizer_class", "options"),
    [(th.optim.Adam, {"fused": True}), (th.optim.SGD, {"momentum": 0.9}), (th.optim.AdamW, {"foreach": True})],
)
def test_what_is_known_of_a_frozen_one_is_forgotten(optimizer_class, options):
    """Its gradient as well, which torch's own optimisers would follow."""
    parameters = _parameters((3,), (2,))
    trained = TrainedParameters(parameters, optimizer_class(parameters, lr=0.1, **options), unclipped=1)
    trained.step(_gradients(parameters, 0), None)
    assert set(trained.optimizer.state) == set(parameters)
    parameters[0].requires_grad_(False)
    before = [p.detach().clone() for p in parameters]
    trained.refresh()
    assert set(trained.optimizer.state) == {parameters[1]}
    assert trained.trained == trained.optimizer.param_groups[0]["trained"] == [False, True]
    assert trained.norm(_gradients(trained.parameters, 1)).item() == 0.0, "the one that is left has no say in clipping"
    trained.step(_gradients(trained.parameters, 1), th.zeros(()))
    assert th.equal(parameters[0], before[0])
    assert (parameters[1] - before[1]).abs().min() > 1e-3
    parameters[0].requires_grad_(True)
    trained.refresh()
    trained.step(_gradients(parameters, 2), None)
    assert not th.equal(parameters[0], before[0])


def test_a_state_that_was_loaded_counts():
    """Steps go on from it, where the same parameters are trained as before."""
    ours, others = _parameters((3,), (2,)), _parameters((3,), (2,), seed=1)
    trained, other = (TrainedParameters(ps, th.optim.Adam(ps, lr=0.1, fused=True)) for ps in (ours, others))
    for step in range(3):
        other.step(_gradients(others, step), None)
    trained.optimizer.load_state_dict(deepcopy(other.optimizer.state_dict()))
    with th.no_grad():
        for p, q in zip(ours, others, strict=True):
            p.copy_(q)
    for one in (trained, other):
        one.refresh()
        one.step(_gradients(ours, 3), None)
    th.testing.assert_close(ours, others)
    assert trained.optimizer.state[ours[0]]["step"].item() == 4


@pytest.mark.parametrize("frozen", [None, 0, 1, 2])
def test_a_file_with_one_flat_parameter_is_laid_out_by_parameter(frozen):
    """Each gets what was its own, in the order of those that were trained; a rate that differs stays what it was."""
    ours = _parameters((2, 3), (3,), (2,))
    theirs = deepcopy(ours)
    plain = th.optim.Adam(theirs, lr=0.1)
    was_trained = [index != frozen for index in range(3)]
    for step in range(3):
        _plain_step(
            plain,
            [p for p, is_trained in zip(theirs, was_trained, strict=True) if is_trained],
            [g for g, is_trained in zip(_gradients(theirs, step), was_trained, strict=True) if is_trained],
        )
    own = plain.state_dict()["state"]
    flat = {name: th.cat([own[index][name].flatten() for index in own]) for name in ("exp_avg", "exp_avg_sq")}
    options = {"lr": 0.02, "params": [0], **({} if frozen is None else {"trained": was_trained})}
    group = plain.state_dict()["param_groups"][0] | options
    trained = TrainedParameters(ours, th.optim.Adam(ours, lr=0.1, fused=True))
    saved = {"state": {0: {**flat, "step": own[min(own)]["step"]}}, "param_groups": [group]}
    present = trained.in_present_layout(saved)
    assert set(present["state"]) == set(own)
    for index, state in own.items():
        th.testing.assert_close(present["state"][index], state)
        assert state["exp_avg"].shape == present["state"][index]["exp_avg"].shape == ours[index].shape
    assert present["param_groups"][0]["params"] == [0, 1, 2]
    assert present["param_groups"][0]["lr"] == 0.02
    present["state"][min(own)]["step"].add_(1)
    assert all(present["state"][index]["step"].item() == 3 for index in own if index != min(own)), "one step for all"
    assert trained.in_present_layout(plain.state_dict())["state"].keys() == own.keys(), "a present one is left as it is"


def test_a_flat_file_that_knows_nothing_yet():
    ours = _parameters((2, 3), (3,))
    trained = TrainedParameters(ours, th.optim.Adam(ours, lr=0.1, fused=True))
    group = trained.optimizer.state_dict()["param_groups"][0] | {"params": [0]}
    assert trained.in_present_layout({"state": {}, "param_groups": [group]})["state"] == {}


def test_a_gradient_within_its_bound_is_not_multiplied():
    assert scale_of([th.tensor(0.4)], 0.5) is None
    assert scale_of([th.tensor(3.0), th.tensor(4.0)], 10.0) is None, "of both together"
    th.testing.assert_close(scale_of([th.tensor(3.0), th.tensor(4.0)], 2.0), th.tensor(0.4))
    assert scale_of([th.tensor(float("nan"))], 0.5).isnan(), "what is not finite shows"


def test_steps_by_hand_in_between_count_once_for_each_parameter():
    """A user may pre-train a network with its optimiser; the counters of all parameters are views of one tensor."""
    ours = _parameters((3, 2), (2,), (1,))
    theirs = deepcopy(ours)
    trained = TrainedParameters(ours, th.optim.Adam(ours, lr=0.1, fused=True))
    plain = th.optim.Adam(theirs, lr=0.1, foreach=False)
    for step in range(6):
        gradients = _gradients(ours, step)
        if step % 2:
            _plain_step(trained.optimizer, ours, gradients)
        else:
            trained.step(gradients, None)
        _plain_step(plain, theirs, gradients)
    for one, other in zip(ours, theirs, strict=True):
        th.testing.assert_close(one, other)
        assert trained.optimizer.state[one]["step"] == 6
    assert [entry["step"].shape for entry in trained.optimizer.state_dict()["state"].values()] == [()] * 3


def test_of_what_is_left_the_memory_has_its_rate_where_another_parameter_is_frozen():
    ours = _parameters((3,), (2, 2), (4,))
    trained = TrainedParameters(ours, th.optim.Adam(ours, lr=0.1, fused=True), memory=[ours[2]])
    trained.scale_memory(0.25)
    ours[0].requires_grad_(False)
    trained.refresh(compiled=False)
    before = [p.detach().clone() for p in ours]
    trained.step([th.ones(2, 2), th.ones(4)])  # of which Adam's first step has the length of the learning rate
    moved = [(p - old).abs().max().item() for p, old in zip(ours, before, strict=True)]
    assert moved == pytest.approx([0.0, 0.1, 0.025], rel=1e-4)
