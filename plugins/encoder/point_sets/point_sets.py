"""Functions of sets: concatenating the points of a batch of clouds, and maxima over each cloud."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.errors import ConfigError
from framework.geometry.clouds import Normalisation, normalise_clouds, require_clouds, sizes

AT_ONCE = 2**12
"""Number of points that a CPU takes through a network together: more leave its caches (2^16 are half as fast)."""
AT_ONCE_ON_DEVICE = 2**19


def columns_read(input_shape: tuple[int, ...], by: str, attributes: bool) -> int:
    """Return how many columns of its clouds an encoder reads: the coordinates, and the attributes if requested.

    Raises:
        ConfigError: the input is no cloud, or has no attributes.
    """
    require_clouds(input_shape, by)
    if attributes and input_shape[1] == 3:
        raise ConfigError(
            f"{by} with attributes=true wants clouds with more columns than x, y, z, these have none. Leave it out."
        )
    return input_shape[1] if attributes else 3


class Reading(NamedTuple):
    """The part of its clouds that an encoder reads.

    Attributes:
        columns: number of columns, the first ones.
        most: largest number of points of a cloud, the first ones; None for all.
        normalise: as of `framework.geometry.clouds.normalise_clouds`.
    """

    columns: int
    most: int | None
    normalise: Normalisation


def over_points(
    network: Callable[[Tensor, Tensor], Tensor],
    clouds: Float[Tensor, "batch points columns"],
    reading: Reading,
    dtype: torch.dtype,
    *,
    training: bool,
    held: int = 1,
) -> Float[Tensor, "batch features"]:
    """Return the features that a network computes of clouds, in parts of the batch where possible.

    Args:
        network: function of the points (as `points_of` returns them) and of the number of points of each cloud.
        clouds: (batch, points, columns).
        reading: columns, points and normalisation that are read.
        dtype: dtype of the points that the network reads.
        training: whether the network needs the whole batch at once, as batch norm does.
        held: as of `in_parts`.
    """
    columns, most, normalise = reading
    values, counts = points_of(clouds, normalise, columns=columns, most=most, dtype=dtype)
    if training or torch.is_grad_enabled():
        return network(values, counts)
    return in_parts(network, values, counts, held)


def points_of(
    clouds: Float[Tensor, "batch points columns"],
    normalise: Normalisation,
    *,
    columns: int,
    most: int | None,
    dtype: torch.dtype,
) -> tuple[Float[Tensor, "point read"], Int[Tensor, "batch"]]:
    """Return the points of all clouds, concatenated, normalised and without padding, and the number of points of each.

    Args:
        clouds: (batch, points, columns).
        normalise: as of `framework.geometry.clouds.normalise_clouds`; it reads all points.
        columns: number of columns that are read, the first ones.
        most: largest number of points that are read of a cloud, the first ones; None for all.
        dtype: dtype of the points returned.

    Raises:
        DataError: as `framework.geometry.clouds.sizes`.
    """
    counts = sizes(clouds)
    points = normalise_clouds(clouds, normalise, counts).clouds[:, :most, :columns].to(dtype)
    counts = counts if most is None else counts.clamp(max=most)
    if even(counts, points.shape[1]):
        return points.flatten(0, 1), counts
    real = torch.arange(points.shape[1], device=points.device) < counts[:, None]
    return points[real], counts


def largest(
    values: Float[Tensor, "point channels"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "batch channels"]:
    """Return the maximum of each channel over the points of each cloud; every cloud has at least one point."""
    count, channels = len(counts), values.shape[1]
    if count == 0:
        return values.new_zeros(0, channels)
    if even(counts, len(values) // count):
        return values.unflatten(0, (count, -1)).amax(1)
    return torch.stack([part.amax(0) for part in values.split(counts.tolist())])


def first_rows(counts: Int[Tensor, "batch"], most: int) -> Int[Tensor, "found"]:
    """Return the rows, among all points concatenated, of the first `most` points of each cloud."""
    if len(counts) == 0:
        return counts
    start = counts.cumsum(0) - counts
    number = torch.arange(min(most, int(counts.max())), device=counts.device)
    return (start[:, None] + number)[number < counts[:, None]]


def to_points(
    values: Float[Tensor, "batch channels"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "point channels"]:
    """Return the values of each cloud, repeated for each of its points."""
    return values.repeat_interleave(counts, 0)


def even(counts: Int[Tensor, "batch"], points: int) -> bool:
    """Return whether every cloud has `points` points."""
    return bool((counts == points).all())


def in_parts(
    network: Callable[[Tensor, Tensor], Tensor],
    values: Float[Tensor, "point columns"],
    counts: Int[Tensor, "batch"],
    held: int = 1,
) -> Float[Tensor, "batch features"]:
    """Return the features of a network of points and counts, computed for few clouds at a time to stay in caches.

    It is for evaluation without gradient: a gradient holds all numbers anyway, and batch norm in training needs the
    whole batch.

    Args:
        network: as of `over_points`.
        values: concatenated points.
        counts: number of points of each cloud.
        held: approximate number of rows of numbers that the network makes of a point.
    """
    limit = (AT_ONCE if values.device.type == "cpu" else AT_ONCE_ON_DEVICE) // held
    total, groups = 0, [[]]
    for number in counts.tolist():
        if groups[-1] and total + number > limit:
            total, groups = 0, [*groups, []]
        total += number
        groups[-1].append(number)
    parts = zip(values.split([sum(group) for group in groups]), groups, strict=True)
    return torch.cat([network(part, counts.new_tensor(group)) for part, group in parts])
