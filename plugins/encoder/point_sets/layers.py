"""The layers that PointNet and PointNet++ are made of."""

from collections.abc import Sequence

from torch import nn


def layers(length: int, widths: Sequence[int]) -> nn.Sequential:
    """Return linear, batch norm and ReLU layers for each width; the bias is in the batch norm."""
    found: list[nn.Module] = []
    for width in widths:
        found += [nn.Linear(length, width, bias=False), nn.BatchNorm1d(width), nn.ReLU(inplace=True)]
        length = width
    return nn.Sequential(*found)
