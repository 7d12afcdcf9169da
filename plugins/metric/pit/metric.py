"""Calibration of densities of real numbers and angles by the probability integral transform."""

from typing import TYPE_CHECKING, Annotated, ClassVar

import torch
from pydantic import Field
from torch import Tensor
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.checks import refuse_nan
from framework.metric import Directions, HasFigure, Metric
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.pit.functional import cramer_von_mises, kolmogorov_smirnov, transform

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class PIT(Metric, HasFigure):
    """Probability integral transform (PIT) F(y) of each number of the target; uniform for calibrated densities.

    - `pit_ks`: largest distance of the distribution of F(y) from uniform (Kolmogorov-Smirnov), in [0, 1].
    - `pit_cvm`: mean squared distance of the distribution of F(y) from uniform (Cramér-von Mises).
    - `pit_mean`: mean of F(y). It is ½ for unbiased densities, and higher if the targets lie above the densities.
    - `pit_spread`: 12 times the mean square of F(y) - ½. It is 1 for calibrated densities, above 1 for densities that
      are too narrow, and below 1 for densities that are too broad.

    Each number of a target is transformed by its marginal density, and the transforms of all numbers are pooled. For
    angles, F(y) is the mass from the antipode of the density's mean direction counter-clockwise to y. The figure is the
    histogram of F(y), with a band that contains each bin with probability 0.95 if the densities are calibrated.

    Args:
        bins: number of bins of the histogram.
        samples: number of draws for a density whose distribution function is not known.

    Raises:
        ConfigError: the target is made of classes.
        UserError: transforms are NaN.
    """

    bibtex = "diebold1998evaluating"
    columns: ClassVar[dict[str, str]] = {"pit_ks": "PIT KS"}
    better: ClassVar[Directions] = {"pit_ks": "lower"}
    figure_name: ClassVar[str] = "pit"
    values: list[Tensor] | Tensor

    def __init__(
        self,
        target: Target,
        *,
        bins: Annotated[int, Field(ge=2, le=100)] = 20,
        samples: Annotated[int, Field(ge=10, le=10**6)] = 1000,
    ) -> None:
        super().__init__()
        target.refuse(
            "class",
            "metric pit measures the probability below the target, but classes have no order (this data set's "
            f"classes: {target.listed_names}). Leave this metric out; `coverage` also evaluates classes.",
        )
        self.numbers = len(target.names)
        self.bins = bins
        self.samples = samples
        self.add_state("values", [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        target = prediction.target
        if len(target) == 0:
            return
        assert isinstance(self.values, list)
        for index in range(self.numbers):
            at = target[:, index : index + 1]
            transforms = transform(prediction.marginal(index), at, self.samples)
            self.values.append(refuse_nan(transforms, "transforms"))

    def compute(self) -> dict[str, Tensor]:
        values = self._collect_values()
        return {
            "pit_ks": kolmogorov_smirnov(values),
            "pit_cvm": cramer_von_mises(values),
            "pit_mean": values.mean(),
            "pit_spread": 12 * (values - 0.5).square().mean(),
        }

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.metric.pit.picture import histogram

        return histogram(
            self._collect_values().cpu().numpy(), self.bins, self.numbers, title, synthetic=synthetic
        )

    def _collect_values(self) -> Tensor:
        return dim_zero_cat(self.values) if len(self.values) else torch.empty(0, dtype=torch.float64)
