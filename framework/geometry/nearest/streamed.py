"""Nearest neighbours in clouds larger than memory: points come in chunks of any size, one after the other.

The cloud is read three times:

    middle = Middle()                       # first: the mean
    for chunk in chunks(): middle.add(chunk)
    reach = Reach(middle.mean)              # second: the largest distance from the mean
    for chunk in chunks(): reach.add(chunk)
    stream = Stream(queries)                # third: the search in the normalised cloud
    for chunk in chunks(): stream.add(normalise_chunk(chunk, middle.mean, reach.norm))

A chunk is a cloud (points, columns): x, y, z, then attributes. Memory holds one chunk and the results so far.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from framework.errors import DataError
from framework.geometry.nearest import Queries, nearest, prepare


class Streamed(NamedTuple):
    """The nearest point of each query in a cloud that was read in chunks.

    Attributes:
        distance: Euclidean distance, in the unit and the dtype of the coordinates.
        index: number of the nearest point among the points of all chunks, from 0, int64.
        point: the nearest point, with all its columns.
    """

    distance: Float[Tensor, "query"]
    index: Int[Tensor, "query"]
    point: Float[Tensor, "query columns"]


class Stream:
    """Search for the nearest points in a cloud that is read in chunks.

    On one device, the results equal those of `nearest` for the whole cloud exactly.

    Args:
        queries: (query, 3), or the result of `prepare`.
    """

    def __init__(self, queries: Float[Tensor, "query 3"] | Queries) -> None:
        # copies, here and below: a reader of a large cloud may fill one buffer again and again
        self.queries = queries if isinstance(queries, Queries) else prepare(queries.clone())
        self.count = 0
        self.best: Streamed | None = None

    def add(self, chunk: Float[Tensor, "points columns"]) -> None:
        """Search one more chunk.

        Raises:
            DataError: a number is not finite, the dtype cannot hold a distance, or the chunk has another number of
                columns than the first one. The results so far are then unchanged.
        """
        chunk = chunk.detach()
        if len(chunk) == 0:
            return
        if self.best is not None and chunk.shape[1] != self.best.point.shape[1]:
            raise DataError(
                f"A chunk of {chunk.shape[1]} columns follows chunks of {self.best.point.shape[1]} columns. "
                "Read the same columns from every part of the cloud."
            )
        chunk_nearest = nearest(chunk[None, :, :3], self.queries)
        distance, index = chunk_nearest.distance[0], chunk_nearest.index[0]
        if self.best is None:
            self.best = Streamed(distance, index, chunk[index])
        else:
            nearer = self.nearer(distance, chunk[index, :3]).nonzero().flatten()
            self.best.distance[nearer] = distance[nearer]
            self.best.index[nearer] = index[nearer] + self.count
            self.best.point[nearer] = chunk[index[nearer]]
        self.count += len(chunk)

    def nearer(
        self, distance: Float[Tensor, "query"], points: Float[Tensor, "query 3"]
    ) -> Bool[Tensor, "query"]:
        """Return a mask of queries for which a point of the new chunk is nearer than all points of earlier chunks.

        The mask is false for equal distances, so that the lower index stays.

        Args:
            distance: distance of the nearest point in the new chunk.
            points: coordinates of this nearest point.
        """
        assert self.best is not None
        nearer = distance < self.best.distance
        # squared distances that differ may have the same root, and `nearest` compares the squares
        same = (distance == self.best.distance).nonzero().flatten()
        if len(same):
            both = torch.stack([self.best.point[same, :3], points[same]], 1)
            nearer[same] = nearest(both, self.queries.points[same, None]).index[:, 0] == 1
        return nearer

    def result(self) -> Streamed:
        """Return the nearest points among the chunks so far.

        Raises:
            DataError: no point was added.
        """
        if self.best is None:
            raise DataError(
                "The chunks of a cloud held no point; expected at least one point. Leave out empty clouds."
            )
        return Streamed(*(tensor.clone() for tensor in self.best))


class Middle:
    """The mean of the points of all chunks so far, in float64."""

    def __init__(self) -> None:
        self.count = 0
        self.first = self.sum = torch.zeros(3, dtype=torch.float64)

    def add(self, chunk: Float[Tensor, "points columns"]) -> None:
        """Update the mean with the points of a chunk."""
        points = finite_points(chunk)
        if len(points) == 0:
            return
        if self.count == 0:
            self.first = points[0].clone()
            self.sum = torch.zeros_like(self.first)
        self.sum = self.sum + (points - self.first).sum(
            0
        )  # relative to the first point: clouds far from 0 keep their digits
        self.count += len(points)

    @property
    def mean(self) -> Float[Tensor, "3"]:
        """Mean of the points of all chunks so far, (3,)."""
        return self.first + self.sum / max(1, self.count)


class Reach:
    """The largest distance from a centre to a point of the chunks so far, in float64.

    Args:
        centre: coordinates of the centre, (3,).
    """

    def __init__(self, centre: Float[Tensor, "3"]) -> None:
        self.centre = centre.detach().double().clone()
        self.largest = 0.0

    def add(self, chunk: Float[Tensor, "points columns"]) -> None:
        """Update the largest distance from the centre with the points of a chunk."""
        points = finite_points(chunk)
        if len(points):
            self.largest = max(
                self.largest, float(torch.linalg.vector_norm(points - self.centre, dim=1).max())
            )

    @property
    def norm(self) -> float:
        """Largest distance from the centre; 1 if all points are at the centre."""
        return self.largest or 1.0


def finite_points(chunk: Tensor) -> Float[Tensor, "points 3"]:
    """Return the coordinates of a chunk's points, in float64.

    Raises:
        DataError: a coordinate is NaN or infinite.
    """
    points = chunk.detach()[:, :3].double()
    bad = (~points.isfinite().all(1)).nonzero()
    if len(bad):
        raise DataError(
            f"Point {int(bad[0])} of a chunk of {len(points)} is {points[bad[0, 0]].tolist()}; expected finite "
            "coordinates. Correct the file, or remove such points."
        )
    return points


def normalise_chunk(
    chunk: Float[Tensor, "points columns"], centre: Tensor, scale: float
) -> Float[Tensor, "points columns"]:
    """Return the chunk minus the centre, divided by the scale (thesis eq. 6.2); dtype and attributes are unchanged."""
    points = (chunk[:, :3].double() - centre) / scale
    return torch.cat([points.to(chunk.dtype), chunk[:, 3:]], 1)
