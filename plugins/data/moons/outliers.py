"""Data set of points far from the moons; framework.data describes the contract."""

import math
from collections.abc import Mapping
from typing import Annotated

import numpy as np
import torch
from pydantic import Field

from framework.datasets.fields import Fields
from plugins.data.moons.points import Draws, PlanePoints, fingerprint, split_of

FEWER = Draws(test=1000)


class MoonsOutliers(PlanePoints):
    """Two discs in the upper left and the lower right corner of [-4, 4]², far from either moon.

    The training data of `moons` hold no points there, but networks trained on them are nevertheless certain (the
    triangles of thesis Figure 2.2; §2.3.1).

    Points are uniformly distributed on the discs, in the scaled coordinates of the inputs of `moons`. The target of a
    point is the class of the nearer moon; it has no meaning. The splits are independent draws.

    Args:
        draws: Sizes and seed of the splits; the points lie alternately on the two discs.
        corner: Coordinate of the discs' centres, (-corner, corner) and (corner, -corner).
        radius: Radius of the discs.
    """

    bibtex = "prokudin2020robust"
    groups = ("outliers",)

    def __init__(
        self,
        *,
        draws: Draws = FEWER,
        corner: Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)] = 3.2,
        radius: Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)] = 0.6,
    ) -> None:
        self.draws = draws
        self.corner = corner
        self.radius = radius

    def draw_split(self, size: int, split: int) -> Fields:
        # the last 1 makes the stream differ from those of moons with the same seed
        random = np.random.default_rng([self.draws.data_seed, split, 1, 1]).random((size, 2))
        label = np.arange(size) % 2
        centre = np.where(label == 0, 1.0, -1.0)[:, None] * [-self.corner, self.corner]
        # the square root of a uniform number is the radius of a uniform point of a disc
        distance, angle = self.radius * np.sqrt(random[:, 0]), 2 * math.pi * random[:, 1]
        points = centre + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        return split_of(torch.from_numpy(points).float(), label)

    def fingerprint(self) -> Mapping[str, str]:
        return fingerprint(
            "moons_outliers 1",
            self._splits,
            corner=self.corner,
            radius=self.radius,
            data_seed=self.draws.data_seed,
        )
