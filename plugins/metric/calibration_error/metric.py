"""Expected calibration error in bins of equal width and of equal mass, and its sampling bias."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import torch
from jaxtyping import Float64, Int
from pydantic import Field
from torch import Tensor
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.class_probabilities import require_labels
from framework.errors import ConfigError
from framework.metric import Directions, HasFigure, Metric, jackknife_error
from framework.prediction import Prediction
from framework.target import Target

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NEAR = 2.0**-20
"""Largest difference of two confidences that count as equal when samples are assigned to bins.

The same probability, computed in float32 on two devices, may differ by a few times 2^-24.
"""


class CalibrationError(Metric, HasFigure):
    """Difference between confidence and the share of right predictions in bins of confidence (thesis eq. 2.28-2.31).

    - `ece`: expected calibration error in bins of equal width.
    - `ece_positive`: only for two classes, the error of p(y = 1) against y = 1 in bins of equal width, independent of
      `probability`. This is exactly eq. 2.28-2.29: predictions of p(y = 1) = 0.9 and 0.1 do not share a bin.
    - `ece_equal_mass`: error in bins with equal numbers of samples; confidences within 2^-20 of each other share a bin.
    - `ece_sem`, `ece_positive_sem`: standard errors over samples, by the jackknife. They do not contain the bias: by
      chance, the error of a calibrated model is larger than 0. `ece_equal_mass` has none, because its bins change with
      each sample.
    - `mce`: the largest difference in a nonempty bin of equal width.
    - `squared_ce_debiased`: the squared calibration error in bins of equal mass, minus the part that chance adds; the
      result may be negative. Bins with one sample are left out, because they do not allow this correction; the result
      is NaN if all bins are left out.
    - `ece_debiased`: root of `squared_ce_debiased`, or 0 if that is negative.

    A result is NaN if there was no sample. A confidence of 1, which the half-open intervals of eq. 2.28 would leave
    out, belongs to the last bin. A confidence that misses the lower edge of a bin by 2^-21 or less belongs to this bin.
    These rules affect only the choice of bins: the sums use the unchanged confidences.

    Args:
        bins: number of bins, L of eq. 2.31, for both kinds of bins.
        probability: probability that serves as the confidence. "predicted" is the largest class probability (of equally
            likely classes, the first), compared with whether that class is right (Guo et al. 2017). "positive" is
            p(y = 1) of two classes, compared with y = 1, as in eq. 2.28-2.29.

    Raises:
        ConfigError: the target is not a class, or `probability` is "positive" and there are more than two classes.
        UserError: a density has no class probabilities, or NaN among them.
        DataError: a label is not a class of the data set.
    """

    bibtex = "guo2017calibration, kumar2019verified"
    columns: ClassVar[dict[str, str]] = {"ece": "ECE", "ece_equal_mass": "ECE (equal mass)"}
    better: ClassVar[Directions] = {"ece": "lower", "ece_equal_mass": "lower"}
    figure_name = "reliability"
    samples: list[Tensor] | Tensor

    def __init__(
        self,
        target: Target,
        *,
        bins: Annotated[int, Field(ge=1, le=1000)] = 15,
        probability: Literal["predicted", "positive"] = "predicted",
    ) -> None:
        super().__init__()
        target.require("class", by="metric calibration_error")
        if probability == "positive" and len(target.names) != 2:
            raise ConfigError(
                "metric calibration_error with probability=positive requires two classes, but this data set has "
                f"{len(target.names)}: {target.listed_names}. Choose probability=predicted."
            )
        self.names = target.names
        self.two_classes = len(target.names) == 2
        if self.two_classes:
            self.columns = {  # pyright: ignore[reportAttributeAccessIssue]  # of two classes alone
                "ece": "ECE",
                "ece_positive": f"ECE of p({target.names[1]})",
                "ece_equal_mass": "ECE (equal mass)",
            }
            self.better = dict.fromkeys(self.columns, "lower")  # pyright: ignore[reportAttributeAccessIssue]
        self.bins = bins
        self.positive = probability == "positive"
        # (confidence, right) of each sample, for two classes also (p(y = 1), y); bins of equal mass require all samples
        self.add_state("samples", [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        probability = prediction.class_probabilities
        label = require_labels(prediction.target, probability.shape[-1])
        if self.positive:
            confidence, right = probability[:, 1], label == 1
        else:
            confidence, predicted = probability.max(-1)
            right = predicted == label
        assert isinstance(self.samples, list)
        positive = [probability[:, 1], (label == 1).double()] if self.two_classes else []
        self.samples.append(torch.stack([confidence, right.double(), *positive], -1))

    def compute(self) -> dict[str, Tensor]:
        confidence, right = self._collect_samples()
        width_index = equal_width(confidence, self.bins)
        width = sum_by_bin(confidence, right, width_index, self.bins)
        mass = sum_by_bin(confidence, right, equal_mass(confidence, self.bins), self.bins)
        squared = squared_error_debiased(mass)
        results = {
            "ece": expected_error(width),
            "ece_sem": self._standard_error(confidence, right, width_index),
            "ece_equal_mass": expected_error(mass),
            "mce": largest_error(width),
            "ece_debiased": squared.clamp(min=0).sqrt(),
            "squared_ce_debiased": squared,
        }
        if self.two_classes:
            positive, label = self._collect_samples(2)
            index = equal_width(positive, self.bins)
            results["ece_positive"] = expected_error(sum_by_bin(positive, label, index, self.bins))
            results["ece_positive_sem"] = self._standard_error(positive, label, index)
        return results

    def _standard_error(self, confidence: Tensor, right: Tensor, index: Tensor) -> Tensor:
        return jackknife_error(errors_without_each(confidence, right, index, self.bins))

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.metric.calibration_error.picture import reliability

        confidence, right = self._collect_samples()
        bins = self._equal_width_bins(confidence, right)
        return reliability(
            bins.count.cpu().numpy(),
            bins.confidence.cpu().numpy(),
            bins.right.cpu().numpy(),
            confidence_label=f"p({self.names[1]})" if self.positive else "confidence in the predicted class",
            accuracy_label=f"share of {self.names[1]}" if self.positive else "accuracy",
            title=title,
            synthetic=synthetic,
            # the largest class probability is at least the mean of all of them
            least=0.0 if self.positive or len(self.names) < 2 else 1 / len(self.names),
        )

    def _equal_width_bins(self, confidence: Tensor, right: Tensor) -> "Bins":
        return sum_by_bin(confidence, right, equal_width(confidence, self.bins), self.bins)

    def _collect_samples(self, first: int = 0) -> tuple[Float64[Tensor, "sample"], Float64[Tensor, "sample"]]:
        """Return the confidences in ascending order, and whether each prediction is right (0 or 1).

        Sorting makes sums independent of the order of the samples. `first` is the column of the state that holds the
        confidences; the next column holds whether the prediction is right.
        """
        samples = dim_zero_cat(self.samples) if len(self.samples) else torch.zeros(0, 4, dtype=torch.float64)
        confidence, order = samples[:, first].contiguous().sort()
        return confidence, samples[order, first + 1]


@dataclass(frozen=True)
class Bins:
    """Sums over the samples of each bin, float64.

    Attributes:
        count: number of samples, |B_l|.
        confidence: sum of the confidences.
        right: number of right predictions.
    """

    count: Float64[Tensor, "bin"]
    confidence: Float64[Tensor, "bin"]
    right: Float64[Tensor, "bin"]

    @property
    def nonempty(self) -> "Bins":
        """Bins that are not empty."""
        return self.with_at_least(1)

    def with_at_least(self, samples: int) -> "Bins":
        """Return the bins that have at least the given number of samples."""
        large_enough = self.count >= samples
        return Bins(self.count[large_enough], self.confidence[large_enough], self.right[large_enough])


def equal_width(confidence: Float64[Tensor, "sample"], bins: int) -> Int[Tensor, "sample"]:
    """Return the index of the bin of each sample, for L = `bins` bins of equal width.

    The bin with index l - 1 holds the confidences with (l - 1)/L ≤ confidence < l/L (thesis eq. 2.28), with edges
    lowered by NEAR/2. A confidence of 1 belongs to the last bin.
    """
    edges = torch.arange(1, bins, dtype=torch.float64, device=confidence.device) / bins
    return torch.bucketize(confidence, edges - NEAR / 2, right=True)


def equal_mass(confidence: Float64[Tensor, "sample"], bins: int) -> Int[Tensor, "sample"]:
    """Return the index of the bin of each sample, with sample counts as equal as possible (Nguyen & O'Connor 2015).

    With n samples in order of confidence, the sample of rank r = 0, 1, ... belongs to bin ⌊L (r + ½) / n⌋. Confidences
    that `group_near_confidences` puts into one group all belong to the bin of their middle rank.

    Args:
        confidence: confidences in any order.
        bins: number of bins L.
    """
    confidence = group_near_confidences(confidence)
    ordered = confidence.sort().values
    first = torch.searchsorted(ordered, confidence)
    after = torch.searchsorted(ordered, confidence, right=True)
    # the middle rank is r = (first + after - 1) / 2, so r + ½ = (first + after) / 2; integers avoid rounding
    return bins * (first + after) // (2 * max(1, len(confidence)))


def group_near_confidences(confidence: Float64[Tensor, "sample"]) -> Float64[Tensor, "sample"]:
    """Return, for each sample, the smallest confidence of the group of nearly equal confidences to which it belongs.

    Groups are formed in ascending order: a group consists of the smallest confidence that has no group yet, and of all
    confidences up to NEAR above it. Rounding to a grid instead could separate nearly equal confidences.
    """
    ordered, order = confidence.sort()
    count = len(ordered)
    # end[i] is the end of a group that begins at i; following `end` from 0 gives the beginnings of all groups
    end = torch.searchsorted(ordered, ordered + NEAR, right=True)
    end = torch.cat([end, end.new_full((1,), count)])
    begins = torch.zeros_like(end, dtype=torch.bool)
    begins[0] = True
    jumps = 1
    while jumps < count:
        begins[end[begins]] = True
        end, jumps = end[end], 2 * jumps
    begins = begins[:count]
    least = ordered[begins][begins.cumsum(0) - 1]
    return torch.empty_like(confidence).scatter_(0, order, least)


def sum_by_bin(
    confidence: Float64[Tensor, "sample"],
    right: Float64[Tensor, "sample"],
    index: Int[Tensor, "sample"],
    bins: int,
) -> Bins:
    """Return the sums over the samples of each bin; `index` holds the bin of each sample."""
    columns = torch.stack([torch.ones_like(right), confidence, right], -1)
    return Bins(*columns.new_zeros(bins, 3).index_add_(0, index, columns).unbind(-1))


def expected_error(bins: Bins) -> Float64[Tensor, ""]:
    """Return the expected calibration error Σ_l |B_l|/Q |conf(B_l) - acc(B_l)| (thesis eq. 2.31); NaN without samples.

    conf(B_l) is the mean confidence in bin l, acc(B_l) the share of right predictions, |B_l| the number of samples in
    the bin, and Q the number of all samples. The error is computed as Σ_l |Σ conf - Σ right| / Q, so that empty bins
    add 0.
    """
    return (bins.confidence - bins.right).abs().sum() / bins.count.sum()


def errors_without_each(
    confidence: Float64[Tensor, "sample"],
    right: Float64[Tensor, "sample"],
    index: Int[Tensor, "sample"],
    bins: int,
) -> Float64[Tensor, "sample"]:
    """Return the `expected_error` of all samples but one, for each of n samples, with the same bins; NaN for n = 1.

    Args:
        confidence: confidence of each sample.
        right: whether each prediction is right (0 or 1).
        index: bin of each sample.
        bins: number of bins.
    """
    gap = confidence - right
    total = gap.new_zeros(bins).index_add_(0, index, gap)
    of_bin = total[index]
    return (total.abs().sum() - of_bin.abs() + (of_bin - gap).abs()) / (len(gap) - 1)


def largest_error(bins: Bins) -> Float64[Tensor, ""]:
    """Return max_l |conf(B_l) - acc(B_l)| over nonempty bins (Guo et al. 2017, eq. 5); NaN without samples.

    conf(B_l) is the mean confidence in bin l, and acc(B_l) the share of right predictions.
    """
    nonempty = bins.nonempty
    gaps = (nonempty.confidence - nonempty.right).abs() / nonempty.count
    return gaps.max() if len(gaps) else gaps.new_tensor(torch.nan)


def squared_error_debiased(bins: Bins) -> Float64[Tensor, ""]:
    """Return Σ_l |B_l|/Q [(conf - acc)² - acc (1 - acc) / (|B_l| - 1)], over bins of at least two samples.

    conf is the mean confidence in bin l, acc the share of right predictions, |B_l| the number of samples in the bin,
    and Q the number of samples in all these bins. The formula is the squared calibration error minus an unbiased
    estimate of the variance of acc, which the squared error contains (Bröcker 2012; Kumar et al. 2019, §5). The result
    is unbiased if the confidences within a bin are equal. If they differ, the result is too low by about their variance
    divided by |B_l|.
    """
    several = bins.with_at_least(2)
    confidence, right = several.confidence / several.count, several.right / several.count
    squared = (confidence - right).square() - right * (1 - right) / (several.count - 1)
    return (several.count * squared).sum() / several.count.sum()
