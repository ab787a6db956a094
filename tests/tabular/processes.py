"""Random processes and policies, and the best return there is."""

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from sb3_gac.tabular import TabularPOMDP

STATES, ACTIONS = 4, 3
FEW = settings(max_examples=20, deadline=None)
SEEDS = st.integers(0, 2**31)
ALPHAS = st.floats(0.05, 5.0)


def random_process(rng, aggregated, gamma=0.8):
    """With four states; where it is aggregated, two pairs of them look the same."""
    transitions = rng.dirichlet(np.full(STATES, 0.5), size=(STATES, ACTIONS))
    observations = np.array([0, 1, 0, 1]) if aggregated else np.arange(STATES)
    rewards = rng.uniform(-1, 1, (STATES, ACTIONS))
    return TabularPOMDP(transitions, rewards, observations, rng.dirichlet(np.ones(STATES)), gamma)


def random_policy(rng, rows):
    return rng.dirichlet(np.ones(ACTIONS), size=rows)


def random_pair(seed, aggregated):
    rng = np.random.default_rng(seed)
    process = random_process(rng, aggregated)
    return process, random_policy(rng, STATES), random_policy(rng, process.shape[2]), rng


def best_return(process, sweeps=300):
    """Of a policy that sees the state, by value iteration."""
    values = np.zeros(len(process.start))
    for _ in range(sweeps):
        values = (process.rewards + process.gamma * process.transitions @ values).max(axis=1)
    return float(process.start @ values)
