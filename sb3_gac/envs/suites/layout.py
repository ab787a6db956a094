"""Tasks whose observation is split by position: noisy positions, and what only a simulator knows of velocities."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym

from sb3_gac.envs.disturbances import delayed_and_dropped
from sb3_gac.envs.wrappers import History, SensorNoise, SplitObservation

PRIVILEGED_CHOICES = ("state", "velocity")


@dataclass(frozen=True)
class TaskLayout:
    """
    Where a task's observation holds what.

    :param env_id: the simulator's own id
    :param partial: indices of positions and other quantities without velocities
    :param velocity: indices of velocities
    :param kwargs: of ``gymnasium.make``
    """

    env_id: str
    partial: tuple[int, ...]
    velocity: tuple[int, ...]
    kwargs: dict[str, Any] = field(default_factory=dict)


def positions_first(env_id: str, n_positions: int, n_velocities: int, **kwargs: Any) -> TaskLayout:
    """
    :param env_id: the simulator's own id
    :param n_positions: at the observation's beginning
    :param n_velocities: after them
    :param kwargs: of ``gymnasium.make``
    """
    size = n_positions + n_velocities
    return TaskLayout(env_id, tuple(range(n_positions)), tuple(range(n_positions, size)), kwargs)


def visible_in(layout: TaskLayout, privileged: str) -> tuple[int, ...]:
    """
    :param layout: of the task
    :param privileged: "state" for the whole clean state, "velocity" for velocities alone
    :return: indices of the privileged entry
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

    :param layout: of the task
    :param noise_std: standard deviation of the noise on ``partial``, in the observation's own units; 0 for none
    :param privileged: "state" for the whole clean state, "velocity" for velocities alone
    :param history: observations that ``partial`` holds, see :func:`noisy_with_history`
    :param delay: steps by which ``partial`` is late
    :param drop: probability that an observation of ``partial`` is lost
    :param kwargs: of the gymnasium environment
    :raises ValueError: naming the argument that is wrong
    """
    visible = visible_in(layout, privileged)
    env = gym.make(layout.env_id, disable_env_checker=True, max_episode_steps=-1, **{**layout.kwargs, **kwargs}).unwrapped
    return noisy_with_history(SplitObservation(env, layout.partial, visible), noise_std, history, delay, drop)


def noisy_with_history(env: gym.Env, noise_std: float, history: int = 1, delay: int = 0, drop: float = 0.0) -> gym.Env:
    """
    What every suite's ``partial`` may have: sensor noise, a delay, losses, and a short memory of what has arrived.

    :param env: with an entry ``partial``
    :param noise_std: standard deviation of the noise on ``partial``, in its own units; 0 for none
    :param history: noisy observations that ``partial`` then holds, the newest last, followed by the actions between them;
        1 for the newest alone
    :param delay: steps by which noisy observations are late
    :param drop: probability that one is lost, and the last one shown again
    :raises ValueError: if ``noise_std`` is negative, ``history`` no positive integer, ``delay`` no integer of at least 0, or
        ``drop`` no probability
    """
    if not isinstance(history, int) or isinstance(history, bool) or history < 1:
        raise ValueError(f"history must be an integer of at least 1, got {history!r}.")
    arriving = delayed_and_dropped(SensorNoise(env, noise_std), delay, drop)
    return arriving if history == 1 else History(arriving, history, actions=True)
