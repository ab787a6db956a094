"""Dual variables: they move towards their constraint, stay inside their bounds, and refuse what they can't be."""

import pytest
import torch as th

from sb3_gac.optim.coefficients import (
    AdditiveCoefficient,
    DualVariable,
    FixedCoefficient,
    SoftplusDual,
    make_coefficient,
)

CPU = th.device("cpu")


def _kl_coef(spec, bounds=(1e-4, 100.0)):
    return make_coefficient("kl_coef", spec, 1.0, bounds, 3e-3, CPU)


@pytest.mark.parametrize(("kl", "direction"), [(0.02, 1), (0.001, -1)])
def test_moves_up_above_the_target_and_down_below(kl, direction):
    dual = _kl_coef("auto_0.5")
    before = dual.value.item()
    loss = dual.update(th.full((8,), kl) - 0.005)["kl_coef_loss"]
    assert direction * (dual.value.item() - before) > 0
    assert dual.at_bound().item() == 0
    assert loss.item() == pytest.approx(-0.5 * (kl - 0.005), rel=1e-5)


@pytest.mark.parametrize(("violation", "bound"), [(1.0, 0.6), (-1.0, 0.4)])
def test_stops_at_its_bounds_and_says_so(violation, bound):
    dual = _kl_coef("auto_0.5", bounds=(0.4, 0.6))
    for _ in range(100):
        dual.update(th.tensor([violation]))
    assert dual.value.item() == pytest.approx(bound)
    assert dual.at_bound().item() == 1


def test_leaves_a_bound_when_the_constraint_turns():
    dual = _kl_coef("auto_0.6", bounds=(0.4, 0.6))
    for _ in range(200):
        dual.update(th.tensor([1.0]))
    for _ in range(400):
        dual.update(th.tensor([-1.0]))
    assert dual.value.item() == pytest.approx(0.4)
    assert dual.at_bound().item() == 1


@pytest.mark.parametrize(("spec", "value"), [(0.3, 0.3), ("0.3", 0.3), (0, 0.0), (1, 1.0)])
def test_a_number_stays_fixed(spec, value):
    coefficient = _kl_coef(spec)
    assert isinstance(coefficient, FixedCoefficient)
    assert coefficient.update(th.ones(3)) == {}
    assert coefficient.at_bound().item() == 0
    assert coefficient.value.item() == pytest.approx(value)


@pytest.mark.parametrize(("spec", "value"), [("auto", 1.0), ("auto_0.25", 0.25)])
def test_auto_starts_where_it_is_told(spec, value):
    coefficient = _kl_coef(spec)
    assert isinstance(coefficient, DualVariable)
    assert coefficient.value.item() == pytest.approx(value)


@pytest.mark.parametrize(("bounds", "start"), [((2.0, 8.0), 2.0), ((0.01, 0.5), 0.5), ((0.01, 8.0), 1.0)])
def test_auto_starts_inside_its_bounds(bounds, start):
    """At the bound that is nearest where its usual start lies outside, and the bounds stay what they are."""
    dual = _kl_coef("auto", bounds)
    assert dual.value.item() == pytest.approx(start)
    assert dual.at_bound().item() == (start in bounds)
    assert dual.bounds == bounds
    for far_away, bound in zip((-20.0, 20.0), bounds, strict=True):
        dual.log_value.data.fill_(far_away)
        dual.update(th.zeros(1))
        assert dual.value.item() == pytest.approx(bound)


@pytest.mark.parametrize("spec", ["automatic", "auto_", "auto_x", "auto_-1", "auto_0", "none", -0.1, float("nan"), None])
def test_bad_coefficients_are_refused_by_name(spec):
    with pytest.raises(ValueError, match="kl_coef must be"):
        _kl_coef(spec)


@pytest.mark.parametrize("bounds", [(1.0, 0.1), (0.0, 1.0), (1.0,), 3.0, (1.0, float("inf")), None])
def test_bad_bounds_are_refused_by_name(bounds):
    with pytest.raises(ValueError, match="kl_coef_bounds must be"):
        _kl_coef("auto", bounds=bounds)


def test_a_start_value_outside_the_bounds_is_refused():
    with pytest.raises(ValueError, match="outside kl_coef_bounds"):
        _kl_coef("auto_200")


def test_goes_on_from_another_one_inside_its_own_bounds_and_at_its_own_rate():
    other = make_coefficient("kl_coef", "auto_2", 1.0, (1e-4, 100.0), 0.5, CPU)
    other.update(th.tensor([1.0]))
    assert other.value.item() > 2
    dual = make_coefficient("kl_coef", "auto", 1.0, (0.5, 1.5), 1e-3, CPU)
    dual.go_on_from(other)
    assert dual.value.item() == pytest.approx(1.5)
    assert dual.optimizer.param_groups[0]["lr"] == 1e-3
    state, gathered = (one.optimizer.state_dict()["state"][0] for one in (dual, other))
    assert th.equal(state["exp_avg"], gathered["exp_avg"])
    assert state["exp_avg"].item() != 0


@pytest.mark.parametrize(("kind", "of"), [(SoftplusDual, th.nn.functional.softplus), (DualVariable, th.exp)])
@pytest.mark.parametrize("shape", [(), (3,)])
def test_learns_as_adam_does_from_the_gradient_of_its_loss(kind, of, shape):
    """Each by itself, from violations of many sizes, so that the slope of each value counts."""
    dual = kind("coef", 0.7, (1e-3, 50.0), 0.1, CPU, shape)
    start = dual.parameter.detach().clone().requires_grad_()
    assert of(start).detach().numpy() == pytest.approx(0.7)
    plain = th.optim.Adam([start], lr=0.1)
    generator = th.Generator().manual_seed(0)
    for _ in range(8):
        violation = th.randn(5, *shape, generator=generator).exp() - 1.3
        loss = -(of(start).view(shape) * violation.mean(dim=0)).sum()
        plain.zero_grad()
        loss.backward()
        plain.step()
        th.testing.assert_close(dual.update(violation)["coef_loss"], loss.detach())
    th.testing.assert_close(dual.value, of(start).detach().view(shape))
    assert dual.value.shape == shape


@pytest.mark.parametrize("kind", [SoftplusDual, DualVariable])
def test_one_coefficient_a_dimension_follows_its_own_constraint(kind):
    dual = kind("coef", 1.0, (0.9, 1.1), 0.2, CPU, (2,))
    for _ in range(5):
        dual.update(th.tensor([[1.0, -1.0], [3.0, -0.5]]))
    assert dual.value.tolist() == pytest.approx([1.1, 0.9])
    assert dual.at_bound().item() == 1
    dual = kind("coef", 1.0, (0.9, 1.1), 0.2, CPU, (2,))
    for _ in range(5):
        dual.update(th.tensor([1.0, 0.0]))
    assert dual.value.tolist() == pytest.approx([1.1, 1.0])
    assert dual.at_bound().item() == 0.5


@pytest.mark.parametrize("shape", [(), (3,)])
def test_padding_moves_no_coefficient(shape):
    """Not even where it is no number."""
    violation, mask = th.randn(4, 2, *shape), th.ones(4, 2)
    violation[2:, 1] = float("nan")
    mask[2:, 1] = 0
    padded, valid = (SoftplusDual("coef", 1.0, (0.1, 10.0), 0.1, CPU, shape) for _ in range(2))
    losses = padded.update(violation, mask), valid.update(violation[mask > 0])
    th.testing.assert_close(*losses)
    th.testing.assert_close(padded.optimizer.state_dict()["state"], valid.optimizer.state_dict()["state"])


def test_a_coefficient_that_is_moved_by_steps_stays_inside_its_bounds_and_says_where_it_is():
    coefficient = AdditiveCoefficient(0.5, 0.2, (0.0, 1.0), CPU)
    seen = []
    for direction in (1.0, -1.0, 0.0, -1.0, -1.0, -1.0, 4.0, 1.0):
        coefficient.move(direction)
        seen.append((coefficient.value.item(), coefficient.at_bound().item()))
    values = [0.7, 0.5, 0.5, 0.3, 0.1, 0.0, 0.8, 1.0]
    assert [value for value, _ in seen] == pytest.approx(values)
    assert [at_bound for _, at_bound in seen] == [value in (0.0, 1.0) for value in values]
    assert coefficient.update(th.ones(3)) == {}
    assert coefficient.value.item() == 1.0
