"""Calibration of densities over images, number by number, and whether their scales tell where errors are."""

import math
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from framework.distributions.checks import refuse_nan
from framework.errors import DataError
from framework.metric import Metric, Pictured
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.pixel_uncertainty.functional import coverage, rank_correlation, transform

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = 19
"""Nominal masses 0.05, 0.10, ..., 0.95."""
KEPT = 8
"""Images that are kept beside the least and the most certain: the one next to the median of all is shown."""


class PixelUncertainty(Metric, Pictured):
    """Whether the pixels of images lie in their intervals, and whether the widest are the most wrong.

    Each image is judged by itself; then means over images, with standard errors:

    - `pixel_coverage_90`: share of numbers between their 5 % and 95 % quantiles.
    - `pixel_coverage_error`: mean |share - mass| over the masses 0.05, 0.10, ..., 0.95.
    - `spearman`: rank correlation of the pixels' mean |error|, of the point prediction rounded as files are, and their
      root mean variance; exact, within an image, so that no image counts for being harder than another; NaN where one
      scale stands for all pixels.
    - `pixel_scale`: mean over pixels of that root mean variance.

    Each is over the frame and, with `_masked`, over the pixels of the true mask. **Read those inside.** Background that
    is exactly white flatters the frame twice: its small scales and small errors go together, and a number that is 1 in
    the file may have been anything from there up: of a density that puts all its mass there every number between 0
    and 1 is a transform, and each interval holds it with just its own mass. So it is calibrated, and tells nothing.

    Args:
        steps: of the stored numbers, which are on a grid; 0: they are not.
        masked: also inside the true mask, which batches then need.

    Raises:
        ConfigError: the target is no image.
        DataError: batches without a mask.
        UserError: a density without a distribution function, or a variance, of each number; transforms that are NaN.
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
    picture: ClassVar[str] = "pixel_uncertainty"
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
        # (image, region × (level + 2)); of images kept (1, scale and index), (1, height, width, 2 · number + 2)
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
        if self.steps:  # as a file would hold it: no error is smaller than what rounding hides
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
        """The numbers of every image, (image, level + 2), by region."""
        width = LEVELS + 2
        seen = dim_zero_cat(self.numbers) if len(self.numbers) else self._levels().new_zeros(0, 2 * width)
        return dict(zip(self.regions, seen.split(width, 1), strict=False))

    def _levels(self) -> Float[Tensor, "level"]:
        return torch.arange(1, LEVELS + 1, dtype=torch.float64, device=self.device) / (LEVELS + 1)


def with_error(name: str, each: Float[Tensor, "image"]) -> dict[str, Tensor]:
    """Mean and standard error over the images that have the number."""
    known = each[~each.isnan()]
    error = known.std() / math.sqrt(len(known)) if len(known) > 1 else known.new_tensor(math.nan)
    return {name: known.mean(), f"{name}_sem": error}


def kept(facts: Float[Tensor, "image 2"]) -> list[int]:
    """Which of images with (scale, index) may have to be shown: the least, the largest, and KEPT at random, the same
    ones in whatever order they came. None without a scale."""
    told = facts.tolist()
    known = sorted((at for at, (scale, _) in enumerate(told) if scale == scale), key=told.__getitem__)
    random = sorted(
        known, key=lambda at: int(told[at][1]) * 2654435761 % 2**32
    )  # Knuth's multiplicative hash
    return sorted({*known[:1], *known[-1:], *random[:KEPT]})
