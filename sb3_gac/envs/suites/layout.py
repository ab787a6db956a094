"""Tasks whose observation is split by index: noisy positions, and velocities that only a simulator knows."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from gymnasium import spaces

from sb3_gac.envs.arguments import check_count
from sb3_gac.envs.disturbances import delayed_and_dropped
from sb3_gac.envs.wrappers import History, SensorNoise, SplitObservation

PRIVILEGED_CHOICES = ("state", "velocity")


@dataclass(frozen=True)
class TaskLayout:
    """
    The layout of a task's observation.

    :param env_id: simulator's own id of the task
    :param partial: indices of positions and other quantities without velocities
    :param velocity: indices of velocities
    :param kwargs: keyword arguments for ``gymnasium.make``
    :param n_unused: number of components in neither selection
    """

    env_id: str
    partial: tuple[int, ...]
    velocity: tuple[int, ...]
    kwargs: dict[str, Any] = field(default_factory=dict)
    n_unused: int = 0

    @property
    def size(self) -> int:
        """Number of the observation's components."""
        return len(self.partial) + len(self.velocity) + self.n_unused


def positions_first(env_id: str, n_positions: int, n_velocities: int, n_unused: int = 0, **kwargs: Any) -> TaskLayout:
    """
    Make the layout of an observation that begins with positions, followed by velocities.

    :param env_id: simulator's own id of the task
    :param n_positions: number of positions, at the observation's beginning
    :param n_velocities: number of velocities, after the positions
    :param n_unused: number of components after the velocities, which no entry shows
    :param kwargs: keyword arguments for ``gymnasium.make``
    :return: layout of the task's observation
    """
    end = n_positions + n_velocities
    return TaskLayout(env_id, tuple(range(n_positions)), tuple(range(n_positions, end)), kwargs, n_unused)


def check_size(name: str, size: int, expected: int) -> None:
    """
    Check that an observation is as large as the split by position takes it to be.

    :param name: simulator's own id of the task, for the message
    :param size: number of the observation's components
    :param expected: number of components that the split is for
    :raises ValueError: if the numbers differ
    """
    if size != expected:
        raise ValueError(
            f"The observation of {name} has {size} components, but it is split by position as one of {expected}. Leave out "
            "the arguments that change it; or make the simulator's own environment, and split it by SplitObservation."
        )


def visible_in(layout: TaskLayout, privileged: str) -> tuple[int, ...]:
    """
    :param layout: layout of the task's observation
    :param privileged: "state" for the whole clean state, "velocity" for velocities alone
    :return: indices of the privileged entry's components
    :raises ValueError: if ``privileged`` is unknown
    """
    if privileged not in PRIVILEGED_CHOICES:
        raise ValueError(f"privileged must be one of {list(PRIVILEGED_CHOICES)}, got {privileged!r}.")
    return layout.velocity if privileged == "velocity" else tuple(sorted((*layout.partial, *layout.velocity)))


def make_task(
    layout: TaskLayout,
    noise_std: float,
    privileged: str,
    history: int = 1,
    delay: int = 0,
    drop: float = 0.0,
    **kwargs: Any,
) -> gym.Env:
    """
    Build a task without its time limit.

    :param layout: layout of the task's observation
    :param noise_std: standard deviation of the noise on ``partial``, in the observation's own units; 0 for none
    :param privileged: "state" for the whole clean state, "velocity" for velocities alone
    :param history: number of observations in ``partial``, with actions between them, as in :func:`noisy_with_history`
    :param delay: number of steps by which ``partial`` is late
    :param drop: probability that an observation of ``partial`` is lost, and the last one shown again
    :param kwargs: further keyword arguments for ``gymnasium.make``, which override those of the layout
    :return: environment with ``partial`` and ``privileged``
    :raises ValueError: if an argument is wrong, or ``kwargs`` make an observation of another size, as another robot has
    """
    visible = visible_in(layout, privileged)
    env = gym.make(layout.env_id, disable_env_checker=True, max_episode_steps=-1, **{**layout.kwargs, **kwargs}).unwrapped
    check_size(layout.env_id, spaces.flatdim(env.observation_space), layout.size)
    return noisy_with_history(SplitObservation(env, layout.partial, visible), noise_std, history, delay, drop)


def noisy_with_history(env: gym.Env, noise_std: float, history: int = 1, delay: int = 0, drop: float = 0.0) -> gym.Env:
    """
    Give ``partial`` sensor noise, a delay, losses, and a short history of the observations that have arrived.

    :param env: environment with an entry ``partial``
    :param noise_std: standard deviation of the noise on ``partial``, in its own units; 0 for none
    :param history: number of noisy observations in ``partial``, the newest last, followed by the actions between them; 1 for
        the newest alone
    :param delay: number of steps by which noisy observations are late
    :param drop: probability that a noisy observation is lost, and the last one shown again
    :return: environment in these wrappers
    :raises ValueError: if ``noise_std`` is negative, ``history`` no positive integer, ``delay`` no integer of at least 0, or
        ``drop`` no probability
    """
    history = check_count("history", history)
    arriving = delayed_and_dropped(SensorNoise(env, noise_std), delay, drop)
    return arriving if history == 1 else History(arriving, history, actions=True)
