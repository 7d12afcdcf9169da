"""PointNet++ (Qi et al. 2017), for classification."""

from typing import Annotated, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import linear

from framework.encoder import Encoder
from framework.geometry.clouds import Normalisation, pad, require_normalised, sizes
from framework.geometry.farthest import farthest
from plugins.encoder.point_sets.balls import within
from plugins.encoder.point_sets.layers import layers
from plugins.encoder.point_sets.point_sets import Reading, columns_read, first_rows, largest, over_points

Count = Annotated[int, Field(gt=0)]


class Scale(NamedTuple):
    """Balls of one size around the centroids of a level, and the layers that their points pass.

    Attributes:
        radius: in units of the radius of the first level's balls in "single_scale".
        neighbours: largest number of points of a ball.
        widths: outputs of each layer.
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
"""Published scales of each level, by grouping."""
WHOLE, LAST = (256, 512, 1024), (512, 256)
"""Widths of the layers that the last centroids pass, and of the layers after the maximum over them."""
REACH = 5
"""Intended largest distance of a cloud from the origin, in radii of the first level's balls: 1 as published."""


class PointNet2(Encoder):
    """A PointNet on small balls of points, one on larger balls around fewer centroids, and one on the whole cloud.

    Centroids are points that are as far as possible from each other; the first is the farthest from the mean of the
    cloud (`framework.geometry.farthest`). A ball is described by its points: their positions relative to the centroid,
    and their features. They all pass the same layers, each with batch norm and ReLU; the maximum of each channel over
    the ball is the feature of the centroid. If a ball has more points than are read, points that are far from each
    other are read. Padding changes no feature. The order of the points changes none unless distances are equal, as in a
    lattice: of equally far points the first is chosen. In evaluation, points that occur twice change no feature if each
    point does.

    Args:
        input_shape: (points, columns).
        grouping: "single_scale", balls of one size around a centroid; or "multi_scale", balls of three sizes.
        centroids: numbers of centroids of the two levels; clouds that have fewer points use all.
        radius: radius of the first level's balls in "single_scale", in units of the normalised cloud; others in
            proportion.
        width: factor of the published widths of all layers.
        dropout: probability of dropping an output of each of the two last layers.
        points: largest number of points that are read of a cloud, the first ones; None for all.
        normalise: as of framework.geometry.clouds.normalise_clouds.
        attributes: whether columns after x, y, z are read too.

    Raises:
        ConfigError: the input is no cloud, or has no attributes to read.
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
        points: Count | None = 1024,
        normalise: Normalisation = "unit_ball",
        attributes: bool = False,
    ) -> None:
        super().__init__()
        columns = columns_read(input_shape, "encoder pointnet2", attributes)
        self.reading = Reading(columns, points, normalise)
        self.radius = radius
        self.levels = nn.ModuleList()
        length = columns - 3
        for count, published in zip(centroids, PUBLISHED[grouping], strict=True):
            self.levels.append(Level(length, count, radius, published, width))
            length = sum(scaled(scale.widths, width)[-1] for scale in published)
        *_, after = widths = scaled(WHOLE, width)
        self.whole = layers(3 + length, widths)
        found: list[nn.Module] = []
        for last in scaled(LAST, width):
            found += [*layers(after, [last]), nn.Dropout(dropout)]
            after = last
        self.last = nn.Sequential(*found)
        self.output_shape = (after,)
        # the numbers of one cloud at a time fit into a CPU's cache, those of several do not
        self.held = max(scale.neighbours for level in PUBLISHED[grouping] for scale in level)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        """Return the features of the clouds."""
        if self.reading.normalise == "none":
            require_normalised(inputs[..., :3], REACH * self.radius, sizes(inputs), by="encoder pointnet2")
        dtype = next(self.parameters()).dtype
        return over_points(
            self._described, inputs, self.reading, dtype, training=self.training, held=self.held
        )

    def _described(
        self, values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
    ) -> Float[Tensor, "batch length"]:
        values = spread(values, counts)
        places, values = values[:, :3], values[:, 3:]
        for level in self.levels:
            places, values, counts = level(places, values, counts)
        return self.last(largest(self.whole(torch.cat([places, values], 1)), counts))


class Level(nn.Module):
    """A level that replaces points by centroids with features of the balls around them ("set abstraction").

    Args:
        length: number of features of a point.
        centroids: number of points of each cloud that remain.
        radius: unit of the scales' radii.
        scales: the balls; the features of the scales are concatenated.
        width: factor of the scales' widths.
    """

    def __init__(
        self, length: int, centroids: int, radius: float, scales: tuple[Scale, ...], width: float
    ) -> None:
        super().__init__()
        self.centroids = centroids
        self.balls = [(radius * scale.radius, scale.neighbours) for scale in scales]
        self.networks = nn.ModuleList(layers(3 + length, scaled(scale.widths, width)) for scale in scales)

    def forward(
        self,
        places: Float[Tensor, "point 3"],
        values: Float[Tensor, "point length"],
        counts: Int[Tensor, "batch"],
    ) -> tuple[Float[Tensor, "centroid 3"], Float[Tensor, "centroid channels"], Int[Tensor, "batch"]]:
        """Return positions and features of the centroids, and their counts, from points in the order of `spread`."""
        # The first points in this order are also the centroids, in their order. It is found once for all levels.
        centres = places[first_rows(counts, self.centroids)]
        found = []
        for (radius, most), network in zip(self.balls, self.networks, strict=True):
            index = within(places, counts, self.centroids, radius, most)
            found.append(described(network, places, values, centres, index))
        return centres, torch.cat(found, 1), counts.clamp(max=self.centroids)


def described(
    network: nn.Module,
    places: Float[Tensor, "point 3"],
    values: Float[Tensor, "point length"],
    centres: Float[Tensor, "centroid 3"],
    index: Int[Tensor, "centroid most"],
) -> Float[Tensor, "centroid channels"]:
    """Return the maximum of each channel over the points of each ball, after a network.

    The network reads the points' positions relative to the centroid, and their features.
    """
    enter, *others, last = network.children()
    weight = enter.get_parameter("weight")
    rows = index.flatten()
    offset = places.index_select(0, rows) - centres.repeat_interleave(index.shape[1], 0)
    # A linear layer of (offset, value) is the sum of one of the offset and one of the value. The latter is computed
    # once for each point, not for each ball.
    found = linear(offset, weight[:, :3])
    if values.shape[1]:
        found = found + linear(values, weight[:, 3:]).index_select(0, rows)
    for layer in others:
        found = layer(found)
    found = found.unflatten(0, index.shape)
    # `max` has the faster gradient, `amax` the faster value. The last layer is a ReLU, which may follow the maximum.
    return last(found.max(1).values if found.requires_grad else found.amax(1))


def spread(
    values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "point columns"]:
    """Return the points of each cloud in an order in which each is as far as possible from the points before it."""
    if len(counts) == 0:
        return values
    places = pad(values[:, :3].detach().split(counts.tolist()))
    order = farthest(places, counts, places.shape[1])
    start = counts.cumsum(0) - counts
    real = torch.arange(places.shape[1], device=counts.device) < counts[:, None]
    return values.index_select(0, (start[:, None] + order)[real])


def scaled(widths: tuple[int, ...], factor: float) -> tuple[int, ...]:
    """Return the widths times a factor, rounded, at least 1."""
    return tuple(max(1, round(factor * width)) for width in widths)
