"""Inception-ResNet-v2 up to its global average pooling, as the thesis uses it for PASCAL3D+ (§3.6.1)."""

from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.configuration.paths import FilePath
from framework.encoder import Encoder, images_in_unit_range, require_grey_or_color
from framework.storage.weights import fill_from_file
from plugins.encoder.inception_resnet_v2.layers import (
    ConvNorm,
    block8,
    block17,
    block35,
    mixed_5b,
    mixed_6a,
    mixed_7a,
)

SMALLEST = 75
"""Smallest height and width of an image, pixels."""


class InceptionResNetV2(Encoder):
    """Inception-ResNet-v2 for large images: 54.3 million parameters, random or from a local weight file.

    The weights have the names and shapes of timm's `inception_resnet_v2`, so that a weight file of timm loads name by
    name; the classifier's weights are left out. Images are scaled to [-1, 1], as timm's weights require. A single
    channel is repeated to three.

    Args:
        input_shape: (channels, height, width), 1 or 3 channels, at least 75 × 75 pixels; the published network reads
            299 × 299.
        weights: a local file (`framework.storage.weights`), or None to start from random weights.
        dropout: probability of dropping a feature.

    Raises:
        ConfigError: the input is not an image, or too small; or the weight file does not exist.
        CheckpointError: the weights in the file do not fit the network, or the file is damaged.
    """

    initial = frozenset({"weights"})
    bibtex = "szegedy2017inception"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        weights: FilePath | None = None,
        dropout: Annotated[float, Field(ge=0, lt=1)] = 0.2,
    ) -> None:
        super().__init__()
        require_grey_or_color(input_shape, by="inception_resnet_v2", smallest=SMALLEST)
        self.conv2d_1a = ConvNorm(3, 32, 3, stride=2, padding="valid")
        self.conv2d_2a = ConvNorm(32, 32, 3, padding="valid")
        self.conv2d_2b = ConvNorm(32, 64, 3)
        self.maxpool_3a = nn.MaxPool2d(3, stride=2)
        self.conv2d_3b = ConvNorm(64, 80)
        self.conv2d_4a = ConvNorm(80, 192, 3, padding="valid")
        self.maxpool_5a = nn.MaxPool2d(3, stride=2)
        self.mixed_5b = mixed_5b()
        self.repeat = nn.Sequential(*(block35() for _ in range(10)))
        self.mixed_6a = mixed_6a()
        self.repeat_1 = nn.Sequential(*(block17() for _ in range(20)))
        self.mixed_7a = mixed_7a()
        self.repeat_2 = nn.Sequential(*(block8() for _ in range(9)))
        self.block8 = block8(scale=1.0, relu=False)
        self.conv2d_7b = ConvNorm(2080, 1536)
        self.dropout = nn.Dropout(dropout)
        self.output_shape = (1536,)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        if weights is not None:
            fill_from_file(self, weights, ignored=("classif.", "classifier."))

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch 1536"]:
        """Return the features of the images."""
        images = images_in_unit_range(inputs, self.conv2d_7b.conv.weight.dtype)
        maps = (images * 2 - 1).expand(-1, 3, -1, -1)  # (x - mean 0.5) / deviation 0.5
        *layers, dropout = self.children()  # in the order of the constructor
        for layer in layers:
            maps = layer(maps)
        return dropout(maps.mean((2, 3)))
