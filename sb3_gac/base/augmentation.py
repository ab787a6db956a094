"""Images that are shifted at random before a gradient step sees them."""

from collections.abc import Iterable
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_gac.math.images import random_shift
from sb3_gac.replay.samples import SequenceSamples


def shifted_entries(space: spaces.Dict, keys: Iterable[str], pixels: int) -> tuple[str, ...]:
    """
    :param space: of the observations
    :param keys: entries that the deployed policy reads
    :param pixels: argument ``random_shift``
    :return: the images among them, if they are to be shifted
    :raises ValueError: if they are to be, and there are none, or they are smaller than the shift
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


def shifted(samples: Any, keys: Iterable[str], pixels: int) -> Any:
    """
    :param samples: of a replay buffer
    :param keys: entries that are images, (\\*E, H, W) each
    :param pixels: see :func:`sb3_gac.math.images.random_shift`
    :return: the same with observations and next ones shifted, each by numbers of its own; a sequence by the same throughout
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
