"""A run's state on disk: written in one move, so that a run can go on however its process ended."""

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_gac import ExactCheckpointCallback, SeededEvalCallback
from sb3_gac.checkpoint.files import checkpoints
from sb3_gac.deploy.statistics import STATISTICS

CHECKPOINT, TIMING = "checkpoint", "timing.json"
#: A model, and the state of the callback that evaluates it
Resumed: TypeAlias = tuple[BaseAlgorithm, dict[str, Any]]


def write_atomically(path: Path, text: str) -> None:
    """
    Write a file in one move: whenever the process ends, the file has the whole text or is unchanged.

    :param path: file to write
    :param text: content of the file
    """
    write_together({path: text})


def write_together(texts: Mapping[Path, str]) -> None:
    """
    Write files of which none is to be newer than the others: each is written beside its place, then all are moved.

    :param texts: file to write -> content of the file
    """
    temporaries = {path: path.with_name(f"{path.name}.tmp") for path in texts}
    for path, temporary in temporaries.items():
        with temporary.open("w", encoding="utf-8") as file:
            file.write(texts[path])
            file.flush()
            os.fsync(file.fileno())
    for path, temporary in temporaries.items():
        temporary.replace(path)


def read_seconds(path: Path) -> float:
    """
    :param path: path of a run's ``timing.json``
    :return: seconds from the run's start to its last evaluation, 0 if there is no file
    """
    return float(json.loads(path.read_text(encoding="utf-8"))["seconds"]) if path.exists() else 0.0


def write_timing(path: Path, seconds: float, steps: int, learner: float) -> None:
    """
    :param path: path of a run's ``timing.json``
    :param seconds: seconds from the run's start to its last evaluation
    :param steps: environment steps at that evaluation
    :param learner: mean return of the learner at that evaluation
    """
    write_atomically(path, json.dumps({"seconds": seconds, "steps": steps, "learner": learner}))


class ExactCheckpoints:
    """
    The checkpoints of a run of one of this package's algorithms, one after every evaluation. A run that goes on from the last
    one ends as it would have without the interruption, to the bit if the state of its environments can be restored.

    :param directory: directory of the run
    """

    def __init__(self, directory: Path):
        self._directory = directory / CHECKPOINT

    def resume(self, algorithm_class: Any, arguments: dict[str, Any], env: VecEnv, seed: int) -> Resumed | None:
        """
        :param algorithm_class: class of the algorithm
        :param arguments: arguments that the model was made with
        :param env: environments of the run, made as before
        :param seed: seed of the run
        :return: model, and the state of its evaluations so far; ``None`` if there is no checkpoint
        """
        if not checkpoints(self._directory):
            return None
        model = algorithm_class.resume(self._directory, env, device="cpu", **arguments)
        return model, _as_state(model.resumed_notes)

    def callback(self, evaluation: SeededEvalCallback, every: int) -> BaseCallback:
        """
        :param evaluation: callback that evaluates; it is called before the one that is returned
        :param every: environment steps between two evaluations
        :return: callback that writes a checkpoint after every evaluation
        """
        # A run that is told to end writes no checkpoint: one between two evaluations would shift the next evaluations
        return ExactCheckpointCallback(self._directory, every, notes=evaluation.checkpoint_state, on_signals=False)

    def remove(self) -> None:
        """Remove all checkpoints, once the run is finished."""
        shutil.rmtree(self._directory, ignore_errors=True)


class SB3Checkpoints(ExactCheckpoints):
    """
    The checkpoints of a run of one of SB3's own algorithms: model, replay buffer if it has one, and the statistics of
    ``VecNormalize`` if there is one. A run that goes on from one starts new episodes, with another seed.
    """

    def resume(self, algorithm_class: Any, arguments: dict[str, Any], env: VecEnv, seed: int) -> Resumed | None:
        """See :meth:`ExactCheckpoints.resume`; the new seed follows from the run's seed and steps alone."""
        for path in (self._directory, self._with(".old")):
            if path.exists():
                model = algorithm_class.load(path / "model", env=env, device="cpu")
                if hasattr(model, "load_replay_buffer"):  # on-policy algorithms have none
                    model.load_replay_buffer(path / "replay_buffer.pkl")
                _restore_statistics(env, path / STATISTICS)
                model.set_random_seed(hash((seed, model.num_timesteps)) % 2**31)
                return model, _as_state(json.loads((path / "history.json").read_text(encoding="utf-8")))
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

    def _save(self, model: Any, evaluations: dict[str, Any]) -> None:
        current, new, old = (self._with(suffix) for suffix in ("", ".new", ".old"))
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir()
        model.save(new / "model")
        if hasattr(model, "save_replay_buffer"):
            model.save_replay_buffer(new / "replay_buffer.pkl")
        if (normalize := model.get_vec_normalize_env()) is not None:
            normalize.save(str(new / STATISTICS))
        write_atomically(new / "history.json", json.dumps(evaluations))
        shutil.rmtree(old, ignore_errors=True)
        if current.exists():
            current.rename(old)
        new.rename(current)  # between the two moves, the old one is the checkpoint
        shutil.rmtree(old, ignore_errors=True)


class _AfterEvaluation(BaseCallback):
    """
    Saves the model after every evaluation.

    :param evaluation: callback that evaluates; it is called before this one
    :param save: function that saves the model, and the state of its evaluations
    """

    def __init__(self, evaluation: SeededEvalCallback, save: Callable[[Any, dict[str, Any]], None]):
        super().__init__()
        self._evaluation, self._save = evaluation, save

    def _on_step(self) -> bool:
        if self.n_calls % self._evaluation.eval_freq == 0:
            self._save(self.model, self._evaluation.checkpoint_state())
        return True


def _restore_statistics(env: VecEnv, path: Path) -> None:
    """Give the ``VecNormalize`` around environments, if there is one, the statistics that another one saved."""
    normalize = unwrap_vec_normalize(env)
    if normalize is None:
        return
    if not path.exists():
        raise ValueError(
            f"{path.parent} lacks {path.name}, the statistics of its normalisation, as checkpoints of earlier versions do: "
            "remove it, and the run begins again."
        )
    saved = VecNormalize.load(str(path), normalize.venv)
    normalize.obs_rms, normalize.ret_rms = saved.obs_rms, saved.ret_rms


def _as_state(notes: Any) -> dict[str, Any]:
    """State of the evaluations in a checkpoint, in whose place those of earlier versions have the rows alone."""
    return {"history": notes} if isinstance(notes, list) else notes


def checkpoints_of(algorithm_class: type, directory: Path) -> ExactCheckpoints:
    """
    :param algorithm_class: class of a run's algorithm
    :param directory: directory of the run
    :return: the run's checkpoints, of the kind that the algorithm has
    """
    return (ExactCheckpoints if hasattr(algorithm_class, "save_checkpoint") else SB3Checkpoints)(directory)
