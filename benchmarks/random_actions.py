"""
Random actions, which need no training, and the shortest program for :mod:`benchmarks.external`::

    random-actions: {class: "benchmarks.external:Program", command: [python, -m, benchmarks.random_actions]}
"""

import sys
from typing import Any

import numpy as np
from gymnasium import Space

from benchmarks.program import Request


class RandomPolicy:
    """
    A policy whose actions are random.

    :param space: action space
    :param seed: seed of the action space's generator
    """

    def __init__(self, space: Space, seed: int):
        self._space = space
        self._space.seed(seed)

    def predict(self, observation: dict[str, np.ndarray], *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        """
        :param observation: observations of n environments, of which the number alone is used
        :return: actions, shape (n, ...), and ``None`` as the state
        """
        n_envs = len(next(iter(observation.values())))
        return np.stack([self._space.sample() for _ in range(n_envs)]), None


def main() -> None:
    """Entry point of the command line, whose only argument is the path of a request."""
    request = Request(sys.argv[1])
    policy = RandomPolicy(request.make_env().action_space, request.spec.seed)
    request.go_on_from(0)  # there are no checkpoints to go on from
    for timesteps in request.evaluations:
        print(f"{timesteps} steps: {request.evaluate(timesteps, policy):.1f}")


if __name__ == "__main__":
    main()
