"""Exact search for the point of a cloud nearest to each query, and the Chamfer distance (thesis eq. 6.4-6.6).

The CPU uses compiled kernels (`processor`, imported when first needed), other devices use torch (`device`). For clouds
in pieces see `streamed`; the other modules are for this package alone.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.errors import DataError
from framework.geometry.clouds import point_mask
from framework.geometry.nearest.exponents import MOST

OFTEN = 2**16
"""Largest number of queries that can be packed well in less than a second."""


class Nearest(NamedTuple):
    """The nearest point of each query.

    Attributes:
        distance: Euclidean, in the unit of the coordinates, of their dtype; NaN for queries beyond `query_sizes`.
        index: row of the cloud, int64; 0 for queries beyond `query_sizes`. Of points at the same distance, after
            rounding of its square in the dtype, the lowest row.
    """

    distance: Float[Tensor, "batch query"]
    index: Int[Tensor, "batch query"]


@dataclass(frozen=True, eq=False)
class Queries:
    """Queries that all clouds share, with results that are computed from them once (`prepare`).

    Attributes:
        points: finite.
        once: true if the queries are used for one batch only, so that packing them well takes longer than it saves.
    """

    points: Float[Tensor, "query 3"]
    once: bool = False

    @cached_property
    def largest(self) -> float:
        """Largest magnitude of a coordinate."""
        return float(self.points.abs().max())

    @cached_property
    def packed(self) -> Any:
        """Queries packed for the kernels of the CPU."""
        from framework.geometry.nearest.processor import packed_once, packed_well

        points = self.points.numpy()
        return packed_once(points) if self.once or len(points) > OFTEN else packed_well(points)


def prepare(queries: Tensor, once: bool = False) -> Queries:
    """Return queries (query, 3) prepared for many clouds: `nearest` takes them in place of the tensor, and is faster.

    Raises:
        DataError: there is no query, or a coordinate is NaN or infinite.
    """
    queries = queries.detach().contiguous()
    require_points(queries[None], "queries")
    refuse_bad(queries[None], None, "queries")
    return Queries(queries, once)


def nearest(
    clouds: Tensor, queries: Tensor | Queries, sizes: Tensor | None = None, query_sizes: Tensor | None = None
) -> Nearest:
    """Return the nearest point of each cloud to each query: exact in the dtype of the coordinates, float32 or float64.

    Squares of differences are added in that dtype. The distance, and that of the point that is found, are therefore the
    smallest to 2.5e-7 of the largest coordinate or distance in float32, 1e-15 in float64. The function uses as many
    threads as torch does. It has no gradient: gather points by `index` if a gradient is needed.

    Args:
        clouds: (batch, points, 3), on the device of the queries. Rows from `sizes` on are not read.
        queries: (query, 3), shared by all clouds, or (batch, query, 3), separate for each cloud.
        sizes: (batch,) number of points of each cloud; all if None.
        query_sizes: (batch,) number of queries of each cloud, for queries (batch, …); all if None.

    Raises:
        DataError: an empty cloud, a number that is not finite, a distance that the dtype cannot hold; the message names
            the cloud.
    """
    clouds = clouds.detach()
    own = isinstance(queries, Tensor) and queries.dim() == 3
    if isinstance(queries, Tensor) and not own:
        queries = prepare(queries, once=True)
    points = queries.points if isinstance(queries, Queries) else queries.detach()
    require_points(clouds, "clouds")
    require_points(points if own else points[None], "queries")
    if points.dtype != clouds.dtype or points.device != clouds.device or (own and len(points) != len(clouds)):
        raise DataError(
            f"Queries of shape {tuple(points.shape)}, {points.dtype} on {points.device} do not fit clouds of shape "
            f"{tuple(clouds.shape)}, {clouds.dtype} on {clouds.device}. Give both the same type and device, "
            "and as many sets of queries as clouds, or one."
        )
    if query_sizes is not None and not own:
        raise DataError(
            "Got query_sizes with queries that all clouds share, but query_sizes are numbers of queries of each cloud. "
            "Leave query_sizes out, or give queries (batch, query, 3)."
        )
    sizes = require_sizes(clouds, sizes, "clouds")
    query_sizes = require_sizes(points, query_sizes, "queries") if own else None
    if len(clouds) == 0:
        return Nearest(clouds.new_empty(0, points.shape[-2]), clouds.new_empty(0, points.shape[-2]).long())
    if clouds.device.type == "cpu":
        return on_processor(clouds, queries, sizes, query_sizes)
    return on_device(clouds, points, sizes, query_sizes)


def require_points(points: Tensor, name: str) -> None:
    """Check that points are (batch, points ≥ 1, 3) of float32 or float64.

    Raises:
        DataError: they are not.
    """
    if points.dim() != 3 or points.shape[2] != 3 or points.dtype not in (torch.float32, torch.float64):
        raise DataError(
            f"Got {name} of shape {tuple(points.shape)} and type {points.dtype}; expected coordinates x, y, z of "
            "float32 or float64. Take the first three columns and call .float()."
        )
    if points.shape[1] == 0:
        raise DataError(f"{name} of shape {tuple(points.shape)} hold no point; expected at least one.")


def require_sizes(points: Tensor, sizes: Tensor | None, name: str) -> Tensor | None:
    """Return the sizes as int64 on the CPU.

    Raises:
        DataError: a size is not in 1…points.
    """
    if sizes is None:
        return None
    sizes = sizes.to("cpu", torch.int64)
    wrong = ((sizes < 1) | (sizes > points.shape[1])).nonzero()
    if len(sizes) != len(points) or len(wrong):
        fault = (
            f"number {int(wrong[0])} has the size {int(sizes[wrong[0]])}"
            if len(wrong)
            else f"there are {len(sizes)} sizes"
        )
        raise DataError(
            f"Of {len(points)} {name} of up to {points.shape[1]} points, {fault}; expected a size from 1 to "
            f"{points.shape[1]} for each. Leave out empty ones."
        )
    return sizes


def refuse_bad(points: Tensor, sizes: Tensor | None, name: str) -> None:
    """Raise an error that names the first number that is not finite, if there is one.

    Raises:
        DataError: a number is not finite.
    """
    bad = ~points.isfinite().all(-1)
    if sizes is not None:
        bad &= point_mask(points, sizes)
    if bad.any():
        cloud, point = bad.nonzero()[0].tolist()
        raise DataError(
            f"{name}: point {point} of number {cloud} of the batch is {points[cloud, point].tolist()}; expected "
            "finite coordinates. Correct the file, remove such points, or give `sizes` so that padding is not read."
        )


def on_processor(
    clouds: Tensor, queries: Tensor | Queries, sizes: Tensor | None, query_sizes: Tensor | None
) -> Nearest:
    """Return the nearest points by the compiled kernels of the CPU."""
    from framework.geometry.nearest import processor

    shared = isinstance(queries, Queries)
    points = queries.points if isinstance(queries, Queries) else queries.detach().contiguous()
    clouds = clouds.contiguous()
    results = processor.search_batch(
        clouds.numpy(),
        None if sizes is None else sizes.numpy(),
        queries.packed if isinstance(queries, Queries) else points.numpy(),
        None if query_sizes is None else query_sizes.numpy(),
        queries.largest if isinstance(queries, Queries) else 0.0,
    )
    distance, index = torch.from_numpy(results.distance), torch.from_numpy(results.index)
    for i, outcome in enumerate(results.outcome.tolist() if results.outcome.any() else ()):
        if outcome == processor.BAD_CLOUD:
            refuse_bad(clouds, sizes, "clouds")
        elif outcome == processor.BAD_QUERIES:
            refuse_bad(points, query_sizes, "queries")
        elif outcome == processor.IMMODERATE:
            some = points if shared else points[i]
            some = some if query_sizes is None else some[: int(query_sizes[i])]
            cloud = clouds[i] if sizes is None else clouds[i, : int(sizes[i])]
            scale = scaling(cloud, some)
            scaled_result = nearest(cloud[None] * scale, some * scale)
            distance[i, : len(some)], index[i, : len(some)] = (
                unscale(scaled_result.distance[0], scale, i),
                scaled_result.index[0],
            )
    return Nearest(distance, index)


def on_device(clouds: Tensor, points: Tensor, sizes: Tensor | None, query_sizes: Tensor | None) -> Nearest:
    """Return the nearest points by torch, on other devices."""
    from framework.geometry.nearest.device import nearest_of

    refuse_bad(clouds, sizes, "clouds")
    if query_sizes is not None:
        refuse_bad(points, query_sizes, "queries")
    distance, index = nearest_of(clouds, points, sizes, query_sizes)
    for i in distance.isinf().any(1).nonzero().flatten().tolist():
        unscale(distance[i], 1.0, i)
    return Nearest(distance, index)


def scaling(cloud: Tensor, queries: Tensor) -> float:
    """Return a power of two, by which multiplying is exact, that scales the largest coordinate to about 1.

    If the dtype cannot hold such a power, the coordinate only becomes closer to 1, and `nearest` then scales again.
    """
    largest = max(float(cloud.abs().max()), float(queries.abs().max()))
    return 2.0 ** max(-MOST[cloud.dtype], min(MOST[cloud.dtype], -math.frexp(largest)[1]))


def unscale(distance: Tensor, scale: float, cloud: int) -> Tensor:
    """Return distances divided by the scale.

    Raises:
        DataError: the dtype cannot hold a distance.
    """
    distance = distance / scale
    if not distance.isfinite().all():
        raise DataError(
            f"Cloud {cloud} of the batch is so far from its queries that {distance.dtype} cannot hold the distance. "
            "Use float64 or a larger unit."
        )
    return distance


def chamfer(
    a: Float[Tensor, "batch points_a 3"],
    b: Float[Tensor, "batch points_b 3"],
    sizes_a: Int[Tensor, "batch"] | None = None,
    sizes_b: Int[Tensor, "batch"] | None = None,
) -> Float[Tensor, "batch"]:
    """Return the mean squared distance to the nearest point of the other cloud, both ways added (eq. 6.6).

    The result is differentiable.

    Raises:
        DataError: as `nearest`; or the dtype cannot hold the mean of the squares: it is too large, or too small and not
            0.
    """
    forward_offsets, backward_offsets = offsets(a, b, sizes_a, sizes_b), offsets(b, a, sizes_b, sizes_a)
    distance = mean_square(forward_offsets, sizes_a) + mean_square(backward_offsets, sizes_b)
    are_different = forward_offsets.detach().any(2).any(1) | backward_offsets.detach().any(2).any(1)
    lost = ~distance.detach().isfinite() | ((distance.detach() == 0) & are_different)
    if lost.any():
        cloud = int(lost.nonzero()[0])
        lies, unit = (
            ("near each other", "smaller") if distance[cloud] == 0 else ("far from each other", "larger")
        )
        raise DataError(
            f"Clouds {cloud} of the batch lie so {lies} that {a.dtype} cannot hold their mean squared distance. Use "
            f"float64 or a {unit} unit."
        )
    return distance


def offsets(
    queries: Tensor, clouds: Tensor, query_sizes: Tensor | None, sizes: Tensor | None
) -> Float[Tensor, "batch query 3"]:
    """Return the vectors from the nearest point of the cloud to each query; 0 for queries beyond `query_sizes`."""
    index = nearest(clouds, queries, sizes, query_sizes).index
    real = None if query_sizes is None else point_mask(queries, query_sizes)[..., None]
    if real is not None:
        queries = queries.where(real, 0)  # before anything is subtracted: NaN × 0 is no gradient
    vectors = queries - clouds.gather(1, index[..., None].expand(-1, -1, 3))
    return vectors if real is None else vectors.where(real, 0)


def mean_square(offsets: Float[Tensor, "batch query 3"], sizes: Tensor | None) -> Float[Tensor, "batch"]:
    """Return the mean of the squared lengths of the first `sizes` offsets of each cloud; the other offsets are 0."""
    sizes = offsets.new_full((len(offsets),), offsets.shape[1]) if sizes is None else sizes.to(offsets)
    return MeanSquare.apply(offsets, sizes)  # type: ignore[return-value]


class MeanSquare(torch.autograd.Function):
    """Mean of the squared lengths of offsets, computed in units of the largest, so that no square over- or underflows.

    A unit is a power of two, by which multiplying is exact. The derivative is that of the formula, since a chain of the
    single steps would multiply by the square of the unit, which the dtype may not hold.
    """

    @staticmethod
    def forward(ctx: Any, offsets: Tensor, sizes: Tensor) -> Tensor:  # type: ignore[override]
        """Return the mean squared length, (batch,)."""
        ctx.save_for_backward(offsets, sizes)
        exponent = torch.frexp(offsets.abs().amax((1, 2))).exponent.clamp(
            -MOST[offsets.dtype], MOST[offsets.dtype]
        )
        unit = torch.ldexp(torch.ones_like(sizes), exponent)
        square = (offsets / unit[:, None, None]).square().sum(-1)
        return square.sum(1) / sizes * unit * unit

    @staticmethod
    def backward(ctx: Any, along: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        """Return the gradient in the offsets."""
        offsets, sizes = ctx.saved_tensors
        return 2 * offsets * (along / sizes)[:, None, None], None
