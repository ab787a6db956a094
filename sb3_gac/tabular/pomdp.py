"""
Decision processes with finitely many states: a guider sees the state, and a learner sees an observation of the state.

=============  ============================================================  ===========
symbol         meaning                                                       shape
=============  ============================================================  ===========
mu, guider     probabilities of actions by state                             (S, A)
pi, learner    probabilities of actions by observation                       (O, A)
Q              values of actions by state                                    (S, A)
=============  ============================================================  ===========

S states, O observations, A actions. Equation numbers are those of the Guided Actor-Critic paper.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TabularPOMDP:
    """
    A decision process with an observation function, which may give several states the same observation.

    :param transitions: probabilities of the next state, shape (S, A, S); the episode ends with the probability that a row
        lacks to one
    :param rewards: expected reward of each state and action, shape (S, A)
    :param observations: index of the learner's observation in each state, shape (S,); indices count from 0, and none is left
        out
    :param start: probabilities of the first state, shape (S,)
    :param gamma: discount factor, from 0 to 1
    :raises ValueError: if an argument is none of this; the message names the argument
    """

    transitions: np.ndarray
    rewards: np.ndarray
    observations: np.ndarray
    start: np.ndarray
    gamma: float

    def __post_init__(self) -> None:
        for name in ("rewards", "transitions", "observations", "start"):
            object.__setattr__(self, name, np.asarray(getattr(self, name)))  # lists do as well
        if self.rewards.ndim != 2 or not self.rewards.size or not np.isfinite(self.rewards).all():
            raise ValueError(f"rewards must be finite numbers of shape (S, A), got {self.rewards}.")
        states, actions = self.rewards.shape
        for name, shape in (("transitions", (states, actions, states)), ("observations", (states,)), ("start", (states,))):
            given = np.shape(getattr(self, name))
            if given != shape:
                raise ValueError(f"{name} must have shape {shape}, as rewards have {(states, actions)}, got {given}.")
        _check_probabilities("transitions", self.transitions)
        _check_probabilities("start", self.start, whole=True)
        seen = np.unique(self.observations)
        if self.observations.dtype.kind not in "iu" or not np.array_equal(seen, np.arange(len(seen))):
            raise ValueError(f"observations must be indices from 0 with none left out, got {seen}.")
        if not 0 <= self.gamma <= 1:
            raise ValueError(f"gamma must be from 0 to 1, got {self.gamma!r}.")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of states, actions and observations."""
        return *self.rewards.shape, int(np.max(self.observations)) + 1

    def by_state(self, learner: np.ndarray) -> np.ndarray:
        """
        :param learner: the learner's probabilities of actions by observation, shape (O, A)
        :return: the learner's probabilities of actions by state, shape (S, A)
        :raises ValueError: if ``learner`` has another shape, or its rows are no probabilities that sum to one
        """
        _, actions, observations = self.shape
        return check_policy("learner", learner, (observations, actions))[self.observations]

    def by_observation(self, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """
        The averages over the states that look the same.

        :param values: values of states and actions, shape (S, A)
        :param weights: weights of states, not negative, shape (S,); if all states of an observation have weight 0, their
            average is unweighted
        :return: averages by observation, shape (O, A)
        :raises ValueError: if ``weights`` has another shape, or a weight is negative or not finite
        """
        return self.shares(weights) @ values

    def shares(self, weights: np.ndarray) -> np.ndarray:
        """
        The weights by which :meth:`by_observation` averages.

        :param weights: weights of states, as of :meth:`by_observation`, shape (S,)
        :return: share of each state in the average of its observation, 0 in the others', shape (O, S)
        :raises ValueError: if ``weights`` has another shape, or a weight is negative or not finite
        """
        weights = np.asarray(weights)
        if weights.shape != self.start.shape or not (np.isfinite(weights) & (weights >= 0)).all():
            raise ValueError(f"weights must be numbers of at least 0, one for each state, got {weights}.")
        same = np.arange(self.shape[2])[:, None] == self.observations
        weight = same * weights
        weight = np.where(weight.sum(axis=1, keepdims=True) > 0, weight, same)
        return weight / weight.sum(axis=1, keepdims=True)

    def discounted_next(self, values: np.ndarray) -> np.ndarray:
        """
        :param values: values of states, which may be infinite, shape (S,)
        :return: gamma times the expected value of the next state, by state and action, shape (S, A)
        """
        return expected(self.gamma * self.transitions, values)


def expected(probabilities: np.ndarray, values: np.ndarray) -> np.ndarray:
    """
    :param probabilities: probabilities of what may happen, shape (\\*E, N)
    :param values: values, which may be infinite, shape (N,) or (\\*E, N)
    :return: sum of probabilities times values, in which what has probability 0 does not count, shape (\\*E)
    """
    with np.errstate(invalid="ignore"):
        return np.where(probabilities > 0, probabilities * values, 0.0).sum(axis=-1)


def check_policy(name: str, policy: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """
    Check that an array is a policy.

    :param name: name of the array, for the message
    :param policy: probabilities of actions, in rows
    :param shape: shape that the array must have
    :return: the policy
    :raises ValueError: if the array has another shape, or its rows are no probabilities that sum to one
    """
    policy = np.asarray(policy)
    if policy.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {policy.shape}.")
    _check_probabilities(name, policy, whole=True)
    return policy


def check_above_zero(name: str, value: float) -> None:
    """
    Check that a value is a finite number above 0, which a float holds with all its digits.

    :param name: name of the value, for the message
    :param value: value to check
    :raises ValueError: unless the value is such a number
    """
    smallest = np.finfo(float).tiny
    if not smallest <= value < np.inf:
        raise ValueError(f"{name} must be above 0, finite, and not below {smallest:.3g}, got {value!r}.")


def _check_probabilities(name: str, values: np.ndarray, whole: bool = False) -> None:
    sums = np.sum(values, axis=-1)
    if not (np.min(values) >= 0 and np.max(sums) <= 1 + 1e-9 and (not whole or np.min(sums) >= 1 - 1e-9)):  # nor NaN
        raise ValueError(f"{name} must be probabilities that sum to {'' if whole else 'at most '}one, got sums {sums}.")


def _moves(pomdp: TabularPOMDP, policy: np.ndarray) -> np.ndarray:
    """Probabilities of the next state under a policy, shape (S, S)."""
    return np.einsum("sa,sat->st", check_policy("policy", policy, pomdp.rewards.shape), pomdp.transitions)


def _may_reach(goals: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Whether each state is one of the goals, or may be followed by one, however late, shape (S,)."""
    for _ in range(len(goals)):
        goals = goals | ((moves > 0) & goals).any(axis=1)
    return goals


def _solve(pomdp: TabularPOMDP, moves: np.ndarray, right: np.ndarray, transposed: bool = False) -> np.ndarray:
    """x = right + gamma P x, or with the transpose of P; P has the states' transitions under a policy."""
    # Not left to the solver: the rounding of probabilities that sum to one makes an unsolvable system look solvable
    if pomdp.gamma == 1 and not _may_reach(moves.sum(axis=1) < 1 - 1e-12, moves).all():
        raise ValueError("The policy never ends an episode that it is in, so that with gamma=1 it has no value.")
    return np.linalg.solve(np.eye(len(moves)) - pomdp.gamma * (moves.T if transposed else moves), right)


def state_values(pomdp: TabularPOMDP, policy: np.ndarray, rewards: np.ndarray) -> np.ndarray:
    """
    :param pomdp: decision process with S states
    :param policy: probabilities of actions by state, shape (S, A)
    :param rewards: expected reward of each state under this policy, which may be ``-inf``, shape (S,)
    :return: expected discounted sum of rewards from each state on, shape (S,)
    :raises ValueError: if ``policy`` is none, or ``gamma`` is 1 and the policy has states from which no episode ends
    """
    moves = _moves(pomdp, policy)
    is_lost = _may_reach(np.isneginf(rewards), pomdp.gamma * moves)
    values = _solve(pomdp, moves, np.where(is_lost, 0.0, rewards))
    return np.where(is_lost, -np.inf, values)


def action_values(pomdp: TabularPOMDP, policy: np.ndarray) -> np.ndarray:
    """
    The values of a policy without guidance, which the regression of eq. 15 aims at.

    :param pomdp: decision process with S states
    :param policy: probabilities of actions by state, shape (S, A)
    :return: Q of states and actions, shape (S, A)
    """
    rewards = (check_policy("policy", policy, pomdp.rewards.shape) * pomdp.rewards).sum(axis=1)
    return pomdp.rewards + pomdp.discounted_next(state_values(pomdp, policy, rewards))


def expected_return(pomdp: TabularPOMDP, policy: np.ndarray) -> float:
    """
    The return of eq. 1, discounted.

    :param pomdp: decision process with S states
    :param policy: probabilities of actions by state, shape (S, A); ``pomdp.by_state(learner)`` for a learner
    :return: expected discounted return from the start distribution
    """
    return float(pomdp.start @ (policy * action_values(pomdp, policy)).sum(axis=1))


def visits(pomdp: TabularPOMDP, policy: np.ndarray) -> np.ndarray:
    """
    :param pomdp: decision process with S states
    :param policy: probabilities of actions by state, shape (S, A)
    :return: expected discounted number of steps in each state, shape (S,)
    """
    return np.maximum(_solve(pomdp, _moves(pomdp, policy), pomdp.start, transposed=True), 0.0)


def tiger_door() -> TabularPOMDP:
    """
    TigerDoor of appendix B: a tiger is behind one of two doors, and only the guider knows behind which.

    The states are left and right before listening, and left and right after listening; the observations are nothing, left and
    right. The actions open the left door, open the right door, or listen, with the rewards of the paper's Table 1. An open
    door ends the episode; there is no discount.

    :return: decision process with S = 4, A = 3 and O = 3
    """
    transitions = np.zeros((4, 3, 4))
    transitions[[0, 1, 2, 3], 2, [2, 3, 2, 3]] = 1.0
    rewards = np.array([[1.0, 0.0, -0.1], [0.0, 1.0, -0.1]] * 2)
    return TabularPOMDP(transitions, rewards, np.array([0, 0, 1, 2]), np.array([0.5, 0.5, 0.0, 0.0]), gamma=1.0)
