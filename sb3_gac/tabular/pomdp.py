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
        :param learner: the learner's probabilities of actions by observation, shape (O, A)
        :return: the learner's probabilities of actions by state, shape (S, A)
        """
        return learner[self.observations]

    def by_observation(self, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """
        The averages over the states that look the same.

        :param values: values of states and actions, shape (S, A)
        :param weights: weights of states, not negative, shape (S,); if all states of an observation have weight 0, their
            average is unweighted
        :return: averages by observation, shape (O, A)
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
    :param pomdp: decision process with S states
    :param policy: probabilities of actions by state, shape (S, A)
    :param rewards: expected reward of each state under this policy, shape (S,)
    :return: expected discounted sum of rewards from each state on, shape (S,)
    :raises ValueError: if ``gamma`` is 1 and the policy has states from which no episode ends
    """
    return _solve(pomdp, policy, rewards)


def action_values(pomdp: TabularPOMDP, policy: np.ndarray) -> np.ndarray:
    """
    The values of a policy without guidance, which the regression of eq. 15 aims at.

    :param pomdp: decision process with S states
    :param policy: probabilities of actions by state, shape (S, A)
    :return: Q of states and actions, shape (S, A)
    """
    return pomdp.rewards + pomdp.gamma * pomdp.transitions @ state_values(pomdp, policy, (policy * pomdp.rewards).sum(axis=1))


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
    return np.maximum(_solve(pomdp, policy, pomdp.start, transposed=True), 0.0)


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
