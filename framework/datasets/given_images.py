"""Images that a user has in memory, as inputs of models of image data."""

from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from framework.data import Data
from framework.datasets.images import cut_square, decode
from framework.errors import DataError, shorten


def to_inputs(data: Data, images: Any) -> Tensor:
    """Return a user's images as a batch of inputs; data sets of square images use this function as `Data.inputs`.

    `input_shape` of the data set is (channels, side, side). Besides files and arrays of that shape, the function
    accepts Pillow images, and arrays of bytes with the shape of a Pillow image: (height, width), (height, width,
    channels), or a batch of either. A batch without channels is allowed if the model's images are grey. Images of
    another size are made square by repeating border pixels, and scaled, as files are. Floating-point values must lie in
    0…1.

    Raises:
        DataError: `images` has none of these forms.
    """
    items = images if isinstance(images, list | tuple) else [images]
    if items and all(isinstance(item, Image.Image) for item in items):
        return torch.stack([_whole(item, data.input_shape) for item in items])
    if isinstance(images, np.ndarray | Tensor) and data.input_shape not in (images.shape, images.shape[1:]):
        pixels = images.numpy(force=True) if isinstance(images, Tensor) else images
        if pixels.ndim in (2, 3) and pixels.shape[2:] in ((), (1,), (3,), (4,)):
            pixels = pixels[None]
        allowed = (
            ((), (1,), (3,), (4,))
            if len(images.shape) == 2 or data.input_shape[0] == 1
            else ((1,), (3,), (4,))
        )
        if pixels.dtype != np.uint8 or pixels.ndim < 3 or pixels.shape[3:] not in allowed:
            raise DataError(
                f"Got an array of shape {'×'.join(map(str, images.shape))} and type {images.dtype}, which is not an "
                f"image. Expected uint8 of shape (height, width, 3), or shape {'×'.join(map(str, data.input_shape))} "
                "with uint8 or values from 0 to 1."
            )
        pixels = pixels[..., 0] if pixels.shape[3:] == (1,) else pixels
        return torch.stack([_whole(Image.fromarray(item), data.input_shape) for item in pixels])
    inputs = Data.inputs(data, images)
    if inputs.is_floating_point() and inputs.numel() and not (inputs.amin() >= 0 and inputs.amax() <= 1):
        raise DataError(
            f"Got floating-point images with values from {inputs.amin():.4g} to {inputs.amax():.4g}. Expected values "
            "from 0 to 1, or uint8. Scale the values, or convert them to uint8."
        )
    return inputs


def _whole(image: Image.Image, shape: tuple[int, ...]) -> UInt8[Tensor, "channels side side"]:
    """Return an image as an input of shape `shape`; border pixels are repeated to make the image square."""
    try:
        decoded = decode(image, shape[0], upright=True)
    except DataError as error:
        raise DataError(f"An image of mode {image.mode} cannot be read: {error}") from error
    except Exception as error:  # Pillow reads the file only at this point
        why = shorten(error) or type(error).__name__
        raise DataError(
            f"An image of mode {image.mode} cannot be decoded ({why}). Copy the image file again from its source."
        ) from error
    pixels = cut_square(decoded, (0.0, 0.0, float(decoded.width), float(decoded.height)), 0.0, shape[1])
    if pixels is None:
        raise DataError(
            f"Got an image of {image.width} × {image.height} pixels, but at least 1 × 1 is required. Leave this "
            "image out."
        )
    return torch.from_numpy(pixels)
