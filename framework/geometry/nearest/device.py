"""Nearest neighbours in torch, on devices other than the CPU: all pairs, in pieces of bounded memory."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.geometry.clouds import point_mask
from framework.geometry.nearest.exponents import MOST

PAIRS = 2**24
"""Number of squared distances held at a time, in each of three arrays: 192 MiB in float32."""


def nearest_of(
    clouds: Float[Tensor, "batch points 3"],
    queries: Float[Tensor, "query 3"] | Float[Tensor, "batch query 3"],
    sizes: Int[Tensor, "batch"] | None,
    query_sizes: Int[Tensor, "batch"] | None,
    pairs: int = PAIRS,
) -> tuple[Float[Tensor, "batch query"], Int[Tensor, "batch query"]]:
    """Return the distance of each query to the nearest point, and the row of this point, for finite coordinates.

    Differences are computed before they are squared, because |p|² - 2 p·q + |q|² would lose the digits of small
    distances. Each square is rounded before it is added, while the search on the CPU adds it unrounded (fused
    multiply-add). Distances therefore differ from the CPU's by a unit in the last place, and of two points at nearly
    equal distance, the CPU may find the other one.

    Args:
        clouds: (batch, points, 3).
        queries: (query, 3), shared by all clouds, or (batch, query, 3).
        sizes: number of points of each cloud; None if all rows are points.
        query_sizes: number of queries of each cloud; None if all rows are queries.
        pairs: number of squared distances held at a time.
    """
    batch, points, _ = clouds.shape
    query_count = queries.shape[-2]
    if queries.dim() == 2:
        queries = queries.expand(batch, -1, -1)
    # division by a power of two is exact, and no square over- or underflows afterwards
    real_points, real_queries = point_mask(clouds, sizes), point_mask(queries, query_sizes)
    clouds, queries = clouds.where(real_points[..., None], 0), queries.where(real_queries[..., None], 0)
    largest = torch.maximum(clouds.abs().amax((1, 2)), queries.abs().amax((1, 2)))
    exponent = torch.frexp(largest).exponent.clamp(-MOST[clouds.dtype], MOST[clouds.dtype])
    clouds = torch.ldexp(clouds, -exponent[:, None, None])
    queries = torch.ldexp(queries, -exponent[:, None, None])

    distance = clouds.new_empty(batch, query_count)
    index = torch.empty(batch, query_count, dtype=torch.int64, device=clouds.device)
    # the batch is cut first, then the queries; points are cut only if they exceed `pairs`
    cut_points = min(points, pairs)
    cut_queries = max(1, min(query_count, pairs // cut_points))
    cut_batch = max(1, min(batch, pairs // (cut_points * cut_queries)))
    for b in range(0, batch, cut_batch):
        for q in range(0, query_count, cut_queries):
            query_piece = queries[b : b + cut_batch, q : q + cut_queries]
            best = query_piece.new_full(query_piece.shape[:2], torch.inf)
            which = torch.zeros_like(best, dtype=torch.int64)
            for p in range(0, points, cut_points):
                cloud_piece = clouds[b : b + cut_batch, p : p + cut_points]
                square = (query_piece[:, :, None, 0] - cloud_piece[:, None, :, 0]).square_()
                square += (query_piece[:, :, None, 1] - cloud_piece[:, None, :, 1]).square_()
                square += (query_piece[:, :, None, 2] - cloud_piece[:, None, :, 2]).square_()
                square.masked_fill_(~real_points[b : b + cut_batch, None, p : p + cut_points], torch.inf)
                least = square.argmin(2)  # the first of equal ones
                square = square.gather(2, least[..., None])[..., 0]
                nearer = square < best
                best, which = square.where(nearer, best), (least + p).where(nearer, which)
            distance[b : b + cut_batch, q : q + cut_queries] = best.sqrt()
            index[b : b + cut_batch, q : q + cut_queries] = which
    distance = torch.ldexp(distance, exponent[:, None])
    return distance.where(real_queries, torch.nan), index.where(real_queries, 0)
