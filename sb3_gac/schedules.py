"""Schedules as text, which YAML, presets and saved models can hold, such as "geometric 0.05 -> 0.0033 over 0.6"."""

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

    :param kind: kind of change: "linear", by equal differences, or "geometric", by equal ratios
    :param start: value at the start of training
    :param end: value from the fraction ``over`` of training on
    :param over: fraction of training over which the value changes, above 0 and at most 1
    """

    kind: str
    start: float
    end: float
    over: float = 1.0

    def __call__(self, progress_remaining: float) -> float:
        """
        The value at a point of training.

        :param progress_remaining: remaining fraction of training, from 1 at the start to 0 at the end
        :return: value of the schedule
        """
        done = min((1.0 - progress_remaining) / self.over, 1.0)
        if done == 1.0:
            return self.end
        if self.kind == "linear":
            return self.start + done * (self.end - self.start)
        return float(self.start * (self.end / self.start) ** done)


def read_schedule(text: str) -> NamedSchedule:
    """
    :param text: schedule as text, such as "linear 1.0 -> 0.0" or "geometric 0.05 -> 0.0033 over 0.6"
    :return: schedule that the text describes
    :raises ValueError: if the text describes no schedule
    """
    found = _FORM.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"{text!r} is no schedule: {_WRITE}.")
    kind, start, end, over = found[1], float(found[2]), float(found[3]), float(found[4] or 1.0)
    if kind == "geometric" and not (start > 0 and end > 0):
        raise ValueError(f"{text!r}: a geometric schedule goes from one number above 0 to another.")
    if not 0 < over <= 1:
        raise ValueError(f'{text!r}: the FRACTION in "over FRACTION" must be above 0 and at most 1.')
    return NamedSchedule(kind, start, end, over)


def as_schedule(value: Any) -> Any:
    """
    :param value: value of an argument that may be a schedule
    :return: schedule if the value is a text; else the value itself
    :raises ValueError: if the value is a text that describes no schedule
    """
    return read_schedule(value) if isinstance(value, str) else value
