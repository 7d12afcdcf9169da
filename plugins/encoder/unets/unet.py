"""The U-Net of the thesis, the reference network for completing images of projected vertices."""

from collections.abc import Iterator
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from plugins.encoder.unets.canvas import Canvas, CroppedUNet, Precision, build_head, require_images
from plugins.encoder.unets.layers import Layer, Normalisation, Step


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
        normalisation: "batch", by the moments of the batch; "renorm", by the moments of the batch, corrected towards
            the running moments; or "group", by the moments of each image's groups of channels. See `layers.Layer`.
        colors: number of output channels that are colours, whose values are in [0, 1].
        scales: number of further output channels: logarithms of the scales of a density of the colours.
        crop: margin, pixels. Evaluation computes only the subject's bounding box and this margin around it; None: the
            whole image.
        precision: precision of evaluation; "auto" is bfloat16 on processors with fast bfloat16 matrix products, else
            float32.
        residual: whether the network's output is added to the input's first `colors` channels, which are colours of a
            rasterised mesh. Before training the output is then the input. Colours may lie a little beyond [0, 1].

    Raises:
        ConfigError: the input is not an image, or `crop` with `normalisation="group"`.
    """

    bibtex = "prokudin2021smplpix, ronneberger2015unet"

    # More than eight parameters: each keyword is a config key that a user sets alone.
    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        width: Annotated[int, Field(gt=0)] = 32,
        levels: Annotated[int, Field(ge=1, le=8)] = 5,
        normalisation: Normalisation = "renorm",
        colors: Annotated[int, Field(gt=0)] = 3,
        scales: Literal[0, 1, 3] = 0,
        crop: Annotated[int, Field(ge=0)] | None = 32,
        precision: Precision = "float32",
        residual: bool = False,
    ) -> None:
        super().__init__()
        require_images("unet", input_shape, normalisation, crop, colors if residual else 1)
        self.levels = levels
        widths = [width * 2**level for level in range(levels)]
        sides: list[tuple[int, int]] = []
        before = input_shape[0]
        for after in widths:
            sides += [(before, after), (after, after)]
            before = after
        for after in widths[-2::-1]:
            sides += [(before, after), (2 * after, after), (after, after)]
            before = after
        self.layers = nn.ModuleList(Layer(*pair, 3, normalisation) for pair in sides)
        self.head = build_head(width, 1, colors, scales, residual=residual)
        self.canvas = Canvas(colors, 2 ** (levels - 1), crop, precision, residual=residual)
        self.output_shape = (colors + scales, *input_shape[1:])
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

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
