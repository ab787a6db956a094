"""The runs of a launch: each run's state, its progress, the reason of its failure, and the time that is left."""

import json
import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.checkpoint import TIMING
from benchmarks.engines import ATTEMPT
from benchmarks.suite import RunSpec

STATES = ("waiting", "running", "finished", "not started", "failed")
ENDED_BADLY = ("not started", "failed")
_READ_AT_MOST = 1 << 16  # bytes from the end of a log, which may be long


@dataclass
class Job:
    """
    A run that a launch is to make.

    :param spec: settings of the run
    :param directory: directory of the run's files
    :param command: words of the command that makes the run
    :param state: one of ``STATES``
    :param needs: jobs that must be finished before this one starts
    :param reason: reason why the last attempt failed, empty if none failed
    :param ended: time at which the job ended, in seconds of :func:`time.monotonic`
    """

    spec: RunSpec
    directory: Path
    command: list[str]
    state: str = "waiting"
    needs: list["Job"] = field(default_factory=list)
    reason: str = ""
    ended: float = 0.0

    @property
    def lacking(self) -> list["Job"]:
        """The jobs that this one needs and that will never be finished."""
        return [job for job in self.needs if job.state in ENDED_BADLY]

    @property
    def is_ready(self) -> bool:
        """Whether all jobs that this one needs have ended, well or badly."""
        return all(job.state not in ("waiting", "running") for job in self.needs)

    @property
    def log(self) -> Path:
        """The file of the run's output, over all attempts."""
        return self.directory / "log.txt"


def last_evaluation(job: Job) -> tuple[int, float | None]:
    """
    :param job: job in any state
    :return: environment steps at the run's last evaluation, and the learner's mean return there; 0 and ``None`` before the
        first evaluation
    """
    try:
        last = json.loads((job.directory / TIMING).read_text(encoding="utf-8"))
        return int(last["steps"]), float(last["learner"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0, None


def count(jobs: Sequence[Job]) -> str:
    """
    :param jobs: jobs of a launch
    :return: text that says how many jobs are in each state
    """
    states = Counter(job.state for job in jobs)
    return ", ".join(f"{states[state]} {state}" for state in reversed(STATES) if states[state] or state not in ENDED_BADLY)


def reason_in(log: Path, status: int) -> str:
    """
    :param log: file with the output of all attempts at a run
    :param status: exit status of the last attempt's process, negative for the signal that ended it
    :return: reason why the last attempt failed: the exception at the end of its last traceback; without a traceback, the
        signal, or the last line of the output
    """
    lines = _last_attempt(log)
    tracebacks = [index for index, line in enumerate(lines) if line.startswith("Traceback (most recent call last)")]
    if tracebacks:
        said = (line for line in lines[tracebacks[-1] + 1 :] if not line[0].isspace())
        if exception := next(said, None):
            return exception
    if status < 0:
        name = signal.Signals(-status).name
        return f"killed by {name}" + (", as when memory runs out" if name == "SIGKILL" else "")
    return f"{lines[-1]} (exit status {status})" if lines else f"exit status {status}, and no output"


def _last_attempt(log: Path) -> list[str]:
    """The lines of the last attempt's output, without empty ones."""
    try:
        with log.open("rb") as file:
            file.seek(max(log.stat().st_size - _READ_AT_MOST, 0))
            text = file.read().decode(errors="replace")
    except OSError:
        return []
    _, attempt, output = text.rpartition(ATTEMPT)
    lines = output.splitlines()[1 if attempt else 0 :]  # the first one is the command
    return [line for line in lines if line.strip()]


class Clock:
    """
    Estimates the time that a launch still takes, from the environment steps that all its runs have made since it began.

    :param jobs: jobs of the launch
    :param now: function that returns the time in seconds
    """

    def __init__(self, jobs: Sequence[Job], now: Callable[[], float] = time.monotonic):
        self._jobs, self._now = jobs, now
        self._before = {id(job): last_evaluation(job)[0] for job in jobs}
        self._started = self._changed = now()
        self._made = 0

    def done_of_all(self) -> tuple[int, int]:
        """The environment steps made so far, and all steps, both of the runs that are finished, running or waiting."""
        counted = [job for job in self._jobs if job.state not in ENDED_BADLY]
        return sum(map(self._done, counted)), sum(job.spec.steps for job in counted)

    def seconds_left(self) -> float | None:
        """The seconds that are left at the pace so far, ``None`` before the first evaluation."""
        now, made = self._now(), sum(self._done(job) - self._before[id(job)] for job in self._jobs)
        if made != self._made:
            self._made, self._changed = made, now
        if self._made <= 0 or self._changed <= self._started:
            return None
        done, of_all = self.done_of_all()
        seconds_per_step = (self._changed - self._started) / self._made
        return max((of_all - done) * seconds_per_step - (now - self._changed), 0.0)

    def _done(self, job: Job) -> int:
        if job.state == "finished":
            return job.spec.steps
        if job.state == "waiting":
            return self._before[id(job)]
        return min(max(last_evaluation(job)[0], self._before[id(job)]), job.spec.steps)


def in_words(seconds: float) -> str:
    """
    :param seconds: duration in seconds
    :return: text in seconds, minutes, or hours and minutes
    """
    minutes = round(seconds / 60)
    if seconds < 60:
        return f"{seconds:.0f} s"
    if minutes < 60:
        return f"{minutes} min"
    return f"{minutes // 60:,} h {minutes % 60:02} min"
