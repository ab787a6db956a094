"""
Decision processes with finitely many states, of which a learner sees an observation and a guider sees all.

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
    A process whose states are seen through a function that may give several of them the same observation.

    :param transitions: probabilities of the next state, shape (S, A, S); what a row lacks to one ends the episode
    :param rewards: expected rewards, shape (S, A)
    :param observations: index of what the learner sees in each state, shape (S,); indices count from 0, and each occurs
    :param start: probabilities of the first state, shape (S,)
    :param gamma: discount, from 0 to 1
    :raises ValueError: naming the argument that is no such thing
    """

    transitions: np.ndarray
    rewards: np.ndarray
    observations: np.ndarray
    start: np.ndarray
    gamma: float

    def __post_init__(self) -> None:
        states, actions = np.shape(self.rewards)
        for name, shape in (("transitions", (states, actions, states)), ("observations", (states,)), ("start", (states,))):
            given = np.shape(getattr(self, name))
            if given != shape:
                raise ValueError(f"{name} must have shape {shape}, as rewards have {(states, actions)}, got {given}.")
        _check_probabilities("transitions", self.transitions)
        _check_probabilities("start", self.start, whole=True)
        if not np.array_equal(np.unique(self.observations), np.arange(np.max(self.observations) + 1)):
            raise ValueError(f"observations must be indices from 0 with none left out, got {np.unique(self.observations)}.")
        if not 0 <= self.gamma <= 1:
            raise ValueError(f"gamma must be from 0 to 1, got {self.gamma!r}.")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of states, actions and observations."""
        return *self.rewards.shape, int(np.max(self.observations)) + 1

    def by_state(self, learner: np.ndarray) -> np.ndarray:
        """
        :param learner: shape (O, A)
        :return: what it does in each state, shape (S, A)
        """
        return learner[self.observations]

    def by_observation(self, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """
        Average over the states that look the same.

        :param values: shape (S, A)
        :param weights: of states, not negative, shape (S,); states of an observation whose weights are all zero count alike
        :return: shape (O, A)
        """
        same = np.arange(self.shape[2])[:, None] == self.observations
        weight = same * weights
        weight = np.where(weight.sum(axis=1, keepdims=True) > 0, weight, same)
        return (weight / weight.sum(axis=1, keepdims=True)) @ values


def _check_probabilities(name: str, values: np.ndarray, whole: bool = False) -> None:
    sums = np.sum(values, axis=-1)
    if np.min(values) < 0 or np.max(sums) > 1 + 1e-9 or (whole and np.min(sums) < 1 - 1e-9):
        raise ValueError(f"{name} must be probabilities that sum to {'' if whole else 'at most '}one, got sums {sums}.")


def _solve(pomdp: TabularPOMDP, policy: np.ndarray, right: np.ndarray, transposed: bool = False) -> np.ndarray:
    """x = right + gamma P x, or with the transpose of P; P has the states' transitions under the policy."""
    moves = np.einsum("sa,sat->st", policy, pomdp.transitions)
    try:
        return np.linalg.solve(np.eye(len(moves)) - pomdp.gamma * (moves.T if transposed else moves), right)
    except np.linalg.LinAlgError:
        raise ValueError("The policy never ends an episode that it is in, so that with gamma=1 it has no value.") from None


def state_values(pomdp: TabularPOMDP, policy: np.ndarray, rewards: np.ndarray) -> np.ndarray:
    """
    :param pomdp: with S states
    :param policy: by state, shape (S, A)
    :param rewards: of each state under this policy, shape (S,)
    :return: expected discounted sums of rewards, shape (S,)
    :raises ValueError: with ``gamma=1``, if the policy never ends an episode
    """
    return _solve(pomdp, policy, rewards)


def action_values(pomdp: TabularPOMDP, policy: np.ndarray) -> np.ndarray:
    """
    Values of a policy by itself, without guidance: what eq. 15 is a regression to.

    :param pomdp: with S states
    :param policy: by state, shape (S, A)
    :return: Q, shape (S, A)
    """
    return pomdp.rewards + pomdp.gamma * pomdp.transitions @ state_values(pomdp, policy, (policy * pomdp.rewards).sum(axis=1))


def expected_return(pomdp: TabularPOMDP, policy: np.ndarray) -> float:
    """
    Eq. 1, discounted.

    :param pomdp: with S states
    :param policy: by state, shape (S, A); ``pomdp.by_state(learner)`` for a learner
    :return: expected discounted return from the start distribution
    """
    return float(pomdp.start @ (policy * action_values(pomdp, policy)).sum(axis=1))


def visits(pomdp: TabularPOMDP, policy: np.ndarray) -> np.ndarray:
    """
    :param pomdp: with S states
    :param policy: by state, shape (S, A)
    :return: expected discounted number of steps in each state, shape (S,)
    """
    return np.maximum(_solve(pomdp, policy, pomdp.start, transposed=True), 0.0)


def tiger_door() -> TabularPOMDP:
    """
    Appendix B: a tiger is behind one of two doors, and only the guider knows behind which.

    States are (left, right) before listening and (left, right) after it; observations are nothing, left and right. Actions
    open the left door, open the right door, or listen, with the rewards of the paper's Table 1. An open door ends the
    episode; there is no discount.

    :return: with S = 4, A = 3, O = 3
    """
    transitions = np.zeros((4, 3, 4))
    transitions[[0, 1, 2, 3], 2, [2, 3, 2, 3]] = 1.0
    rewards = np.array([[1.0, 0.0, -0.1], [0.0, 1.0, -0.1]] * 2)
    return TabularPOMDP(transitions, rewards, np.array([0, 0, 1, 2]), np.array([0.5, 0.5, 0.0, 0.0]), gamma=1.0)
