"""Images that a user has in memory, as inputs of models of image data."""

from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from framework.data import Data
from framework.datasets.images import plain, square
from framework.errors import DataError, shorten


def inputs(data: Data, given: Any) -> Tensor:
    """Return images as a batch of inputs: `Data.inputs` of a data set of square images.

    `input_shape` of the data set is (channels, side, side). Besides files and arrays of that shape the function takes
    Pillow images, and arrays of bytes as Pillow holds them: (height, width), (height, width, channels), or a batch of
    either. A batch without channels is allowed if the model's images are grey. Images of another size are made square
    by repeating border pixels, and scaled, as files are. Floats are from 0 to 1.

    Raises:
        DataError: `given` is none of these.
    """
    items = given if isinstance(given, list | tuple) else [given]
    if items and all(isinstance(item, Image.Image) for item in items):
        return torch.stack([_whole(item, data.input_shape) for item in items])
    if isinstance(given, np.ndarray | Tensor) and data.input_shape not in (given.shape, given.shape[1:]):
        pixels = given.numpy(force=True) if isinstance(given, Tensor) else given
        if pixels.ndim in (2, 3) and pixels.shape[2:] in ((), (1,), (3,), (4,)):
            pixels = pixels[None]
        known = (
            ((), (1,), (3,), (4,))
            if len(given.shape) == 2 or data.input_shape[0] == 1
            else ((1,), (3,), (4,))
        )
        if pixels.dtype != np.uint8 or pixels.ndim < 3 or pixels.shape[3:] not in known:
            raise DataError(
                f"an array of shape {'×'.join(map(str, given.shape))} and type {given.dtype} is no image; wanted bytes "
                f"(uint8), (height, width, 3), or inputs {'×'.join(map(str, data.input_shape))}, bytes or 0 to 1."
            )
        pixels = pixels[..., 0] if pixels.shape[3:] == (1,) else pixels
        return torch.stack([_whole(Image.fromarray(item), data.input_shape) for item in pixels])
    found = Data.inputs(data, given)
    if found.is_floating_point() and found.numel() and not (found.amin() >= 0 and found.amax() <= 1):
        raise DataError(
            f"floating-point images from {found.amin():.4g} to {found.amax():.4g}; wanted 0 to 1, or bytes (uint8)."
        )
    return found


def _whole(image: Image.Image, shape: tuple[int, ...]) -> UInt8[Tensor, "channels side side"]:
    """Return an image as an input of this shape; border pixels are repeated to make it square."""
    try:
        decoded = plain(image, shape[0], upright=True)
    except DataError as error:
        raise DataError(f"an image of mode {image.mode}: {error}") from error
    except Exception as error:  # Pillow reads the file only at this point
        why = shorten(error) or type(error).__name__
        raise DataError(
            f"an image of mode {image.mode} cannot be decoded ({why}). Restore its file."
        ) from error
    pixels = square(decoded, (0.0, 0.0, float(decoded.width), float(decoded.height)), 0.0, shape[1])
    if pixels is None:
        raise DataError(f"an image of {image.width} × {image.height} pixels shows nothing.")
    return torch.from_numpy(pixels)
