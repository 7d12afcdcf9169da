"""The layers that PointNet, PointNet++ and DGCNN are made of."""

from collections.abc import Sequence

from torch import nn


def layers(length: int, widths: Sequence[int], slope: float = 0.0) -> nn.Sequential:
    """Return for each width a linear layer without bias, batch norm (which has a bias) and ReLU.

    Args:
        length: number of inputs of the first layer.
        widths: number of outputs of each layer.
        slope: slope of the activation for negative numbers; a slope other than 0 makes the activation LeakyReLU.
    """
    modules: list[nn.Module] = []
    for width in widths:
        activation = nn.LeakyReLU(slope, inplace=True) if slope else nn.ReLU(inplace=True)
        modules += [nn.Linear(length, width, bias=False), nn.BatchNorm1d(width), activation]
        length = width
    return nn.Sequential(*modules)
