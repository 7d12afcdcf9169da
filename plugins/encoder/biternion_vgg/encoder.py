"""The batch-normalised VGG-style network of Beyer et al. (2015), as the thesis uses it (§3.6.1)."""

from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.encoder import Encoder, images_in_unit_range, require_grey_or_color
from framework.errors import ConfigError

Channels = Annotated[int, Field(gt=0)]


class BiternionVGG(Encoder):
    """Six 3×3 convolutions with batch norm and one fully connected layer, for small images.

    The layers are those of Beyer et al. 2015: convolutions without padding, each followed by batch norm; 2×2
    max-pooling after every second convolution except the last; dropout; a fully connected layer; ReLU; dropout. ReLU
    comes after the pooling where there is one, as in the authors' code: both orders give the same numbers, and this
    order computes ReLU on a quarter of them. Convolutions have no bias, since the batch norm after them would subtract
    the bias.

    Images are read in [0, 1] and not normalised further. Because the convolutions pad no zeros, the first batch norm
    removes any scale and offset of the images.

    Args:
        input_shape: (channels, height, width), 1 or 3 channels; at least 32 × 32 pixels for six convolutions.
        channels: output channels of each convolution.
        features: length of the fully connected layer, and so of the features.
        convolution_dropout: probability of dropping a number that enters the fully connected layer.
        dropout: probability of dropping a feature.

    Raises:
        ConfigError: the input is not an image, or too small for this many convolutions.
    """

    bibtex = "beyer2015biternion"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        channels: Annotated[list[Channels], Field(min_length=1)] = [24, 24, 48, 48, 64, 64],  # noqa: B006 - never written
        features: Annotated[int, Field(gt=0)] = 512,
        convolution_dropout: Annotated[float, Field(ge=0, lt=1)] = 0.2,
        dropout: Annotated[float, Field(ge=0, lt=1)] = 0.5,
    ) -> None:
        super().__init__()
        require_grey_or_color(input_shape, by="biternion_vgg")
        pooled = range(1, len(channels) - 1, 2)
        planes, *sides = input_shape
        layers: list[nn.Module] = []
        for index, width in enumerate(channels):
            layers += [nn.Conv2d(planes, width, kernel_size=3, bias=False), nn.BatchNorm2d(width)]
            sides = [side - 2 for side in sides]
            if index in pooled:
                layers.append(nn.MaxPool2d(2))
                sides = [side // 2 for side in sides]
            layers.append(nn.ReLU(inplace=True))
            planes = width
        if min(sides) < 1:
            raise ConfigError(
                f"biternion_vgg with {len(channels)} convolutions needs images of at least "
                f"{_smallest(len(channels))} × {_smallest(len(channels))} pixels, but got images of "
                f"{input_shape[1]} × {input_shape[2]}. Make the images larger, or shorten `channels`."
            )
        # channels_last: 0.7 of the time of a training step on a CPU (README)
        self.convolutions = nn.Sequential(*layers).to(memory_format=torch.channels_last)  # pyright: ignore
        self.convolution_dropout = nn.Dropout(convolution_dropout)
        self.fully_connected = nn.Linear(planes * sides[0] * sides[1], features)
        self.dropout = nn.Dropout(dropout)
        self.output_shape = (features,)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch features"]:
        """Return the features of the images."""
        images = images_in_unit_range(inputs, self.fully_connected.weight.dtype)
        flat = self.convolution_dropout(self.convolutions(images)).flatten(1)
        return self.dropout(self.fully_connected(flat).relu())


def _smallest(convolutions: int) -> int:
    """Return the side, in pixels, of the smallest image that has one pixel after all convolutions and poolings."""
    side = 1
    for index in reversed(range(convolutions)):
        side = (side * 2 if index in range(1, convolutions - 1, 2) else side) + 2
    return side
