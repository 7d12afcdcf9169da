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
    """Balls of one size about the centroids of a level, and the layers that their points pass.

    Attributes:
        radius: in radii of the first level's balls at single scale.
        neighbours: points of a ball at most.
        widths: of the layers.
    """

    radius: float
    neighbours: int
    widths: tuple[int, ...]


PUBLISHED = {
    # Qi et al. 2017, "PointNet++", supplement on architectures; numbers of neighbours as in the authors' code
    "single_scale": (
        (Scale(1, 32, (64, 64, 128)),),
        (Scale(2, 64, (128, 128, 256)),),
    ),
    "multi_scale": (
        (Scale(0.5, 16, (32, 32, 64)), Scale(1, 32, (64, 64, 128)), Scale(2, 128, (64, 96, 128))),
        (Scale(1, 32, (64, 64, 128)), Scale(2, 64, (128, 128, 256)), Scale(4, 128, (128, 128, 256))),
    ),
}
"""Of each level."""
WHOLE, LAST = (256, 512, 1024), (512, 256)
"""Widths of the layers that the last centroids pass, and of those after the maximum over them."""
REACH = 5
"""How far a cloud is meant to reach from the origin, in radii of the first level's balls: 1 as published."""


class PointNet2(Encoder):
    """A PointNet for the points of small balls, one for larger balls about fewer places, one for the whole cloud.

    Centroids are points as far as can be from each other, the first from the mean of the cloud
    (`framework.geometry.farthest`). A ball is described by where its points are relative to the centroid and what is
    known of them: they pass the same layers, each with batch norm and ReLU, then the largest number of each channel
    stands at the centroid. A ball with more points than are read is described by those that are far from each other.
    Padding changes no feature, and the order of the points none but where distances are equal, as in a lattice: of
    equally far points the first is chosen. Nor do, in evaluation, points that come twice, if each does.

    Args:
        input_shape: (points, columns).
        grouping: "single_scale", balls of one size about a centroid; or "multi_scale", of three.
        centroids: of the two levels; all points of clouds that have fewer.
        radius: of the first level's balls at single scale, in units of the normalised cloud; others in proportion.
        width: factor of the published widths of all layers.
        dropout: after each of the two last layers.
        points: of each cloud at most so many are read, the first; None for all.
        normalise: as of framework.geometry.clouds.normalised.
        attributes: whether columns after x, y, z are read too.

    Raises:
        ConfigError: the input is no cloud, or has no attributes to read.
    """

    bibtex = """@inproceedings{qi2017pointnetplusplus,
  author    = {Qi, Charles R. and Yi, Li and Su, Hao and Guibas, Leonidas J.},
  title     = {{PointNet++}: Deep Hierarchical Feature Learning on Point Sets in a Metric Space},
  booktitle = {Advances in Neural Information Processing Systems},
  pages     = {5099--5108},
  year      = {2017}
}"""

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
        # numbers of one cloud at a time stay near a CPU, those of several do not
        self.held = max(scale.neighbours for level in PUBLISHED[grouping] for scale in level)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
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
    """Fewer points, each with what is known of the balls about it ("set abstraction").

    Args:
        length: how many numbers are known of a point.
        centroids: how many points of each cloud stay.
        radius: of the scales' unit.
        scales: of the balls; what is known of each stands one after the other.
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
        """Places and values of points, those of a cloud as `spread` orders them, to those of the centroids."""
        # a beginning of such an order is the order of its points, so that it is found once for all levels
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
    """The largest number of each channel over the points of each ball, whose places relative to the centroid and whose
    values have passed a network."""
    enter, *others, last = network.children()
    weight = enter.get_parameter("weight")
    rows = index.flatten()
    offset = places.index_select(0, rows) - centres.repeat_interleave(index.shape[1], 0)
    # a linear layer of (offset, value) is one of the offset and one of the value, which is a point's and not a ball's
    found = linear(offset, weight[:, :3])
    if values.shape[1]:
        found = found + linear(values, weight[:, 3:]).index_select(0, rows)
    for layer in others:
        found = layer(found)
    found = found.unflatten(0, index.shape)
    # `max` has the faster gradient, `amax` the faster value; the last layer is a ReLU, which the largest may pass alone
    return last(found.max(1).values if found.requires_grad else found.amax(1))


def spread(
    values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "point columns"]:
    """The points of each cloud, each as far as can be from those before it."""
    if len(counts) == 0:
        return values
    places = pad(values[:, :3].detach().split(counts.tolist()))
    order = farthest(places, counts, places.shape[1])
    start = counts.cumsum(0) - counts
    real = torch.arange(places.shape[1], device=counts.device) < counts[:, None]
    return values.index_select(0, (start[:, None] + order)[real])


def scaled(widths: tuple[int, ...], factor: float) -> tuple[int, ...]:
    return tuple(max(1, round(factor * width)) for width in widths)
