"""Simulators of many environments whose observations are groups, one of them for the critic, as in Isaac Lab."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_gac.envs.selections import KeySelection
from sb3_gac.envs.vector.base import BatchStep, BatchVecEnv

_NEEDED = ("num_envs", "single_observation_space", "single_action_space", "reset", "step")
Groups = dict[str, np.ndarray]


class GroupsVecEnv(BatchVecEnv):
    """
    SB3's ``VecEnv`` over a simulator of N environments whose observation is ``{"policy": ..., "critic": ...}``::

        env = GroupsVecEnv(gym.make("Isaac-Velocity-Rough-Anymal-D-v0", cfg=cfg))
        model = GAC("MultiInputPolicy", env, role_keys={"critic": ["privileged"]})

    The simulator has ``num_envs``, ``single_observation_space`` (a Dict of Boxes) and ``single_action_space``.  Its
    ``reset(seed=...)`` returns (groups, extras), and its ``step(actions)`` returns (groups, rewards, terminated, truncated,
    extras), as tensors of any device or as arrays, of shape (N, ...).

    Such a simulator itself resets the environments whose episodes have ended, and returns the first observations of the next
    episodes.  If it does not report an episode's last observation (``final_key``), the observation before the last one stands
    in.  Nothing is lost at a termination, after which no return is expected.  At a time limit, the value to bootstrap from is
    that of one step earlier.  A checkpoint can't take up episodes again.

    :param simulator: simulator with these attributes and methods, wrapped or not
    :param partial: groups that the deployed policy sees, or a mapping from groups to indices into them
    :param privileged: groups that only training sees, in the same form
    :param max_action: bound of Box actions where the simulator's action space has none
    :param final_key: key in ``extras`` of the groups of last observations, of shape (N, ...), which are read in the rows of
        ended episodes; ``None`` if the simulator does not report them
    :param noise_std: standard deviation of noise on ``partial``, a number or one per component; 0 for none
    :raises ValueError: if an argument or a group is wrong; the message names it
    """

    def __init__(
        self,
        simulator: Any,
        partial: KeySelection = ("policy",),
        privileged: KeySelection = ("critic",),
        max_action: float = 1.0,
        final_key: str | None = None,
        noise_std: float | Sequence[float] = 0.0,
    ):
        if not isinstance(max_action, (int, float, np.integer, np.floating)) or not 0 < max_action < np.inf:
            raise ValueError(f"max_action must be a finite number above 0, got {max_action!r}.")
        self.simulator, self.final_key = simulator, final_key
        of_one = getattr(simulator, "unwrapped", simulator)
        if missing := [name for name in _NEEDED if not hasattr(of_one, name)]:
            raise ValueError(f"simulator must have {', '.join(_NEEDED)}, but {of_one!r} lacks {', '.join(missing)}.")
        super().__init__(
            of_one.num_envs,
            of_one.single_observation_space,
            _bounded(of_one.single_action_space, max_action),
            partial,
            privileged,
            noise_std=noise_std,
        )
        self.extras: Mapping[str, Any] = {}
        self._device: Any = None
        self._shown: Groups = {}
        self._has_ended = np.zeros(self.num_envs, dtype=bool)

    @property
    def time_limit(self) -> int | None:
        """``None``, for the simulator alone truncates episodes."""
        return None

    @time_limit.setter
    def time_limit(self, steps: int | None) -> None:
        if steps is not None:
            raise ValueError(
                f"time_limit can't be set, got {steps!r}: the simulator resets its environments by itself. Set the length of "
                "its episodes in its own configuration."
            )

    def start(self, seeds: Sequence[int]) -> Groups:
        """
        Reset the simulator by a seed.

        :param seeds: seeds, one for each environment; the simulator takes the first for all of them
        :return: first observations by group, each of shape (N, ...)
        """
        return self._reset(seed=seeds[0])

    def restart(self, indices: np.ndarray) -> Groups:
        """
        Begin new episodes; where episodes have ended, the simulator has done so already.

        :param indices: indices of all environments, or of those whose episodes have ended
        :return: first observations of these environments by group
        """
        if not self._has_ended[indices].all():
            return self._reset()
        return {name: values[indices] for name, values in self._shown.items()}

    def advance(self, actions: np.ndarray) -> BatchStep:
        """
        Step all environments.

        :param actions: actions within the action space, one for each environment
        :return: results of the step, with the last observations of episodes that have ended
        """
        before = self._shown
        given: Any = np.asarray(actions, dtype=self.action_space.dtype)
        if self._device is not None:
            given = th.tensor(given, device=self._device)
        groups, rewards, terminated, truncated, self.extras = self.simulator.step(given)
        self._shown = _in_arrays(groups)
        terminated, truncated = (_array(flags).astype(bool) for flags in (terminated, truncated))
        self._has_ended = terminated | truncated
        final = self._last_of(before) if self._has_ended.any() else self._shown
        last = {
            name: np.where(self._has_ended.reshape(-1, *[1] * (values.ndim - 1)), final[name], values)
            for name, values in self._shown.items()
        }
        return BatchStep(last, _array(rewards), terminated, truncated & ~terminated)

    def close(self) -> None:
        """Close the simulator, if it can be closed."""
        if hasattr(self.simulator, "close"):
            self.simulator.close()

    def _reset(self, **given: Any) -> Groups:
        groups, self.extras = self.simulator.reset(**given)
        first = next(iter(groups.values()))
        self._device = first.device if isinstance(first, th.Tensor) else None  # actions go to the device of the observations
        self._shown, self._has_ended = _in_arrays(groups), np.zeros(self.num_envs, dtype=bool)
        return self._shown

    def _last_of(self, before: Groups) -> Groups:
        """Last observations of episodes that have ended."""
        if self.final_key is None:
            return before
        if self.final_key not in self.extras:
            raise ValueError(
                f'final_key="{self.final_key}", but episodes ended and the extras have {sorted(self.extras)}: leave it out, '
                "and the observation before the last one stands in."
            )
        return _in_arrays(self.extras[self.final_key])


def _bounded(space: spaces.Space, bound: float) -> spaces.Space:
    if not isinstance(space, spaces.Box):
        return space
    low = np.where(np.isfinite(space.low), space.low, -bound).astype(np.float32)
    high = np.where(np.isfinite(space.high), space.high, bound).astype(np.float32)
    return spaces.Box(low, high, dtype=np.float32)


def _in_arrays(groups: Mapping[str, Any]) -> Groups:
    """Copy all groups into arrays: the simulator may write into its own tensors again."""
    return {name: np.array(_array(values)) for name, values in groups.items()}


def _array(values: Any) -> np.ndarray:
    """Make an array of a tensor on any device, or of anything like an array."""
    return np.asarray(values.detach().cpu() if hasattr(values, "detach") else values)
