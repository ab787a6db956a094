"""
Disturbances of a sensor's signal on its way to the policy: the signal comes late, or not at all.

The wrappers compose with :class:`~sb3_gac.envs.wrappers.SensorNoise` in the order of a real robot: a value is measured with
noise, then it is sent, and the policy keeps a history of the values that have arrived::

    env = History(DroppedFrames(SensorDelay(SensorNoise(env, 0.1), steps=2), probability=0.1), length=4, actions=True)

A delayed value has the noise that it was measured with, and a value that is shown again has the same noise again. Wrappers in
another order warn.
"""

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import gymnasium as gym
import numpy as np

from sb3_gac.envs.arguments import check_count
from sb3_gac.envs.entries import RECEIVED, SENT, count_wrappers, entries_changed_by, inward, place_of
from sb3_gac.envs.goals import DESIRED_GOAL
from sb3_gac.envs.spaces import PARTIAL
from sb3_gac.envs.state import layers
from sb3_gac.envs.wrappers import EntryWrapper, SensorNoise, SplitDictObservation

FRAME_STREAM = 0x6672616D65  # separates the losses from generators that others seed with the same number
#: How to make an environment whose entry can be disturbed
_HOW = (
    "Put History and PreviousAction outside of SplitDictObservation; keep a goal as an entry (keep), and put "
    "AppendDesiredGoal outside."
)


class SensorDelay(EntryWrapper):
    """
    Show one entry as it was ``steps`` steps before.

    In an episode's first steps, the first value stands in for earlier ones.

    :param env: environment with a Dict observation
    :param steps: number of steps by which the entry is late, 0 for none
    :param key: the entry that is late; all others stay as they are
    :raises ValueError: if ``steps`` is no integer of at least 0, or the entry is missing
    """

    _place = SENT

    def __init__(self, env: gym.Env, steps: int, key: str = PARTIAL):
        super().__init__(env, key)
        self._steps = self._checked(steps)
        self._settings_made_with = {"steps": self.steps}
        self._values: deque[np.ndarray] = deque(maxlen=self.steps + 1)

    @staticmethod
    def _checked(steps: int) -> int:
        return check_count("steps", steps, 0, "by which the entry is late")

    @property
    def steps(self) -> int:
        """Number of steps by which the entry is late; a larger one takes effect as further values are measured."""
        return self._steps

    @steps.setter
    def steps(self, steps: int) -> None:
        self._steps = self._checked(steps)
        self._values = deque(self._values, self._steps + 1)

    def _first(self, value: np.ndarray, seed: int | None) -> np.ndarray:
        self._values.extend([value.copy()] * (self.steps + 1))
        return self._values[0].copy()

    def _next(self, value: np.ndarray, action: object, reward: object) -> np.ndarray:
        self._values.append(value.copy())  # the environment may write into the array again
        return self._values[0].copy()


class DroppedFrames(EntryWrapper):
    """
    Lose each value of one entry with a fixed probability, independently; the last value that arrived is then shown again.

    An episode's first value always arrives. Losses have a random generator of their own, seeded by ``reset(seed=...)``. So the
    random numbers of the environment and of the noise do not depend on ``probability``, and a value that is lost at a small
    probability is lost at a larger one as well.

    :param env: environment with a Dict observation
    :param probability: probability that a value is lost, from 0 to 1
    :param key: the entry whose values are lost; all others stay as they are
    :raises ValueError: if ``probability`` is no number from 0 to 1, or the entry is missing
    """

    _place = SENT

    def __init__(self, env: gym.Env, probability: float, key: str = PARTIAL):
        super().__init__(env, key)
        self.probability = probability
        self._settings_made_with = {"probability": self.probability}
        self._generator = np.random.default_rng()
        self._shown = np.empty(0)

    @property
    def probability(self) -> float:
        """Probability that a value is lost, from the next step on."""
        return self._probability

    @probability.setter
    def probability(self, probability: float) -> None:
        is_number = isinstance(probability, (int, float, np.integer, np.floating)) and not isinstance(probability, bool)
        if not is_number or not 0 <= probability <= 1:
            raise ValueError(f"probability must be a number from 0 to 1, with which a value is lost, got {probability!r}.")
        self._probability = float(probability)

    @property
    def _stream(self) -> list[int]:
        """Name of the losses' random numbers, separate from those of inner wrappers, which :func:`disturb` may add later."""
        return [FRAME_STREAM] * (1 + count_wrappers(self.env, DroppedFrames))

    def _first(self, value: np.ndarray, seed: int | None) -> np.ndarray:
        if seed is not None:
            self._generator = np.random.default_rng([seed, *self._stream])
        self._shown = value.copy()
        return self._shown.copy()

    def _next(self, value: np.ndarray, action: object, reward: object) -> np.ndarray:
        if self._generator.random() >= self.probability:
            self._shown = value.copy()
        return self._shown.copy()


def delayed_and_dropped(env: gym.Env, delay: int, drop: float, key: str = PARTIAL) -> gym.Env:
    """
    Make an entry late, and lose some of its values.

    :param env: environment with the entry as the sensor sends it
    :param delay: number of steps by which the entry is late; 0 adds no wrapper
    :param drop: probability that a value of the entry is lost on the way; 0 adds no wrapper
    :param key: key of the entry
    :return: environment with the entry as it arrives
    :raises ValueError: if ``delay`` or ``drop`` is out of its range; the message names the argument
    """
    try:
        late = env if _is_zero(delay) else SensorDelay(env, delay, key)
    except ValueError as error:
        raise ValueError(f"delay: {error}") from None
    try:
        return late if _is_zero(drop) else DroppedFrames(late, drop, key)
    except ValueError as error:
        raise ValueError(f"drop: {error}") from None


def _is_zero(value: object) -> bool:
    """Whether a value is the number 0; arrays and the like are none, which the wrappers refuse by name."""
    return np.ndim(value) == 0 and bool(value == 0)  # type: ignore[arg-type]


def disturb(env: gym.Env, noise_std: float = 0.0, delay: int = 0, drop: float = 0.0, key: str = PARTIAL) -> gym.Env:
    """
    Disturb the sensor of an environment that has wrappers already.

    The new wrappers stand directly around the sensor's signal, beneath every history, previous action and goal: these are the
    policy's own and need no sensor. New noise stands beneath the environment's own delays and losses as well: a value that is
    late or shown again keeps the noise of its measurement. A ``SplitDictObservation`` is followed to the entries that it was
    given. The function is for evaluations: the outer wrappers keep the bounds
    of their spaces, although noisy values may go beyond them.

    :param env: environment in its wrappers, changed in place, which must not have been reset yet
    :param noise_std: standard deviation of noise on top of the environment's own, 0 for none
    :param delay: number of steps by which the entry is late
    :param drop: probability that a value of the entry is lost
    :param key: key of the entry
    :return: the environment, whose outermost layer may be a new wrapper
    :raises ValueError: if an argument is wrong, and the message names it; or if a ``SplitDictObservation`` over histories or
        goals makes the entry of values that can't be disturbed for this entry alone
    """
    if noise_std != 0:
        env = _insert(env, key, SENT, lambda source, inner: SensorNoise(inner, noise_std, source))
    if drop != 0 and len(beneath(env, key, RECEIVED)) > 1:
        raise ValueError(f'drop: "{key}" is made of several entries, and each would lose other values. {_HOW}')
    if (delay, drop) != (0, 0):
        env = _insert(env, key, RECEIVED, lambda source, inner: delayed_and_dropped(inner, delay, drop, source))
    return env


class Place(NamedTuple):
    """
    A place for a wrapper of an entry.

    :param layer: layer that the wrapper is put around
    :param key: key of the entry there
    :param is_shared: whether other entries further out are made of this one as well
    """

    layer: gym.Env
    key: str
    is_shared: bool = False


def beneath(env: gym.Env, key: str, place: int) -> list[Place]:
    """
    Find the outermost place beneath all wrappers that belong at some place or further out.

    A ``SplitDictObservation`` over such wrappers, or over a desired goal, leads to a place for each of its sources; a goal is
    a command, and has none.

    :param env: environment in its wrappers
    :param key: key of an entry of its observation
    :param place: ``MEASURED``, ``SENT`` or ``RECEIVED``, of :mod:`sb3_gac.envs.entries`
    :return: outermost place beneath these wrappers, where there are none the whole environment; several where the entry is
        made of several
    """
    inner, found = inward(env, key), []
    for layer, source in inner:
        if not source == DESIRED_GOAL != key:
            is_shared = isinstance(env, SplitDictObservation) and env.shows_elsewhere(source, key)
            found += [at._replace(is_shared=at.is_shared or is_shared) for at in beneath(layer, source, place)]
    is_passed = key in entries_changed_by(env) and place_of(env) >= place
    is_passed_further_in = [(at.layer, at.key) for at in found] != inner
    return found if is_passed or is_passed_further_in else [Place(env, key)]


def _insert(env: gym.Env, key: str, place: int, wrap: Callable[[str, gym.Env], gym.Env]) -> gym.Env:
    """Insert wrappers beneath all that belong at a place or further out."""
    places = beneath(env, key, place)
    if any(found.is_shared for found in places):
        raise ValueError(
            f'"{key}" can\'t be disturbed alone, since SplitDictObservation makes another entry of the same values. {_HOW}'
        )
    for found in places:
        env = insert_above(env, found.layer, partial(wrap, found.key))
    return env


def insert_above(env: gym.Env, layer: gym.Env, wrap: Callable[[gym.Env], gym.Env]) -> gym.Env:
    """
    Insert a wrapper between two layers of an environment.

    :param env: environment in its wrappers, changed in place
    :param layer: layer of the environment that the new wrapper is put around
    :param wrap: function that returns the layer in the new wrapper
    :return: the environment, whose outermost layer is the new wrapper if ``layer`` was the outermost
    """
    if layer is env:
        return wrap(env)
    outside = next(other for other in layers(env) if isinstance(other, gym.Wrapper) and other.env is layer)
    outside.env = wrap(layer)
    return env
