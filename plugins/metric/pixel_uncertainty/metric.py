"""Calibration of densities over images, value by value, and correlation of predicted scales with errors."""

import math
from typing import TYPE_CHECKING, Annotated, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from framework.distributions.checks import refuse_nan
from framework.errors import DataError
from framework.figures.chosen_images import choose_images
from framework.metric import Directions, HasFigure, Metric
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.pixel_uncertainty.functional import coverage, rank_correlation, transform

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = 19
"""Number of nominal masses 0.05, 0.10, ..., 0.95."""


class PixelUncertainty(Metric, HasFigure):
    """Coverage of the predicted intervals of pixels, and rank correlation of errors with predicted scales.

    Each image is evaluated by itself; the results are means over images, with standard errors:

    - `pixel_coverage_90`: share of values between the 5 % and the 95 % quantile of their densities.
    - `pixel_coverage_error`: mean |share - mass| over the masses 0.05, 0.10, ..., 0.95.
    - `spearman`: rank correlation, over the pixels of an image, between the mean |error| and the predicted scale, which
      is the root of the mean variance over channels. The error is that of the point prediction, rounded to `steps`. The
      correlation is computed within each image, so that difficult images have no more weight than easy ones; it is NaN
      if all pixels have the same scale.
    - `pixel_scale`: mean scale over pixels.

    Each result is over the whole image and, with `_masked`, over the pixels of the true mask. **Read the masked
    results.** A background that is exactly white makes the results of the whole image too good in two ways. First, its
    small scales coincide with small errors. Second, a stored value of 1 may stand for any higher value: if a density
    has all its mass there, every transform between 0 and 1 is possible, and each interval contains the value with
    exactly the probability of its mass. Such a density is calibrated but not informative.

    Args:
        steps: number of steps between the stored values 0 and 1; 0 if values were not rounded.
        masked: whether to compute the results also inside the true mask; batches must then have the field "mask".

    Raises:
        ConfigError: the target is not an image.
        DataError: batches have no mask.
        UserError: a density has no distribution function or no variance for each value; or transforms are NaN.
    """

    bibtex = "czado2009predictive"
    columns: ClassVar[dict[str, str]] = {
        "pixel_coverage_90": "pixels in 90 %",
        "pixel_coverage_90_masked": "in 90 %, in mask",
        "spearman": "error by scale",
        "spearman_masked": "error by scale, in mask",
    }
    better: ClassVar[Directions] = {"spearman": "higher", "spearman_masked": "higher"}
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
        # shapes: (image, region × (level + 2)); for each stored image: (1, 2), (1, height, width, 2 · channel + 2)
        for name in ("numbers", "facts", "panels"):
            self.add_state(name, [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        true, density, point = prediction.target, prediction.density, prediction.point
        if "mask" not in prediction.batch and len(self.regions) > 1:
            raise DataError(
                "metric pixel_uncertainty with `masked: true` requires the batch field 'mask', but the batches have "
                "only "
                f"{', '.join(prediction.batch)}. Set `masked` to false, or choose data with masks."
            )
        if len(true) == 0:
            return
        transforms = transform(density, true, self.steps)
        scale = density.variance.mean(-1).sqrt()
        refuse_nan(
            (transforms.low + transforms.high).sum((1, 2, 3)) + scale.sum((1, 2)),
            "images' transforms and scales",
        )
        if self.steps:  # round the prediction like a file, so that rounding alone causes no error
            point = (point.clamp(0, 1) * self.steps).round() / self.steps
        error = (point - true).abs().mean(-1)
        everywhere = torch.ones_like(true[..., 0], dtype=torch.bool)
        masks = [everywhere, prediction.true_image("mask")] if len(self.regions) > 1 else [everywhere]
        index = prediction.batch["index"].double()
        for row in range(len(true)):
            parts: list[Tensor] = []
            for mask in masks:
                inside = mask[row]
                shares = coverage(
                    type(transforms)(*(part[row][inside] for part in transforms)), self._levels()
                )
                wide = scale[row][inside].double()
                parts += [shares, torch.stack([rank_correlation(error[row][inside], wide), wide.mean()])]
            self.numbers.append(torch.cat(parts).unsqueeze(0))
            self.facts.append(torch.stack([parts[-1][-1], index[row]]).unsqueeze(0))
            shown = [true[row], point[row], error[row].unsqueeze(-1), scale[row].unsqueeze(-1)]
            self.panels.append(torch.cat(shown, -1).half().unsqueeze(0))
            stay = choose_images(torch.cat(self.facts))
            self.facts, self.panels = ([some[at] for at in stay] for some in (self.facts, self.panels))

    def compute(self) -> dict[str, Tensor]:
        results: dict[str, Tensor] = {}
        for region, numbers in self._numbers_by_region().items():
            shares, rank, scale = numbers[:, :LEVELS], numbers[:, LEVELS], numbers[:, LEVELS + 1]
            for name, values in {
                "pixel_coverage_90": shares[:, 17],
                "spearman": rank,
                "pixel_scale": scale,
            }.items():
                results |= with_error(name + region, values)
            off = (shares.nanmean(0) - self._levels()).abs().mean()
            results[f"pixel_coverage_error{region}"] = off
        return results

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.metric.pixel_uncertainty.picture import sheet

        by_region = self._numbers_by_region()
        numbers = by_region[self.regions[-1]].cpu()
        scale = numbers[:, LEVELS + 1]
        shown = {}
        if len(self.facts):
            facts, panels = dim_zero_cat(self.facts).cpu(), dim_zero_cat(self.panels).float().cpu()
            order = facts[:, 0].argsort().tolist()
            middle = min(order, key=lambda row: abs(float(facts[row, 0] - scale.nanmedian())))
            for name, row in {"least": order[-1], "middling": middle, "most": order[0]}.items():
                shown[f"{name} certain: image {int(facts[row, 1])}"] = panels[row].numpy()
        names = {"": "whole image", "_masked": "inside the mask"}
        shares = {
            names[region]: part[:, :LEVELS].nanmean(0).cpu().numpy() for region, part in by_region.items()
        }
        return sheet(shown, self._levels().cpu().numpy(), shares, len(numbers), title, synthetic=synthetic)

    def _numbers_by_region(self) -> dict[str, Tensor]:
        """Return, for the whole image and for the mask, the numbers of every image, (image, level + 2).

        They are the coverage at each level, and two more numbers: rank correlation and mean scale.
        """
        width = LEVELS + 2
        numbers = dim_zero_cat(self.numbers) if len(self.numbers) else self._levels().new_zeros(0, 2 * width)
        return dict(zip(self.regions, numbers.split(width, 1), strict=False))

    def _levels(self) -> Float[Tensor, "level"]:
        return torch.arange(1, LEVELS + 1, dtype=torch.float64, device=self.device) / (LEVELS + 1)


def with_error(name: str, values: Float[Tensor, "image"]) -> dict[str, Tensor]:
    """Return mean and standard error over the images whose value is not NaN."""
    known = values[~values.isnan()]
    error = known.std() / math.sqrt(len(known)) if len(known) > 1 else known.new_tensor(math.nan)
    return {name: known.mean(), f"{name}_sem": error}
