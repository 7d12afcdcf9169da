"""Fully connected layers, for features, point clouds and images small enough to flatten."""

import math
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.encoder import Encoder
from framework.errors import ConfigError

Width = Annotated[int, Field(gt=0)]


class MLP(Encoder):
    """Fully connected layers with ReLU; flattens whatever comes in.

    Each layer is linear, batch norm where asked for, ReLU, dropout.

    Args:
        input_shape: any; a sample is flattened.
        widths: output length of each layer; with an empty list the features are the flattened input.
        dropout: probability of dropping an output of a layer.
        batch_norm: whether to normalise over the batch; training then needs batches of at least two.

    Raises:
        ConfigError: a sample holds no numbers.
    """

    bibtex = """@article{rumelhart1986learning,
  author  = {Rumelhart, David E. and Hinton, Geoffrey E. and Williams, Ronald J.},
  title   = {Learning representations by back-propagating errors},
  journal = {Nature},
  volume  = {323},
  pages   = {533--536},
  year    = {1986}
}"""

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        widths: list[Width] = [512, 512],  # noqa: B006 - never written
        dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0,
        batch_norm: bool = False,
    ) -> None:
        super().__init__()
        length = math.prod(input_shape)
        if length == 0:
            raise ConfigError(
                f"mlp got samples of shape {input_shape}, which hold no numbers; wanted at least one. "
                "Check what `data` yields, or the encoder before it."
            )
        layers: list[nn.Module] = []
        for width in widths:
            layers.append(nn.Linear(length, width, bias=not batch_norm))  # batch norm has its own
            if batch_norm:
                layers.append(nn.BatchNorm1d(width))
            layers += [nn.ReLU(inplace=True), nn.Dropout(dropout)]
            length = width
        self.layers = nn.Sequential(*layers)
        self.vectorises = not batch_norm  # whose running moments are buffers
        self.output_shape = (length,)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        numbers = inputs.flatten(1)
        dtype = next((parameter.dtype for parameter in self.parameters()), torch.get_default_dtype())
        if inputs.dtype == torch.uint8:
            numbers = numbers.to(dtype) / 255
        return self.layers(numbers.to(dtype))
