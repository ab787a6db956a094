"""Random numbers that are drawn beside training, which training does not see."""

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th


@contextmanager
def random_numbers_kept(device: th.device | None = None) -> Iterator[None]:
    """
    Keep the random numbers of Python, numpy and torch as if none were drawn, and no seeds set, within the context.

    :param device: device whose generator is kept beside the CPU's; ``None`` for those of all GPUs
    """
    states = random.getstate(), np.random.get_state()
    gpus = {} if device is None else {"devices": [th.cuda.current_device()] if device.type == "cuda" else []}
    try:
        with th.random.fork_rng(**gpus):
            yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])
