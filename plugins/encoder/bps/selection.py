"""Choice of basis points for a set of clouds: the points whose distances together say most about all distances.

The distances of a set of clouds from many candidate points are the columns of a matrix with one row for each cloud.
QR factorisation with column pivoting (Businger & Golub 1965) chooses columns one after the other: always the column
with the largest residual in a linear least-squares fit to the columns chosen before. The same method places sensors
(Manohar, Brunton, Kutz & Brunton 2018). It reads no target.
"""

from collections.abc import Iterable, Iterator
from itertools import chain

import torch
from jaxtyping import Float, Int
from torch import Tensor

CANDIDATES = 2048
"""Smallest number of candidates."""
MOST_POINTS = 2048
"""Largest number of points that can be chosen; the covariance of twice as many candidates takes 134 MB."""
ROWS = 1024
"""Number of clouds whose distances are added to the covariance at a time."""
NEGLIGIBLE = 1e-10
"""Residual variance, as a share of the largest variance, below which a candidate counts as explained."""


def candidate_count(points: int) -> int:
    """Return the number of candidates among which `points` basis points are chosen."""
    return max(CANDIDATES, 2 * points)


def covariance(batches: Iterable[Float[Tensor, "batch candidate"]]) -> Float[Tensor, "candidate candidate"]:
    """Return the covariance of the columns over the rows of all batches, float64.

    The mean of the first rows is subtracted as a common origin, so that the difference of two large sums loses no
    digits.

    Args:
        batches: at least one batch with at least one row.
    """
    groups = _regroup(batches)
    first = next(groups)
    origin, count = first.mean(0), 0
    total, squares = torch.zeros_like(origin), origin.new_zeros(len(origin), len(origin))
    for rows in chain([first], groups):
        shifted = rows - origin
        total += shifted.sum(0)
        squares.addmm_(shifted.T, shifted)
        count += len(rows)
    mean = total / count
    return squares / count - torch.outer(mean, mean)


def _regroup(batches: Iterable[Tensor]) -> Iterator[Tensor]:
    """Yield the rows of all batches in float64, at least ROWS at a time except at the end."""
    waiting: list[Tensor] = []
    for batch in batches:
        waiting.append(batch.double())
        if sum(map(len, waiting)) >= ROWS:
            yield torch.cat(waiting)
            waiting = []
    if sum(map(len, waiting)):
        yield torch.cat(waiting)


def pivots(matrix: Float[Tensor, "candidate candidate"], count: int) -> Int[Tensor, "chosen"]:
    """Return the first pivots of the QR factorisation with column pivoting of rows with this covariance.

    The pivots are those of the Cholesky factorisation of the covariance with diagonal pivoting (Higham 2002, §10.3).
    Fewer than `count` pivots are returned if these columns explain all others; of equal residuals the first one wins.

    Args:
        matrix: covariance of the columns, float64.
        count: largest number of pivots.
    """
    residual = matrix.diagonal().clone()
    limit = NEGLIGIBLE * residual.max()
    factor = matrix.new_zeros(count, len(matrix))
    chosen: list[int] = []
    for step in range(min(count, len(matrix))):
        pivot = int(residual.argmax())
        if residual[pivot] <= limit:
            break
        chosen.append(pivot)
        row = matrix[pivot] - factor[:step, pivot] @ factor[:step]
        factor[step] = row / residual[pivot].sqrt()
        residual -= factor[step].square()
        residual[chosen] = -torch.inf  # rounding must not choose a column twice
    return torch.tensor(chosen, dtype=torch.int64)


def select(batches: Iterable[Float[Tensor, "batch candidate"]], count: int) -> Int[Tensor, "count"]:
    """Return the indices of `count` candidates, the most informative first.

    If fewer candidates explain the distances of all others, as in a set of fewer than `count` clouds, the remaining
    ones are the first candidates that are not chosen yet.

    Args:
        batches: distances of all clouds from the candidates.
        count: number of candidates to choose.
    """
    matrix = covariance(batches)
    chosen = pivots(matrix, count)
    others = torch.ones(len(matrix), dtype=torch.bool)
    others[chosen] = False
    return torch.cat([chosen, others.nonzero()[: count - len(chosen), 0]])
