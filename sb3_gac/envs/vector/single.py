"""One environment of a simulator that steps many, as a ``gymnasium.Env``."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_gac.envs.suites import make_batch


class SingleEnv(gym.Env):
    """
    A ``gymnasium.Env`` over a vectorised environment that has one environment alone.

    A vectorised environment begins the next episode when one ends. The first observation of that next episode is kept for the
    reset that follows.

    :param vec_env: vectorised environment of one, with a Dict observation
    :raises ValueError: if it has more than one environment
    """

    def __init__(self, vec_env: Any):
        if vec_env.num_envs != 1:
            raise ValueError(f"vec_env must be of one environment, got {vec_env.num_envs}.")
        self.vec_env = vec_env
        self.observation_space, self.action_space = vec_env.observation_space, vec_env.action_space
        self._next_first: dict[str, np.ndarray] | None = None

    @property
    def _settings_made_with(self) -> Mapping[str, Any]:
        """The simulator's settings; a checkpoint has them with the simulator's state."""
        made_with: Mapping[str, Any] = self.vec_env._settings_made_with
        return made_with

    @property
    def noise_std(self) -> np.ndarray:
        """Standard deviation of the noise on ``partial`` from the next step on."""
        noise_std: np.ndarray = self.vec_env.noise_std
        return noise_std

    @noise_std.setter
    def noise_std(self, noise_std: Any) -> None:
        self.vec_env.noise_std = noise_std

    @property
    def time_limit(self) -> int | None:
        """Number of steps after which an episode is truncated."""
        time_limit: int | None = self.vec_env.time_limit
        return time_limit

    @time_limit.setter
    def time_limit(self, time_limit: int | None) -> None:
        self.vec_env.time_limit = time_limit

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """
        Begin a new episode.

        :param seed: seed of the simulator and of the noise, ``None`` to go on with their random numbers
        :param options: options of the vectorised environment's reset; a simulator that steps a batch takes none
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
        :param action: action within the action space
        :return: observation, reward, terminated, truncated, info
        :raises RuntimeError: if the episode has ended
        """
        if self._next_first is not None:
            raise RuntimeError("The episode has ended: call reset().")
        observations, rewards, dones, (info,) = self.vec_env.step(np.asarray(action)[None])
        observation = _only(observations)
        truncated = info.pop("TimeLimit.truncated")
        info.pop("episode", None)  # a Monitor around this environment adds its own
        if dones[0]:
            self._next_first, observation = observation, info.pop("terminal_observation")
        return observation, float(rewards[0]), bool(dones[0]) and not truncated, truncated, info

    def close(self) -> None:
        """Close the vectorised environments."""
        self.vec_env.close()

    def checkpoint_state(self) -> dict[str, Any]:
        """
        :return: state of the vectorised environment and the kept first observation, for :mod:`sb3_gac.envs.state`
        """
        return {"vec_env": self.vec_env.checkpoint_state(), "next_first": self._next_first}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """
        Put the environment back into a state.

        :param state: state that :meth:`checkpoint_state` returned
        """
        self.vec_env.restore_checkpoint_state(state["vec_env"])
        self._next_first = state["next_first"]


def _only(observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {key: values[0] for key, values in observations.items()}


def make_single(env_id: str, **kwargs: Any) -> gym.Env:
    """
    Make one environment of a suite whose simulator steps a batch.

    :param env_id: id of a registered environment whose simulator steps a batch
    :param kwargs: keyword arguments for the suite's vectorised environments
    :return: one environment, with its time limit
    """
    return SingleEnv(make_batch(env_id, n_envs=1, **kwargs))
