"""Corruptions of test images, in five strengths."""

from collections.abc import Callable, Sequence
from io import BytesIO
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch
from framework.datasets import images
from framework.datasets.fields import FetchedInBatches, fetch

Corruption = Literal["noise", "blur", "contrast", "jpeg"]
STRENGTHS: dict[str, tuple[float, ...]] = {
    "noise": (0.08, 0.12, 0.18, 0.26, 0.38),
    "blur": (1 / 224, 2 / 224, 3 / 224, 4 / 224, 6 / 224),
    "contrast": (0.4, 0.3, 0.2, 0.1, 0.05),
    "jpeg": (25, 18, 15, 10, 7),
}
"""Parameters of the five strengths of ImageNet-C (Hendrycks & Dietterich 2019, the authors' code).

"noise": standard deviation of Gaussian noise, where the values of an image range from 0 to 1. "blur": standard
deviation of a Gaussian filter as a share of the image's side. "contrast": factor of the difference from the mean of
each channel. "jpeg": quality of the JPEG format.
"""


class Corrupted(FetchedInBatches):
    """Data set whose images are corrupted when they are fetched; a sample is always corrupted in the same way.

    Args:
        dataset: Data set with images in the field "input", uint8 of shape (channels, height, width).
        kind: Kind of the corruption.
        strength: Strength, from 1 to 5.
    """

    def __init__(self, dataset: Dataset[Batch], kind: Corruption, strength: int) -> None:
        self.dataset = dataset
        self.corrupt = CORRUPT[kind]
        self.amount = STRENGTHS[kind][strength - 1]

    def __len__(self) -> int:
        return len(self.dataset)  # type: ignore[arg-type]

    def __getitems__(self, indices: Sequence[int]) -> Batch:
        batch = fetch(self.dataset, indices)
        pairs = zip(batch["input"], indices, strict=True)
        return {
            **batch,
            "input": torch.stack([self.corrupt(image, self.amount, index) for image, index in pairs]),
        }


Pixels = UInt8[Tensor, "channels height width"]


def add_noise(image: Pixels, deviation: float, index: int) -> Pixels:
    """Return the image with Gaussian noise.

    Args:
        image: The image.
        deviation: Standard deviation of the noise, as a share of the range from 0 to 255.
        index: Number of the sample, which is the seed of the noise.
    """
    noise = np.random.default_rng(index).normal(0.0, 255 * deviation, tuple(image.shape))
    return _round(image + torch.from_numpy(noise))


def blur(image: Pixels, share: float, index: int) -> Pixels:
    """Return the image convolved with a Gaussian.

    Args:
        image: The image.
        share: Standard deviation of the Gaussian, as a share of the image's side.
        index: Number of the sample, which is not used.
    """
    return images.blur(image, share * image.shape[-1])


def reduce_contrast(image: Pixels, factor: float, index: int) -> Pixels:
    """Return the image with the differences of all pixels from the mean of their channel multiplied by a factor.

    Args:
        image: The image.
        factor: The factor.
        index: Number of the sample, which is not used.
    """
    mean = image.double().mean((1, 2), keepdim=True)
    return _round(mean + factor * (image - mean))


def compress(image: Pixels, quality: float, index: int) -> Pixels:
    """Return the image after it is written as a JPEG file and read again.

    Args:
        image: The image.
        quality: Quality of the JPEG format; lower values give stronger artefacts.
        index: Number of the sample, which is not used.
    """
    pixels = image.permute(1, 2, 0).numpy()
    stream = BytesIO()
    Image.fromarray(pixels[..., 0] if len(image) == 1 else pixels).save(stream, "JPEG", quality=int(quality))
    with images.open_stream(stream) as file:
        decoded = np.atleast_3d(np.asarray(images.decode(file, len(image), upright=False)))
    return torch.from_numpy(decoded.transpose(2, 0, 1).copy())


CORRUPT: dict[str, Callable[[Pixels, float, int], Pixels]] = {
    "noise": add_noise,
    "blur": blur,
    "contrast": reduce_contrast,
    "jpeg": compress,
}


def _round(image: Float[Tensor, "channels height width"]) -> Pixels:
    return image.round().clamp(0, 255).to(torch.uint8)
