"""Blocks of fully connected layers that append their output to their input, with an optional narrow last layer."""

from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.encoder import Encoder, require_numbers


class DenseBlocks(Encoder):
    """A fully connected network in the manner of DenseNet: two blocks of two layers, for mesh registration.

    A block repeats `layers` times a linear layer, batch norm if requested, ReLU and dropout. The block returns its
    input with its output appended, so that later layers read the features themselves and everything computed from them
    (thesis Figure 6.2, §6.5.2-6.5.3; Huang et al. 2017).

    Args:
        input_shape: any; a sample is flattened.
        blocks, layers: number of blocks, and number of layers in each.
        width: outputs of a layer.
        dropout: probability of dropping an output of a layer.
        standardise: whether each feature is first brought to mean 0 and deviation 1, by the moments over all training
            batches (during training by those of the current batch). Without standardisation, training takes many times
            longer if the features hardly vary around their mean.
        batch_norm: whether layers normalise over the batch. With `batch_norm` or `standardise`, training needs batches
            of at least two samples.
        bottleneck: length of an additional last linear layer without activation, and so of the features; None for no
            such layer. A short last layer makes the linear layer that follows it smaller and faster in proportion,
            which matters for a density head with very many distribution parameters.

    Raises:
        ConfigError: a sample holds no numbers.
    """

    bibtex = "huang2017densely"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        blocks: Annotated[int, Field(ge=1, le=100)] = 2,
        layers: Annotated[int, Field(ge=1, le=100)] = 2,
        width: Annotated[int, Field(gt=0)] = 1024,
        dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0,
        standardise: bool = False,
        batch_norm: bool = False,
        bottleneck: Annotated[int, Field(gt=0)] | None = None,
    ) -> None:
        super().__init__()
        length = require_numbers(input_shape, by="dense_blocks")
        # momentum=None: all batches have equal weight; affine=False: nothing is learnt
        self.standard = nn.BatchNorm1d(length, affine=False, momentum=None) if standardise else nn.Identity()
        self.blocks = nn.ModuleList()
        for _ in range(blocks):
            parts: list[nn.Module] = []
            inner = length
            for _ in range(layers):
                parts.append(nn.Linear(inner, width, bias=not batch_norm))  # batch norm has its own bias
                if batch_norm:
                    parts.append(nn.BatchNorm1d(width))
                parts += [nn.ReLU(inplace=True), nn.Dropout(dropout)]
                inner = width
            self.blocks.append(nn.Sequential(*parts))
            length += width
        self.bottleneck = nn.Identity() if bottleneck is None else nn.Linear(length, bottleneck)
        self.vectorises = not (batch_norm or standardise)  # their running moments are buffers
        self.starts_flat = bottleneck is not None
        self.output_shape = (bottleneck or length,)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        """Return the features of the flattened inputs."""
        numbers = inputs.flatten(1).to(next(self.parameters()).dtype)
        if inputs.dtype == torch.uint8:
            numbers = numbers / 255
        numbers = self.standard(numbers)
        for block in self.blocks:
            numbers = torch.cat([numbers, block(numbers)], 1)
        return self.bottleneck(numbers)
