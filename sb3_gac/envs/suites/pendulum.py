"""Pendulum with a hidden angular velocity: its physics is cheap, and a policy needs a memory for it."""

from typing import Any

import gymnasium as gym

from sb3_gac.envs.suites.layout import TaskLayout, make_task

LAYOUT = TaskLayout("Pendulum-v1", partial=(0, 1), velocity=(2,))


def make_pendulum(
    noise_std: float = 0.0,
    privileged: str = "state",
    history: int = 1,
    delay: int = 0,
    drop: float = 0.0,
    **kwargs: Any,
) -> gym.Env:
    """
    Build the task without its time limit, which ``gymnasium.make("sb3_gac/Pendulum-v1")`` adds.

    ``partial`` is the angle's cosine and sine.

    :param noise_std: standard deviation of the noise on the cosine and the sine; 0 for none
    :param privileged: "state" for the whole clean state, "velocity" for the angular velocity alone
    :param history: number of observations in ``partial``, the newest last, followed by the actions between them
    :param delay: number of steps by which ``partial`` is late
    :param drop: probability that an observation of ``partial`` is lost, and the last one shown again
    :param kwargs: keyword arguments of gymnasium's environment
    :return: environment with ``partial`` and ``privileged``
    :raises ValueError: if an argument is wrong; the message names it
    """
    return make_task(LAYOUT, noise_std, privileged, history, delay, drop, **kwargs)


#: Id -> arguments of its registration, with its time limit of 200 steps
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "sb3_gac/Pendulum-v1": {"entry_point": f"{__name__}:make_pendulum", "max_episode_steps": 200}
}
