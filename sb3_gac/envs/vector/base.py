"""The base of vectorised environments whose simulator steps all of them in one call."""

import time
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_gac.envs.noise import NOISE_STREAM, check_noise_std, noisy_box
from sb3_gac.envs.selections import BatchSelection, Indices, KeySelection
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.state import NotRestorableError

SimulatorObservation = np.ndarray | Mapping[str, np.ndarray]
Observations = dict[str, np.ndarray]


class BatchStep(NamedTuple):
    """
    What a simulator returns of a step of its N environments.

    :param observation: after it, before any reset; an array, or arrays by key, each of shape (N, ...)
    :param rewards: shape (N,)
    :param terminated: shape (N,), whether the task has ended by itself
    :param truncated: shape (N,), or ``False``; a time limit of the adapter's own is added to it
    :param infos: name -> values of shape (N, ...), which the environments' infos get
    """

    observation: SimulatorObservation
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray | bool = False
    infos: Mapping[str, np.ndarray] = {}


class BatchVecEnv(VecEnv):
    """
    Observations of a simulator's batch, split into ``partial`` and ``privileged``, with all that SB3 expects of a ``VecEnv``.

    A subclass has :meth:`start`, :meth:`restart` and :meth:`advance`; the rest is here: time limit, new episodes at once and
    the last observation of the one before (``terminal_observation``), ``TimeLimit.truncated``, returns and lengths in the
    infos as ``Monitor`` has them, and Gaussian noise on ``partial``, drawn once for each observation by a generator of its
    own, which ``seed`` seeds: the simulator's random numbers are the same whatever ``noise_std`` is.

    The environments share one simulator: attributes are those of this object, set for all of them at once.

    :param n_envs: number of environments
    :param observation_space: space of one environment's observation as the simulator gives it: a Box, or a Dict of Boxes
    :param action_space: space of one environment's actions; Box actions are clipped to it
    :param partial: what of the observation the deployed policy sees: indices or a slice of a Box, keys of a Dict, or a mapping
        from keys to indices, slices or ``None`` for all
    :param privileged: what only training sees, in the same form
    :param time_limit: steps after which an episode is truncated, ``None`` for no limit of the adapter's own
    :param noise_std: standard deviation of the noise on ``partial``, a number or one per component; 0 for none
    :raises ValueError: naming the argument that is wrong
    """

    render_mode: str | None = None  # VecEnv.__init__ asks for it

    def __init__(
        self,
        n_envs: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        partial: Indices | KeySelection,
        privileged: Indices | KeySelection,
        time_limit: int | None = None,
        noise_std: float | Sequence[float] = 0.0,
    ):
        for name, value in {"n_envs": n_envs, "time_limit": 1 if time_limit is None else time_limit}.items():
            if not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"{name} must be a whole number above 0, got {value!r}.")
        self._partial = BatchSelection(PARTIAL, partial, observation_space)
        self._privileged = BatchSelection(PRIVILEGED, privileged, observation_space)
        self.time_limit, self.noise_std = time_limit, check_noise_std(noise_std, self._partial.space, PARTIAL)
        noisy = noisy_box(self._partial.space, self.noise_std)
        space = spaces.Dict({PARTIAL: noisy, PRIVILEGED: self._privileged.space})
        super().__init__(int(n_envs), space, _in_float32(action_space))
        actions = self.action_space
        self._bounds = (actions.low, actions.high) if isinstance(actions, spaces.Box) else None
        self._is_noisy, self._noise = bool((self.noise_std > 0).any()), np.random.default_rng()
        #: Steps so far, and those after which the episodes began: no array is touched before one may be over its limit
        self._n_steps, self._begun, self._first_begun = 0, np.zeros(self.num_envs, dtype=np.int64), 0
        self._returns = np.zeros(self.num_envs)
        self._has_started, self._created = False, time.time()
        self._actions: np.ndarray | None = None

    # --- the simulator's --------------------------------------------------------------------------------------------

    @abstractmethod
    def start(self, seeds: Sequence[int]) -> SimulatorObservation:
        """
        New episodes in all environments, whose random numbers depend on nothing but the seeds.

        :param seeds: one for each environment
        :return: first observations, of shape (N, ...)
        """

    @abstractmethod
    def restart(self, indices: np.ndarray) -> SimulatorObservation:
        """
        New episodes in some environments, whose random numbers go on; the others stay where they are.

        :param indices: of those environments, ascending
        :return: their first observations, of shape (number of indices, ...), in that order
        """

    @abstractmethod
    def advance(self, actions: np.ndarray) -> BatchStep:
        """
        :param actions: one for each environment, within the action space
        """

    def simulator_state(self) -> dict[str, Any]:
        """
        :return: all of the simulator that the next steps depend on: numbers, strings, lists, dicts, arrays and generators
        :raises NotRestorableError: saying why it can't be had
        """
        raise NotRestorableError(f"{type(self).__name__} can't write down its simulator's state")

    def restore_simulator_state(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`simulator_state`
        """
        raise NotRestorableError(f"{type(self).__name__} can't put back its simulator's state")

    # --- SB3's ------------------------------------------------------------------------------------------------------

    def reset(self) -> Observations:
        """
        :return: first observations of new episodes, by the seeds of :meth:`seed` if it was called since the last reset
        :raises ValueError: if there are options
        """
        if any(self._options):
            raise ValueError(f"{type(self).__name__} takes no options of a reset, got {self._options}.")
        if not self._has_started and self._seeds[0] is None:
            self.seed()
        if self._seeds[0] is None:
            raw = self.restart(np.arange(self.num_envs))
        else:
            raw = self.start(self._seeds)  # type: ignore[arg-type]
            self._noise = np.random.default_rng([self._seeds[0], NOISE_STREAM])
        self._has_started = True
        self._reset_seeds()
        self._begin(np.arange(self.num_envs))
        return self._observed(raw)

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: one for each environment
        :raises RuntimeError: before the first reset
        """
        if not self._has_started:
            raise RuntimeError(f"{type(self).__name__} must be reset before its first step.")
        if self._bounds is not None:  # np.clip takes twice as long
            actions = np.minimum(np.maximum(actions, self._bounds[0]), self._bounds[1])
        self._actions = actions

    def step_wait(self) -> tuple[Observations, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """
        :return: observations, after an episode's end those of the next one, rewards, dones, infos
        """
        assert self._actions is not None
        raw, rewards, terminated, truncated, values = self.advance(self._actions)
        self._n_steps += 1
        self._returns += rewards
        if self.time_limit is not None and self._n_steps - self._first_begun >= self.time_limit:
            truncated = truncated | (self._n_steps - self._begun >= self.time_limit)
        dones = terminated | truncated
        observation = self._observed(raw)
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        for name, of_all in values.items():
            for info, value in zip(infos, of_all, strict=True):
                info[name] = value
        if np.count_nonzero(dones):
            self._end_episodes(np.flatnonzero(dones), ~terminated, observation, infos)
        return observation, rewards.astype(np.float32), dones, infos

    def _end_episodes(
        self, ended: np.ndarray, is_cut: np.ndarray, observation: Observations, infos: list[dict[str, Any]]
    ) -> None:
        """Put their last observations into the infos, and the first ones of the next episodes in their place."""
        seconds = round(time.time() - self._created, 6)
        for index in ended.tolist():
            infos[index]["TimeLimit.truncated"] = bool(is_cut[index])
            infos[index]["terminal_observation"] = {key: values[index].copy() for key, values in observation.items()}
            infos[index]["episode"] = {
                "r": round(float(self._returns[index]), 6),
                "l": self._n_steps - int(self._begun[index]),
                "t": seconds,
            }
        self._begin(ended)
        for key, values in self._observed(self.restart(ended)).items():
            observation[key][ended] = values

    def _begin(self, indices: np.ndarray) -> None:
        self._begun[indices], self._returns[indices] = self._n_steps, 0.0
        self._first_begun = int(self._begun.min())

    def _observed(self, raw: SimulatorObservation) -> Observations:
        partial = self._partial.of(raw)
        if self._is_noisy:
            partial += self._noise.standard_normal(partial.shape, dtype=np.float32) * self.noise_std
        return {PARTIAL: partial, PRIVILEGED: self._privileged.of(raw)}

    def close(self) -> None:
        """Nothing to be freed."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        :param attr_name: of an attribute of this object
        :param indices: of environments
        :return: the attribute, for each of them
        """
        return [getattr(self, attr_name)] * len(self._list_of(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        :param attr_name: of an attribute of this object
        :param value: for all environments
        :param indices: of environments, all of them
        :raises ValueError: if they are some of the environments
        """
        if set(self._list_of(indices)) != set(range(self.num_envs)):
            raise ValueError(f"{attr_name} is one for all environments of {type(self).__name__}: leave indices out.")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        :param method_name: of a method of this object, which is called once
        :param indices: of environments
        :return: what it returned, for each of them
        """
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        return [result] * len(self._list_of(indices))

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """
        :param wrapper_class: of a wrapper
        :param indices: of environments
        :return: for each of them, whether this is ``Monitor``, whose infos they have
        """
        return [wrapper_class is Monitor] * len(self._list_of(indices))

    def _list_of(self, indices: VecEnvIndices) -> list[int]:
        given: Iterable[int] = self._get_indices(indices)
        return list(given)

    # --- checkpoints ------------------------------------------------------------------------------------------------

    def checkpoint_state(self) -> dict[str, Any]:
        """
        :return: what the next steps depend on
        :raises NotRestorableError: if the simulator's state can't be had
        """
        lengths = self._n_steps - self._begun
        own = {"lengths": lengths, "returns": self._returns, "noise": self._noise, "has_started": self._has_started}
        return {"simulator": self.simulator_state(), **deepcopy(own)}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`checkpoint_state`
        :raises NotRestorableError: if the simulator can't be put back
        """
        self.restore_simulator_state(state["simulator"])
        self._begin(np.arange(self.num_envs))
        self._begun -= state["lengths"]
        self._first_begun = int(self._begun.min())
        self._returns, self._noise, self._has_started = state["returns"], state["noise"], state["has_started"]


def _in_float32(space: spaces.Space) -> spaces.Space:
    if not isinstance(space, spaces.Box) or space.dtype == np.float32:
        return space
    return spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)
