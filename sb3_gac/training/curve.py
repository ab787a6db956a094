"""The learning curve of a run, as a picture."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np

from sb3_gac.envs.spaces import PARTIAL


def draw_learning_curve(
    history: Sequence[Mapping[str, float]],
    title: str,
    path: Path,
    untrained: Mapping[str, tuple[float, float]] | None = None,
    warm_up: float = 0,
    seen: str = PARTIAL,
) -> None:
    """
    Draw the policies' returns over environment steps and, where the evaluations have it, the KL with its target.

    :param history: evaluations, the ``history`` of a :class:`sb3_gac.GuiderLearnerEvalCallback` or
        :class:`sb3_gac.SeededEvalCallback`
    :param title: title of the figure
    :param path: path of the picture
    :param untrained: name of a policy without training -> mean and standard deviation of its returns, of which the mean is
        drawn as a line; ``None`` for no lines
    :param warm_up: number of environment steps with random actions at the start, drawn as a shaded area
    :param seen: entries that the learner reads, in words
    """
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    with_kl = any("kl" in row for row in history)
    figure, axes = plt.subplots(1, 1 + with_kl, figsize=(5 + 5 * with_kl, 4), layout="constrained", squeeze=False)
    steps = [row["timesteps"] for row in history]
    returns = axes[0, 0]
    returns.plot(steps, [row["learner"] for row in history], label=f"learner ({seen} alone)", marker="o")
    if any("guider" in row for row in history):
        returns.plot(steps, [row.get("guider", np.nan) for row in history], label="guider (privileged)", linestyle="--")
    for (name, (mean, _)), style in zip((untrained or {}).items(), itertools.cycle([":", "-."])):
        returns.axhline(mean, color="gray", linestyle=style, label=name)
    returns.set(ylabel="return, mean of an evaluation's episodes")
    if with_kl:
        kl = axes[0, 1]
        kl.plot(steps, [row.get("kl", np.nan) for row in history], label="KL(guider ‖ learner)", marker="o")
        kl.plot(steps, [row.get("target_kl", np.nan) for row in history], label="target", color="black", linestyle=":")
        kl.set(ylabel="KL, mean over action dimensions", ylim=(0, None))
    for panel in axes.flat:
        if warm_up > 0:
            panel.axvspan(0, warm_up, color="gray", alpha=0.2, linewidth=0, label="warm-up")
        panel.set(xlabel="environment steps", xlim=(0, None))
        panel.xaxis.set_major_formatter("{x:,.0f}")
        panel.legend(fontsize="small")
    figure.suptitle(title)
    figure.savefig(path, dpi=120)
    plt.close(figure)
