"""Random shifts of images, as augmentation of the batches that gradient steps take."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_gac.math.images import random_shift
from sb3_gac.replay.samples import SequenceSamples


def shifted_entries(space: spaces.Dict, keys: Iterable[str], pixels: int) -> tuple[str, ...]:
    """
    Entries of the observation that are to be shifted.

    :param space: observation space of the environment
    :param keys: names of the entries that the deployed policy reads
    :param pixels: value of the argument ``random_shift``, in pixels
    :return: names of the images among ``keys``; none if ``pixels`` is 0
    :raises ValueError: if ``pixels`` is above 0, and there is no image or an image is smaller than the shift
    """
    if not pixels:
        return ()
    keys = list(keys)
    images = tuple(key for key in keys if is_image_space(space[key], normalized_image=True))
    if not images:
        raise ValueError(
            f"random_shift={pixels} shifts images, but the deployed policy reads {keys}, of which none is: leave it 0."
        )
    for key in images:
        if pixels >= min(space[key].shape[-2:]):  # type: ignore[index]
            raise ValueError(f'random_shift={pixels} leaves nothing of the entry "{key}", which is {space[key]}: lower it.')
    return images


def check_channels_first(space: spaces.Dict, images: Iterable[str], pixels: int) -> None:
    """
    Check that a shift goes over the heights and widths of images.

    :param space: observation space of the environment
    :param images: names of the images that are to be shifted
    :param pixels: value of the argument ``random_shift``, in pixels
    :raises ValueError: naming images whose last dimension is the smallest, so that it must be that of their channels
    """
    last = [key for key in images if np.argmin(space[key].shape) == 2]  # type: ignore[arg-type]
    if last:  # SB3 brings images of uint8 into the other order, and no others
        raise ValueError(
            f"random_shift={pixels} needs images with their channels first, and {last} seem to have them last, by shape. "
            "Transpose them where they are made, or make them of type uint8."
        )


def shifted(samples: Any, keys: Iterable[str], pixels: int) -> Any:
    """
    Shift the images of a batch at random.

    :param samples: batch that a replay buffer has sampled
    :param keys: names of entries that are images, each of shape (\\*E, H, W)
    :param pixels: largest shift in each direction, in pixels, see :func:`sb3_gac.math.images.random_shift`
    :return: the batch with shifted observations and next observations; each image has its own shift, and all images of a
        sequence have the same one
    """
    for key in keys:
        if isinstance(samples, SequenceSamples):
            moved = random_shift(samples.observations[key].transpose(0, 1), pixels).transpose(0, 1)
            samples = samples._replace(observations=samples.observations | {key: moved})
            continue
        entries: tuple[dict[str, th.Tensor], ...] = (samples.observations, samples.next_observations)
        now, later = ({**each, key: random_shift(each[key], pixels)} for each in entries)
        samples = samples._replace(observations=now, next_observations=later)
    return samples
