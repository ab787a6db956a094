"""The two policies that a finished run is judged by: the learner as it is deployed, and actions at random."""

from typing import Any

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_gac.envs import PARTIAL

EVAL_SEED = 10_000


class PartialOnly:
    """
    A model that is handed the partial entry and nothing else, as on the robot.

    :param model: with ``predict``
    """

    def __init__(self, model: Any):
        self._model = model

    def predict(self, observation: dict[str, np.ndarray], *args: Any, **kwargs: Any) -> Any:
        """Arguments and result of the model's ``predict``."""
        return self._model.predict({PARTIAL: observation[PARTIAL]}, *args, **kwargs)


class UniformActions:
    """
    Random actions, the yardstick for a short run.

    :param env: whose actions to sample
    :param seed: of the actions
    """

    def __init__(self, env: VecEnv, seed: int = 0):
        self._space, self._n_envs = env.action_space, env.num_envs
        self._space.seed(seed)

    def predict(self, observation: Any, state: Any = None, *args: Any, **kwargs: Any) -> Any:
        """Arguments and result of a model's ``predict``."""
        return np.stack([self._space.sample() for _ in range(self._n_envs)]), state


def evaluate(policy: Any, env: VecEnv, episodes: int) -> tuple[float, float]:
    """
    :param policy: with ``predict``
    :param env: evaluated from ``EVAL_SEED``
    :param episodes: number of episodes
    :return: mean and standard deviation of the return
    """
    env.seed(EVAL_SEED)
    mean, std = evaluate_policy(policy, env, n_eval_episodes=episodes)
    return float(mean), float(std)  # type: ignore[arg-type]
