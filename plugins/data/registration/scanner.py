"""Simulated scans of a body: points of its surface with noise, missing parts, and points of other objects."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float
from numpy.random import Generator
from pydantic import Field

from framework.errors import ConfigError
from framework.geometry.meshes import Mesh, normals, sample

Kind = Literal["whole", "partial", "outliers"]
KINDS: tuple[Kind, ...] = ("whole", "partial", "outliers")


Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class Scanner:
    """Settings of the simulated scanner.

    Attributes:
        points: total number of points of the surface and of other objects; fewer if parts are missing.
        noise: largest standard deviation of the noise on every coordinate, metres; the standard deviation of a scan is
            drawn uniformly below this value.
        cut: largest share of the points that is missing behind a plane or within a ball.
        strangers: largest share of the points that do not belong to the body.
    """

    points: Annotated[int, Field(ge=100, le=1_000_000)] = 10_000
    noise: Annotated[float, Field(ge=0, le=0.1, allow_inf_nan=False)] = 0.004
    cut: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = 0.2
    strangers: Annotated[float, Field(ge=0, le=0.3, allow_inf_nan=False)] = 0.1


@dataclass(frozen=True, kw_only=True)
class Kinds:
    """Shares of two kinds of scans; the remaining scans are complete.

    Attributes:
        partial: share of the scans with missing parts.
        outliers: share of the scans with points of other objects.

    Raises:
        ConfigError: the two shares add up to more than 1.
    """

    partial: Share = 0.2
    outliers: Share = 0.2

    def __post_init__(self) -> None:
        if self.partial + self.outliers > 1 + 1e-9:  # two decimal numbers may round to a little more than 1
            raise ConfigError(
                f"data.partial = {self.partial} and data.outliers = {self.outliers} add up to "
                f"{self.partial + self.outliers:g}, but each scan has one kind. Give shares that add up to at most 1."
            )

    def shares(self) -> Float[np.ndarray, "kind"]:
        """Return the share of each kind of scan; their sum is 1."""
        parts = (1 - min(1, self.partial + self.outliers), self.partial, self.outliers)
        return np.array(parts) / sum(parts)


def scan(mesh: Mesh, kind: Kind, scanner: Scanner, random: Generator) -> Float[np.ndarray, "points 3"]:
    """Return the points of one simulated scan of a body, metres.

    The points are uniform over the part of the surface that is not missing. A scan of kind "partial" lacks one of three
    sets of points, chosen at random: the points behind a plane, those within a ball, or those on faces that are turned
    away from a camera at the body's height. Points that an arm hides from this camera are kept. A scan of kind
    "outliers" also has points of a patch of floor and points anywhere around the body.
    """
    stranger = int(scanner.strangers * scanner.points * random.random()) if kind == "outliers" else 0
    surface_sample = sample(mesh, scanner.points - stranger, random)
    points = surface_sample.points
    if kind == "partial":
        hidden = (_behind_plane, _within_ball, _facing_away)[random.integers(3)]
        points = points[~hidden(mesh, surface_sample.points, surface_sample.face, scanner.cut, random)]
    points = points + random.normal(0, scanner.noise * random.random(), points.shape)
    if stranger:
        points = np.concatenate([points, strangers(mesh.vertices, stranger, random)])
    return points


def strangers(
    vertices: Float[np.ndarray, "vertex 3"], count: int, random: Generator
) -> Float[np.ndarray, "points 3"]:
    """Return `count` points that do not belong to the body.

    They lie on a patch of the floor under the feet; up to one point in fifty lies anywhere in a box around the body.
    """
    low, high = vertices.min(0), vertices.max(0)
    anywhere = random.integers(count // 50 + 1)
    middle, reach = (low + high) / 2, 0.65 * (high - low).max()
    around = middle + random.uniform(-reach, reach, (anywhere, 3))
    side = random.uniform(0.3, 0.8, 2)
    centre = middle[[0, 2]] + random.normal(0, 0.15, 2)
    floor = np.empty((count - anywhere, 3))
    floor[:, [0, 2]] = centre + random.uniform(-side, side, (count - anywhere, 2))
    floor[:, 1] = low[1] + random.normal(0, 0.004, count - anywhere)
    return np.concatenate([floor, around])


def _behind_plane(
    mesh: Mesh, points: np.ndarray, face: np.ndarray, most: float, random: Generator
) -> Bool[np.ndarray, "points"]:
    along = points @ _direction(random)
    return along > np.quantile(along, 1 - most * random.random())


def _within_ball(
    mesh: Mesh, points: np.ndarray, face: np.ndarray, most: float, random: Generator
) -> Bool[np.ndarray, "points"]:
    distance = np.linalg.norm(points - points[random.integers(len(points))], axis=1)
    return distance < np.quantile(distance, most * random.random())


def _facing_away(
    mesh: Mesh, points: np.ndarray, face: np.ndarray, most: float, random: Generator
) -> Bool[np.ndarray, "points"]:
    azimuth = random.normal(0, 0.7) + (np.pi if random.random() < 0.3 else 0)  # mostly the front is seen
    towards = np.array([np.sin(azimuth), random.normal(0, 0.15), np.cos(azimuth)])
    return normals(mesh)[face] @ towards < 0


def _direction(random: Generator) -> Float[np.ndarray, "3"]:
    vector = random.normal(size=3)
    return vector / np.linalg.norm(vector)
