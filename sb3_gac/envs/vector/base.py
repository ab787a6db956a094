"""The base class of vectorised environments whose simulator steps all of them in one call."""

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

from sb3_gac.envs.arguments import check_count
from sb3_gac.envs.noise import NOISE_STREAM, check_noise_std, noisy_box
from sb3_gac.envs.selections import BatchSelection, Indices, KeySelection
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED
from sb3_gac.envs.state import NotRestorableError, restore_settings, settings_of

SimulatorObservation = np.ndarray | Mapping[str, np.ndarray]
Observations = dict[str, np.ndarray]


class BatchStep(NamedTuple):
    """
    The results of a simulator's step of its N environments.

    :param observation: observations after the step, before any reset: an array, or arrays by key, each of shape (N, ...)
    :param rewards: rewards of the step, shape (N,)
    :param terminated: whether each episode has terminated, because its task has ended by itself, shape (N,)
    :param truncated: whether the simulator has truncated each episode, shape (N,), or ``False`` for none;
        :class:`BatchVecEnv` adds its own time limit
    :param infos: name -> values of shape (N, ...), which the environments' infos get
    """

    observation: SimulatorObservation
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray | bool = False
    infos: Mapping[str, np.ndarray] = {}


class BatchVecEnv(VecEnv):
    """
    SB3's ``VecEnv`` over a simulator that steps a batch, with observations split into ``partial`` and ``privileged``.

    A subclass has :meth:`start`, :meth:`restart` and :meth:`advance`; the rest is here. A time limit truncates episodes. Where
    an episode has ended, the next one begins at once; the infos then have the last observation (``terminal_observation``),
    ``TimeLimit.truncated``, and the episode's return and length as ``Monitor`` has them. Gaussian noise on ``partial`` is
    drawn once for each observation, by a generator of its own, which ``seed`` seeds. So the simulator's random numbers do not
    depend on ``noise_std``.

    The environments share one simulator. So their attributes are those of this object, set for all of them at once.

    :param n_envs: number of environments
    :param observation_space: space of one environment's observation as the simulator gives it: a Box, or a Dict of Boxes
    :param action_space: space of one environment's actions; Box actions are clipped to it
    :param partial: components that the deployed policy sees: indices or a slice of a Box, keys of a Dict, or a mapping from
        keys to indices, slices, or ``None`` for a whole entry
    :param privileged: components that only training sees, in the same form
    :param time_limit: number of steps after which an episode is truncated, ``None`` if the simulator alone truncates episodes
    :param noise_std: standard deviation of the noise on ``partial``, a number or one per component; 0 for none
    :raises ValueError: if an argument is wrong; the message names it
    """

    render_mode: str | None = None  # VecEnv.__init__ reads this attribute

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
        n_envs = check_count("n_envs", n_envs)
        time_limit = None if time_limit is None else check_count("time_limit", time_limit)
        self._partial = BatchSelection(PARTIAL, partial, observation_space)
        self._privileged = BatchSelection(PRIVILEGED, privileged, observation_space)
        self.time_limit, self.noise_std = time_limit, noise_std
        self._settings_made_with = {"time_limit": self.time_limit, "noise_std": self.noise_std}
        noisy = noisy_box(self._partial.space, self.noise_std)
        space = spaces.Dict({PARTIAL: noisy, PRIVILEGED: self._privileged.space})
        super().__init__(n_envs, space, _in_float32(action_space))
        actions = self.action_space
        self._bounds = (actions.low, actions.high) if isinstance(actions, spaces.Box) else None
        self._noise = np.random.default_rng()
        #: Steps so far, the step at which each episode began, and the first of these: no array is touched before an episode
        #: may have reached its time limit
        self._n_steps, self._begun, self._first_begun = 0, np.zeros(self.num_envs, dtype=np.int64), 0
        self._returns = np.zeros(self.num_envs)
        self._has_started, self._created = False, time.time()
        self._actions: np.ndarray | None = None

    @property
    def noise_std(self) -> np.ndarray:
        """Standard deviation of the noise from the next step on; the bounds of the space are those of the first one."""
        return self._noise_std

    @noise_std.setter
    def noise_std(self, noise_std: float | Sequence[float]) -> None:
        self._noise_std = check_noise_std(noise_std, self._partial.space, PARTIAL)
        self._is_noisy = bool((self._noise_std > 0).any())

    # --- interface to the simulator ---------------------------------------------------------------------------------

    @abstractmethod
    def start(self, seeds: Sequence[int]) -> SimulatorObservation:
        """
        Begin new episodes in all environments, whose random numbers depend on the seeds alone.

        :param seeds: seeds, one for each environment
        :return: first observations: an array, or arrays by key, each of shape (N, ...)
        """

    @abstractmethod
    def restart(self, indices: np.ndarray) -> SimulatorObservation:
        """
        Begin new episodes in some environments, whose random numbers go on; the others stay where they are.

        :param indices: indices of these environments, ascending
        :return: first observations of these environments, in that order: an array, or arrays by key, each of shape
            (number of indices, ...)
        """

    @abstractmethod
    def advance(self, actions: np.ndarray) -> BatchStep:
        """
        Step all environments.

        :param actions: actions within the action space, one for each environment
        :return: results of the step
        """

    def simulator_state(self) -> dict[str, Any]:
        """
        Write down the state of the simulator.

        :return: all of the simulator's state that the next steps depend on: numbers, strings, lists, dicts, arrays and
            generators
        :raises NotRestorableError: if the simulator's state can't be read; the message says why
        """
        raise NotRestorableError(f"{type(self).__name__} can't write down its simulator's state")

    def restore_simulator_state(self, state: dict[str, Any]) -> None:
        """
        Put the simulator back into a state.

        :param state: state that :meth:`simulator_state` returned
        :raises NotRestorableError: if the simulator can't be put back
        """
        raise NotRestorableError(f"{type(self).__name__} can't put back its simulator's state")

    # --- interface of VecEnv ----------------------------------------------------------------------------------------

    def reset(self) -> Observations:
        """
        Begin new episodes in all environments.

        :return: first observations of new episodes, seeded if :meth:`seed` was called since the last reset
        :raises ValueError: if :meth:`set_options` was given options, which this class does not take, and the next reset is
            without; or if the simulator's observations are of another size than their space
        """
        if any(options := self._options):
            self._reset_options()  # or the next reset would be refused as well
            raise ValueError(f"{type(self).__name__} takes no reset options, got {options}: leave them out.")
        if not self._has_started and self._seeds[0] is None:
            self.seed()
        if self._seeds[0] is None:
            raw = self.restart(np.arange(self.num_envs))
        else:
            raw = self.start(self._seeds)  # type: ignore[arg-type]
            self._noise = np.random.default_rng([self._seeds[0], NOISE_STREAM])
        for selection in (self._partial, self._privileged):
            selection.check_sizes(raw)
        self._has_started = True
        self._reset_seeds()
        self._begin(np.arange(self.num_envs))
        return self._observed(raw)

    def step_async(self, actions: np.ndarray) -> None:
        """
        Keep the actions of the next step, clipped to the action space.

        :param actions: actions, one for each environment
        :raises RuntimeError: if the environments were not reset yet
        """
        if not self._has_started:
            raise RuntimeError(f"{type(self).__name__} must be reset before its first step.")
        if self._bounds is not None:  # np.clip takes twice as long
            actions = np.minimum(np.maximum(actions, self._bounds[0]), self._bounds[1])
        self._actions = actions

    def step_wait(self) -> tuple[Observations, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """
        Step all environments by the actions of :meth:`step_async`.

        :return: observations, rewards, dones, infos; where an episode has ended, the observation is the first one of the next
        """
        assert self._actions is not None
        raw, rewards, terminated, truncated, values = self.advance(self._actions)
        # Of the numbers 0 and 1, which a simulator may tell ends by, ~ is true
        terminated, truncated = np.asarray(terminated, dtype=bool), np.asarray(truncated, dtype=bool)
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
        """Put the last observations of ended episodes into the infos, and the first ones of the next in their place."""
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
        """Free nothing; subclasses close their simulators."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        Read an attribute of this object.

        :param attr_name: name of an attribute of this object
        :param indices: indices of environments, ``None`` for all
        :return: value of the attribute, once for each of these environments
        """
        return [getattr(self, attr_name)] * len(self._list_of(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        Set an attribute of this object, for all environments at once.

        :param attr_name: name of the attribute
        :param value: value for all environments
        :param indices: indices of all environments, or ``None``
        :raises ValueError: if ``indices`` leaves environments out, or there is no such attribute
        """
        if not hasattr(self, attr_name):
            raise ValueError(f"{type(self).__name__} has no attribute {attr_name!r} that could be set.")
        if set(self._list_of(indices)) != set(range(self.num_envs)):
            raise ValueError(f"{attr_name} is one for all environments of {type(self).__name__}: leave indices out.")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        Call a method of this object.

        :param method_name: name of a method of this object, which is called once, with the further arguments
        :param indices: indices of environments, ``None`` for all
        :return: result of the method, once for each of these environments
        """
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        return [result] * len(self._list_of(indices))

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """
        :param wrapper_class: class of a wrapper
        :param indices: indices of environments, ``None`` for all
        :return: for each of these environments, whether the class is ``Monitor``, whose infos they have
        """
        return [wrapper_class is Monitor] * len(self._list_of(indices))

    def _list_of(self, indices: VecEnvIndices) -> list[int]:
        given: Iterable[int] = self._get_indices(indices)
        return list(given)

    # --- checkpoints ------------------------------------------------------------------------------------------------

    def checkpoint_state(self) -> dict[str, Any]:
        """
        :return: state that the next steps depend on: the simulator's, the noise's, and returns and lengths of the episodes
        :raises NotRestorableError: if the simulator's state can't be read
        """
        lengths = self._n_steps - self._begun
        own = {"lengths": lengths, "returns": self._returns, "noise": self._noise, "has_started": self._has_started}
        own["settings"] = settings_of(self)
        return {"simulator": self.simulator_state(), **deepcopy(own)}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """
        Put the environments back into a state.

        :param state: state that :meth:`checkpoint_state` returned, which may be restored again later
        :raises NotRestorableError: if the simulator can't be put back
        """
        state = deepcopy(state)  # the next steps write into arrays and generators
        self.restore_simulator_state(state["simulator"])
        restore_settings(self, state.get("settings", {}))  # files of earlier versions have none
        self._begin(np.arange(self.num_envs))
        self._begun -= state["lengths"]
        self._first_begun = int(self._begun.min())
        self._returns, self._noise, self._has_started = state["returns"], state["noise"], state["has_started"]


def _in_float32(space: spaces.Space) -> spaces.Space:
    if not isinstance(space, spaces.Box) or space.dtype == np.float32:
        return space
    return spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)
