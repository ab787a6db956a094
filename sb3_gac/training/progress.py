"""Progress of a run: on a terminal a bar with returns, KL and time left, elsewhere a line for each evaluation."""

import shutil
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from sb3_gac import SeededEvalCallback
from sb3_gac.training.directory import shown

_BAR = "{percentage:3.0f}% {bar} {n:,}/{total:,}{desc}"
#: Number of columns from which the terminal has room for long texts
_WIDE = 100


class Progress(BaseCallback):
    """
    A callback that shows the progress of a run; it comes after the callback that evaluates.

    :param evaluation: callback whose ``history`` is shown
    :param total: number of environment steps of the whole run
    """

    def __init__(self, evaluation: SeededEvalCallback, total: int):
        super().__init__()
        self._evaluation, self._total = evaluation, total
        self._started = time.monotonic()
        self._bar: Any = None
        self._evaluations = 0
        self._logged: dict[str, float] = {}
        self._updates_before = 0
        #: Time in seconds and number of environment steps at which warm-up and compilation were over
        self._under_way: tuple[float, int] | None = None
        self._compiles_now = False

    def _on_training_start(self) -> None:
        self._evaluations, self._updates_before = len(self._evaluation.history), self.model._n_updates
        if self.model.compile_decision:  # type: ignore[attr-defined]
            print(self.model.compile_decision, flush=True)  # type: ignore[attr-defined]
        if sys.stderr.isatty():
            start: dict[str, Any] = {"total": self._total, "initial": self.num_timesteps}
            # The delay hides the bar until it is complete: tqdm would write notes behind an incomplete bar, not above it
            start["delay"] = 1e-9
            self._bar = tqdm(**start, bar_format=_BAR, dynamic_ncols=True, mininterval=0.2, leave=True)
            self.model.learn_scope.callback(self._bar.close)  # type: ignore[attr-defined]
        self._show(refresh=True)

    def _on_rollout_start(self) -> None:
        self._logged.update({name: value for name, value in self.logger.name_to_value.items() if "kl" in name})
        if self._under_way is None and self.model._n_updates > self._updates_before:
            self._under_way, self._compiles_now = (time.monotonic(), self.num_timesteps), False
        self._show()

    def _on_step(self) -> bool:
        if self._bar is not None:
            self._bar.update(min(self.num_timesteps, self._total) - self._bar.n)
        if len(self._evaluation.history) > self._evaluations:
            self._evaluations = len(self._evaluation.history)
            if self._bar is None:
                print(self.line(), flush=True)
            self._show(refresh=True)
        return True

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        begins = self.num_timesteps > getattr(model, "learning_starts", 0)
        if model.compiles and not model.programs and begins and not self._compiles_now:
            self._compiles_now = True
            if self._bar is None:
                print("Compiling gradient steps, which takes about half a minute.", flush=True)
            self._show(refresh=True)

    def _show(self, refresh: bool = False) -> None:
        if self._bar is not None:
            self._bar.set_description_str(self.beside_the_bar(shutil.get_terminal_size().columns), refresh=refresh)

    def beside_the_bar(self, columns: int) -> str:
        """
        :param columns: width of the terminal
        :return: text beside the bar: returns, KL and time left, or what the run does now
        """
        if self._compiles_now:
            return "  compiling: half a minute" if columns < _WIDE else "  compiling gradient steps, about half a minute"
        parts = [f"{name} {shown(value)}" for name, value in self._returns().items()]
        kl, target = self._kl()
        if kl is not None:
            parts.append(f"KL {kl:.2g}" + ("" if target is None else f"/{target:.2g}"))
        left = self.seconds_left()
        if left and left >= 0.5:
            parts.append(f"{clock(left)} left")
        elif left is not None:
            parts.append(f"{clock(time.monotonic() - self._started)} in all")
        elif self.num_timesteps < getattr(self.model, "learning_starts", 0):
            parts.append("warm-up")
        return "".join(f"  {part}" for part in parts)

    def line(self) -> str:
        """A line with the results of the last evaluation and the time left."""
        parts = [f"{name} {shown(value)}" for name, value in self._returns().items()]
        last = self._evaluation.history[-1]
        if "kl" in last:
            parts.append(f"KL {last['kl']:.2g}" + (f" (target {last['target_kl']:.2g})" if "target_kl" in last else ""))
        width = len(f"{self._total:,}")
        left = self.seconds_left()
        times = f"{clock(time.monotonic() - self._started)} so far" + (f", {clock(left)} left" if left and left >= 0.5 else "")
        return f"{self.num_timesteps:{width},} of {self._total:,} steps: {', '.join(parts)}; {times}"

    def _returns(self) -> dict[str, float]:
        if not self._evaluation.history:
            return {}
        last = self._evaluation.history[-1]
        return {name: last[name] for name in ("learner", "guider") if name in last}

    def _kl(self) -> tuple[float | None, float | None]:
        """KL of the last gradient steps, and its target; ``None`` for what the algorithm does not log."""
        return self._logged.get("train/kl"), self._logged.get("train/target_kl")

    def seconds_left(self) -> float | None:
        """Seconds left at the pace since warm-up and compilation were over; ``None`` before."""
        if self._under_way is None:
            return None
        since, steps_then = self._under_way
        done = self.num_timesteps - steps_then
        return max(self._total - self.num_timesteps, 0) * (time.monotonic() - since) / done if done > 0 else None


def clock(seconds: float) -> str:
    """
    :param seconds: duration in seconds
    :return: duration as text, such as 1:05 or 2:00:30
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


@contextmanager
def warnings_in_a_line() -> Iterator[None]:
    """Show warnings as one line each, above the bar if there is one, without a line of code."""

    def show(message: Warning | str, category: type[Warning], *place: Any, **others: Any) -> None:
        tqdm.write(f"{'Deprecated' if issubclass(category, DeprecationWarning) else 'Note'}: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Stopped by SIG")  # that warning says how to resume in Python
        warnings.showwarning = show
        yield
