"""The check that an exported file acts as the policy does, on random observations, before the file is handed out."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_gac.deploy.normalization import DeploymentNormalizer
from sb3_gac.networks.actors import DeployedPolicy

TOLERANCE = 1e-5
SHARE_OF_OUTLIERS = 0.1  # share of far values in the draw of normalised entries, of which many are clipped
FARTHEST = 100.0  # standard deviations: where clipping begins farther out than this, far values stay within it
STEPS = 8  # length of the sequences on which policies with a memory are compared
Entries = dict[str, np.ndarray]


class ExportError(RuntimeError):
    """An exported file's actions are not the policy's."""


@th.no_grad()
def check_agreement(
    policy: DeployedPolicy, path: Path, normalizer: DeploymentNormalizer | None, n: int, seed: int = 0
) -> None:
    """
    Compare a file's actions with those of ``predict``.

    Continuous actions may differ by 1e-5 of half their range, or of their value if that is larger. Discrete actions may differ
    where two logits differ by less than 1e-5.

    :param policy: exported policy, on the CPU
    :param path: file of the policy
    :param normalizer: normaliser of the policy's observations, ``None`` for none
    :param n: number of observations; for a policy with a memory, number of sequences of 8 observations
    :param seed: seed of the observations
    :raises ExportError: if the actions differ by more
    """
    act = (_onnx_runner if path.suffix == ".onnx" else _torchscript_runner)(path, policy, n)
    state = None
    for step in range(1 if policy.memory is None else STEPS):
        raw = draw_observations(policy, normalizer, n, seed + step)
        seen = raw if normalizer is None else normalizer(raw)
        error = _error(policy, seen, state, act(raw))
        if not error <= TOLERANCE:
            raise ExportError(
                f"The actions of the exported {path.name} differ from those of predict() by up to {error:.2g}, more than "
                f"{TOLERANCE:g}: it was not written. A features extractor of one's own must not branch on values, and must do "
                "the same in every call."
            )
        _, state = policy.predict(seen, state, deterministic=True)


def draw_observations(policy: DeployedPolicy, normalizer: DeploymentNormalizer | None, n: int, seed: int = 0) -> Entries:
    """
    Draw observations of a policy's entries.

    :param policy: policy that reads the entries
    :param normalizer: normaliser of the policy's observations, ``None`` for none; entries that it normalises are drawn from
        its statistics, all others from their space, without the far ends of wide ones
    :param n: number of observations, N
    :param seed: seed of the draw
    :return: entry -> its raw values, shape (N, ...)
    """
    rng = np.random.default_rng(seed)
    assert isinstance(policy.observation_space, spaces.Dict)
    entries = {}
    for key, space in policy.observation_space.items():
        space.seed(int(rng.integers(2**31)))
        drawn = np.stack([np.asarray(space.sample()) for _ in range(n)])
        if np.issubdtype(drawn.dtype, np.floating):
            if normalizer is not None and key in normalizer.mean:
                scale = np.where(rng.random(drawn.shape) < SHARE_OF_OUTLIERS, 2.0 * min(normalizer.clip_obs, FARTHEST), 2.0)
                drawn = normalizer.mean[key] + rng.normal(scale=scale) * np.sqrt(normalizer.var[key])
            elif not ((space.high - space.low) < 1e3).all():  # type: ignore[attr-defined]
                drawn = np.clip(rng.normal(scale=2.0, size=drawn.shape), space.low, space.high)  # type: ignore[attr-defined]
        entries[key] = drawn.astype(space.dtype)
    return entries


def _error(policy: DeployedPolicy, seen: Entries, state: tuple[np.ndarray, ...] | None, actions: np.ndarray) -> float:
    """
    Measure how far a file's actions are from those of ``predict``.

    :param policy: exported policy
    :param seen: entry -> its normalised values, shape (N, ...)
    :param state: state of the policy's memory, ``None`` at the start
    :param actions: actions of the file, shape (N, \\*action shape)
    :return: largest difference, as :func:`check_agreement` measures it
    """
    space = policy.action_space
    if isinstance(space, spaces.Box):
        expected, _ = policy.predict(seen, state, deterministic=True)
        scale = np.maximum(np.abs(expected), (space.high - space.low) / 2)
        return float(np.max(np.abs(actions - expected) / scale)) if actions.shape == expected.shape else np.inf
    obs, _ = policy.obs_to_tensor(seen)
    distribution, _ = policy.remember(obs, None if state is None else state[0], None)
    logits = distribution.logits  # type: ignore[union-attr]
    chosen = logits.gather(-1, th.as_tensor(actions).long().reshape(-1, 1)).squeeze(-1)
    return float((logits.max(dim=-1).values - chosen).max())


def _onnx_runner(path: Path, policy: DeployedPolicy, n: int) -> Callable[[Entries], np.ndarray]:
    from sb3_gac.learner import OnnxPolicy

    return OnnxPolicy.load(path).act


def _torchscript_runner(path: Path, policy: DeployedPolicy, n: int) -> Callable[[Entries], np.ndarray]:
    module = th.jit.load(str(path))
    state = [] if policy.memory is None else [th.zeros(n, policy.memory.state_size)]

    def act(raw: Entries) -> np.ndarray:
        result = module(*(th.as_tensor(value) for value in raw.values()), *state)
        if not state:
            return result.numpy()
        action, state[0] = result
        return action.numpy()

    return act
