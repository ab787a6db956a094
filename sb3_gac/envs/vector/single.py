"""One environment of a simulator that steps many, as gymnasium knows environments."""

from typing import Any

import gymnasium as gym
import numpy as np

from sb3_gac.envs.suites import batch_factory


class SingleEnv(gym.Env):
    """
    A ``gymnasium.Env`` over vectorised environments of which there is one.

    Those begin the next episode when one ends; its first observation is kept for the reset that follows.

    :param vec_env: with one environment, whose observation is a Dict
    :raises ValueError: if there are more
    """

    def __init__(self, vec_env: Any):
        if vec_env.num_envs != 1:
            raise ValueError(f"vec_env must be of one environment, got {vec_env.num_envs}.")
        self.vec_env = vec_env
        self.observation_space, self.action_space = vec_env.observation_space, vec_env.action_space
        self._next_first: dict[str, np.ndarray] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """
        :param seed: of the simulator and of the noise
        :param options: none
        :return: observation, info
        """
        super().reset(seed=seed)
        first, self._next_first = self._next_first, None
        if seed is not None:
            self.vec_env.seed(seed)
        if options:
            self.vec_env.set_options(options)
        if first is None or seed is not None or options:
            first = _only(self.vec_env.reset())
        return first, {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """
        :param action: within the action space
        :return: observation, reward, terminated, truncated, info
        :raises RuntimeError: if the episode has ended
        """
        if self._next_first is not None:
            raise RuntimeError("The episode has ended: call reset().")
        observations, rewards, dones, (info,) = self.vec_env.step(np.asarray(action)[None])
        observation = _only(observations)
        truncated = info.pop("TimeLimit.truncated")
        info.pop("episode", None)  # Monitor's, which is around this environment if it is wanted
        if dones[0]:
            self._next_first, observation = observation, info.pop("terminal_observation")
        return observation, float(rewards[0]), bool(dones[0]) and not truncated, truncated, info

    def close(self) -> None:
        """Close the vectorised environments."""
        self.vec_env.close()

    def checkpoint_state(self) -> dict[str, Any]:
        """See :mod:`sb3_gac.envs.state`."""
        return {"vec_env": self.vec_env.checkpoint_state(), "next_first": self._next_first}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """See :mod:`sb3_gac.envs.state`."""
        self.vec_env.restore_checkpoint_state(state["vec_env"])
        self._next_first = state["next_first"]


def _only(observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {key: values[0] for key, values in observations.items()}


def make_single(env_id: str, **kwargs: Any) -> gym.Env:
    """
    :param env_id: registered, of a suite whose simulator steps a batch
    :param kwargs: of the suite's vectorised environments
    :return: one environment, with its time limit
    """
    factory, of_task = batch_factory(env_id)
    return SingleEnv(factory(n_envs=1, **of_task | kwargs))
