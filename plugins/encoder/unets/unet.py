"""The U-Net of the thesis, the reference network for completing images of projected vertices."""

from collections.abc import Iterator
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from plugins.encoder.unets.canvas import CroppedUNet, Settings
from plugins.encoder.unets.layers import Step

DEFAULT_SETTINGS = Settings()


class UNet(CroppedUNet):
    """Five levels of two 3×3 convolutions each, with skip connections (thesis §7.3.2; Ronneberger et al. 2015).

    Max-pooling leads to the next lower level. Bilinear interpolation and a 3×3 convolution lead to the next upper
    level, without the checkerboard patterns of transposed convolutions.

    An input of 1 in every channel is empty background, and so is everything beyond the border: sides are padded with
    empty background to a multiple of 2 ** (levels - 1) pixels.

    Args:
        input_shape: (channels, height, width); the network also reads images of other heights and widths.
        width: channels of the first level; each further level has twice as many channels as the level above it.
        levels: number of levels.
        settings: normalisation, output channels, crop and precision.
    """

    bibtex = "prokudin2021smplpix, ronneberger2015unet"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        width: Annotated[int, Field(gt=0)] = 32,
        levels: Annotated[int, Field(ge=1, le=8)] = 5,
        settings: Settings = DEFAULT_SETTINGS,
    ) -> None:
        super().__init__("unet", input_shape, settings)
        self.levels = levels
        widths = [width * 2**level for level in range(levels)]
        shapes: list[tuple[int, int, int]] = []
        before = input_shape[0]
        for after in widths:
            shapes += [(before, after, 3), (after, after, 3)]
            before = after
        for after in widths[-2::-1]:
            shapes += [(before, after, 3), (2 * after, after, 3), (after, after, 3)]
            before = after
        self.build_layers(shapes, 1, 2 ** (levels - 1))

    def maps(self, images: Tensor, layers: Iterator[Step]) -> Tensor:
        """Return the feature maps that the last convolution reads.

        Args:
            images: differences from the empty background; sides are multiples of the network's stride.
            layers: iterator over functions, one for each layer of the network.
        """
        maps = images.contiguous(memory_format=torch.channels_last)
        across: list[Tensor] = []
        for level in range(self.levels):
            maps = functional.max_pool2d(maps, 2) if level else maps
            maps = next(layers)(maps)
            maps = next(layers)(maps)
            across.append(maps)
        for same_size in reversed(across[:-1]):
            maps = torch.cat([same_size, next(layers)(double_size(maps))], 1)
            maps = next(layers)(maps)
            maps = next(layers)(maps)
        return maps


def double_size(maps: Float[Tensor, "batch channels height width"]) -> Tensor:
    """Return the maps at twice the size by bilinear interpolation; beyond the border lies empty background."""
    wide = functional.pad(maps, (1, 1, 1, 1))
    return functional.interpolate(wide, scale_factor=2.0, mode="bilinear")[..., 2:-2, 2:-2]
