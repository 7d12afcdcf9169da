"""Accuracy and intersection over union of points, with standard errors over the scans to which the points belong."""

from typing import ClassVar

import torch
from jaxtyping import Float64
from torch import Tensor
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.class_probabilities import require_labels
from framework.errors import ConfigError
from framework.metric import Directions, Metric
from framework.prediction import Prediction
from framework.target import Target


class Segmentation(Metric):
    """Accuracy and mean intersection over union of the most likely classes of points, over all points of the test.

    - `point_accuracy`: share of points whose most likely class is the true one; if several classes are equally likely,
      the first of them is the prediction.
    - `mean_iou`: mean over the classes of the intersection over union, TP / (TP + FP + FN) with counts over all points
      (Everingham et al. 2010). Classes that are neither true nor predicted anywhere are left out.
    - `iou_<class>`: intersection over union of one class; NaN if it is neither true nor predicted.

    The standard errors are those of the jackknife over scans (Efron & Tibshirani 1993, eq. 11.5). The points of one
    scan are not independent, so that a standard error over points would be far too small. With one scan, they are NaN,
    and so is that of a class that is true or predicted in one scan only.

    Raises:
        ConfigError: The target is not a class, or the batches have no field "scan".
        UserError: A density has no class probabilities, or NaN among them.
        DataError: A label is not a class of the target.
    """

    bibtex = "everingham2010pascal"
    columns: ClassVar[dict[str, str]] = {"point_accuracy": "accuracy of points", "mean_iou": "mean IoU"}
    better: ClassVar[Directions] = dict.fromkeys(columns, "higher")
    scan: list[Tensor] | Tensor
    table: list[Tensor] | Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("class", by="metric segmentation")
        self.names = target.names
        # a table of counts for each scan of each batch; the jackknife needs the scans separately
        self.add_state("scan", [], dist_reduce_fx="cat")
        self.add_state("table", [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        if "scan" not in prediction.batch:
            raise ConfigError(
                "metric segmentation reads the field 'scan' of the batches, the number of the scan to which a sample "
                f"belongs, but the batches have only {', '.join(prediction.batch)}. Choose data whose samples are "
                "points of scans, or metric=[accuracy]."
            )
        probability = prediction.class_probabilities
        classes = probability.shape[-1]
        label = require_labels(prediction.target, classes).long()
        if not len(label):
            return
        scan, place = prediction.batch["scan"].unique(return_inverse=True)
        cell = (place * classes + label) * classes + probability.argmax(-1)
        table = torch.bincount(cell, minlength=len(scan) * classes**2).view(len(scan), classes, classes)
        self.scan.append(scan)  # type: ignore[union-attr]
        self.table.append(table)  # type: ignore[union-attr]

    def compute(self) -> dict[str, Tensor]:
        if len(self.scan) == 0:
            nan = torch.tensor(torch.nan, dtype=torch.float64)
            scores = {"point_accuracy": nan, "mean_iou": nan} | {f"iou_{name}": nan for name in self.names}
            return {key: nan for name in scores for key in (name, f"{name}_sem")}
        scan, table = dim_zero_cat(self.scan), dim_zero_cat(self.table)
        number, place = scan.unique(return_inverse=True)
        counts = table.new_zeros(len(number), *table.shape[1:]).index_add_(0, place, table).double()
        total = counts.sum(0)
        whole, left_out = shares(total[None])[0], shares(total - counts)
        scans = len(number)
        # NaN if a number is not known without one of the scans: its class then occurs in this scan only
        spread = (left_out - left_out.mean(0)).square().sum(0)
        error = (spread * ((scans - 1) / scans)).sqrt().where(torch.tensor(scans > 1), torch.nan)
        keys = ("point_accuracy", "mean_iou", *(f"iou_{name}" for name in self.names))
        return {
            **dict(zip(keys, whole, strict=True)),
            **dict(zip((f"{key}_sem" for key in keys), error, strict=True)),
        }


def shares(table: Float64[Tensor, "tables class class"]) -> Float64[Tensor, "tables scores"]:
    """Return accuracy, mean intersection over union, and the intersection over union of each class of count tables.

    Args:
        table: Number of points by true class (rows) and predicted class (columns).
    """
    right = table.diagonal(dim1=1, dim2=2)
    union = table.sum(1) + table.sum(2) - right
    overlap = right / union  # 0/0 is NaN: the class is neither true nor predicted
    accuracy = right.sum(1) / table.sum((1, 2))
    return torch.cat([accuracy[:, None], overlap.nanmean(1, keepdim=True), overlap], 1)
