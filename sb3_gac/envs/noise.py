"""Gaussian noise of sensors: its standard deviation, and the space that a noisy entry has."""

from collections.abc import Sequence

import numpy as np
from gymnasium import spaces

NOISE_STREAM = 0x6E6F697365  # keeps the noise apart from generators that others seed with the same number


def check_noise_std(noise_std: float | Sequence[float], entry: spaces.Box, key: str) -> np.ndarray:
    """
    :param noise_std: standard deviation, a number, or one per component
    :param entry: that becomes noisy
    :param key: of the entry
    :return: shape () or that of the entry, float32
    :raises ValueError: if ``noise_std`` is negative or of another shape, or the entry is of integers
    """
    std = np.asarray(noise_std, dtype=np.float32)
    if not (np.isfinite(std).all() and (std >= 0).all()):
        raise ValueError(f"noise_std must be a finite number >= 0, or one per component, got {noise_std!r}.")
    if not np.issubdtype(entry.dtype, np.floating):
        raise ValueError(f'SensorNoise needs a floating-point entry, but "{key}" has {entry}.')
    if std.shape not in ((), entry.shape):
        raise ValueError(f"noise_std must be a number or have the entry's shape {entry.shape}, got {noise_std!r}.")
    return std


def noisy_box(entry: spaces.Box, noise_std: np.ndarray) -> spaces.Box:
    """
    :param entry: without noise
    :param noise_std: of :func:`check_noise_std`
    :return: the entry with noise, which has no bounds
    """
    noisy = np.broadcast_to(noise_std, entry.shape) > 0
    low, high = np.where(noisy, -np.inf, entry.low), np.where(noisy, np.inf, entry.high)
    dtype = entry.dtype
    return spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype)
