"""Evaluation of a finished run: the learner as it is deployed, beside policies without training."""

import warnings
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

EVAL_SEED = 10_000


class DeployedView:
    """
    A policy that gives a model the entries of its deployed policy alone, as on the robot.

    :param model: model of one of this package's algorithms
    """

    def __init__(self, model: Any):
        self._model, self._entries = model, model.policy.deployed_entries

    def predict(self, observation: dict[str, np.ndarray], *args: Any, **kwargs: Any) -> Any:
        """The model's actions on these entries, with the arguments and result of the model's ``predict``."""
        return self._model.predict({key: observation[key] for key in self._entries}, *args, **kwargs)


class UniformActions:
    """
    A policy that takes random actions, as a reference for the returns of short runs.

    :param env: vectorised environments whose action space is sampled
    :param seed: seed of the actions
    """

    def __init__(self, env: VecEnv, seed: int = 0):
        self._space, self._n_envs = env.action_space, env.num_envs
        self._space.seed(seed)

    def predict(self, observation: Any, state: Any = None, *args: Any, **kwargs: Any) -> Any:
        """Random actions, with the arguments and result of a model's ``predict``."""
        return np.stack([self._space.sample() for _ in range(self._n_envs)]), state


class MiddleAction:
    """
    A policy that always takes the middle action of a Box, which lets a robot stand still, or hang. An untrained policy's
    likeliest action is near it.

    :param env: vectorised environments with finite bounds of actions
    """

    def __init__(self, env: VecEnv):
        space = cast(spaces.Box, env.action_space)
        self._actions = np.stack([((space.low + space.high) / 2).astype(space.dtype)] * env.num_envs)

    def predict(self, observation: Any, state: Any = None, *args: Any, **kwargs: Any) -> Any:
        """The middle action, with the arguments and result of a model's ``predict``."""
        return self._actions.copy(), state


def untrained_policies(env: VecEnv) -> dict[str, Any]:
    """
    Policies without training, whose returns a trained policy must leave behind. On tasks that reward a robot for standing,
    or punish strong actions, the middle action is better than random actions.

    :param env: vectorised environments
    :return: name in sentences -> policy: random actions, and the middle action where the actions have a middle
    """
    policies: dict[str, Any] = {"random actions": UniformActions(env)}
    if isinstance(env.action_space, spaces.Box) and env.action_space.is_bounded():
        policies["the middle action"] = MiddleAction(env)
    return policies


class EndlessEpisodesWarning(BaseCallback):
    """
    A callback that warns before the first evaluation if no episode has ended so far, for an evaluation goes on until they end.

    :param env_id: id of the environment, for the message
    :param every: number of calls from one evaluation to the next
    """

    def __init__(self, env_id: str, every: int):
        super().__init__()
        self._env_id, self._every = env_id, every

    def _on_step(self) -> bool:
        if self.n_calls == self._every and not self.model.ep_info_buffer:
            warnings.warn(
                f"No episode of {self._env_id} has ended in {self.num_timesteps:,} steps, and an evaluation goes on until "
                "episodes end. If they never do, stop by Ctrl-C twice, and register the environment with max_episode_steps, "
                "or wrap it in gymnasium.wrappers.TimeLimit.",
                stacklevel=2,
            )
        return True


def evaluate(policy: Any, env: VecEnv, episodes: int) -> tuple[float, float]:
    """
    Evaluate a policy on episodes that start from the seed ``EVAL_SEED``.

    :param policy: model or policy with a method ``predict``
    :param env: vectorised environments to evaluate in
    :param episodes: number of episodes
    :return: mean and standard deviation of the episodes' returns
    """
    env.seed(EVAL_SEED)
    mean, std = evaluate_policy(policy, env, n_eval_episodes=episodes)
    return float(mean), float(std)  # type: ignore[arg-type]
