"""The results of an evaluation: rows of a table, and all numbers as JSON."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_gac.evaluation.episodes import Episode
from sb3_gac.evaluation.settings import UNDISTURBED, Setting
from sb3_gac.evaluation.statistics import Interval, mean_interval

#: Setting -> policy -> its episodes, from the same seeds in all settings
Results = Mapping[Setting, Mapping[str, Sequence[Episode]]]
HEADER = ("noise", "delay", "drop", "policy", "return", "std", "95% of the mean", "share", "difference", "success")
NOTHING = "-"
LEGEND = "share, difference: of the undisturbed return, episode by episode from the same seeds; - where it can't be said."


@dataclass(frozen=True)
class Outcome:
    """
    The outcome of a policy's episodes in a setting.

    :param returns: returns, one for each seed, shape (number of episodes,)
    :param lengths: numbers of steps of the episodes, shape (number of episodes,)
    :param successes: whether each episode was a success, ``None`` where the environment does not report it
    :param mean: mean of the returns, with its interval over episodes
    :param std: standard deviation of the returns, ``nan`` for a single episode
    :param difference: mean of the difference between each return and the undisturbed one from the same seed, with its interval
    :param share: mean return divided by the undisturbed mean return, ``None`` unless the latter is above 0
    """

    returns: np.ndarray
    lengths: np.ndarray
    successes: np.ndarray | None
    mean: Interval
    std: float
    difference: Interval
    share: float | None

    def as_json(self) -> dict[str, Any]:
        """The outcome as JSON holds it, with ``None`` for numbers that a single episode does not have."""
        return {
            "mean": self.mean.mean,
            "std": _finite(self.std),
            "interval": [_finite(self.mean.low), _finite(self.mean.high)],
            "share": self.share,
            "difference": self.difference.mean,
            "difference_interval": [_finite(self.difference.low), _finite(self.difference.high)],
            "success": self.success,
            "returns": self.returns.tolist(),
            "lengths": self.lengths.tolist(),
        }

    @property
    def success(self) -> float | None:
        """Share of the episodes that were a success, ``None`` where the environment does not report successes."""
        return None if self.successes is None else float(self.successes.mean())


def outcome(episodes: Sequence[Episode], undisturbed: Sequence[Episode]) -> Outcome:
    """
    Compare a policy's episodes in a setting with its undisturbed ones.

    :param episodes: episodes of a policy in a setting
    :param undisturbed: undisturbed episodes of the same policy, from the same seeds
    :return: outcome of the policy in the setting
    """
    returns, before = (np.array([episode.total for episode in those]) for those in (episodes, undisturbed))
    successes = [episode.success for episode in episodes]
    return Outcome(
        returns,
        np.array([episode.length for episode in episodes]),
        None if None in successes else np.array(successes),
        mean_interval(returns),
        float(returns.std(ddof=1)) if len(returns) > 1 else math.nan,
        mean_interval(returns - before),
        float(returns.mean() / before.mean()) if before.mean() > 0 else None,
    )


def outcomes(results: Results) -> dict[Setting, dict[str, Outcome]]:
    """
    Compare all policies in all settings with their undisturbed episodes.

    :param results: episodes of all settings, the undisturbed one among them
    :return: setting -> policy -> outcome
    """
    undisturbed = results[UNDISTURBED]
    return {
        setting: {policy: outcome(episodes, undisturbed[policy]) for policy, episodes in of_policies.items()}
        for setting, of_policies in results.items()
    }


def header_of(episodes: Sequence[Episode]) -> tuple[str, ...]:
    """
    :param episodes: episodes of any setting
    :return: names of the columns; successes are the last one, and left out where the environment does not report them
    """
    return HEADER if all(episode.success is not None for episode in episodes) else HEADER[:-1]


def row(setting: Setting, policy: str, found: Outcome) -> list[str]:
    """
    Write an outcome as a row of the table.

    :param setting: setting of the sensor
    :param policy: name of the policy
    :param found: outcome of the policy in the setting
    :return: cells under :data:`HEADER`
    """
    is_reference = setting == UNDISTURBED
    return [
        f"{setting.noise:g}",
        str(setting.delay),
        f"{setting.drop:g}",
        policy,
        in_digits(found.mean.mean),
        in_digits(found.std),
        _in_words(found.mean),
        NOTHING if found.share is None else f"{found.share:.0%}",
        NOTHING if is_reference else _difference(found.difference),
        NOTHING if found.success is None else f"{found.success:.0%}",
    ]


def _difference(found: Interval) -> str:
    """A difference with its interval; the difference alone where a single episode has no interval."""
    return in_digits(found.mean, "+") + (f" {_in_words(found, '+')}" if math.isfinite(found.low) else "")


def in_digits(value: float, sign: str = "") -> str:
    """
    Write a return as text.

    :param value: return, or difference of returns
    :param sign: sign in the number's format, "+" to write it before positive numbers
    :return: the value in four digits, from 1,000 on as a whole number; ``NOTHING`` if it is not finite
    """
    if not math.isfinite(value):
        return NOTHING
    return f"{value:{sign}.0f}" if abs(value) >= 1000 else f"{value:{sign}.4g}"


def _in_words(interval: Interval, sign: str = "") -> str:
    if not math.isfinite(interval.low):
        return NOTHING
    return f"[{in_digits(interval.low, sign)}, {in_digits(interval.high, sign)}]"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
