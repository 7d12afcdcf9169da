"""DGCNN (Wang et al. 2019), for classification."""

from itertools import pairwise
from typing import Annotated, cast

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import linear

from plugins.encoder.point_sets.layers import layers
from plugins.encoder.point_sets.neighbours import nearest_rows
from plugins.encoder.point_sets.point_sets import FIRST_1024_POINTS, CloudNetwork, Reading, largest, mean
from plugins.encoder.point_sets.pooled import fold_norm

Width = Annotated[int, Field(gt=0)]
SLOPE = 0.2
"""Slope of the activation LeakyReLU for negative numbers, as in the authors' code."""


class DGCNN(CloudNetwork):
    """Edge convolutions over the nearest neighbours of each point, which every layer finds anew among its own inputs.

    An edge convolution describes a point i by the edges to its nearest neighbours j, of which the point itself is one.
    An edge is the vector (x_j - x_i, x_i), which passes a linear layer, batch norm and LeakyReLU; the maximum of each
    channel over the neighbours is the output for the point (eq. 7, 8). The first layer finds neighbours by coordinates,
    each later layer by the outputs of the layer before. The outputs of all these layers together pass one more layer.
    The maximum and the mean of this layer's outputs over the cloud, concatenated, pass further layers.

    Padding does not change the features. The order of the points changes the features only if distances are equal, as
    in a lattice. If a cloud has fewer points than `neighbours`, all its points are neighbours; each point is then
    repeated as its own neighbour, which changes only the moments of batch norm in training.

    Args:
        input_shape: (points, columns).
        neighbours: number of nearest neighbours, including the point itself.
        edge_widths: number of outputs of each edge convolution.
        point_width: number of outputs of the layer before the maximum and the mean over the cloud.
        widths: number of outputs of each layer after the maximum and the mean; the last is the length of the features.
        dropout: probability of dropping an output of each of these last layers.
        reading: the part of the clouds that is read; the first layer finds neighbours by x, y, z alone.
    """

    bibtex = "wang2019dynamic"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        neighbours: Annotated[int, Field(gt=0, le=1024)] = 20,
        edge_widths: Annotated[list[Width], Field(min_length=1)] = [64, 64, 128, 256],  # noqa: B006 - never written
        point_width: Width = 1024,
        widths: Annotated[list[Width], Field(min_length=1)] = [512, 256],  # noqa: B006
        dropout: Annotated[float, Field(ge=0, lt=1)] = 0.5,
        reading: Reading = FIRST_1024_POINTS,
    ) -> None:
        super().__init__(input_shape, "encoder dgcnn", reading)
        self.neighbours = neighbours
        # without the activation, which `edge_convolution` applies after the maximum
        self.edges = nn.ModuleList(
            layers(2 * before, [after])[:2] for before, after in pairwise([self.columns, *edge_widths])
        )
        self.each = layers(sum(edge_widths), [point_width], SLOPE)
        length = 2 * point_width
        last_layers: list[nn.Module] = []
        for width in widths:
            last_layers += [*layers(length, [width], SLOPE), nn.Dropout(dropout)]
            length = width
        self.last = nn.Sequential(*last_layers)
        self.output_shape = (length,)
        self.rows_per_point = neighbours

    def encode(
        self, values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
    ) -> Float[Tensor, "batch length"]:
        places, outputs = values[:, :3], []
        for network in self.edges:
            index = nearest_rows(places, counts, self.neighbours)
            values = places = edge_convolution(cast(nn.Sequential, network), values, index)
            outputs.append(values)
        values = self.each(torch.cat(outputs, 1))
        return self.last(torch.cat([largest(values, counts), mean(values, counts)], 1))


def edge_convolution(
    network: nn.Sequential, values: Float[Tensor, "point length"], index: Int[Tensor, "point neighbours"]
) -> Float[Tensor, "point channels"]:
    """Return the maximum of LeakyReLU(norm(W (x_j - x_i, x_i))) over the neighbours j of each point i.

    With W = (A, B), the product is A x_j + (B - A) x_i. Both terms are computed once for each point instead of once for
    each edge. LeakyReLU is increasing, so that it is applied after the maximum; so is batch norm in evaluation, where
    it is folded into A and B.

    Args:
        network: linear layer without bias, of 2 · length inputs, and batch norm.
        values: x, the points of all clouds.
        index: rows of the neighbours of each point.
    """
    edge, norm = cast(nn.Linear, network[0]), cast(nn.BatchNorm1d, network[1])
    folded = type(norm) is nn.BatchNorm1d and not norm.training and norm.running_mean is not None
    weight, shift = fold_norm(edge, norm) if folded else (edge.weight, None)
    to_neighbour, to_own = weight.chunk(2, 1)
    neighbour = linear(values, to_neighbour).index_select(0, index.flatten()).unflatten(0, index.shape)
    own = linear(values, to_own - to_neighbour, shift)
    if folded:
        maxima = own + _over_neighbours(neighbour)
    else:
        edges = neighbour + own.unsqueeze(1)
        maxima = _over_neighbours(norm(edges.flatten(0, 1)).unflatten(0, index.shape))
    return nn.functional.leaky_relu(maxima, SLOPE)


def _over_neighbours(values: Float[Tensor, "point neighbours channels"]) -> Float[Tensor, "point channels"]:
    """Return the maximum over the neighbours.

    It is computed by `max` if a gradient is needed, and otherwise by `amax`, whose forward pass is faster.
    """
    return values.max(1).values if values.requires_grad else values.amax(1)
