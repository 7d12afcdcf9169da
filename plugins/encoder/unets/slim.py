"""A U-Net for CPUs: few pixels, dense 3×3 convolutions, and numbers of channels that fill vector registers."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from plugins.encoder.unets.canvas import Canvas, CroppedUNet, Precision, build_head, require_images
from plugins.encoder.unets.layers import Layer, Normalisation, Step

Channels = Annotated[int, Field(gt=0)]


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
        normalisation: "batch", "renorm" or "group" (`layers.Layer`).
        colors: number of output channels that are colours, whose values are in [0, 1].
        scales: number of further output channels: logarithms of the scales of a density of the colours.
        crop: margin, pixels. Evaluation computes only the subject's bounding box and this margin around it; None: the
            whole image.
        precision: precision of evaluation; "auto" is bfloat16 on processors with fast bfloat16 matrix products, else
            float32.
        residual: whether the network's output is added to the input's first `colors` channels.

    Raises:
        ConfigError: the input is not an image, or `crop` with `normalisation="group"`.
    """

    bibtex = "shi2016realtime"

    # More than eight parameters: each keyword is a config key that a user sets alone.
    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        widths: Annotated[list[Channels], Field(min_length=1, max_length=8)] = [32, 48, 64, 96],  # noqa: B006 - never written
        unshuffle: Annotated[int, Field(ge=1, le=8)] = 2,
        normalisation: Normalisation = "renorm",
        colors: Annotated[int, Field(gt=0)] = 3,
        scales: Literal[0, 1, 3] = 0,
        crop: Annotated[int, Field(ge=0)] | None = 24,
        precision: Precision = "float32",
        residual: bool = False,
    ) -> None:
        super().__init__()
        require_images("slim", input_shape, normalisation, crop, colors if residual else 1)
        self.unshuffle = unshuffle
        self.levels = len(widths)
        first, pixels = widths[0], unshuffle**2
        shapes = [(input_shape[0] * pixels, first, 3)]
        for upper, lower in pairwise(widths):
            shapes += [(upper, lower, 2), (lower, lower, 3)]
        shapes += [(lower, upper, 3) for upper, lower in reversed(list(pairwise(widths)))]
        shapes += [(first, first, 3)]
        self.layers = nn.ModuleList(Layer(*shape, normalisation) for shape in shapes)
        self.head = build_head(first, 3, colors, scales, pixels, residual=residual)
        self.canvas = Canvas(
            colors, unshuffle * 2 ** (self.levels - 1), crop, precision, unshuffle, residual=residual
        )
        self.output_shape = (colors + scales, *input_shape[1:])
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

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
