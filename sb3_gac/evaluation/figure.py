"""The figure of an evaluation: the return over each part of the setting that is varied, in a panel of its own."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from sb3_gac.evaluation.results import Outcome
from sb3_gac.evaluation.settings import Setting

LABELS = {
    "noise": "standard deviation of the sensor noise",
    "delay": "steps by which observations are late",
    "drop": "probability that an observation is lost",
}
STYLES: dict[str, dict[str, Any]] = {
    "learner": {"color": "tab:blue", "marker": "o"},
    "guider": {"color": "tab:orange", "marker": "s", "linestyle": "--"},
}


def draw(
    found: Mapping[Setting, Mapping[str, Outcome]],
    curves: Mapping[str, Sequence[Setting]],
    trained: Setting,
    labels: Mapping[str, str],
    title: str,
    path: Path,
) -> None:
    """
    Draw mean returns with their intervals; a dotted line marks the value of training.

    :param found: setting -> policy -> outcome, for all settings
    :param curves: name of a part of the setting that is varied -> settings, in the order of its values; if this is empty, all
        settings stand side by side
    :param trained: setting of training
    :param labels: policy -> its name in the legend
    :param title: title of the figure
    :param path: file of the picture
    """
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    panels = len(curves) or 1
    figure, axes = plt.subplots(1, panels, figsize=(2 + 4 * panels, 4.2), layout="constrained", sharey=True, squeeze=False)
    for axis, (name, settings) in zip(axes[0], curves.items(), strict=False):
        values = [getattr(setting, name) for setting in settings]
        _draw_lines(axis, values, [found[setting] for setting in settings], labels)
        axis.axvline(getattr(trained, name), color="gray", linestyle=":", label="as in training")
        axis.set(xlabel=LABELS[name], xticks=values)
        axis.set_title(_held(name, settings[0]), fontsize="medium")
    if not curves:
        _draw_points(axes[0, 0], found, labels)
    axes[0, 0].set_ylabel("return, mean and its 95% interval")
    axes[0, 0].legend()
    figure.suptitle(title.replace(", ", "\n", 1))
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _draw_lines(axis: Any, values: Sequence[float], found: Sequence[Mapping[str, Outcome]], labels: Mapping[str, str]) -> None:
    for policy in found[0]:
        means, lows, highs = np.array([of_policies[policy].mean for of_policies in found]).T
        style = STYLES[policy]
        axis.plot(values, means, label=labels[policy], **style)
        if np.isfinite(lows).all():  # a single episode has no interval
            axis.fill_between(values, lows, highs, color=style["color"], alpha=0.2, linewidth=0)


def _draw_points(axis: Any, found: Mapping[Setting, Mapping[str, Outcome]], labels: Mapping[str, str]) -> None:
    for shift, policy in zip((-0.06, 0.06), next(iter(found.values())), strict=False):
        means, lows, highs = np.array([of_policies[policy].mean for of_policies in found.values()]).T
        bars = [means - lows, highs - means] if np.isfinite(lows).all() else None
        style = {**STYLES[policy], "linestyle": "none", "label": labels[policy]}
        axis.errorbar(np.arange(len(found)) + shift, means, bars, capsize=4, **style)
    axis.set(xticks=range(len(found)), xlim=(-0.5, len(found) - 0.5))
    axis.set_xticklabels([str(setting).replace(", ", "\n") for setting in found])


def _held(varied: str, setting: Setting) -> str:
    """The other parts of the setting, in words."""
    return ", ".join(part for part in str(setting).split(", ") if not part.startswith(varied))
