"""
Wrappers that split an observation into ``partial`` and ``privileged``, and give ``partial`` noise or a history.

Each is a picklable ``gymnasium.Wrapper``, and passes the environment checkers of gymnasium and SB3.  The wrappers compose::

    env = SplitObservation(gym.make("HalfCheetah-v5"), partial=range(8), privileged=range(17))
    env = History(SensorNoise(env, noise_std=0.1), length=4, actions=True)
"""

import warnings
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Collection, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_gac.envs.arguments import check_count
from sb3_gac.envs.entries import MEASURED, RECEIVED, count_wrappers, place_of, wrappers_of
from sb3_gac.envs.noise import NOISE_STREAM, check_noise_std, noisy_box
from sb3_gac.envs.selections import KeySelection, as_slice, check_indices, check_keys
from sb3_gac.envs.spaces import PARTIAL, PRIVILEGED, box_entry, concatenate_boxes, has_channels_last, take_from_box
from sb3_gac.envs.state import MADE_WITH, layers

Observation = dict[str, np.ndarray]
#: Samples of the noise that are drawn at once, since one by one takes several times as long; and numbers, for large entries
_NOISE_BLOCK, _NOISE_NUMBERS = 128, 2**16


def reset_with(env: gym.Env, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, dict[str, Any]]:
    """Reset an environment with those keywords that were given: not every environment takes both."""
    given: dict[str, Any] = {name: value for name, value in {"seed": seed, "options": options}.items() if value is not None}
    return env.reset(**given)


class _SplitWrapper(gym.ObservationWrapper):
    """Base of wrappers that make ``partial`` and ``privileged``."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """
        :param seed: seed of the environment, ``None`` to go on with its random numbers
        :param options: options of the environment's reset
        :return: observation with ``partial`` and ``privileged``, info
        """
        observation, info = reset_with(self.env, seed, options)
        return self.observation(observation), info


class SplitObservation(_SplitWrapper):
    """
    Split a flat Box observation by indices.

    :param env: environment with a one-dimensional Box observation
    :param partial: indices of the components that the deployed policy sees
    :param privileged: indices of the components that only training sees; they may repeat those of ``partial``, for a clean
        copy of components that become noisy
    :raises ValueError: if the observation is of another kind, or an index is outside it
    """

    def __init__(self, env: gym.Env, partial: Sequence[int], privileged: Sequence[int]):
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"SplitObservation needs a one-dimensional Box observation, but the environment has {space}.")
        indices = {
            PARTIAL: check_indices(PARTIAL, partial, space),
            PRIVILEGED: check_indices(PRIVILEGED, privileged, space),
        }
        self.observation_space = spaces.Dict({key: take_from_box(space, index) for key, index in indices.items()})
        self._selectors = [as_slice(index) for index in indices.values()]

    def observation(self, observation: np.ndarray) -> Observation:
        """
        :param observation: observation of the wrapped environment, shape (D,)
        :return: entries ``partial`` and ``privileged``, float32
        """
        partial, privileged = self._selectors
        observation = observation.astype(np.float32)
        return {PARTIAL: observation[partial], PRIVILEGED: observation[privileged].copy()}


class SplitDictObservation(_SplitWrapper):
    """
    Split a Dict observation, such as that of a goal environment, by keys; entries are flattened and concatenated.

    :param env: environment with a flat Dict observation of Box entries
    :param partial: keys of the entries that the deployed policy sees; or a mapping from keys to indices into the flattened
        entry, with ``None`` for a whole entry
    :param privileged: keys of the entries that only training sees, in the same form
    :param keep: keys of entries that stay beside the two, with their shapes, such as the goals that ``HerReplayBuffer`` needs
    :raises ValueError: if the observation is of another kind, or a key or an index is unknown
    """

    def __init__(self, env: gym.Env, partial: KeySelection, privileged: KeySelection, keep: Sequence[str] = ()):
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, spaces.Dict):
            raise ValueError(f"SplitDictObservation needs a Dict observation, but the environment has {space}.")
        self._selections = {
            PARTIAL: check_keys(PARTIAL, partial, space),
            PRIVILEGED: check_keys(PRIVILEGED, privileged, space),
        }
        split = {
            name: concatenate_boxes([take_from_box(box_entry(space, key), index) for key, index in keys.items()])
            for name, keys in self._selections.items()
        }
        kept = {key: _in_single_precision(box_entry(space, key)) for key in _check_kept(keep)}
        self._kept = {key: box.dtype for key, box in kept.items()}
        self.observation_space = spaces.Dict({**split, **kept})

    def observation(self, observation: Observation) -> Observation:
        """
        :param observation: observation of the wrapped environment, by key
        :return: ``partial`` and ``privileged``, one-dimensional and float32; and the kept entries, those of floats in float32
        """
        split = {
            name: np.concatenate([np.ravel(observation[key])[index] for key, index in keys.items()], dtype=np.float32)
            for name, keys in self._selections.items()
        }
        return {**split, **{key: observation[key].astype(dtype) for key, dtype in self._kept.items()}}

    def sources(self, key: str) -> list[str]:
        """
        :param key: key of an entry
        :return: keys of the wrapped environment's entries that it is made of
        """
        return list(self._selections.get(key, [key]))

    def shows_elsewhere(self, source: str, key: str) -> bool:
        """
        :param source: key of an entry of the wrapped environment
        :param key: key of an entry that is made of it
        :return: whether another entry is made of it as well
        """
        return any(source in self.sources(other) for other in (PARTIAL, PRIVILEGED, *self._kept) if other != key)


class EntryWrapper(gym.Wrapper, ABC):
    """Base of wrappers that change one entry of a Dict observation."""

    #: Place among the other wrappers of the entry, ``None`` where any will do
    _place: int | None = None
    #: Whether the entry no longer depends on the wrapped environment's entry
    makes_anew = False

    def __init__(self, env: gym.Env, key: str):
        super().__init__(env)
        self._key = key
        self._entry = box_entry(env.observation_space, key)
        self._warn_of_order()

    @property
    def changed_entries(self) -> Sequence[str]:
        """Keys of the entries that the wrapper changes, see :func:`sb3_gac.envs.entries.entries_changed_by`."""
        return (self._key,)

    def _warn_of_order(self) -> None:
        """Warn if the wrapper disturbs what was made of the sensor's values further inside."""
        for layer, key in wrappers_of(self.env, self._key):
            if self._place is not None and place_of(layer) > self._place:
                own, inner = type(self).__name__, type(layer).__name__
                warnings.warn(
                    f'{own} stands outside of {inner}, and also disturbs what {inner} has made of the entry "{key}": '
                    f"make it {inner}({own}(env, ...), ...).",
                    stacklevel=4,
                )

    def _set_entry_space(self, box: spaces.Box) -> None:
        entries = self.env.observation_space.spaces  # type: ignore[attr-defined]
        self.observation_space = spaces.Dict({**entries, self._key: box})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """
        :param seed: seed of the environment's random numbers and of this wrapper's own, ``None`` to go on with them
        :param options: options of the environment's reset
        :return: changed observation, info
        """
        observation, info = reset_with(self.env, seed, options)
        return {**observation, self._key: self._first(observation[self._key], seed)}, info

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """
        :param action: action for the environment
        :return: changed observation, reward, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        changed = {**observation, self._key: self._next(observation[self._key], action, reward)}
        return changed, reward, terminated, truncated, info

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """
        Set an attribute on the outermost layer that has it; a setting, such as ``noise_std``, on every layer that has it.

        :param name: name of the attribute
        :param value: value of the attribute
        :param force: whether to create the attribute where no layer has it
        :return: whether the attribute was set
        """
        if name in getattr(self, MADE_WITH, ()):
            for layer in layers(self):
                if name in getattr(layer, MADE_WITH, ()):
                    setattr(layer, name, value)
            return True
        return bool(super().set_wrapper_attr(name, value, force=force))

    @abstractmethod
    def _first(self, value: np.ndarray, seed: int | None) -> np.ndarray:
        """Changed entry after a reset."""

    @abstractmethod
    def _next(self, value: np.ndarray, action: Any, reward: Any) -> np.ndarray:
        """Changed entry after a step."""


class SensorNoise(EntryWrapper):
    """
    Add independent Gaussian noise N(0, noise_std^2) to one entry, drawn once per reset and per step.

    The noise has a random generator of its own, seeded by ``reset(seed=...)``. So the environment's random numbers, and with
    them its dynamics, do not depend on ``noise_std``.

    :param env: environment with a Dict observation
    :param noise_std: standard deviation of the noise, in the units of the entry: a number, or one per component
    :param key: the entry that becomes noisy
    :raises ValueError: if ``noise_std`` is negative, not finite or of another shape, or the entry is missing or holds integers
    """

    _place = MEASURED

    def __init__(self, env: gym.Env, noise_std: float | Sequence[float], key: str = PARTIAL):
        super().__init__(env, key)
        self._generator = np.random.default_rng()
        self._block = max(1, min(_NOISE_BLOCK, _NOISE_NUMBERS // max(1, self._entry.low.size)))
        self.noise_std = noise_std
        self._settings_made_with = {"noise_std": self.noise_std}
        self._set_entry_space(noisy_box(self._entry, self.noise_std))

    @property
    def noise_std(self) -> np.ndarray:
        """Standard deviation of the noise from the next step on; the bounds of the space are those of the first one."""
        return self._noise_std

    @noise_std.setter
    def noise_std(self, noise_std: float | Sequence[float]) -> None:
        self._noise_std = check_noise_std(noise_std, self._entry, self._key)
        self._drawn, self._n_used = np.empty((0, *self._entry.shape), dtype=self._entry.dtype), 0

    @property
    def _stream(self) -> list[int]:
        """Name of the noise's random numbers, separate from those of inner wrappers, which an evaluation may add later."""
        return [NOISE_STREAM] * (1 + count_wrappers(self.env, SensorNoise))

    def _first(self, value: np.ndarray, seed: int | None) -> np.ndarray:
        if seed is not None:
            self._generator = np.random.default_rng([seed, *self._stream])
            self._n_used = len(self._drawn)
        return self._noisy(value)

    def _next(self, value: np.ndarray, action: Any, reward: Any) -> np.ndarray:
        return self._noisy(value)

    def _noisy(self, value: np.ndarray) -> np.ndarray:
        if self._n_used == len(self._drawn):
            noise = self._generator.standard_normal((self._block, *self._entry.shape), dtype=np.float32) * self.noise_std
            self._drawn, self._n_used = noise.astype(self._entry.dtype), 0
        self._n_used += 1
        return np.asarray(value + self._drawn[self._n_used - 1])  # the sum of two numbers in arrays is none


class History(EntryWrapper):
    """
    Replace one entry by its last ``length`` values, oldest first, joined along the first axis.

    Images with their channels last are joined along that axis, so that the history is an image of more channels.
    After a reset the first value fills the whole history, and past actions are zero.

    :param env: environment with a Dict observation
    :param length: number of values in the history, the current one included
    :param actions: whether to append the ``length - 1`` actions between the values; needs Box actions and a one-dimensional
        entry of floats
    :param key: the entry that gets a history
    :raises ValueError: if ``length`` is no positive integer, or the entry or the actions are of another kind
    """

    _place = RECEIVED

    def __init__(self, env: gym.Env, length: int, actions: bool = False, key: str = PARTIAL):
        super().__init__(env, key)
        length = check_count("length", length)
        if not self._entry.shape:
            raise ValueError(f'History needs an entry with at least one axis, but "{key}" has {self._entry}.')
        is_vector = len(self._entry.shape) == 1 and np.issubdtype(self._entry.dtype, np.floating)
        if actions and not (isinstance(env.action_space, spaces.Box) and is_vector):
            raise ValueError(
                f'actions=True needs Box actions and a one-dimensional, floating-point entry "{key}", but the environment '
                f"has {env.action_space} and {self._entry}."
            )
        n_actions = int(np.prod(env.action_space.shape)) if actions else 0  # type: ignore[arg-type]
        self._no_action = np.zeros(n_actions, dtype=np.float32)
        self._values: deque[np.ndarray] = deque(maxlen=length)
        self._actions: deque[np.ndarray] = deque(maxlen=length - 1)
        boxes = [self._entry] * length
        if actions:
            # A policy may hand in actions outside the space, which many environments clip
            boxes += [spaces.Box(-np.inf, np.inf, (n_actions,), np.float32)] * (length - 1)
        self._axis = 2 if has_channels_last(self._entry) else 0
        self._set_entry_space(concatenate_boxes(boxes, self._axis))

    def _first(self, value: np.ndarray, seed: int | None) -> np.ndarray:
        self._values.extend([value.copy()] * (self._values.maxlen or 0))
        self._actions.extend([self._no_action] * (self._actions.maxlen or 0))
        return self._joined()

    def _next(self, value: np.ndarray, action: Any, reward: Any) -> np.ndarray:
        self._values.append(value.copy())  # the environment may write into the array again
        if self._no_action.size:
            self._actions.append(np.array(action, dtype=np.float32).ravel())
        return self._joined()

    def _joined(self) -> np.ndarray:
        parts = [*self._values, *self._actions] if self._no_action.size else list(self._values)
        return np.concatenate(parts, self._axis, dtype=self._entry.dtype)


class PreviousAction(EntryWrapper):
    """
    Append the previous action to one entry, one-hot if actions are discrete, and on request the previous reward.

    Both are zero after a reset.  A policy with a memory needs its previous actions where the dynamics depend on them.

    :param env: environment with a Dict observation
    :param reward: whether to append the previous reward as well
    :param key: key of the entry that gets the action
    :raises ValueError: if the entry is not a floating-point vector, or the actions are neither Box nor Discrete
    """

    _place = RECEIVED

    def __init__(self, env: gym.Env, reward: bool = False, key: str = PARTIAL):
        super().__init__(env, key)
        if not (len(self._entry.shape) == 1 and np.issubdtype(self._entry.dtype, np.floating)):
            raise ValueError(f'PreviousAction needs a one-dimensional, floating-point entry "{key}", not {self._entry}.')
        if not isinstance(env.action_space, (spaces.Box, spaces.Discrete)):
            raise ValueError(f"PreviousAction needs Box or Discrete actions, but the environment has {env.action_space}.")
        self._reward = reward
        self._first_action = int(env.action_space.start) if isinstance(env.action_space, spaces.Discrete) else None
        dtype = self._entry.dtype
        self._nothing = np.zeros(spaces.flatdim(env.action_space) + reward, dtype=dtype)
        # A policy may hand in actions outside a Box, which many environments clip
        bound = 1.0 if isinstance(env.action_space, spaces.Discrete) and not reward else np.inf
        low = 0.0 if bound == 1.0 else -np.inf
        added = spaces.Box(low, bound, self._nothing.shape, dtype)
        self._set_entry_space(concatenate_boxes([self._entry, added]))

    @property
    def appends_reward(self) -> bool:
        """Whether the previous reward is appended as well."""
        return self._reward

    def _first(self, value: np.ndarray, seed: int | None) -> np.ndarray:
        return np.concatenate([value, self._nothing], dtype=self._entry.dtype)

    def _next(self, value: np.ndarray, action: Any, reward: Any) -> np.ndarray:
        added = self._nothing.copy()
        taken = added[:-1] if self._reward else added
        if self._first_action is None:
            taken[:] = np.ravel(action)
        else:
            taken[int(action) - self._first_action] = 1.0
        if self._reward:
            added[-1] = reward
        return np.concatenate([value, added], dtype=self._entry.dtype)


def _check_kept(keep: Sequence[str]) -> Sequence[str]:
    if not isinstance(keep, Collection) or isinstance(keep, str) or {PARTIAL, PRIVILEGED} & set(keep):
        raise ValueError(f"keep must be a list of keys, other than {PARTIAL!r} and {PRIVILEGED!r}, got {keep!r}.")
    return keep


def _in_single_precision(box: spaces.Box) -> spaces.Box:
    """The same Box, in float32 if it is of floats."""
    if not np.issubdtype(box.dtype, np.floating):
        return box
    return spaces.Box(box.low.astype(np.float32), box.high.astype(np.float32), dtype=np.float32)
