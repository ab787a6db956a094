"""Training on the data of another run: its actions, in environments that then do what they did."""

from os import PathLike

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_gac.replay.buffer import CompactDictReplayBuffer


def holds_every_step(buffer: ReplayBuffer | None) -> bool:
    """
    :param buffer: of a model that was trained
    :return: whether :func:`write_recording` can be done
    """
    return isinstance(buffer, CompactDictReplayBuffer) and 0 < buffer.n_added == buffer.size()


def write_recording(model: OffPolicyAlgorithm, path: str | PathLike) -> None:
    """
    Write down all actions that a model's data were collected with, and the rewards, for the argument ``recording``.

    :param model: trained, with a replay buffer that still holds its first step
    :param path: file to write, ``.npz``
    :raises ValueError: if its first steps are no longer there, or the buffer is of another class than this package's
    """
    buffer = model.replay_buffer
    if not holds_every_step(buffer):
        raise ValueError("The replay buffer must be a CompactDictReplayBuffer that holds every step of the training.")
    assert isinstance(buffer, CompactDictReplayBuffer)
    np.savez_compressed(path, actions=buffer.actions[: buffer.n_added], rewards=buffer.rewards[: buffer.n_added])


class Recording:
    """
    What :func:`write_recording` wrote.

    :param path: of the file
    :param n_envs: number of environments, which must be that of the recorded run
    :raises FileNotFoundError: if it is not there
    :raises ValueError: if it is of another number of environments
    """

    def __init__(self, path: str | PathLike, n_envs: int):
        with np.load(path, allow_pickle=False) as stored:
            self._actions, self._rewards = stored["actions"], stored["rewards"]
        recorded = self._actions.shape[1]
        if recorded != n_envs:
            raise ValueError(f"recording is of {recorded} environments, but the model has {n_envs}: make as many.")

    def actions(self, step: int) -> np.ndarray:
        """
        :param step: of each environment
        :return: as the replay buffer has them, shape (n_envs, A)
        :raises ValueError: if there was no such step
        """
        if step >= len(self._actions):
            raise ValueError(f"recording ends after {step} steps of each environment: train no longer than that.")
        return self._actions[step]

    def check(self, step: int, rewards: np.ndarray) -> None:
        """
        :param step: of each environment
        :param rewards: that it has returned, shape (n_envs,)
        :raises ValueError: if they are not the recorded ones
        """
        if not np.array_equal(rewards, self._rewards[step]):
            raise ValueError(
                f"After {step + 1} steps of each environment the rewards are {rewards.tolist()}, and were "
                f"{self._rewards[step].tolist()} when they were recorded: make the environments and the seed those of the "
                "recorded run."
            )
