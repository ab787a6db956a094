"""Random shifts of a batch's images."""

import torch as th


def shift_images(images: th.Tensor, rows: th.Tensor, columns: th.Tensor) -> th.Tensor:
    r"""
    Shift each image by its own number of pixels; pixels from outside of the image repeat those at its border.

    :param images: images of any type, shape (B, \*E, H, W)
    :param rows: number of rows by which each image's crop lies further down, integers, shape (B,)
    :param columns: number of columns by which each image's crop lies further to the right, integers, shape (B,)
    :return: ``images[b, ..., h + rows[b], w + columns[b]]``, with indices clamped to the image, of the images' type and shape
    """
    batch, height, width = len(images), images.shape[-2], images.shape[-1]
    down = (th.arange(height, device=images.device) + rows[:, None]).clamp(0, height - 1)
    right = (th.arange(width, device=images.device) + columns[:, None]).clamp(0, width - 1)
    pixels = (down[:, :, None] * width + right[:, None, :]).reshape(batch, 1, height * width)
    flat = images.reshape(batch, -1, height * width)
    return flat.gather(-1, pixels.expand_as(flat)).reshape(images.shape)


def random_shift(images: th.Tensor, pixels: int) -> th.Tensor:
    r"""
    DrQ's augmentation (Kostrikov et al. 2020, arXiv 2004.13649): images are padded by repeating the border, and cropped at
    random.

    :param images: images of any type, shape (B, \*E, H, W)
    :param pixels: largest shift in each direction, in pixels; all shifts up to it are equally likely. 4 in the paper
    :return: images, each shifted by random numbers of its own, of the same type and shape
    """
    rows, columns = th.randint(-pixels, pixels + 1, (2, len(images)), device=images.device)
    return shift_images(images, rows, columns)
