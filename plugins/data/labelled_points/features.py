"""Features of the points of a scan: position, nearest points, and distances from basis points (thesis §6.3, §8.2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field
from scipy.spatial import KDTree

from framework.errors import DataError
from framework.geometry.nearest import nearest

Count = Annotated[int, Field(ge=0, le=4096)]
SAMPLES = 1000
"""Largest number of points of a scan whose distance to the next point `check_reach` measures."""
POSITION = ("x", "y", "height")
"""Names of the first features: the coordinates relative to the centre and to the lowest point of the scan."""


@dataclass(frozen=True, kw_only=True)
class Features:
    """Settings of the features of a point.

    Attributes:
        neighbours: Number of nearest points of the scan, each of which gives an offset (3 numbers) and a distance.
        surrounding_points: Number of basis points around the point. Each gives its distance to the scan.
        reach: Radius of the ball of the surrounding basis points, and largest distance that they give, in the unit of
            the files.
        basis_points: Number of basis points that are at the same place for all points of a scan. Each gives its
            distance to the scan; together they describe the whole scan.
    """

    neighbours: Count = 16
    surrounding_points: Count = 64
    reach: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] = 4.0
    basis_points: Count = 0

    @property
    def local_names(self) -> tuple[str, ...]:
        """Names of the features that differ between the points of a scan, in their order."""
        offsets = (f"{axis}_to_{i}" for i in range(self.neighbours) for axis in "xyz")
        distances = (f"distance_to_{i}" for i in range(self.neighbours))
        around = (f"surrounding_{i}" for i in range(self.surrounding_points))
        return (*POSITION, *offsets, *distances, *around)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all features, in their order."""
        return (*self.local_names, *(f"basis_{i}" for i in range(self.basis_points)))


class Bases(NamedTuple):
    """Basis points, in the unit of the files.

    Attributes:
        around: Basis points around each point, relative to that point.
        whole: Basis points of the whole scan, relative to the scan's centre and its lowest point.
    """

    around: Float[np.ndarray, "around 3"]
    whole: Float[np.ndarray, "whole 3"]


class Scan:
    """The points of a scan, with a tree that finds nearest points.

    The origin is the mean of x and y, and the smallest z.

    Args:
        points: Coordinates in the unit of the files, z up.
        source: Name of the scan for messages.
        neighbours: Number of neighbours that a point must have.

    Raises:
        DataError: A point has fewer neighbours.
    """

    def __init__(self, points: Float[np.ndarray, "points 3"], source: str, neighbours: int) -> None:
        if len(points) <= neighbours:
            raise DataError(
                f"{source}: the scan has {len(points)} points, but data.neighbours = {neighbours} needs at least "
                f"{neighbours + 1}. Choose a smaller data.neighbours, or leave the scan out."
            )
        origin = np.array([*points[:, :2].mean(0), points[:, 2].min()])
        self.points = points - origin
        self.tree = KDTree(self.points)

    def distances(self, queries: Float[np.ndarray, "queries 3"]) -> Float[np.ndarray, "queries"]:
        """Return the distance from each query to the nearest point, by the compiled search, which needs no tree."""
        return nearest(torch.from_numpy(self.points)[None], torch.from_numpy(queries)).distance[0].numpy()


def draw_bases(features: Features, extents: Float[np.ndarray, "2 3"], random: np.random.Generator) -> Bases:
    """Return random basis points.

    The points around a point are uniform in a ball of radius `reach` (thesis §6.3.2). Those of the whole scan are
    uniform in the box `extents`, because scans are much wider than high, and few points of a ball would be near them.

    Args:
        features: Settings of the features.
        extents: Lowest and highest coordinates of all scans for training, relative to each scan's origin.
        random: Generator of the points.
    """
    direction = random.normal(size=(features.surrounding_points, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = features.reach * np.cbrt(random.random((features.surrounding_points, 1)))
    whole = extents[0] + random.random((features.basis_points, 3)) * (extents[1] - extents[0])
    return Bases(radius * direction, whole)


def check_reach(scans: Sequence[Scan], rows: Sequence[Int[np.ndarray, "_rows"]], features: Features) -> None:
    """Check that the ball of the surrounding basis points is larger than gaps between points, and smaller than scans.

    Args:
        scans: The scans for training.
        rows: Indices of points of each scan, of which some are used.
        features: Settings of the features.

    Raises:
        DataError: The radius is at most the median distance between neighbours, or at least the extent of the largest
            scan; the unit of the files is then most likely another one.
    """
    if not features.surrounding_points:
        return
    samples = [
        np.asarray(scan.tree.query(scan.points[part[:SAMPLES]], min(2, len(scan.points)))[0])
        for scan, part in zip(scans, rows, strict=True)
        if len(part)
    ]
    spacing = float(np.median(np.concatenate([sample.reshape(len(sample), -1)[:, -1] for sample in samples])))
    extent = max(float(np.linalg.norm(np.ptp(scan.points, axis=0))) for scan in scans)
    if not spacing < features.reach < extent:
        raise DataError(
            f"data.reach = {features.reach:g} does not fit the scans, whose points are {spacing:.3g} apart and which "
            f"extend over {extent:.3g} in the unit of the files. Set data.reach to a length between these, such as the "
            "size of a small object, or data.surrounding_points=0."
        )


def local_features(
    scan: Scan, rows: Int[np.ndarray, "rows"], features: Features, bases: Bases
) -> Float[np.ndarray, "rows features"]:
    """Return the features of points that differ between the points of a scan.

    The neighbours of a point are the `neighbours` points of the scan nearest to it, without the point itself, by
    ascending distance. Points at the same place are neighbours with distance 0.

    Args:
        scan: The scan.
        rows: Indices of the points.
        features: Settings of the features.
        bases: Basis points, of which `around` is used.

    Returns:
        Features in the order of `Features.local_names`, in the unit of the files.
    """
    positions = scan.points[rows]
    parts = [positions]
    if features.neighbours:
        index = np.asarray(scan.tree.query(positions, features.neighbours + 1)[1])
        # if more points coincide than are found, the point itself may not be among them; then the last one is dropped
        itself = index == rows[:, None]
        itself[~itself.any(1), -1] = True
        index = index[~itself].reshape(len(rows), features.neighbours)
        offset = scan.points[index] - positions[:, None]
        parts += [offset.reshape(len(rows), -1), np.linalg.norm(offset, axis=2)]
    if features.surrounding_points:
        queries = (positions[:, None] + bases.around).reshape(-1, 3)
        parts.append(scan.distances(queries).clip(max=features.reach).reshape(len(rows), -1))
    return np.concatenate(parts, 1)


def scan_code(scan: Scan, bases: Bases) -> Float[np.ndarray, "basis"]:
    """Return the distance from each basis point of the whole scan to the nearest point of the scan (thesis eq. 6.4)."""
    return scan.distances(bases.whole) if len(bases.whole) else np.empty(0)
