"""Functions of sets: the points of a batch of clouds one after the other, and the largest numbers over each cloud."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.errors import ConfigError
from framework.geometry.clouds import Normalisation, normalised, require_clouds, sizes

AT_ONCE = 2**12
"""Points that a CPU takes through a network together: more leave its caches (2^16 are half as fast)."""
AT_ONCE_ON_DEVICE = 2**19


def columns_read(input_shape: tuple[int, ...], by: str, attributes: bool) -> int:
    """How many columns of its clouds an encoder reads: the coordinates, and the attributes where they are asked for.

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
    """What an encoder reads of its clouds: the first `columns`, of `most` points at most (None for all), normalised."""

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
    """What a network says of clouds, given their points (as `points_of`) and how many each has; in parts where it may.

    Args:
        training: whether the whole batch is wanted at once, as batch norm does.
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
    """The points of all clouds one after the other, normalised, without padding; and how many each cloud has.

    Args:
        normalise: as of `framework.geometry.clouds.normalised`; it sees all points.
        columns: the first so many are read.
        most: of each cloud no more points are read, the first ones; None for all.
        dtype: of the points returned.

    Raises:
        DataError: as `framework.geometry.clouds.sizes`.
    """
    counts = sizes(clouds)
    points = normalised(clouds, normalise, counts).clouds[:, :most, :columns].to(dtype)
    counts = counts if most is None else counts.clamp(max=most)
    if even(counts, points.shape[1]):
        return points.flatten(0, 1), counts
    real = torch.arange(points.shape[1], device=points.device) < counts[:, None]
    return points[real], counts


def largest(
    values: Float[Tensor, "point channels"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "batch channels"]:
    """The largest number of each channel over the points of each cloud; every cloud has one point at least."""
    count, channels = len(counts), values.shape[1]
    if count == 0:
        return values.new_zeros(0, channels)
    if even(counts, len(values) // count):
        return values.unflatten(0, (count, -1)).amax(1)
    return torch.stack([part.amax(0) for part in values.split(counts.tolist())])


def first_rows(counts: Int[Tensor, "batch"], most: int) -> Int[Tensor, "found"]:
    """Rows of the first so many points of each cloud, of all points one after the other."""
    if len(counts) == 0:
        return counts
    start = counts.cumsum(0) - counts
    number = torch.arange(min(most, int(counts.max())), device=counts.device)
    return (start[:, None] + number)[number < counts[:, None]]


def to_points(
    values: Float[Tensor, "batch channels"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "point channels"]:
    """What belongs to a cloud, at each of its points."""
    return values.repeat_interleave(counts, 0)


def even(counts: Int[Tensor, "batch"], points: int) -> bool:
    """Whether every cloud has so many points."""
    return bool((counts == points).all())


def in_parts(
    network: Callable[[Tensor, Tensor], Tensor],
    values: Float[Tensor, "point columns"],
    counts: Int[Tensor, "batch"],
    held: int = 1,
) -> Float[Tensor, "batch features"]:
    """What a network says of points and counts, given few clouds at a time so that their numbers stay near.

    For evaluation without gradient: with it all are held anyway, and batch norm in training wants the whole batch.

    Args:
        held: rows of numbers that the network makes of a point, about.
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
