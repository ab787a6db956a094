"""Images of a batch, shifted at random."""

import torch as th


def shift_images(images: th.Tensor, rows: th.Tensor, columns: th.Tensor) -> th.Tensor:
    r"""
    Move what images show, each by its own number of pixels; what comes in from outside repeats the pixels at the border.

    :param images: any type, shape (B, \*E, H, W)
    :param rows: by how many an image is taken further down, whole numbers, shape (B,)
    :param columns: by how many it is taken further to the right, shape (B,)
    :return: ``images[b, ..., h + rows[b], w + columns[b]]``, indices kept within the image; of the images' type and shape
    """
    batch, height, width = len(images), images.shape[-2], images.shape[-1]
    down = (th.arange(height, device=images.device) + rows[:, None]).clamp(0, height - 1)
    right = (th.arange(width, device=images.device) + columns[:, None]).clamp(0, width - 1)
    pixels = (down[:, :, None] * width + right[:, None, :]).reshape(batch, 1, height * width)
    flat = images.reshape(batch, -1, height * width)
    return flat.gather(-1, pixels.expand_as(flat)).reshape(images.shape)


def random_shift(images: th.Tensor, pixels: int) -> th.Tensor:
    r"""
    DrQ's augmentation (Kostrikov et al. 2020, arXiv 2004.13649): pad by repeating the border, and crop at random.

    :param images: shape (B, \*E, H, W)
    :param pixels: up to so many in each direction, each number as likely as any other; 4 in the paper
    :return: each image shifted by numbers of its own, of the images' type and shape
    """
    rows, columns = th.randint(-pixels, pixels + 1, (2, len(images)), device=images.device)
    return shift_images(images, rows, columns)
