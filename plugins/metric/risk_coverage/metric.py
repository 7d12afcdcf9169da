"""Selective prediction: the error that remains when the least confident predictions are left out."""

import math
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from torch import Tensor
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.checks import refuse_nan
from framework.distributions.circular import angular_distance
from framework.errors import ConfigError
from framework.metric import Directions, HasFigure, Metric, jackknife_error
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.risk_coverage.functional import (
    area,
    areas_without_each,
    at_coverage,
    curve,
    error_at_coverage,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RISKS = {
    "class": ("", "error rate"),
    "real": ("", "mean absolute error"),
    "angle": ("_deg", "mean angular deviation (°)"),
}
"""Kind of target → suffix of the keys, and name of the risk."""


class RiskCoverage(Metric, HasFigure):
    """Error of the most confident share of predictions, against that share.

    For classes, the risk is the error rate. For real numbers, it is the mean absolute error over the numbers of a
    target, in their unit. For angles, it is the mean angular deviation in degrees, and the keys end in `_deg`.

    - `aurc`: area under the curve, the mean risk over all shares.
    - `e_aurc`: `aurc` minus the area for a perfect order of confidence; 0 if all mistakes are less confident than all
      successes.
    - `risk_80`, `risk_95`: risk of the most confident 80 % and 95 %.

    Each result also has a standard error over predictions, with the ending `_sem`: by the jackknife for the areas, and
    by the influence function for the other two results. The standard error is NaN for a single prediction. Equally
    confident predictions count with their mean risk, so that their order has no effect.

    Args:
        confidence: "entropy" for minus the predictive entropy; "mode" for the probability or log-density at the mode.

    Raises:
        ConfigError: the targets are images.
        UserError: confidences or errors are NaN.
    """

    bibtex = "geifman2017selective, geifman2019bias"
    columns: ClassVar[dict[str, str]] = {"aurc": "AURC", "risk_80": "risk at 80 %"}
    better: ClassVar[Directions] = {"aurc": "lower", "risk_80": "lower"}
    figure_name: ClassVar[str] = "risk_coverage"
    confidences: list[Tensor] | Tensor
    risks: list[Tensor] | Tensor

    def __init__(self, target: Target, *, confidence: Literal["entropy", "mode"] = "entropy") -> None:
        super().__init__()
        self.kind = target.kind
        self.confidence = confidence
        if target.kind not in RISKS:
            raise ConfigError(
                f"metric risk_coverage has no error for targets of kind {target.kind!r} ({target.listed_names}), only "
                "for "
                f"{', '.join(RISKS)}. Leave this metric out."
            )
        self.unit, self.risk_name = RISKS[target.kind]
        if target.kind == "angle":
            self.columns = {  # pyright: ignore[reportAttributeAccessIssue]
                "aurc_deg": "AURC °",
                "risk_80_deg": "risk at 80 % °",
            }
            self.better = dict.fromkeys(self.columns, "lower")  # pyright: ignore[reportAttributeAccessIssue]
        self.add_state("confidences", [], dist_reduce_fx="cat")
        self.add_state("risks", [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        if len(prediction.target) == 0:
            return
        assert isinstance(self.confidences, list) and isinstance(self.risks, list)
        self.confidences.append(refuse_nan(self._confidence(prediction), "confidences"))
        self.risks.append(refuse_nan(self._risk(prediction), "errors"))

    def compute(self) -> dict[str, Tensor]:
        confidence, risk = self._collect()
        own_curve = curve(confidence, risk)
        results = {
            "aurc": area(own_curve),
            "e_aurc": area(own_curve) - area(curve(-risk, risk)),
            "risk_80": at_coverage(own_curve, 0.8),
            "risk_95": at_coverage(own_curve, 0.95),
        }
        undefined = risk.new_tensor(torch.nan)
        errors = {
            "aurc": undefined,
            "e_aurc": undefined,
            "risk_80": error_at_coverage(confidence, risk, 0.8),
            "risk_95": error_at_coverage(confidence, risk, 0.95),
        }
        if len(risk) > 1:
            areas = areas_without_each(confidence, risk)
            errors["aurc"] = jackknife_error(areas)
            errors["e_aurc"] = jackknife_error(areas - areas_without_each(-risk, risk))
        # a key in degrees is aurc_deg, and its standard error aurc_deg_sem
        named = {f"{name}{self.unit}_sem": value for name, value in errors.items()}
        return named | {f"{name}{self.unit}": value for name, value in results.items()}

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.metric.risk_coverage.picture import risk_coverage

        confidence, risk = self._collect()
        lines = (curve(confidence, risk), curve(-risk, risk))
        own, oracle = (line.cpu().numpy() for line in lines)
        return risk_coverage(own, oracle, self.risk_name, title, synthetic=synthetic)

    def _confidence(self, prediction: Prediction) -> Tensor:
        if self.confidence == "entropy":
            return -prediction.entropy.double()
        return prediction.density.log_prob(prediction.density.mode).double()

    def _risk(self, prediction: Prediction) -> Tensor:
        point, target = prediction.point, prediction.target
        if self.kind == "class":
            return (point != target).double()
        if self.kind == "angle":
            return angular_distance(point.double(), target.double()).mean(-1) * (180 / math.pi)
        return (point.double() - target.double()).abs().mean(-1)

    def _collect(self) -> tuple[Tensor, Tensor]:
        if not len(self.risks):
            return torch.empty(0, dtype=torch.float64), torch.empty(0, dtype=torch.float64)
        return dim_zero_cat(self.confidences), dim_zero_cat(self.risks)
