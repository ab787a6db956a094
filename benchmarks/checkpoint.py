"""A run's state on disk: written in one move, taken up again after whatever ended the process."""

import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_gac import ExactCheckpointCallback, SeededEvalCallback
from sb3_gac.checkpoint.files import checkpoints

CHECKPOINT, TIMING = "checkpoint", "timing.json"
#: A model and its evaluations so far
Resumed: TypeAlias = tuple[BaseAlgorithm, list[dict[str, float]]]


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


def read_seconds(path: Path) -> float:
    """
    :param path: of a run's ``timing.json``
    :return: seconds that the run has taken so far
    """
    return float(json.loads(path.read_text())["seconds"]) if path.exists() else 0.0


def write_timing(path: Path, seconds: float, steps: int, learner: float) -> None:
    """
    :param path: of a run's ``timing.json``
    :param seconds: from the run's start to its last evaluation
    :param steps: of the environments up to then
    :param learner: return there
    """
    write_atomically(path, json.dumps({"seconds": seconds, "steps": steps, "learner": learner}))


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


class ExactCheckpoints:
    """
    Of a run of this package's algorithms, one after every evaluation: what goes on from the last one ends where the run would
    have ended without an interruption, to the bit if its environments can be put back to where they were.

    :param directory: of the run
    """

    def __init__(self, directory: Path):
        self._directory = directory / CHECKPOINT

    def resume(self, algorithm_class: Any, arguments: dict[str, Any], env: VecEnv, seed: int) -> Resumed | None:
        """
        :param algorithm_class: of the model
        :param arguments: that it was made with
        :param env: made as before
        :param seed: of the run
        :return: model and evaluations so far; ``None`` if there is no checkpoint
        """
        if not checkpoints(self._directory):
            return None
        model = algorithm_class.resume(self._directory, env, device="cpu", **arguments)
        return model, model.resumed_notes

    def callback(self, evaluation: SeededEvalCallback, every: int) -> BaseCallback:
        """
        :param evaluation: called before what is returned
        :param every: steps between two evaluations
        """
        # Told to end, a run ends at once: a checkpoint between evaluations would shift those to come
        return ExactCheckpointCallback(self._directory, every, notes=lambda: _plain(evaluation.history), on_signals=False)

    def remove(self) -> None:
        """Once the run is finished."""
        shutil.rmtree(self._directory, ignore_errors=True)


class SB3Checkpoints(ExactCheckpoints):
    """Of a run of SB3's own algorithms: model and replay buffer; what goes on starts new episodes, and random numbers anew."""

    def resume(self, algorithm_class: Any, arguments: dict[str, Any], env: VecEnv, seed: int) -> Resumed | None:
        """See :meth:`ExactCheckpoints.resume`; the same checkpoint always goes on in the same way."""
        for path in (self._directory, self._with(".old")):
            if path.exists():
                model = algorithm_class.load(path / "model", env=env, device="cpu")
                model.load_replay_buffer(path / "replay_buffer.pkl")
                model.set_random_seed(hash((seed, model.num_timesteps)) % 2**31)
                return model, json.loads((path / "history.json").read_text())
        return None

    def callback(self, evaluation: SeededEvalCallback, every: int) -> BaseCallback:
        """See :meth:`ExactCheckpoints.callback`."""
        return _AfterEvaluation(evaluation, self._save)

    def remove(self) -> None:
        """See :meth:`ExactCheckpoints.remove`."""
        for suffix in ("", ".new", ".old"):
            shutil.rmtree(self._with(suffix), ignore_errors=True)

    def _with(self, suffix: str) -> Path:
        return self._directory.with_name(f"{CHECKPOINT}{suffix}")

    def _save(self, model: Any, history: list[dict[str, float]]) -> None:
        current, new, old = (self._with(suffix) for suffix in ("", ".new", ".old"))
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir()
        model.save(new / "model")
        model.save_replay_buffer(new / "replay_buffer.pkl")
        write_atomically(new / "history.json", json.dumps(_plain(history)))
        shutil.rmtree(old, ignore_errors=True)
        if current.exists():
            current.rename(old)
        new.rename(current)  # between the two moves, the old one is the checkpoint
        shutil.rmtree(old, ignore_errors=True)


class _AfterEvaluation(BaseCallback):
    """
    :param evaluation: called before this one
    :param save: of model and evaluations so far
    """

    def __init__(self, evaluation: SeededEvalCallback, save: Callable[[Any, list[dict[str, float]]], None]):
        super().__init__()
        self._evaluation, self._save = evaluation, save

    def _on_step(self) -> bool:
        if self.n_calls % self._evaluation.eval_freq == 0:
            self._save(self.model, self._evaluation.history)
        return True


def _plain(history: list[dict[str, float]]) -> list[dict[str, float]]:
    return [{key: value if isinstance(value, int) else float(value) for key, value in row.items()} for row in history]


def checkpoints_of(algorithm_class: type, directory: Path) -> ExactCheckpoints:
    """
    :param algorithm_class: of a run
    :param directory: of the run
    """
    return (ExactCheckpoints if hasattr(algorithm_class, "save_checkpoint") else SB3Checkpoints)(directory)
