"""Calibration of densities over images, number by number, and correlation of predicted scales with errors."""

import math
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from framework.distributions.checks import refuse_nan
from framework.errors import DataError
from framework.metric import HasFigure, Metric
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.pixel_uncertainty.functional import coverage, rank_correlation, transform

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = 19
"""Number of nominal masses 0.05, 0.10, ..., 0.95."""
KEPT = 8
"""Number of random images kept beside the least and the most certain; the one closest to the median is shown."""


class PixelUncertainty(Metric, HasFigure):
    """Coverage of the predicted intervals of pixels, and rank correlation of errors with predicted scales.

    Each image is judged by itself; the results are means over images, with standard errors:

    - `pixel_coverage_90`: share of numbers between their 5 % and 95 % quantiles.
    - `pixel_coverage_error`: mean |share - mass| over the masses 0.05, 0.10, ..., 0.95.
    - `spearman`: rank correlation, over the pixels of an image, of the mean |error| with the predicted root mean
      variance. The error is of the point prediction, rounded as files are. The correlation is exact, and taken within
      an image so that a harder image has no more weight than an easier one; it is NaN where all pixels have one scale.
    - `pixel_scale`: mean over pixels of that root mean variance.

    Each is over the full frame and, with `_masked`, over the pixels of the true mask. **Read the masked numbers.** A
    background that is exactly white makes those of the frame too good in two ways. Its small scales and small errors go
    together. And a number that is 1 in the file may stand for any higher number: for a density that puts all its mass
    there, every transform between 0 and 1 is possible, and each interval holds the number with exactly its own mass.
    Such a density is calibrated, but tells nothing.

    Args:
        steps: number of steps of the stored numbers' grid between 0 and 1; 0 if they are not on a grid.
        masked: also compute the numbers inside the true mask, which batches must then have.

    Raises:
        ConfigError: the target is not an image.
        DataError: batches have no mask.
        UserError: a density has no distribution function, or no variance, of each number; or transforms are NaN.
    """

    bibtex = """@article{czado2009predictive,
  author  = {Czado, Claudia and Gneiting, Tilmann and Held, Leonhard},
  title   = {Predictive Model Assessment for Count Data},
  journal = {Biometrics},
  volume  = {65},
  number  = {4},
  pages   = {1254--1261},
  year    = {2009}
}"""
    columns: ClassVar[dict[str, str]] = {
        "pixel_coverage_90": "pixels in 90 %",
        "pixel_coverage_90_masked": "inside",
        "spearman": "error by scale",
        "spearman_masked": "inside",
    }
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {
        "spearman": "higher",
        "spearman_masked": "higher",
    }
    figure_name: ClassVar[str] = "pixel_uncertainty"
    numbers: list[Tensor]
    facts: list[Tensor]
    panels: list[Tensor]

    def __init__(
        self, target: Target, *, steps: Annotated[int, Field(ge=0, le=2**16)] = 255, masked: bool = True
    ) -> None:
        super().__init__()
        target.require("image", by="metric pixel_uncertainty")
        self.steps = steps
        self.regions = ("", "_masked") if masked else ("",)
        self.columns = {key: name for key, name in self.columns.items() if masked or "masked" not in key}  # type: ignore[misc]
        self.better = {key: way for key, way in self.better.items() if key in self.columns}  # type: ignore[misc]
        # shapes: (image, region × (level + 2)); each kept image: (1, 2), (1, height, width, 2 · number + 2)
        for name in ("numbers", "facts", "panels"):
            self.add_state(name, [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        true, density, point = prediction.target, prediction.density, prediction.point
        if "mask" not in prediction.batch and len(self.regions) > 1:
            raise DataError(
                f"pixel_uncertainty looks inside the true mask too, but batches have only "
                f"{', '.join(prediction.batch)}. Set its `masked` to false, or choose data that give a mask."
            )
        if len(true) == 0:
            return
        found = transform(density, true, self.steps)
        scale = density.variance.mean(-1).sqrt()
        refuse_nan(
            (found.low + found.high).sum((1, 2, 3)) + scale.sum((1, 2)), "images' transforms and scales"
        )
        if (
            self.steps
        ):  # round the prediction as a file would, so that it has no error smaller than the rounding
            point = (point.clamp(0, 1) * self.steps).round() / self.steps
        error = (point - true).abs().mean(-1)
        everywhere = torch.ones_like(true[..., 0], dtype=torch.bool)
        places = [everywhere, prediction.true_image("mask")] if len(self.regions) > 1 else [everywhere]
        index = prediction.batch["index"].double()
        for row in range(len(true)):
            parts: list[Tensor] = []
            for place in places:
                inside = place[row]
                shares = coverage(type(found)(*(part[row][inside] for part in found)), self._levels())
                wide = scale[row][inside].double()
                parts += [shares, torch.stack([rank_correlation(error[row][inside], wide), wide.mean()])]
            self.numbers.append(torch.cat(parts).unsqueeze(0))
            self.facts.append(torch.stack([parts[-1][-1], index[row]]).unsqueeze(0))
            shown = [true[row], point[row], error[row].unsqueeze(-1), scale[row].unsqueeze(-1)]
            self.panels.append(torch.cat(shown, -1).half().unsqueeze(0))
            stay = kept(torch.cat(self.facts))
            self.facts, self.panels = ([some[at] for at in stay] for some in (self.facts, self.panels))

    def compute(self) -> dict[str, Tensor]:
        found: dict[str, Tensor] = {}
        for region, numbers in self._seen().items():
            shares, rank, scale = numbers[:, :LEVELS], numbers[:, LEVELS], numbers[:, LEVELS + 1]
            for name, each in {
                "pixel_coverage_90": shares[:, 17],
                "spearman": rank,
                "pixel_scale": scale,
            }.items():
                found |= with_error(name + region, each)
            off = (shares.nanmean(0) - self._levels()).abs().mean()
            found[f"pixel_coverage_error{region}"] = off
        return found

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.metric.pixel_uncertainty.picture import sheet

        seen = self._seen()
        numbers = seen[self.regions[-1]].cpu()
        scale = numbers[:, LEVELS + 1]
        shown = {}
        if len(self.facts):
            facts, panels = dim_zero_cat(self.facts).cpu(), dim_zero_cat(self.panels).float().cpu()
            order = facts[:, 0].argsort().tolist()
            middle = min(order, key=lambda at: abs(float(facts[at, 0] - scale.nanmedian())))
            for name, at in {"least": order[-1], "middling": middle, "most": order[0]}.items():
                shown[f"{name} certain: image {int(facts[at, 1])}"] = panels[at].numpy()
        names = {"": "whole frame", "_masked": "inside the mask"}
        shares = {names[region]: part[:, :LEVELS].nanmean(0).cpu().numpy() for region, part in seen.items()}
        return sheet(shown, self._levels().cpu().numpy(), shares, len(numbers), title, synthetic=synthetic)

    def _seen(self) -> dict[str, Tensor]:
        """Return the numbers of every image, (image, level + 2), by region."""
        width = LEVELS + 2
        seen = dim_zero_cat(self.numbers) if len(self.numbers) else self._levels().new_zeros(0, 2 * width)
        return dict(zip(self.regions, seen.split(width, 1), strict=False))

    def _levels(self) -> Float[Tensor, "level"]:
        return torch.arange(1, LEVELS + 1, dtype=torch.float64, device=self.device) / (LEVELS + 1)


def with_error(name: str, each: Float[Tensor, "image"]) -> dict[str, Tensor]:
    """Return mean and standard error over the images that have the number."""
    known = each[~each.isnan()]
    error = known.std() / math.sqrt(len(known)) if len(known) > 1 else known.new_tensor(math.nan)
    return {name: known.mean(), f"{name}_sem": error}


def kept(facts: Float[Tensor, "image 2"]) -> list[int]:
    """Return the places of the images that may have to be shown, in ascending order.

    They are the image with the smallest scale, that with the largest, and KEPT images at random; the choice does not
    depend on the order of the images. Images without a scale (NaN) are left out.

    Args:
        facts: scale and index of each image.
    """
    told = facts.tolist()
    known = sorted((at for at, (scale, _) in enumerate(told) if scale == scale), key=told.__getitem__)
    random = sorted(
        known, key=lambda at: int(told[at][1]) * 2654435761 % 2**32
    )  # Knuth's multiplicative hash
    return sorted({*known[:1], *known[-1:], *random[:KEPT]})
