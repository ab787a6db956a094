"""
The tasks of EnvPool (extra ``envpool``): C++ simulators that step a batch on the CPU.

EnvPool has MuJoCo Playground, DeepMind control, gymnasium's MuJoCo, MetaWorld and MyoSuite among others;
``envpool.list_all_envs()`` names all tasks.
"""

import warnings
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_gac.envs.arguments import check_count
from sb3_gac.envs.selections import Indices, KeySelection
from sb3_gac.envs.state import NotRestorableError
from sb3_gac.envs.subprocesses import usable_processors
from sb3_gac.envs.suites.extras import import_extra
from sb3_gac.envs.vector.base import BatchStep, BatchVecEnv, SimulatorObservation

_OURS = ("env_type", "num_envs", "batch_size", "seed", "env_seed", "max_episode_steps", "gym_reset_return_info")
_LARGEST = 2**31 - 1  # EnvPool's seeds and time limits are signed 32-bit integers


class EnvPoolVecEnv(BatchVecEnv):
    """
    A task of EnvPool as ``Dict(partial, privileged)``.

    EnvPool seeds a pool when the pool is built. So the pool is built at the first reset, and again at each reset after
    :meth:`seed`; building a robot's simulators takes up to a second for each environment. EnvPool would begin a new episode in
    the step after an episode's end, and ignore that step's action; here the new episode begins at once. The time limit is
    counted here, so that a termination in an episode's last step is told apart from a truncation.

    :param task_id: EnvPool's name of the task, such as "MuJoCoPlayground/Go1JoystickFlatTerrain-v1"
    :param n_envs: number of environments
    :param partial: components that the deployed policy sees: indices or a slice of a flat observation, keys of a dict, or a
        mapping from keys to indices, slices, or ``None`` for a whole entry
    :param privileged: components that only training sees, in the same form
    :param time_limit: number of steps after which an episode is truncated, ``None`` for the task's own time limit
    :param noise_std: standard deviation of Gaussian noise on ``partial``, beside any noise of the task itself: a number, or
        one per component
    :param num_threads: number of the pool's threads, ``None`` for as many as torch's threads leave cores free, at least one
        and at most ``n_envs``. The threads of both wait by spinning: if they are more than the cores, each step and each
        gradient step takes many times as long (``torch.set_num_threads``)
    :param info_keys: names of values in EnvPool's infos that the infos here get as well, such as "success"
    :param kwargs: further keyword arguments for EnvPool's task, such as ``noise_level``
    :raises ValueError: if there is no such task, or another argument is wrong; the message names it
    :raises ImportError: if EnvPool is not installed; the message says how to install it
    """

    def __init__(
        self,
        task_id: str,
        n_envs: int = 1,
        *,
        partial: Indices | KeySelection,
        privileged: Indices | KeySelection,
        time_limit: int | None = None,
        noise_std: float | Sequence[float] = 0.0,
        num_threads: int | None = None,
        info_keys: Sequence[str] = (),
        **kwargs: Any,
    ):
        self._envpool = import_extra("envpool", "envpool", task_id)
        self.task_id, self._kwargs, self.info_keys = task_id, kwargs, tuple(info_keys)
        specification = self._specification()
        space = specification.gymnasium_observation_space
        self._observation_keys = list(space.spaces) if isinstance(space, spaces.Dict) else None
        #: EnvPool's simulators, ``None`` before the first reset
        self.pool: Any = None
        super().__init__(
            n_envs,
            space,
            specification.gymnasium_action_space,
            partial,
            privileged,
            int(specification.config.max_episode_steps) if time_limit is None else time_limit,
            noise_std,
        )
        self.num_threads = _threads(num_threads, self.num_envs)

    def _specification(self) -> Any:
        """EnvPool's specification of the task, for which no simulator is built."""
        if reserved := sorted(set(self._kwargs) & set(_OURS)):
            raise ValueError(f"{reserved} are set by EnvPoolVecEnv: it takes n_envs, time_limit, and seeds by seed().")
        known = self._envpool.list_all_envs()
        if self.task_id not in known:
            close = get_close_matches(self.task_id, known)
            raise ValueError(f"task_id must be one of envpool.list_all_envs(), such as {close}, got {self.task_id!r}.")
        return self._envpool.make_spec(self.task_id, **self._kwargs)

    def start(self, seeds: Sequence[int]) -> SimulatorObservation:
        """Build a pool with these seeds and begin its episodes, as :meth:`BatchVecEnv.start` requires."""
        assert self.time_limit is not None
        self.pool = None  # frees the former pool before the new one is built
        self.pool = self._envpool.make(
            self.task_id,
            env_type="gymnasium",
            num_envs=self.num_envs,
            num_threads=self.num_threads,
            env_seed=[int(seed) % _LARGEST for seed in seeds],
            max_episode_steps=min(self.time_limit + 1, _LARGEST),
            **self._kwargs,
        )
        return self.restart(np.arange(self.num_envs))

    def restart(self, indices: np.ndarray) -> SimulatorObservation:
        """Begin new episodes in some environments, as :meth:`BatchVecEnv.restart` requires."""
        observation, info = self.pool.reset(indices.astype(np.int32))
        return _in_order(observation, np.argsort(info["env_id"]))

    def advance(self, actions: np.ndarray) -> BatchStep:
        """Step all environments, as :meth:`BatchVecEnv.advance` requires."""
        self.pool.send(actions)
        # recv() would also put all infos into nested dicts, which takes as long as a small robot's step
        state = dict(zip(self.pool._state_keys, self.pool._recv(), strict=True))
        done, truncated = state["done"], state["trunc"]
        infos = {name: self._info(state, name) for name in self.info_keys}
        return BatchStep(self._observation_in(state), state["reward"], done & ~truncated, truncated, infos)

    def _observation_in(self, state: Mapping[str, np.ndarray]) -> SimulatorObservation:
        if self._observation_keys is not None:
            return {key: state[f"obs:{key}"] for key in self._observation_keys}
        return next(values for key, values in state.items() if key.startswith("obs"))

    def _info(self, state: Mapping[str, np.ndarray], name: str) -> np.ndarray:
        if f"info:{name}" not in state:
            known = sorted(key.removeprefix("info:") for key in state if key.startswith("info:"))
            raise ValueError(f"info_keys must be of {known}, which {self.task_id} has, got {name!r}.")
        return state[f"info:{name}"]

    def simulator_state(self) -> dict[str, Any]:
        """
        Refuse, since EnvPool's simulators have no state that can be read.

        :raises NotRestorableError: always
        """
        raise NotRestorableError("EnvPool has no way to read its simulators' state or to put it back")

    def close(self) -> None:
        """Free the simulators."""
        self.pool = None


def _in_order(observation: Any, order: np.ndarray) -> SimulatorObservation:
    """Reorder the rows of an array, or of nested dicts of arrays."""
    if isinstance(observation, Mapping):
        return {key: _in_order(value, order) for key, value in observation.items()}  # type: ignore[misc]
    return observation[order]


def _threads(given: int | None, n_envs: int) -> int:
    cores, of_torch = usable_processors(), th.get_num_threads()
    number = max(1, min(n_envs, cores - of_torch)) if given is None else check_count("num_threads", given)
    if number + of_torch > cores > 1:
        warnings.warn(
            f"{number} threads of EnvPool and {of_torch} of torch are more than the {cores} cores. Both wait by spinning, so "
            "that steps and gradient steps take many times as long: lower num_threads, or call torch.set_num_threads(...).",
            stacklevel=3,
        )
    return number
