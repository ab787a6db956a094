import numpy as np
import pytest
from hypothesis import given

from sb3_gac.tabular import TabularPOMDP, action_values, expected_return, tiger_door, uniform_learner, visits
from tests.tabular.processes import FEW, SEEDS, random_pair

GOOD = {
    "transitions": np.full((2, 1, 2), 0.5),
    "rewards": np.ones((2, 1)),
    "observations": np.array([0, 0]),
    "start": np.array([1.0, 0.0]),
    "gamma": 0.5,
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("transitions", np.full((2, 1, 3), 0.1)),
        ("transitions", np.full((2, 1, 2), 0.6)),
        ("transitions", np.array([[[1.5, -0.5]]] * 2)),
        ("transitions", np.full((2, 1, 2), np.nan)),
        ("rewards", np.array([[np.nan], [1.0]])),
        ("rewards", np.ones(2)),
        ("rewards", np.ones((0, 1))),
        ("observations", np.array([0, 2])),
        ("observations", np.array([0])),
        ("observations", np.array([0.0, 1.0])),
        ("start", np.array([0.5, 0.0])),
        ("start", np.array([np.nan, 1.0])),
        ("gamma", 1.1),
        ("gamma", np.nan),
    ],
)
def test_what_is_no_process_is_refused_by_name(name, value):
    TabularPOMDP(**GOOD)
    with pytest.raises(ValueError, match=f"^{name}"):
        TabularPOMDP(**{**GOOD, name: value})


def test_a_policy_without_an_end_has_no_value_without_discount():
    always_listens = np.eye(3)[[2, 2, 2, 2]]
    with pytest.raises(ValueError, match="never ends"):
        expected_return(tiger_door(), always_listens)


@pytest.mark.parametrize("seed", range(4))
def test_rounding_of_probabilities_that_sum_to_one_is_no_end(seed):
    rows = np.random.default_rng(seed).dirichlet(np.ones(5), size=(5, 2))
    process = TabularPOMDP(rows, np.ones((5, 2)), np.arange(5), np.eye(5)[0], gamma=1.0)
    with pytest.raises(ValueError, match="never ends"):
        expected_return(process, np.full((5, 2), 0.5))
    ending = TabularPOMDP(0.999 * rows, np.ones((5, 2)), np.arange(5), np.eye(5)[0], gamma=1.0)
    assert expected_return(ending, np.full((5, 2), 0.5)) == pytest.approx(1000.0)


def test_lists_are_arrays():
    process = TabularPOMDP(**{name: value if name == "gamma" else value.tolist() for name, value in GOOD.items()})
    assert expected_return(process, [[1.0], [1.0]]) == pytest.approx(2.0)


@pytest.mark.parametrize("policy", [np.full((4, 3), 2 / 3), np.full((3, 3), 1 / 3), np.full((4, 3), np.nan)])
def test_what_is_no_policy_has_no_value(policy):
    process = tiger_door()
    for function in (action_values, expected_return, visits):
        with pytest.raises(ValueError, match="policy must"):
            function(process, policy)
    with pytest.raises(ValueError, match="learner must"):
        process.by_state(policy if policy.shape == (4, 3) else policy.T[:2])


@pytest.mark.parametrize("weights", [-np.ones(4), np.ones(3), np.array([1.0, np.nan, 1.0, 1.0])])
def test_what_are_no_weights_average_nothing(weights):
    with pytest.raises(ValueError, match="weights must"):
        tiger_door().by_observation(np.ones((4, 3)), weights)


@FEW
@given(SEEDS)
def test_return_by_values_is_return_by_visits(seed):
    process, policy, _, _ = random_pair(seed, aggregated=True)
    by_visits = visits(process, policy) @ (policy * process.rewards).sum(axis=1)
    assert expected_return(process, policy) == pytest.approx(by_visits, abs=1e-9)
    assert visits(process, policy).sum() == pytest.approx(1 / (1 - process.gamma))


@FEW
@given(SEEDS)
def test_values_solve_bellmans_equation(seed):
    process, policy, _, _ = random_pair(seed, aggregated=True)
    values = action_values(process, policy)
    backup = process.rewards + process.gamma * process.transitions @ (policy * values).sum(axis=1)
    np.testing.assert_allclose(values, backup, atol=1e-9)


def test_averages_over_what_looks_the_same():
    process = TabularPOMDP(**{**GOOD, "observations": np.array([0, 0])})
    values = np.array([[1.0], [5.0]])
    assert process.by_observation(values, np.array([3.0, 1.0])) == pytest.approx(np.array([[2.0]]))
    assert process.by_observation(values, np.zeros(2)) == pytest.approx(np.array([[3.0]]))
    assert uniform_learner(process).shape == (1, 1)
