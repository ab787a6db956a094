"""Schedules that are text, so that YAML, presets and saved models can hold them: "geometric 0.05 -> 0.0033 over 0.6"."""

import re
from dataclasses import dataclass
from typing import Any

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_FORM = re.compile(rf"(linear|geometric)\s+({_NUMBER})\s*->\s*({_NUMBER})(?:\s+over\s+({_NUMBER}))?")
_WRITE = 'write "linear START -> END" or "geometric START -> END", and "over FRACTION" after it if END is reached earlier'


@dataclass(frozen=True)
class NamedSchedule:
    """
    A number that changes over training.

    :param kind: "linear", by equal differences, or "geometric", by equal ratios
    :param start: at the start
    :param end: from the fraction ``over`` of training on
    :param over: from above 0 to 1
    """

    kind: str
    start: float
    end: float
    over: float = 1.0

    def __call__(self, progress_remaining: float) -> float:
        """
        :param progress_remaining: from 1 to 0
        """
        done = min((1.0 - progress_remaining) / self.over, 1.0)
        if done == 1.0:
            return self.end
        if self.kind == "linear":
            return self.start + done * (self.end - self.start)
        return float(self.start * (self.end / self.start) ** done)


def read_schedule(text: str) -> NamedSchedule:
    """
    :param text: such as "linear 1.0 -> 0.0", or "geometric 0.05 -> 0.0033 over 0.6"
    :raises ValueError: if it is no such thing
    """
    found = _FORM.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"{text!r} is no schedule: {_WRITE}.")
    kind, start, end, over = found[1], float(found[2]), float(found[3]), float(found[4] or 1.0)
    if kind == "geometric" and not (start > 0 and end > 0):
        raise ValueError(f"{text!r}: a geometric schedule goes from one number above 0 to another.")
    if not 0 < over <= 1:
        raise ValueError(f"{text!r}: the fraction of training after over is above 0 and at most 1.")
    return NamedSchedule(kind, start, end, over)


def as_schedule(value: Any) -> Any:
    """
    :param value: an argument that may be a schedule
    :return: the schedule, where it is the text of one; else the value as it is
    """
    return read_schedule(value) if isinstance(value, str) else value
