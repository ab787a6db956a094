"""Random shifts against padding and cropping in numpy."""

import numpy as np
import pytest
import torch as th

from sb3_gac.math.images import random_shift, shift_images


def _cropped(images, rows, columns, pad):
    """Pad by repeating the border, crop: image by image."""
    height, width = images.shape[-2:]
    padding = [(0, 0)] * (images.ndim - 3) + [(pad, pad), (pad, pad)]
    padded = [np.pad(image, padding, mode="edge") for image in images]
    return np.stack(
        [
            image[..., pad + row : pad + row + height, pad + column : pad + column + width]
            for image, row, column in zip(padded, rows, columns, strict=True)
        ]
    )


@pytest.mark.parametrize("shape", [(12, 9, 8, 11), (12, 2, 3, 7, 5), (12, 6, 6)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_a_shift_is_numpys_padding_and_crop(shape, dtype):
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, shape).astype(dtype)
    rows, columns = rng.integers(-4, 5, (2, 12))
    moved = shift_images(th.as_tensor(images), th.as_tensor(rows), th.as_tensor(columns))
    assert moved.numpy().dtype == dtype
    np.testing.assert_array_equal(moved, _cropped(images, rows, columns, 4))


def test_shifts_are_uniform_and_independent():
    """Each image tells by its middle pixel how far it was shifted."""
    image = th.arange(11 * 11, dtype=th.int32).reshape(1, 11, 11)
    th.manual_seed(0)
    middle = random_shift(image.expand(20_000, 1, 11, 11), 2)[:, 0, 5, 5].numpy()
    rows, columns = middle // 11 - 5, middle % 11 - 5
    counts = np.histogram2d(rows, columns, bins=np.arange(-2, 4) - 0.5)[0]
    assert counts.sum() == 20_000
    assert np.abs(counts / 20_000 - 1 / 25).max() < 0.006


def test_no_shift_is_none():
    images = th.randint(0, 255, (3, 2, 5, 5))
    assert th.equal(random_shift(images, 0), images)
