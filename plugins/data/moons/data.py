"""Data set of two moons with overlapping noise; framework.data describes the contract."""

from collections.abc import Mapping
from typing import Annotated

import torch
from pydantic import Field

from framework.datasets.fields import Fields
from plugins.data.moons.generator import draw, posterior
from plugins.data.moons.points import Draws, PlanePoints, fingerprint, split_of


class Moons(PlanePoints):
    """Two interleaved half circles with so much noise that the classes overlap (thesis Figure 2.2, §2.3.1).

    The classes are equally likely. Each batch holds "posterior", (batch, 2), the exact class probabilities of its
    points, which no prediction can improve on. The splits are independent draws; `data_seed` determines them.

    Args:
        draws: Sizes and seed of the splits.
        noise: Standard deviation of the noise on either coordinate, in units of the half circles' radius.
    """

    bibtex = "pedregosa2011scikit"
    groups = ("moons",)
    plane = True

    def __init__(
        self,
        *,
        draws: Draws,
        noise: Annotated[float, Field(ge=0.01, le=1, allow_inf_nan=False)] = 0.37,
    ) -> None:
        self.draws = draws
        self.noise = noise

    def draw_split(self, size: int, split: int) -> Fields:
        points, label = draw(size, self.noise, self.draws.data_seed, split)
        inputs = torch.from_numpy(points).float()
        exact = posterior(inputs.double().numpy(), self.noise)
        return split_of(inputs, label, posterior=torch.from_numpy(exact).float())

    def fingerprint(self) -> Mapping[str, str]:
        return fingerprint("moons 1", self._splits, noise=self.noise, data_seed=self.draws.data_seed)
