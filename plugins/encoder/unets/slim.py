"""A U-Net for CPUs: few pixels, dense 3×3 convolutions, and numbers of channels that fill vector registers."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from plugins.encoder.unets.canvas import CroppedUNet, Settings
from plugins.encoder.unets.layers import Step

Channels = Annotated[int, Field(gt=0)]
DEFAULT_SETTINGS = Settings(crop=24)


class Slim(CroppedUNet):
    """A small U-Net that first rearranges squares of `unshuffle`² pixels as channels (the inverse of Shi et al. 2016).

    Each level has one 3×3 convolution on the way down and one on the way up. A 2×2 convolution of stride 2 leads to the
    next lower level. On the way up, a 3×3 convolution gives the channels of the upper level. Each number of its output
    is repeated on 2×2 pixels, and the maps of the upper level from the way down are added.

    An input of 1 in every channel is empty background, and so is everything beyond the border: sides are padded with
    empty background to a multiple of unshuffle × 2 ** (levels - 1) pixels.

    Args:
        input_shape: (channels, height, width); the network also reads images of other heights and widths.
        widths: channels of each level. Processors compute 16 channels at once, so that 24 cost as much as 32.
        unshuffle: side of a square, pixels.
        settings: normalisation, output channels, crop and precision.
    """

    bibtex = "shi2016realtime"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        widths: Annotated[list[Channels], Field(min_length=1, max_length=8)] = [32, 48, 64, 96],  # noqa: B006 - never written
        unshuffle: Annotated[int, Field(ge=1, le=8)] = 2,
        settings: Settings = DEFAULT_SETTINGS,
    ) -> None:
        super().__init__("slim", input_shape, settings)
        self.unshuffle = unshuffle
        self.levels = len(widths)
        shapes = [(input_shape[0] * unshuffle**2, widths[0], 3)]
        for upper, lower in pairwise(widths):
            shapes += [(upper, lower, 2), (lower, lower, 3)]
        shapes += [(lower, upper, 3) for upper, lower in reversed(list(pairwise(widths)))]
        shapes += [(widths[0], widths[0], 3)]
        self.build_layers(shapes, 3, unshuffle * 2 ** (self.levels - 1), unshuffle)

    def maps(self, images: Tensor, layers: Iterator[Step]) -> Tensor:
        """Return the feature maps that the last convolution reads.

        Args:
            images: differences from the empty background; sides are multiples of the network's stride.
            layers: iterator over functions, one for each layer of the network.
        """
        maps = next(layers)(unshuffle_pixels(images, self.unshuffle))
        across = [maps]
        for _ in range(self.levels - 1):
            maps = next(layers)(maps)
            maps = next(layers)(maps)
            across.append(maps)
        for same_size in reversed(across[:-1]):
            maps = functional.interpolate(next(layers)(maps), scale_factor=2.0) + same_size
        return next(layers)(maps)


def unshuffle_pixels(images: Float[Tensor, "batch channels height width"], side: int) -> Tensor:
    """Return the pixels of each square of `side` × `side` pixels as channels, with channels last in memory.

    The numbers are those of torch's `pixel_unshuffle`, which takes three times as long.
    """
    batch, channels, height, width = images.shape
    squares = images.reshape(batch, channels, height // side, side, width // side, side)
    planes = squares.permute(0, 1, 3, 5, 2, 4).reshape(
        batch, channels * side**2, height // side, width // side
    )
    return planes.contiguous(memory_format=torch.channels_last)
