"""
Computes and draws the figure of docs/theory.md, in seconds::

    python -m benchmarks.theory

The command writes ``benchmarks/results/theory.png`` and prints the values in the figure.
"""

import argparse
from itertools import islice
from pathlib import Path

import matplotlib
import numpy as np

from sb3_gac import tabular

matplotlib.use("Agg")
from matplotlib import pyplot as plt

LISTEN = 2
ALPHAS = np.geomspace(0.005, 2.0, 27)
ITERATIONS = {tabular.DISTILLATION: 400, tabular.OWN_CRITIC: 100}
LABELS = {tabular.DISTILLATION: "eq. 8: imitation alone", tabular.OWN_CRITIC: "eq. 16: with its own critic"}
THRESHOLD = 0.1445
DOCS = Path(__file__).parent / "results/theory.png"


def learners_end(alpha: float, step: str) -> tuple[float, float]:
    """
    Solve TigerDoor by guided policy iteration.

    :param alpha: weight of the KL
    :param step: learner's improvement step, a key of ``ITERATIONS``
    :return: learner's probability to listen first, and the learner's expected return
    """
    process = tabular.tiger_door()
    count = ITERATIONS[step]
    last = next(islice(tabular.guided_policy_iteration(process, alpha, step=step), count, None))
    return float(last.learner[0, LISTEN]), tabular.expected_return(process, process.by_state(last.learner))


def pulls_and_gradients(targets: np.ndarray) -> np.ndarray:
    """
    :param targets: targets of the KL, shape (N,)
    :return: norm of the pull, norm of the gradient of the guider's critic, and norm of the difference of the two, shape (N, 3)
    """
    learner, std, best = np.array([0.0, 0.0]), np.array([0.2, 0.4]), np.array([1.0, -0.5])
    curvature = np.array([[2.0, 0.5], [0.5, 1.0]])
    norms = []
    for target in targets:
        alpha = tabular.coefficient_for(target, learner, std, curvature, best)
        guider = tabular.guider_optimum(alpha, learner, std, curvature, best)
        pull, gradient = tabular.pull(alpha, guider, learner, std), tabular.ascent(guider, curvature, best)
        norms.append([np.linalg.norm(vector) for vector in (pull, gradient, pull - gradient)])
    return np.array(norms)


def main() -> None:
    """Entry point of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=DOCS, help="the figure (default: that of docs/theory.md)")
    out = parser.parse_args().out
    figure, (listening, returns, identity) = plt.subplots(1, 3, figsize=(12, 3.4))
    for step, label in LABELS.items():
        ends = np.array([learners_end(alpha, step) for alpha in ALPHAS])
        listening.semilogx(ALPHAS, ends[:, 0], ".-", label=label)
        returns.semilogx(ALPHAS, ends[:, 1], ".-", label=label)
        for alpha, (listens, value) in zip(ALPHAS, ends, strict=True):
            print(f"{label}, alpha {alpha:.4f}: listens first with probability {listens:.4f}, returns {value:.4f}")
    for axes, title in ((listening, "TigerDoor: learner's P(listen first)"), (returns, "TigerDoor: learner's return")):
        axes.axvline(THRESHOLD, color="gray", linestyle=":", label=f"alpha = {THRESHOLD}")
        axes.set(title=title, xlabel="alpha")
    returns.legend(loc="center right", fontsize=8)
    targets = np.geomspace(1e-3, 10.0, 21)
    norms = pulls_and_gradients(targets)
    identity.loglog(targets, norms[:, 0], "-", label="pull of eq. 16")
    identity.loglog(targets, norms[:, 1], "o", fillstyle="none", label="gradient of the guider's critic")
    identity.set(title="The pull is a second policy gradient", xlabel="target_kl")
    identity.legend(fontsize=8)
    print(f"pull and gradient differ by at most {norms[:, 2].max():.1e}, target_kl {targets[0]:g} to {targets[-1]:g}")
    figure.tight_layout()
    figure.savefig(out, dpi=80)
    print(out)


if __name__ == "__main__":
    main()
