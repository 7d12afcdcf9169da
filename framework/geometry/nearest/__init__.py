"""Exact search for the point of a cloud nearest to each query, and the Chamfer distance (thesis eq. 6.4-6.6).

The CPU uses compiled kernels (`processor`, imported when first needed), other devices use torch (`device`). `streamed`
is for clouds that are read in pieces. The other modules are used by this package alone.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.errors import DataError
from framework.geometry.clouds import point_mask
from framework.geometry.nearest.exponents import MOST

OFTEN = 2**16
"""Largest number of queries that `processor.packed_well` packs in less than a second."""
FEW_IN_TRACE, MOST_PARTS = 64, 16
"""Number of queries that `nearest_in_trace` computes at a time, and largest number of such parts.

With more than 64 · 16 queries, the parts are larger.
"""


class Nearest(NamedTuple):
    """The nearest point of each query.

    Attributes:
        distance: Euclidean distance, in the unit and the dtype of the coordinates; NaN for queries beyond
            `query_sizes` (an argument of `nearest`).
        index: row of the nearest point in the cloud, int64; 0 for queries beyond `query_sizes`. If the squares of
            several distances are equal after rounding to the dtype, it is the lowest row.
    """

    distance: Float[Tensor, "batch query"]
    index: Int[Tensor, "batch query"]


@dataclass(frozen=True, eq=False)
class Queries:
    """Queries that all clouds share; what is computed from the queries alone is computed once (`prepare`).

    Attributes:
        points: coordinates of the queries, finite.
        once: true if the queries are used for one batch only; `packed` then has a form that is
            computed fast, because the form for many batches would take longer to compute than it saves.
    """

    points: Float[Tensor, "query 3"]
    once: bool = False

    @cached_property
    def largest(self) -> float:
        """Largest magnitude of a coordinate of the queries."""
        return float(self.points.abs().max())

    @cached_property
    def packed(self) -> Any:
        """Queries in the form that the kernels of the CPU read (`pack.Packed`)."""
        from framework.geometry.nearest.processor import packed_once, packed_well

        points = self.points.numpy()
        return packed_once(points) if self.once or len(points) > OFTEN else packed_well(points)


def prepare(queries: Tensor, once: bool = False) -> Queries:
    """Return queries (query, 3) prepared for many clouds: `nearest` takes them in place of the tensor, which is faster.

    Args:
        queries: (query, 3).
        once: true if the queries are used for one batch only.

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

    Squared differences are added in this dtype. So the returned distance, and the true distance of the point that is
    found, exceed the smallest distance by at most 2.5e-7 (float32) or 1e-15 (float64) times the largest coordinate or
    distance. The function uses as many threads as torch does. It has no gradient: gather points by `index` if a
    gradient is needed.

    Args:
        clouds: (batch, points, 3), on the device of the queries. Rows from `sizes` on are not read.
        queries: (query, 3), shared by all clouds, or (batch, query, 3), separate for each cloud.
        sizes: (batch,) number of points of each cloud; None if all rows are points.
        query_sizes: (batch,) number of queries of each cloud, for queries (batch, query, 3); None if all rows are
            queries.

    Raises:
        DataError: a cloud is empty, a number is not finite, or the dtype cannot hold a distance; the message names the
            cloud.
    """
    clouds = clouds.detach()
    if torch.compiler.is_exporting():
        return nearest_in_trace(clouds, queries.points if isinstance(queries, Queries) else queries, sizes)
    own = isinstance(queries, Tensor) and queries.dim() == 3
    if isinstance(queries, Tensor) and not own:
        queries = prepare(queries, once=True)
    points = queries.points if isinstance(queries, Queries) else queries.detach()
    require_points(clouds, "clouds")
    if own:
        require_points(points, "queries")
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


def nearest_in_trace(clouds: Tensor, queries: Tensor, sizes: Tensor | None) -> Nearest:
    """Return the nearest point of each cloud to each query, computed only by operations that exist in ONNX.

    The arguments are those of `nearest`.

    The squared distance |x|² - 2 x·q + |q|² is computed in float64 as products of matrices, so that distances
    in the unit ball are exact to 1e-7. Few queries at a time keep the products in a CPU's cache.
    """
    points = clouds.double()
    real = point_mask(clouds, sizes)
    # a row of padding is far away from every query
    square = points.square().sum(-1, keepdim=True).where(real[..., None], 1e300)
    points = torch.cat([points.where(real[..., None], 0), square], -1)
    factors = queries.double()
    parts, indices = [], []
    for some in factors.split(max(FEW_IN_TRACE, -(-factors.shape[0] // MOST_PARTS))):
        squares = torch.cat([-2 * some, torch.ones_like(some[..., :1])], -1) @ points.mT
        parts.append(squares.amin(-1))
        indices.append(squares.argmin(-1))
    distance = (torch.cat(parts, -1) + factors.square().sum(-1)).clamp(min=0).sqrt()
    return Nearest(distance.to(clouds.dtype), torch.cat(indices, -1))


def quick_distances(clouds: np.ndarray, queries: Queries) -> np.ndarray | None:
    """Return the distances that `nearest` finds on the CPU, without its checks; None if `nearest` must be called.

    `nearest` must be called if a coordinate is NaN, infinite or of extreme magnitude.

    Args:
        clouds: (batch, points, 3), contiguous, at least one cloud of at least one point, of the dtype of the queries.
        queries: queries that all clouds share, on the CPU.

    Returns:
        Distances, (batch, query), or None.
    """
    from framework.geometry.nearest.processor import search_batch

    results = search_batch(clouds, None, queries.packed, None, queries.largest)
    return None if any(results.outcome.tolist()) else results.distance


def require_points(points: Tensor, name: str) -> None:
    """Check that a tensor of points has the shape (batch, points, 3), at least one point, and float32 or float64.

    Args:
        points: the tensor.
        name: name of the tensor, for the message.

    Raises:
        DataError: the shape or the dtype is not one of these.
    """
    if points.dim() != 3 or points.shape[2] != 3 or points.dtype not in (torch.float32, torch.float64):
        raise DataError(
            f"Got {name} of shape {tuple(points.shape)} and type {points.dtype}; expected coordinates x, y, z of "
            "float32 or float64. Take the first three columns and call .float()."
        )
    if points.shape[1] == 0:
        raise DataError(
            f"{name} of shape {tuple(points.shape)} hold no point; expected at least one point. Leave out empty "
            "entries."
        )


def require_sizes(points: Tensor, sizes: Tensor | None, name: str) -> Tensor | None:
    """Return `sizes` as int64 on the CPU; None if `sizes` is None.

    Args:
        points: (batch, points, 3).
        sizes: number of points of each item of the batch, or None.
        name: name of the points, for the message.

    Raises:
        DataError: a size is not from 1 to the number of rows of `points`.
    """
    if sizes is None:
        return None
    sizes = sizes.to("cpu", torch.int64)
    counts = sizes.tolist()  # for usual batches, numbers of Python are faster than tensors of one number
    if len(counts) == len(points) and (not counts or 1 <= min(counts) <= max(counts) <= points.shape[1]):
        return sizes
    wrong = ((sizes < 1) | (sizes > points.shape[1])).nonzero()
    if len(sizes) != len(points) or len(wrong):
        fault = (
            f"entry {int(wrong[0])} has the size {int(sizes[wrong[0]])}"
            if len(wrong)
            else f"there are {len(sizes)} sizes"
        )
        raise DataError(
            f"Got sizes for a batch of {len(points)} {name} with up to {points.shape[1]} points, but {fault}; "
            f"expected one size for each entry, from 1 to {points.shape[1]}. Leave out empty entries."
        )
    return sizes


def refuse_bad(points: Tensor, sizes: Tensor | None, name: str) -> None:
    """Check that all coordinates are finite.

    Args:
        points: (batch, points, 3).
        sizes: number of points of each item of the batch; None if all rows are points.
        name: name of the points, for the message.

    Raises:
        DataError: a number is NaN or infinite; the message names the first one.
    """
    bad = ~points.isfinite().all(-1)
    if sizes is not None:
        bad &= point_mask(points, sizes)
    if bad.any():
        cloud, point = bad.nonzero()[0].tolist()
        raise DataError(
            f"{name}: point {point} of entry {cloud} of the batch is {points[cloud, point].tolist()}; expected "
            "finite coordinates. Correct the file, remove such points, or give `sizes` so that padding is not read."
        )


def on_processor(
    clouds: Tensor, queries: Tensor | Queries, sizes: Tensor | None, query_sizes: Tensor | None
) -> Nearest:
    """Return the nearest points, found by the compiled kernels of the CPU; the arguments are those of `nearest`."""
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
    for i, outcome in enumerate(results.outcome.tolist()):
        if outcome == processor.FINE:
            continue
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
    """Return the nearest points, found by torch on devices other than the CPU.

    The arguments are those of `nearest`; `points` are the coordinates of the queries.
    """
    from framework.geometry.nearest.device import nearest_of

    refuse_bad(clouds, sizes, "clouds")
    if query_sizes is not None:
        refuse_bad(points, query_sizes, "queries")
    distance, index = nearest_of(clouds, points, sizes, query_sizes)
    for i in distance.isinf().any(1).nonzero().flatten().tolist():
        unscale(distance[i], 1.0, i)
    return Nearest(distance, index)


def scaling(cloud: Tensor, queries: Tensor) -> float:
    """Return the power of two by which coordinates are multiplied, so that the largest magnitude is about 1.

    Multiplying by a power of two is exact. If the required exponent is too large for the dtype (`exponents.MOST`), the
    closest allowed power is returned. `nearest` then finds that the scaled coordinates need scaling, and scales again.

    Args:
        cloud: (points, 3).
        queries: (query, 3), of the dtype of `cloud`.
    """
    largest = max(float(cloud.abs().max()), float(queries.abs().max()))
    return 2.0 ** max(-MOST[cloud.dtype], min(MOST[cloud.dtype], -math.frexp(largest)[1]))


def unscale(distance: Tensor, scale: float, cloud: int) -> Tensor:
    """Return distances divided by the factor `scale` by which the coordinates were multiplied.

    Raises:
        DataError: the dtype cannot hold a distance; the message names the cloud with the index `cloud`.
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
    """Return the Chamfer distance of clouds `a` and `b`, one for each item of the batch (thesis eq. 6.6).

    This is the mean squared distance from the points of `a` to their nearest points of `b`, plus the same mean with `a`
    and `b` exchanged. The result is differentiable in both clouds.

    Args:
        a: clouds, (batch, points, 3).
        b: clouds, (batch, points, 3).
        sizes_a: number of points of each cloud in `a`; None if all rows are points.
        sizes_b: number of points of each cloud in `b`; None if all rows are points.

    Raises:
        DataError: a cloud is empty, a number is not finite, or the dtype cannot hold a distance or the mean of the
            squares; the message names the cloud.
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
        queries = queries.where(real, 0)  # before anything is subtracted: NaN × 0 is not a gradient
    vectors = queries - clouds.gather(1, index[..., None].expand(-1, -1, 3))
    return vectors if real is None else vectors.where(real, 0)


def mean_square(offsets: Float[Tensor, "batch query 3"], sizes: Tensor | None) -> Float[Tensor, "batch"]:
    """Return the mean of the squared lengths of the first `sizes` offsets of each cloud; later offsets must be 0.

    Args:
        offsets: (batch, query, 3).
        sizes: number of offsets of each cloud; None if all rows count.
    """
    sizes = offsets.new_full((len(offsets),), offsets.shape[1]) if sizes is None else sizes.to(offsets)
    return MeanSquare.apply(offsets, sizes)  # type: ignore[return-value]


class MeanSquare(torch.autograd.Function):
    """Differentiable mean of the squared lengths of offsets, without over- or underflow of a square.

    The lengths are computed in a unit near the largest one. The unit is a power of two, so multiplying by it is exact.
    The gradient is computed from the formula of the mean: automatic differentiation of the steps would multiply by the
    square of the unit, which the dtype may not hold.
    """

    @staticmethod
    def forward(ctx: Any, offsets: Tensor, sizes: Tensor) -> Tensor:  # type: ignore[override]
        """Return the mean squared length, (batch,).

        Args:
            ctx: storage for `backward`.
            offsets: (batch, query, 3).
            sizes: number of offsets of each cloud.
        """
        ctx.save_for_backward(offsets, sizes)
        exponent = torch.frexp(offsets.abs().amax((1, 2))).exponent.clamp(
            -MOST[offsets.dtype], MOST[offsets.dtype]
        )
        unit = torch.ldexp(torch.ones_like(sizes), exponent)
        square = (offsets / unit[:, None, None]).square().sum(-1)
        return square.sum(1) / sizes * unit * unit

    @staticmethod
    def backward(ctx: Any, along: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        """Return the gradient with respect to the offsets, given the gradient `along` with respect to the mean."""
        offsets, sizes = ctx.saved_tensors
        return 2 * offsets * (along / sizes)[:, None, None], None
