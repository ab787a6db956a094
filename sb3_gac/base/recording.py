"""Training on the data of another run: its recorded actions, in environments that then return the same again."""

from os import PathLike

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_gac.replay.buffer import CompactDictReplayBuffer


def holds_every_step(buffer: ReplayBuffer | None) -> bool:
    """
    Whether a replay buffer still holds every step that was stored, so that :func:`write_recording` works.

    :param buffer: replay buffer of a trained model, if it has one
    :return: whether every step of the training is there
    """
    return isinstance(buffer, CompactDictReplayBuffer) and 0 < buffer.n_added == buffer.size()


def write_recording(model: OffPolicyAlgorithm, path: str | PathLike) -> None:
    """
    Write the actions and rewards of a model's training to a file, for the argument ``recording`` of another run.

    :param model: trained model, whose replay buffer still holds its first step
    :param path: path of the file to write, ``.npz``
    :raises ValueError: if the first steps are no longer in the replay buffer, or it is of another class than this package's
    """
    buffer = model.replay_buffer
    if not holds_every_step(buffer):
        raise ValueError("The replay buffer must be a CompactDictReplayBuffer that holds every step of the training.")
    assert isinstance(buffer, CompactDictReplayBuffer)
    np.savez_compressed(path, actions=buffer.actions[: buffer.n_added], rewards=buffer.rewards[: buffer.n_added])


class Recording:
    """
    The actions and rewards of a run, read from the file that :func:`write_recording` wrote.

    :param path: path of the file
    :param n_envs: number of environments, which must be that of the recorded run
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if the recorded run had another number of environments
    """

    def __init__(self, path: str | PathLike, n_envs: int):
        with np.load(path, allow_pickle=False) as stored:
            self._actions, self._rewards = stored["actions"], stored["rewards"]
        recorded = self._actions.shape[1]
        if recorded != n_envs:
            raise ValueError(f"recording is of {recorded} environments, but the model has {n_envs}: make as many.")

    def check_length(self, steps: int) -> None:
        """
        Check that there are actions for a whole training.

        :param steps: number of steps of each environment at the end of training
        :raises ValueError: if the recorded run had fewer steps
        """
        if steps > len(self._actions):
            raise ValueError(
                f"recording ends after {len(self._actions)} steps of each environment, and training would end after {steps}: "
                "train no longer than the recorded run."
            )

    def actions(self, step: int) -> np.ndarray:
        """
        The recorded actions of a step.

        :param step: number of steps of each environment before this one
        :return: actions in the replay buffer's form, in [-1, 1] or numbers of discrete actions, shape (n_envs, A)
        :raises ValueError: if the recorded run had fewer steps
        """
        if step >= len(self._actions):
            raise ValueError(f"recording ends after {step} steps of each environment: train no longer than that.")
        return self._actions[step]

    def check(self, step: int, rewards: np.ndarray) -> None:
        """
        Check that the environments return the recorded rewards.

        :param step: number of steps of each environment before this one
        :param rewards: rewards of the step, shape (n_envs,)
        :raises ValueError: if they are not the recorded ones
        """
        if not np.array_equal(rewards, self._rewards[step]):
            raise ValueError(
                f"After {step + 1} steps of each environment the rewards are {rewards.tolist()}, and were "
                f"{self._rewards[step].tolist()} when they were recorded: make the environments and the seed those of the "
                "recorded run."
            )
