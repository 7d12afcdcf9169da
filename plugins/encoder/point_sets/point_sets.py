"""Base class of networks on clouds, and functions that concatenate points and take maxima and means over clouds."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor

from framework.encoder import Encoder
from framework.errors import ConfigError
from framework.geometry.clouds import Normalisation, normalise_clouds, require_clouds, sizes

POINTS_ON_CPU = 2**12
"""Largest number of points that a CPU passes through a network together.

More points do not fit into the caches: 2^16 at once are half as fast.
"""
POINTS_ON_GPU = 2**19
"""Largest number of points that a GPU passes through a network together."""


def count_columns(input_shape: tuple[int, ...], by: str, attributes: bool) -> int:
    """Return the number of columns of a cloud that an encoder reads: 3 coordinates, and the attributes if requested.

    Args:
        input_shape: (points, columns).
        by: name of the encoder, for messages.
        attributes: whether columns after x, y, z are read too.

    Raises:
        ConfigError: the input is not a cloud, or attributes are requested and the clouds have none.
    """
    require_clouds(input_shape, by)
    if attributes and input_shape[1] == 3:
        raise ConfigError(
            f"{by} with attributes=true requires clouds with columns after x, y, z, but the clouds have no such "
            "columns. Set attributes=false."
        )
    return input_shape[1] if attributes else 3


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Settings of a network on clouds: the part of the clouds that it reads, and their normalisation.

    Attributes:
        points: number of points at the beginning of a cloud that are read; None for all.
        normalise: "unit_ball", "robust" or "none" (`framework.geometry.clouds.normalise_clouds`).
        attributes: whether columns after x, y, z are read too.
    """

    points: Annotated[int, Field(gt=0)] | None = None
    normalise: Normalisation = "unit_ball"
    attributes: bool = False


ALL_POINTS = Reading()
FIRST_1024_POINTS = Reading(points=1024)


class CloudNetwork(Encoder):
    """Base class of networks on the points of clouds.

    In evaluation without a gradient, a batch is encoded in parts of few clouds, so that intermediate results stay in
    the processor's caches.

    Args:
        input_shape: (points, columns).
        by: name of the encoder, for messages.
        reading: which points and columns of a cloud are read, and how the points are normalised.

    Attributes:
        reading: the argument `reading`.
        columns: number of leading columns that are read.
        rows_per_point: approximate number of rows of numbers that the network computes for each point.

    Raises:
        ConfigError: the input is not a cloud, or has no attributes to read.
    """

    rows_per_point: int = 1

    def __init__(self, input_shape: tuple[int, ...], by: str, reading: Reading) -> None:
        super().__init__()
        self.reading = reading
        self.columns = count_columns(input_shape, by, reading.attributes)

    @abstractmethod
    def encode(
        self, values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
    ) -> Float[Tensor, "batch length"]:
        """Return the features of clouds.

        Args:
            values: concatenated points of the clouds (`concatenate_points`), in the dtype of the parameters.
            counts: number of points of each cloud.
        """

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        """Return the features of the clouds."""
        reading, dtype = self.reading, next(self.parameters()).dtype
        values, counts = concatenate_points(
            inputs, reading.normalise, columns=self.columns, most=reading.points, dtype=dtype
        )
        # batch norm in training needs the whole batch at once, and a trace depends on no number of points
        if self.training or torch.is_grad_enabled() or torch.compiler.is_exporting():
            return self.encode(values, counts)
        return encode_in_parts(self.encode, values, counts, self.rows_per_point)


def concatenate_points(
    clouds: Float[Tensor, "batch points columns"],
    normalise: Normalisation,
    *,
    columns: int,
    most: int | None,
    dtype: torch.dtype,
) -> tuple[Float[Tensor, "point read"], Int[Tensor, "batch"]]:
    """Return the concatenated points of all normalised clouds without padding, and the number of points of each cloud.

    Args:
        clouds: (batch, points, columns).
        normalise: "unit_ball", "robust" or "none" (`framework.geometry.clouds.normalise_clouds`), computed from all
            points.
        columns: number of leading columns that are read.
        most: number of points at the beginning of a cloud that are read; None for all.
        dtype: dtype of the returned points.

    Raises:
        DataError: a cloud has no points, or a number of a point is not finite.
    """
    counts = sizes(clouds)
    points = normalise_clouds(clouds, normalise, counts).clouds[:, :most, :columns].to(dtype)
    counts = counts if most is None else counts.clamp(max=most)
    if torch.compiler.is_exporting():
        # in a trace all clouds have equally many rows: copies of the first point in place of padding change no maximum
        real = torch.arange(points.shape[1], device=points.device) < counts[:, None]
        return points.where(real[..., None], points[:, :1]).flatten(0, 1), counts
    if all_have(counts, points.shape[1]):
        return points.flatten(0, 1), counts
    real = torch.arange(points.shape[1], device=points.device) < counts[:, None]
    return points[real], counts


def largest(
    values: Float[Tensor, "point channels"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "batch channels"]:
    """Return the maximum of each channel over the points of each cloud.

    Args:
        values: values of the concatenated points of all clouds.
        counts: number of points of each cloud, at least 1.
    """
    count, channels = counts.shape[0], values.shape[1]
    if torch.compiler.is_exporting():
        return values.unflatten(0, (count, -1)).amax(1)
    if count == 0:
        return values.new_zeros(0, channels)
    if all_have(counts, len(values) // count):
        return values.unflatten(0, (count, -1)).amax(1)
    return torch.stack([part.amax(0) for part in values.split(counts.tolist())])


def mean(
    values: Float[Tensor, "point channels"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "batch channels"]:
    """Return the mean of each channel over the points of each cloud; every cloud has at least one point."""
    if len(counts) == 0:
        return values.new_zeros(0, values.shape[1])
    if all_have(counts, len(values) // len(counts)):
        return values.unflatten(0, (len(counts), -1)).mean(1)
    return torch.stack([part.mean(0) for part in values.split(counts.tolist())])


def first_rows(counts: Int[Tensor, "batch"], most: int) -> Int[Tensor, "found"]:
    """Return the rows, in the concatenated points of all clouds, of the first `most` points of each cloud.

    `counts` are the numbers of points of the clouds.
    """
    if len(counts) == 0:
        return counts
    start = counts.cumsum(0) - counts
    number = torch.arange(min(most, int(counts.max())), device=counts.device)
    return (start[:, None] + number)[number < counts[:, None]]


def repeat_for_points(
    values: Float[Tensor, "batch channels"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "point channels"]:
    """Return the values of each cloud, repeated for each of its points, in the order of the concatenated points.

    `counts` are the numbers of points of the clouds.
    """
    return values.repeat_interleave(counts, 0)


def all_have(counts: Int[Tensor, "batch"], points: int) -> bool:
    """Return whether every cloud has `points` points; `counts` are the numbers of points of the clouds."""
    return bool((counts == points).all())


def encode_in_parts(
    network: Callable[[Tensor, Tensor], Tensor],
    values: Float[Tensor, "point columns"],
    counts: Int[Tensor, "batch"],
    rows_per_point: int = 1,
) -> Float[Tensor, "batch features"]:
    """Return the features that a network computes for few clouds at a time.

    Its intermediate results then stay in the processor's caches.

    The function is for evaluation without a gradient: computing a gradient keeps all intermediate results in memory
    anyway, and batch norm in training needs the whole batch.

    Args:
        network: function of concatenated points and of the number of points of each cloud.
        values: concatenated points.
        counts: number of points of each cloud.
        rows_per_point: approximate number of rows of numbers that the network computes for each point.
    """
    limit = (POINTS_ON_CPU if values.device.type == "cpu" else POINTS_ON_GPU) // rows_per_point
    total, groups = 0, [[]]
    for number in counts.tolist():
        if groups[-1] and total + number > limit:
            total, groups = 0, [*groups, []]
        total += number
        groups[-1].append(number)
    parts = zip(values.split([sum(group) for group in groups]), groups, strict=True)
    return torch.cat([network(part, counts.new_tensor(group)) for part, group in parts])
