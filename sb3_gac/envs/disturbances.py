"""
What happens to a sensor's signal on its way to the policy: it comes late, or not at all.

Together with :class:`~sb3_gac.envs.wrappers.SensorNoise` they compose in the order of a real robot: a value is measured, with
noise, then sent, and the policy keeps a history of what has arrived::

    env = History(DroppedFrames(SensorDelay(SensorNoise(env, 0.1), steps=2), probability=0.1), length=4, actions=True)

A delayed value has the noise that it was measured with, and a value that is shown again has the same noise again.
"""

from collections import deque
from collections.abc import Callable

import gymnasium as gym
import numpy as np

from sb3_gac.envs.goals import AppendDesiredGoal
from sb3_gac.envs.spaces import PARTIAL
from sb3_gac.envs.state import layers
from sb3_gac.envs.wrappers import EntryWrapper, History, PreviousAction, SensorNoise, count_wrappers

FRAME_STREAM = 0x6672616D65  # keeps lost frames apart from generators that others seed with the same number
#: Wrappers that add to a sensor's value what does not come from the sensor: they stand outside of what disturbs it
_AFTER_THE_SENSOR = (History, PreviousAction, AppendDesiredGoal)


class SensorDelay(EntryWrapper):
    """
    Show one entry as it was some steps before.

    In an episode's first steps, the first value stands in for those that are not there yet.

    :param env: environment with a Dict observation
    :param steps: number of steps by which the entry is late, 0 for none
    :param key: the entry that is late; all others stay as they are
    :raises ValueError: if ``steps`` is no integer of at least 0, or the entry is missing
    """

    def __init__(self, env: gym.Env, steps: int, key: str = PARTIAL):
        super().__init__(env, key)
        if not isinstance(steps, (int, np.integer)) or isinstance(steps, bool) or steps < 0:
            raise ValueError(f"steps must be an integer of at least 0, by which the entry is late, got {steps!r}.")
        self.steps = int(steps)
        self._values: deque[np.ndarray] = deque(maxlen=self.steps + 1)

    def _first(self, value: np.ndarray, seed: int | None) -> np.ndarray:
        self._values.extend([value.copy()] * (self.steps + 1))
        return self._values[0].copy()

    def _next(self, value: np.ndarray, action: object, reward: object) -> np.ndarray:
        self._values.append(value.copy())  # the environment may write into it again
        return self._values[0].copy()


class DroppedFrames(EntryWrapper):
    """
    Lose each value of one entry with some probability, independently; the last one that arrived is then shown again.

    An episode's first value always arrives. Losses have a generator of their own, seeded by ``reset(seed=...)``: the
    environment's random numbers and those of the noise are the same whatever ``probability`` is, and what is lost with a
    small probability is lost with a larger one as well.

    :param env: environment with a Dict observation
    :param probability: that a value is lost, from 0 to 1
    :param key: the entry whose values are lost; all others stay as they are
    :raises ValueError: if ``probability`` is no number from 0 to 1, or the entry is missing
    """

    def __init__(self, env: gym.Env, probability: float, key: str = PARTIAL):
        super().__init__(env, key)
        is_number = isinstance(probability, (int, float, np.integer, np.floating)) and not isinstance(probability, bool)
        if not is_number or not 0 <= probability <= 1:
            raise ValueError(f"probability must be a number from 0 to 1, with which a value is lost, got {probability!r}.")
        self.probability = float(probability)
        self._stream = [FRAME_STREAM] * (1 + count_wrappers(env, DroppedFrames))  # apart from losses further in
        self._generator = np.random.default_rng()
        self._shown = np.empty(0)

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
    :param env: with the entry as it is sent
    :param delay: steps by which the entry is late; 0 adds no wrapper
    :param drop: probability that a value of it is lost on the way; 0 adds no wrapper
    :param key: the entry
    :return: the environment with the entry as it arrives
    :raises ValueError: naming the argument that is none of these
    """
    try:
        late = env if delay == 0 else SensorDelay(env, delay, key)
    except ValueError as error:
        raise ValueError(f"delay: {error}") from None
    try:
        return late if drop == 0 else DroppedFrames(late, drop, key)
    except ValueError as error:
        raise ValueError(f"drop: {error}") from None


def disturb(env: gym.Env, noise_std: float = 0.0, delay: int = 0, drop: float = 0.0, key: str = PARTIAL) -> gym.Env:
    """
    Put wrappers into an environment that has its own already, where the sensor's signal is: beneath every history, previous
    action and goal, which are the policy's own and need no sensor. For evaluations: the outer wrappers keep the bounds of
    their spaces, although noise may go beyond them.

    :param env: changed in place; must not have been reset yet
    :param noise_std: standard deviation of noise on top of the environment's own, 0 for none
    :param delay: steps by which the entry is late
    :param drop: probability that a value of the entry is lost
    :param key: the entry
    :return: the environment, whose outermost layer may be another one
    :raises ValueError: naming the argument that is wrong
    """

    def wrap(inner: gym.Env) -> gym.Env:
        noisy = inner if noise_std == 0 else SensorNoise(inner, noise_std, key)
        return delayed_and_dropped(noisy, delay, drop, key)

    return insert_above(env, sensor_layer(env), wrap)


def sensor_layer(env: gym.Env) -> gym.Env:
    """
    :param env: wrapped
    :return: the outermost of those of its layers whose observation the sensor alone makes
    """
    outside = [number for number, layer in enumerate(layers(env)) if isinstance(layer, _AFTER_THE_SENSOR)]
    return layers(env)[outside[-1] + 1 if outside else 0]


def insert_above(env: gym.Env, layer: gym.Env, wrap: Callable[[gym.Env], gym.Env]) -> gym.Env:
    """
    :param env: wrapped, changed in place
    :param layer: one of its layers
    :param wrap: what is to stand around that layer
    :return: the environment, whose outermost layer is another one if ``layer`` was the outermost
    """
    if layer is env:
        return wrap(env)
    outside = next(other for other in layers(env) if isinstance(other, gym.Wrapper) and other.env is layer)
    outside.env = wrap(layer)
    return env
