"""Checkpoints on a schedule, and when the process is told to end."""

import signal
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_gac.base.resuming import ResumableAlgorithm, encode_notes
from sb3_gac.checkpoint.files import checkpoints
from sb3_gac.checks.environments import EnvironmentFailedError
from sb3_gac.checks.values import as_sentence, described
from sb3_gac.optim.compile import is_compiling

_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class ExactCheckpointCallback(BaseCallback):
    """
    Save checkpoints before rollouts start, and on signals after a step; a resumed run is the same to the bit from either.

    The callback calls :meth:`ResumableAlgorithm.save_checkpoint`, on a schedule and on signals. SIGTERM, which pre-empting
    schedulers send, and Ctrl-C have the step finished and a checkpoint written. Then the process ends with a message that
    says how to go on: ``SystemExit`` with status 143, or ``KeyboardInterrupt``, also if no checkpoint can be made. A second
    signal ends the process at once, because an environment may hang. Ctrl-C also does so while gradient steps are being
    compiled, because in a terminal it ends the compiler's processes as well. If a checkpoint can't be written, on a full
    disk for example, the callback warns, training goes on, and the checkpoint before it stays.

    :param directory: folder in which the checkpoints are written
    :param every: number of environment steps between two checkpoints
    :param keep: number of checkpoints to keep, the latest ones
    :param notes: function without arguments, called for each checkpoint and when ``learn`` begins, whose value is kept with
        the checkpoint (anything that JSON can hold, and numbers and arrays of numpy and torch); ``None`` for no notes
    :param on_signals: whether to act on SIGTERM and Ctrl-C, which is possible in the main thread only
    :param at_start: whether to write a checkpoint before the first step, so that there is one from the start
    :raises ValueError: if ``every`` or ``keep`` is not positive
    :raises TypeError: when ``learn`` begins, if no checkpoint can hold the model's data (``HerReplayBuffer``) or the notes
    """

    model: ResumableAlgorithm

    def __init__(
        self,
        directory: str | Path,
        every: int,
        keep: int = 2,
        notes: Callable[[], Any] | None = None,
        on_signals: bool = True,
        at_start: bool = False,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        for name, value in {"every": every, "keep": keep}.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}.")
        self.directory = Path(directory)
        self.every = every
        self.keep = keep
        self.notes = notes
        self.on_signals = on_signals
        self.at_start = at_start
        self._caught: int | None = None
        self._handlers: dict[int, Any] = {}
        self._next = 0

    def _init_callback(self) -> None:
        if not isinstance(self.model, ResumableAlgorithm):
            raise TypeError(f"{type(self.model).__name__} has no save_checkpoint(): use SB3's CheckpointCallback.")
        self.model.check_data_can_be_saved()
        if self.notes is not None:
            try:
                notes = self.notes()
            except Exception:  # there may be nothing to note before the first step
                return
            encode_notes(notes)

    def _on_training_start(self) -> None:
        self._next = self.model.num_timesteps + (0 if self.at_start else self.every)
        self._caught = None
        if self.on_signals and threading.current_thread() is threading.main_thread():
            self._handlers = {number: signal.signal(number, self._catch) for number in _SIGNALS}
            self.model.learn_scope.callback(self._release_signals)  # so that they are released after an error as well
            self.model.learn_scope.push(self._save_after_all)

    def _catch(self, number: int, frame: FrameType | None) -> None:
        if self._caught is not None or (number == signal.SIGINT and is_compiling()):
            self._caught = None
            self._release_signals()
            signal.raise_signal(number)
            return
        self._caught = number
        name = signal.Signals(number).name
        warnings.warn(
            f"{name}: the step is finished and a checkpoint made. A second one ends the process at once.", stacklevel=2
        )

    def _save_after_all(self, kind: Any, error: BaseException | None, traceback: Any) -> None:
        """
        Save once ``learn`` has stopped at the step's end. Ctrl-C in a terminal ends the environments' processes as well: then
        the step can't be finished.
        """
        if self._caught is not None and (error is None or isinstance(error, EnvironmentFailedError)):
            self._end_process(self._caught)

    def _on_rollout_start(self) -> None:
        if self._caught is not None:
            self._end_process(self._caught)
        if self.model.num_timesteps >= self._next:
            self._next = self.model.num_timesteps + self.every
            try:
                self._save()
            except OSError as error:
                self._warn_of_failure(error, "Training goes on.")

    def _save(self) -> None:
        self.model.save_checkpoint(self.directory, self.keep, None if self.notes is None else self.notes())

    def _warn_of_failure(self, error: Exception, then: str) -> None:
        failed = f"The checkpoint after {self.model.num_timesteps} steps could not be written to {self.directory}"
        what = as_sentence(error) if isinstance(error, OSError) else described(error)
        warnings.warn(f"{failed}: {what} {then} The checkpoint before it is as it was.", stacklevel=3)

    def _end_process(self, number: int) -> None:
        name, saved = signal.Signals(number).name, f"after {self.model.num_timesteps} steps"
        try:
            self._save()
        except Exception as error:  # whatever it is, the process was told to end
            self._warn_of_failure(error, "What was trained since the one before it is lost.")
            saved = "before the one that failed"
        if checkpoints(self.directory):
            message = (
                f"Stopped by {name}; the checkpoint {saved} is in {self.directory}. To go on: model = "
                f'{type(self.model).__name__}.resume("{self.directory}", env), then '
                "model.learn(model.steps_left, reset_num_timesteps=False)."
            )
        else:
            message = f"Stopped by {name}; no checkpoint is in {self.directory}."
        if number == signal.SIGINT:
            raise KeyboardInterrupt(message)
        warnings.warn(message, stacklevel=2)
        raise SystemExit(128 + number)

    def _on_step(self) -> bool:
        # After the last step there is nothing to stop: what is left of the round belongs to the training
        return self._caught is None or self.model.num_timesteps >= self.model._total_timesteps

    def _release_signals(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}
