"""The layers that PointNet and PointNet++ are made of."""

from collections.abc import Sequence

from torch import nn


def layers(length: int, widths: Sequence[int]) -> nn.Sequential:
    """Return for each width a linear layer without bias, batch norm (which has a bias) and ReLU.

    `length` is the number of inputs of the first layer.
    """
    modules: list[nn.Module] = []
    for width in widths:
        modules += [nn.Linear(length, width, bias=False), nn.BatchNorm1d(width), nn.ReLU(inplace=True)]
        length = width
    return nn.Sequential(*modules)
