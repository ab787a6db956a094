"""A run's state on disk: written in one move, taken up again after whatever ended the process."""

import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_gac import SeededEvalCallback

CHECKPOINT = "checkpoint"


def write_atomically(path: Path, text: str) -> None:
    """
    :param path: which has the whole text or is what it was before, whenever the process ends
    :param text: to write
    """
    temporary = path.with_name(f"{path.name}.tmp")
    with temporary.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """
    :param directory: of a run, for as long as the context lasts this process's alone
    :raises RuntimeError: if another process has it
    """
    with (directory / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RuntimeError(f"Another process is running {directory}.") from None
        yield


class CheckpointCallback(BaseCallback):
    """
    After every evaluation, model, replay buffer and evaluations so far replace the checkpoint before.

    :param directory: of the run
    :param evaluation: called before this one
    """

    def __init__(self, directory: Path, evaluation: SeededEvalCallback):
        super().__init__()
        self._directory = directory
        self._evaluation = evaluation

    def _on_step(self) -> bool:
        if self.n_calls % self._evaluation.eval_freq == 0:
            save_checkpoint(self.model, self._evaluation.history, self._directory)
        return True


def save_checkpoint(model: BaseAlgorithm, history: list[dict[str, float]], directory: Path) -> None:
    """
    :param model: with a replay buffer
    :param history: evaluations so far
    :param directory: of the run
    """
    current, new, old = (directory / f"{CHECKPOINT}{suffix}" for suffix in ("", ".new", ".old"))
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir()
    model.save(new / "model")
    model.save_replay_buffer(new / "replay_buffer.pkl")  # type: ignore[attr-defined]
    write_atomically(new / "history.json", json.dumps([{key: float(value) for key, value in row.items()} for row in history]))
    shutil.rmtree(old, ignore_errors=True)
    if current.exists():
        current.rename(old)
    new.rename(current)  # between the two moves, the old one is the checkpoint
    shutil.rmtree(old, ignore_errors=True)


def load_checkpoint(
    algorithm_class: Any, directory: Path, env: VecEnv, seed: int
) -> tuple[BaseAlgorithm, list[dict[str, float]]] | None:
    """
    :param algorithm_class: of the model
    :param directory: of the run
    :param env: to go on with, from new episodes
    :param seed: of the run; what follows is random anew, but the same for the same checkpoint
    :return: model and evaluations so far; ``None`` if there is no checkpoint
    """
    for name in (CHECKPOINT, f"{CHECKPOINT}.old"):
        path = directory / name
        if path.exists():
            model = algorithm_class.load(path / "model", env=env, device="cpu")
            model.load_replay_buffer(path / "replay_buffer.pkl")
            model.set_random_seed(hash((seed, model.num_timesteps)) % 2**31)
            return model, json.loads((path / "history.json").read_text())
    return None


def remove_checkpoint(directory: Path) -> None:
    """
    :param directory: of a run that is finished
    """
    for suffix in ("", ".new", ".old"):
        shutil.rmtree(directory / f"{CHECKPOINT}{suffix}", ignore_errors=True)
