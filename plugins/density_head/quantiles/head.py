"""The head of quantiles: quantiles of one real number, trained by the pinball loss and conformalised."""

import math
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.density_head import DensityHead
from framework.errors import ConfigError
from framework.heads.parameters import require_finite, require_validation
from framework.heads.scales import scale_of_raw
from framework.heads.unit import Unit
from framework.storage.weights import require_state
from framework.target import Target
from plugins.density_head.quantiles.density import PiecewiseQuantiles

LARGEST = 1e8
"""Bound to which the middle quantile is clamped, in the unit of the raw parameters."""
LARGEST_STEP = 1e3
"""Bound of the distance of two neighbouring quantiles, so that the sum of all keeps the digits of the smallest."""
FURTHEST = 1e9
"""Bound of the corrections that `calibrate` sets, in units of the distance between the outermost quantiles."""


class QuantilesHead(DensityHead):
    """Quantiles of one real number at equally spaced probabilities, as a density (`PiecewiseQuantiles`).

    The loss is the mean pinball loss of all quantiles times 2, in standard deviations of the target. With many levels
    it approaches the continuous ranked probability score (Gneiting & Raftery 2007). The quantiles cannot cross: the raw
    parameters are the middle quantile and the distances between neighbouring quantiles. `calibrate` moves each
    quantile, so that at least the stated share of the validation split lies at or below it (conformalised quantile
    regression, Romano, Patterson & Candès 2019, for each quantile). The distance by which a quantile is moved is a
    share of the distance from the lowest to the highest quantile; this share is the same for all samples. The moved
    quantiles are sorted (Chernozhukov, Fernández-Val & Galichon 2010).

    Args:
        levels: number of quantiles K, odd; their probabilities are k/(K + 1).
        tail: shape ξ of the Pareto tails; 0: exponential tails.
        floor: smallest distance of two neighbouring quantiles, in the unit of the raw parameters.
    """

    bibtex = "koenker1978regression, gasthaus2019probabilistic, ehrlich2021spliced, romano2019conformalized"

    corrections: Tensor

    def __init__(
        self,
        target: Target,
        *,
        levels: Annotated[int, Field(ge=3, le=999)] = 19,
        tail: Annotated[float, Field(ge=0, lt=0.5)] = 0.2,
        floor: Annotated[float, Field(ge=1e-6, le=1.0)] = 1e-3,
    ) -> None:
        super().__init__()
        target.require("real", by="density_head quantiles")
        if len(target.names) != 1 or levels % 2 == 0:
            raise ConfigError(
                f"density_head quantiles predicts one number by an odd number of levels, but the target has "
                f"{len(target.names)} numbers ({target.listed_names}) and density_head.levels is {levels}. Name one "
                "column as the target, and an odd number of levels."
            )
        self.size = levels
        self.tail = tail
        self.floor = floor
        self.unit = Unit.of(target)
        self.levels = torch.arange(1, levels + 1, dtype=torch.float64) / (levels + 1)
        self.register_buffer("corrections", torch.zeros(levels, dtype=torch.float64))
        require_state(self, corrections=(-FURTHEST, FURTHEST))

    def forward(self, raw: Float[Tensor, "*batch size"]) -> PiecewiseQuantiles:
        """Return the density for raw parameters."""
        location, steps = self._parts(raw)
        density = PiecewiseQuantiles(location, steps, self.levels, self.tail)
        if bool(self.corrections.any()):
            offsets = density.offsets
            width = offsets[..., -1:] - offsets[..., :1]
            offsets = spread((offsets + self.corrections.to(offsets) * width).sort(-1).values, self.floor)
            middle = offsets[..., self.size // 2 : self.size // 2 + 1]
            location, steps = location + middle, offsets.diff(dim=-1).clamp(min=self.floor / 2)
        location, unit, _ = self.unit.to_target_unit(location, torch.ones_like(location))
        return PiecewiseQuantiles(location, steps * unit, self.levels, self.tail)

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """Return twice the mean pinball loss of each sample, for quantiles that `calibrate` has not moved."""
        quantiles = PiecewiseQuantiles(*self._parts(raw), self.levels, self.tail).quantiles
        gap = self.unit.standardise(target).to(quantiles) - quantiles
        levels = self.levels.to(quantiles)
        return 2 * torch.maximum(levels * gap, (levels - 1) * gap).mean(-1)

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        """Set the distance by which each quantile is moved, as a share of the range of all quantiles.

        Of n samples, at least min(n, ⌈(n + 1) τ⌉) lie at or below the moved quantile of the probability τ.
        """
        require_validation(raw, "The quantiles are")
        quantiles = PiecewiseQuantiles(*self._parts(raw.double()), self.levels, self.tail).quantiles
        value = self.unit.standardise(target).double()
        scores = ((value - quantiles) / (quantiles[..., -1:] - quantiles[..., :1])).sort(0).values
        count = len(scores)
        ranks = [min(count, math.ceil((count + 1) * level - 1e-9)) for level in self.levels.tolist()]
        moved = torch.stack([scores[rank - 1, number] for number, rank in enumerate(ranks)])
        self.corrections.copy_(moved.clamp(-FURTHEST, FURTHEST))

    def _parts(self, raw: Float[Tensor, "*batch size"]) -> tuple[Tensor, Tensor]:
        """Return the middle quantile and the distances of neighbouring ones, before calibration."""
        raw = require_finite(raw, self.size)
        middle = self.size // 2
        location = raw[..., middle : middle + 1].clamp(-LARGEST, LARGEST)
        # raw parameters of 0 give quantiles that span about four standard deviations
        steps = (
            self.floor
            + scale_of_raw(torch.cat([raw[..., :middle], raw[..., middle + 1 :]], -1)) * 4 / self.size
        )
        return location, steps.clamp(max=LARGEST_STEP)


def spread(quantiles: Float[Tensor, "*batch size"], floor: float) -> Float[Tensor, "*batch size"]:
    """Return ascending quantiles, moved up where two neighbours are closer than `floor`."""
    line = floor * torch.arange(quantiles.shape[-1], dtype=quantiles.dtype, device=quantiles.device)
    return (quantiles - line).cummax(-1).values + line
