"""Gaussian noise of sensors: its standard deviation, and the space of a noisy entry."""

from collections.abc import Sequence

import numpy as np
from gymnasium import spaces

NOISE_STREAM = 0x6E6F697365  # separates the noise from generators that others seed with the same number


def check_noise_std(noise_std: float | Sequence[float], entry: spaces.Box, key: str) -> np.ndarray:
    """
    Check the standard deviation of an entry's noise.

    :param noise_std: standard deviation of the noise: a number, or one per component of the entry
    :param entry: space of the entry that becomes noisy
    :param key: key of the entry, for the message
    :return: standard deviation as a float32 array, of shape () or that of the entry
    :raises ValueError: if ``noise_std`` is negative, not finite or of another shape, or the entry holds integers
    """
    try:
        std = np.asarray(noise_std, dtype=np.float32)
    except (TypeError, ValueError):  # no numbers at all
        std = np.asarray(np.nan)
    if not (np.isfinite(std).all() and (std >= 0).all()):
        raise ValueError(f"noise_std must be a finite number >= 0, or one per component, got {noise_std!r}.")
    if not np.issubdtype(entry.dtype, np.floating):
        raise ValueError(f'SensorNoise needs a floating-point entry, but "{key}" has {entry}.')
    if std.shape not in ((), entry.shape):
        raise ValueError(f"noise_std must be a number or have the entry's shape {entry.shape}, got {noise_std!r}.")
    return std


def noisy_box(entry: spaces.Box, noise_std: np.ndarray) -> spaces.Box:
    """
    Remove the bounds of those components that become noisy.

    :param entry: space of the entry without noise
    :param noise_std: standard deviation of the noise, as :func:`check_noise_std` returns it
    :return: space of the entry with noise; its noisy components have no bounds
    """
    noisy = np.broadcast_to(noise_std, entry.shape) > 0
    low, high = np.where(noisy, -np.inf, entry.low), np.where(noisy, np.inf, entry.high)
    dtype = entry.dtype
    return spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype)
