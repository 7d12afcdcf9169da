"""PointNet++ (Qi et al. 2017), for classification."""

from typing import Annotated, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import linear

from framework.geometry.clouds import pad, require_normalised, sizes
from framework.geometry.farthest import farthest
from plugins.encoder.point_sets.balls import find_within
from plugins.encoder.point_sets.layers import layers
from plugins.encoder.point_sets.point_sets import (
    FIRST_1024_POINTS,
    CloudNetwork,
    Reading,
    first_rows,
    largest,
)

Count = Annotated[int, Field(gt=0)]


class Scale(NamedTuple):
    """Balls of one size around the centroids of a level, and the layers that their points pass.

    Attributes:
        radius: radius of the balls, as a multiple of the argument `radius` of `PointNet2`.
        neighbours: largest number of points of a ball that are read.
        widths: number of outputs of each layer.
    """

    radius: float
    neighbours: int
    widths: tuple[int, ...]


PUBLISHED = {
    # Qi et al. 2017, "PointNet++", supplement on architectures; the numbers of neighbours are from the authors' code
    "single_scale": (
        (Scale(1, 32, (64, 64, 128)),),
        (Scale(2, 64, (128, 128, 256)),),
    ),
    "multi_scale": (
        (Scale(0.5, 16, (32, 32, 64)), Scale(1, 32, (64, 64, 128)), Scale(2, 128, (64, 96, 128))),
        (Scale(1, 32, (64, 64, 128)), Scale(2, 64, (128, 128, 256)), Scale(4, 128, (128, 128, 256))),
    ),
}
"""Scales of each level in the paper, by the names of the `grouping` of `PointNet2`."""
WHOLE, LAST = (256, 512, 1024), (512, 256)
"""Widths of the layers that the last centroids pass, and of the layers after the maximum over them."""
REACH = 5
"""Largest distance of a point from the origin for which the balls are intended, in radii of the first level's balls.

The distance is 1 for the published radius of 0.2.
"""


class PointNet2(CloudNetwork):
    """Three PointNets in sequence: on small balls of points, on larger balls around fewer points, on the whole cloud.

    Centroids are points that are as far as possible from each other; the first one is the farthest from the mean of the
    cloud (`framework.geometry.farthest`). A ball is described by the positions of its points relative to the centroid
    and by their features. All points pass the same layers with batch norm and ReLU; the maxima of each channel over the
    ball are the features of the centroid. If a ball has more points than are read, points that are far from each other
    are read. Padding does not change the features. The order of the points changes the features only if distances are
    equal, as in a lattice: of equally far points the first one is chosen. In evaluation, the features do not change if
    every point occurs twice.

    Args:
        input_shape: (points, columns).
        grouping: "single_scale", balls of one size around a centroid; or "multi_scale", balls of three sizes.
        centroids: numbers of centroids of the two levels; in a cloud with fewer points, all points are centroids.
        radius: radius of the first level's balls in "single_scale", in units of the normalised cloud; all other radii
            change in proportion.
        width: factor by which the published widths of all layers are multiplied.
        dropout: probability of dropping an output of each of the two last layers.
        reading: the part of the clouds that is read.
    """

    bibtex = "qi2017pointnetplusplus"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        grouping: Literal["single_scale", "multi_scale"] = "single_scale",
        centroids: Annotated[list[Count], Field(min_length=2, max_length=2)] = [512, 128],  # noqa: B006 - never written
        radius: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.2,
        width: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0,
        dropout: Annotated[float, Field(ge=0, lt=1)] = 0.5,
        reading: Reading = FIRST_1024_POINTS,
    ) -> None:
        super().__init__(input_shape, "encoder pointnet2", reading)
        self.radius = radius
        self.levels = nn.ModuleList()
        length = self.columns - 3
        for count, published in zip(centroids, PUBLISHED[grouping], strict=True):
            self.levels.append(Level(length, count, radius, published, width))
            length = sum(scale_widths(scale.widths, width)[-1] for scale in published)
        *_, after = widths = scale_widths(WHOLE, width)
        self.whole = layers(3 + length, widths)
        last_layers: list[nn.Module] = []
        for last in scale_widths(LAST, width):
            last_layers += [*layers(after, [last]), nn.Dropout(dropout)]
            after = last
        self.last = nn.Sequential(*last_layers)
        self.output_shape = (after,)
        # with this number, a CPU computes one cloud at a time: the numbers of several clouds do not fit into its cache
        self.rows_per_point = max(scale.neighbours for level in PUBLISHED[grouping] for scale in level)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        """Return the features of the clouds."""
        if self.reading.normalise == "none":
            require_normalised(inputs[..., :3], REACH * self.radius, sizes(inputs), by="encoder pointnet2")
        return super().forward(inputs)

    def encode(
        self, values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
    ) -> Float[Tensor, "batch length"]:
        values = order_by_distance(values, counts)
        positions, values = values[:, :3], values[:, 3:]
        for level in self.levels:
            positions, values, counts = level(positions, values, counts)
        return self.last(largest(self.whole(torch.cat([positions, values], 1)), counts))


class Level(nn.Module):
    """A level that replaces points by centroids with features of the balls around them ("set abstraction").

    Args:
        length: number of features of a point.
        centroids: largest number of centroids of a cloud.
        radius: factor by which the scales' radii are multiplied, in units of the normalised cloud.
        scales: sizes of the balls, and their layers; the features of all scales are concatenated.
        width: factor by which the scales' widths are multiplied.
    """

    def __init__(
        self, length: int, centroids: int, radius: float, scales: tuple[Scale, ...], width: float
    ) -> None:
        super().__init__()
        self.centroids = centroids
        self.balls = [(radius * scale.radius, scale.neighbours) for scale in scales]
        self.networks = nn.ModuleList(
            layers(3 + length, scale_widths(scale.widths, width)) for scale in scales
        )

    def forward(
        self,
        positions: Float[Tensor, "point 3"],
        values: Float[Tensor, "point length"],
        counts: Int[Tensor, "batch"],
    ) -> tuple[Float[Tensor, "centroid 3"], Float[Tensor, "centroid channels"], Int[Tensor, "batch"]]:
        """Return positions and features of the centroids, and the number of centroids of each cloud.

        Args:
            positions: positions of the points of all clouds, each cloud in the order of `order_by_distance`.
            values: features of the points.
            counts: number of points of each cloud.
        """
        # The first points in this order are the centroids. They keep the order, so that it is computed only once.
        centres = positions[first_rows(counts, self.centroids)]
        features = []
        for (radius, most), network in zip(self.balls, self.networks, strict=True):
            index = find_within(positions, counts, self.centroids, radius, most)
            features.append(describe_balls(network, positions, values, centres, index))
        return centres, torch.cat(features, 1), counts.clamp(max=self.centroids)


def describe_balls(
    network: nn.Module,
    positions: Float[Tensor, "point 3"],
    values: Float[Tensor, "point length"],
    centres: Float[Tensor, "centroid 3"],
    index: Int[Tensor, "centroid most"],
) -> Float[Tensor, "centroid channels"]:
    """Return the maximum of each output channel of a network over the points of each ball.

    Args:
        network: layers built by `plugins.encoder.point_sets.layers.layers`. They read a point's position relative to
            the centroid, and the point's features.
        positions: positions of all points.
        values: features of all points.
        centres: positions of the centroids.
        index: rows of the points of each ball, as `find_within` returns them.
    """
    first, *middle, last = network.children()
    weight = first.get_parameter("weight")
    rows = index.flatten()
    offset = positions.index_select(0, rows) - centres.repeat_interleave(index.shape[1], 0)
    # The linear layer of (offset, value) is the sum of a linear layer of the offset and one of the value. The latter is
    # computed once for each point instead of once for each point of each ball.
    numbers = linear(offset, weight[:, :3])
    if values.shape[1]:
        numbers = numbers + linear(values, weight[:, 3:]).index_select(0, rows)
    for layer in middle:
        numbers = layer(numbers)
    numbers = numbers.unflatten(0, index.shape)
    # `max` has the faster gradient, `amax` the faster value. The last layer, a ReLU, can be applied after the maximum.
    return last(numbers.max(1).values if numbers.requires_grad else numbers.amax(1))


def order_by_distance(
    values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "point columns"]:
    """Return the points of each cloud, ordered so that each is as far as possible from the points before it.

    Args:
        values: concatenated points of all clouds; the first three columns are the positions.
        counts: number of points of each cloud.
    """
    if len(counts) == 0:
        return values
    positions = pad(values[:, :3].detach().split(counts.tolist()))
    order = farthest(positions, counts, positions.shape[1])
    start = counts.cumsum(0) - counts
    real = torch.arange(positions.shape[1], device=counts.device) < counts[:, None]
    return values.index_select(0, (start[:, None] + order)[real])


def scale_widths(widths: tuple[int, ...], factor: float) -> tuple[int, ...]:
    """Return the widths times a factor, rounded; each is at least 1."""
    return tuple(max(1, round(factor * width)) for width in widths)
