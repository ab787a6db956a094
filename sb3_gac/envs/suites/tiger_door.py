"""TigerDoor, appendix B of the paper: a guider that knows the door, and a learner that has to listen first."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.wrappers import Observation

LISTEN = 2
_NOTHING = 2  # no door was heard; 0 is the left door, 1 the right one


class TigerDoor(gym.Env):
    """
    A task in which one of two doors pays 1 and the other nothing; opening either ends the episode.

    The actions are left, right and listen. Listening costs 0.1 and tells the learner the paying door, once and for all.
    ``partial`` is the door that was heard (left, right, none), ``privileged`` the paying door and the door that was heard,
    each one-hot. Without knowledge of the paying door it is optimal to listen first, with a return of 0.9.
    """

    def __init__(self) -> None:
        self.action_space = spaces.Discrete(3)
        self.observation_space = spaces.Dict(
            {PARTIAL: spaces.Box(0.0, 1.0, (3,), np.float32), PRIVILEGED: spaces.Box(0.0, 1.0, (5,), np.float32)}
        )
        self._door, self._heard = 0, _NOTHING

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """
        :param seed: seed of the paying door, ``None`` to go on with the environment's random numbers
        :param options: unused
        :return: observation, info
        """
        super().reset(seed=seed)
        self._door, self._heard = int(self.np_random.integers(2)), _NOTHING
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """
        :param action: 0 for the left door, 1 for the right one, 2 to listen
        :return: observation, reward, terminated, truncated, info
        """
        if action == LISTEN:
            self._heard = self._door
            return self._observation(), -0.1, False, False, {}
        return self._observation(), float(action == self._door), True, False, {}

    def checkpoint_state(self) -> dict[str, Any]:
        """
        :return: the paying door, and the door that was heard
        """
        return {"door": self._door, "heard": self._heard}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """
        Put the environment back into a state.

        :param state: state that :meth:`checkpoint_state` returned
        """
        self._door, self._heard = state["door"], state["heard"]

    def _observation(self) -> Observation:
        heard = np.eye(3, dtype=np.float32)[self._heard]
        return {PARTIAL: heard, PRIVILEGED: np.concatenate([np.eye(2, dtype=np.float32)[self._door], heard])}


#: Id -> arguments of its registration; the time limit ends the episodes of a policy that only listens
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "sb3_gac/TigerDoor-v0": {"entry_point": f"{__name__}:TigerDoor", "max_episode_steps": 20}
}
