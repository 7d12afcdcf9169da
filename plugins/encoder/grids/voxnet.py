"""VoxNet (Maturana & Scherer 2015) and the deeper network that the thesis applies to basis point grids (§6.5.3)."""

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.encoder import Encoder
from framework.errors import ConfigError

Positive = Annotated[int, Field(gt=0)]
Probability = Annotated[float, Field(ge=0, lt=1)]
SLOPE = 0.1
"""Slope of VoxNet's leaky ReLU below zero."""


@dataclass(frozen=True)
class Published:
    """Published settings of a variant of `VoxNet`.

    Attributes:
        channels: number of outputs of each convolution.
        widths: number of outputs of each fully connected layer.
        dropout: probabilities: three in "voxnet", one for each fully connected layer in "conv3d".
    """

    channels: tuple[int, ...]
    widths: tuple[int, ...]
    dropout: tuple[float, ...]


PUBLISHED = {
    "voxnet": Published((32, 32), (128,), (0.2, 0.3, 0.4)),
    "conv3d": Published((8, 16, 32, 64), (512, 512), (0.8, 0.6)),
}


class VoxNet(Encoder):
    """Three-dimensional convolutions over a grid (channels, side, side, side), then fully connected layers.

    "voxnet" has a 5 × 5 × 5 convolution of stride 2, 3 × 3 × 3 convolutions, 2 × 2 × 2 max-pooling, and one fully
    connected layer. Leaky ReLU follows each convolution. Dropout follows the first convolution, the pooling and the
    last layer. "conv3d" has 3 × 3 × 3 convolutions, each with ReLU and batch norm, and max-pooling after every second
    convolution. Dropout follows each fully connected layer. The thesis does not state the channels of "conv3d"; with
    the default channels, the network has the number of parameters and the size that Tables 6.2 and 6.3 of the thesis
    state (README).

    Args:
        input_shape: (channels, side, side, side).
        variant: "voxnet" or "conv3d".
        channels: number of outputs of each convolution; None for the published ones.
        widths: number of outputs of each fully connected layer; the last is the length of the features. None for the
            published ones.
        dropout: probabilities: three in "voxnet", one for each fully connected layer in "conv3d". None for the
            published ones.
        padding: width, in cells, of the border of zeros around the input of each 3 × 3 × 3 convolution; with 1, its
            output has as many cells along each edge as its input.

    Raises:
        ConfigError: the input is not a cubic grid, or is too small, or `dropout` has the wrong length.
    """

    bibtex = "maturana2015voxnet"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        variant: Literal["voxnet", "conv3d"] = "voxnet",
        channels: Annotated[list[Positive], Field(min_length=1)] | None = None,
        widths: Annotated[list[Positive], Field(min_length=1)] | None = None,
        dropout: list[Probability] | None = None,
        padding: Annotated[int, Field(ge=0, le=1)] = 0,
    ) -> None:
        super().__init__()
        if len(input_shape) != 4 or len(set(input_shape[1:])) != 1:
            raise ConfigError(
                "voxnet reads grids of shape (channels, side, side, side), but got an input of shape "
                f"{input_shape}. Put an encoder before voxnet that encodes a cloud on a cubic grid, such as occupancy."
            )
        published = PUBLISHED[variant]
        planes, fully = list(channels or published.channels), list(widths or published.widths)
        drops = list(published.dropout if dropout is None else dropout)
        dropout_layers = 3 if variant == "voxnet" else len(fully)
        if len(drops) != dropout_layers:
            raise ConfigError(
                f"encoder.voxnet.dropout has {len(drops)} probabilities; variant={variant} with {len(fully)} fully "
                f"connected layers has {dropout_layers} dropout layers. Set one probability for each dropout layer."
            )
        body = _voxnet if variant == "voxnet" else _conv3d
        layers, side = body(input_shape[0], input_shape[1], planes, drops, padding)
        if side < 1:
            smallest = next(edge for edge in range(1, 4096) if body(1, edge, planes, drops, padding)[1] >= 1)
            raise ConfigError(
                f"voxnet with variant={variant} and {len(planes)} convolutions needs a grid of at least {smallest} "
                f"cells a side, but got {input_shape[1]}. Make the grid finer, set padding=1, or shorten `channels`."
            )
        # on a CPU, channels last takes 0.7 of the time for the deeper network, forward and in training, but 1.2 of the
        # time for VoxNet
        self.layout = torch.channels_last_3d if variant == "conv3d" else torch.contiguous_format
        self.convolutions = nn.Sequential(*layers).to(memory_format=self.layout)  # pyright: ignore
        length = planes[-1] * side**3
        connected: list[nn.Module] = []
        ends = drops[-len(fully) :] if variant == "conv3d" else [0.0] * (len(fully) - 1) + drops[-1:]
        for width, drop in zip(fully, ends, strict=True):
            connected += [nn.Linear(length, width), nn.ReLU(), nn.Dropout(drop)]
            length = width
        self.connected = nn.Sequential(*connected)
        self.output_shape = (length,)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        """Return the features of the grids."""
        grid = inputs.to(next(self.parameters()).dtype, memory_format=self.layout)
        return self.connected(self.convolutions(grid).flatten(1))


def _voxnet(
    planes: int, side: int, channels: list[int], dropout: list[float], padding: int
) -> tuple[list[nn.Module], int]:
    """Return the layers of "voxnet" up to the pooling, and the side of their output in cells.

    The side is below 1 if the grid is too small. The input has `planes` channels and `side` cells along each edge.
    """
    first, *later_channels = channels
    layers: list[nn.Module] = [
        nn.Conv3d(planes, first, kernel_size=5, stride=2),
        nn.LeakyReLU(SLOPE),
        nn.Dropout(dropout[0]),
    ]
    side = (side - 5) // 2 + 1
    for before, after in zip(channels, later_channels, strict=False):
        layers += [nn.Conv3d(before, after, kernel_size=3, padding=padding), nn.LeakyReLU(SLOPE)]
        side += 2 * padding - 2
    return [*layers, nn.MaxPool3d(2), nn.Dropout(dropout[1])], side // 2


def _conv3d(
    planes: int, side: int, channels: list[int], dropout: list[float], padding: int
) -> tuple[list[nn.Module], int]:
    """Return the layers of "conv3d" before the fully connected ones, and the side of their output in cells.

    The side is below 1 if the grid is too small. The input has `planes` channels and `side` cells along each edge.
    """
    layers: list[nn.Module] = []
    for index, width in enumerate(channels):
        layers += [
            nn.Conv3d(planes, width, kernel_size=3, padding=padding),
            nn.ReLU(),
            nn.BatchNorm3d(width),
        ]
        planes, side = width, side + 2 * padding - 2
        if side < 1:
            return layers, 0
        if index % 2:
            layers.append(nn.MaxPool3d(2))
            side //= 2
    return layers, side
