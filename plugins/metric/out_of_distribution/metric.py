"""Mean entropy on outliers, and measures of how well a score separates outliers from the test split."""

from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.distributions import Distribution
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.checks import refuse_nan
from framework.distributions.class_probabilities import class_probabilities
from framework.distributions.model_mixtures import expected_entropy
from framework.distributions.unchanged import outlier_score
from framework.errors import ConfigError
from framework.metric import Directions, Metric
from framework.prediction import Prediction, Split


class OutOfDistribution(Metric):
    """Mean entropy on outliers, nats (thesis eq. 2.32 as a mean), and how well a score separates outliers.

    - `ood_entropy`, `ood_entropy_sem`: mean entropy on outliers and its standard error; `entropy_test`: mean entropy on
      the test split. One infinite entropy makes the mean infinite.
    - `auroc`, `auroc_sem`: probability that an outlier has a higher score than a test sample, where equal scores count
      half; and its standard error from the variation of outliers and of test samples (DeLong et al. 1988). The standard
      error is NaN with a single outlier or test sample.
    - `aupr`: average precision with outliers as the positives; it depends on the share of outliers.
    - `fpr95`: share of test samples that are classified as outliers at the highest threshold that detects 95 % of the
      outliers. A score equal to the threshold counts as above it (Hendrycks et al. 2019). Papers that use the test
      split as the positives report different values.

    `auroc`, `aupr` and `fpr95` are NaN if there are no outliers or no test samples.

    Args:
        score: score that is high on outliers. "entropy" is the entropy of the density. "confidence" is the negative
            confidence: the confidence is the largest probability for classes (Hendrycks & Gimpel 2017), and the
            log-density at the mode for other targets. "mutual_information" is that of target and model, 0 for a single
            model (Depeweg et al. 2018; framework.distributions.model_mixtures). "outlier_score" is the score of the
            input that a wrapper adds to the density (framework.distributions.unchanged).

    Raises:
        ConfigError: the densities have no outlier score, which `score` requests.
        UserError: entropies or scores are NaN.
    """

    bibtex = "hendrycks2019deep, delong1988comparing, depeweg2018decomposition"
    splits: ClassVar[tuple[Split, ...]] = ("test", "outliers")
    columns: ClassVar[dict[str, str]] = {
        "ood_entropy": "OOD entropy",
        "auroc": "AUROC",
        "aupr": "AUPR",
        "fpr95": "FPR95",
    }
    better: ClassVar[Directions] = {**dict.fromkeys(columns, "higher"), "fpr95": "lower"}
    test: list[Tensor] | Tensor
    outliers: list[Tensor] | Tensor

    def __init__(
        self, *, score: Literal["entropy", "confidence", "mutual_information", "outlier_score"] = "entropy"
    ) -> None:
        super().__init__()
        self.score = score
        # (entropy, score) of each sample; rankings require all samples
        self.add_state("test", [], dist_reduce_fx="cat")
        self.add_state("outliers", [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        if prediction.density.batch_shape.numel() == 0:
            return
        where = "outliers" if prediction.split == "outliers" else "the test split"
        entropy = refuse_nan(prediction.entropy.double(), f"entropies of {where}")
        score = entropy
        if self.score == "confidence":
            score = refuse_nan(uncertainty_score(prediction.density), f"confidences in {where}")
        if self.score == "mutual_information":
            expected = refuse_nan(
                expected_entropy(prediction.density).double(), f"expected entropies of {where}"
            )
            score = torch.where(entropy == expected, 0.0, entropy - expected)
        if self.score == "outlier_score":
            score = refuse_nan(required_score(prediction.density), f"outlier scores of {where}")
        collected = self.outliers if prediction.split == "outliers" else self.test
        assert isinstance(collected, list)
        collected.append(torch.stack([entropy, score], -1))

    def compute(self) -> dict[str, Tensor]:
        test, outliers = _concatenate(self.test), _concatenate(self.outliers)
        entropy = outliers[:, 0]
        # the standard deviation of one value is NaN, and torch would emit a warning
        spread = entropy.std() if len(entropy) > 1 else entropy.new_tensor(torch.nan)
        return {
            "ood_entropy": entropy.mean(),
            "ood_entropy_sem": spread / len(entropy) ** 0.5 if len(entropy) else spread,
            "entropy_test": test[:, 0].mean(),
            **ranking(outliers[:, 1], test[:, 1]),
        }


def required_score(density: Distribution) -> Float64[Tensor, "batch"]:
    """Return the outlier score of the input of each density.

    Raises:
        ConfigError: the densities have no outlier score.
    """
    score = outlier_score(density)
    if score is None:
        raise ConfigError(
            "metric.out_of_distribution.score=outlier_score ranks samples by a score that a wrapper adds to the "
            "density, but these densities have no such score. Choose a wrapper that computes one, such as "
            "uncertainty=[feature_score], as the last of the list, or choose another score."
        )
    return score.double()


def uncertainty_score(density: Distribution) -> Float64[Tensor, "batch"]:
    """Return a score that is high for uncertain densities.

    For classes, the score is 1 - max_k p_k; for other targets, it is the negative log-density at the mode. 1 - max_k
    p_k is computed as the sum of the probabilities of all other classes. The scores of almost certain samples
    therefore keep their digits and their order, even if the largest probability rounds to 1.
    """
    if density.has_enumerate_support:
        return class_probabilities(density).sort(-1).values[:, :-1].sum(-1)
    return -density.log_prob(density.mode).double()


def ranking(
    outliers: Float[Tensor, "outlier"], test: Float[Tensor, "sample"]
) -> dict[str, Float64[Tensor, ""]]:
    """Return `auroc`, `auroc_sem`, `aupr` and `fpr95` of two sets of scores, with outliers as positives.

    All results are NaN if one of the two sets is empty.
    """
    test_count, outlier_count = len(test), len(outliers)
    if test_count == 0 or outlier_count == 0:
        undefined = outliers.new_tensor(torch.nan, dtype=torch.float64)
        return {name: undefined.clone() for name in ("auroc", "auroc_sem", "aupr", "fpr95")}
    test, outliers = test.sort().values, outliers.sort().values
    lower = torch.searchsorted(test, outliers)  # number of test samples below each outlier
    upper = torch.searchsorted(test, outliers, right=True)  # number of test samples not above it
    # number of outliers not below it, including itself
    at_or_above = outlier_count - torch.searchsorted(outliers, outliers)
    precision = at_or_above.double() / (at_or_above + test_count - lower)
    # the smallest number of outliers that is at least 95 %, in integers: 0.95 × 20 must give 19
    threshold = outliers[outlier_count - (95 * outlier_count + 99) // 100]
    shares = (lower + upper).double() / (2 * test_count)  # share of test samples below each outlier
    above = outlier_count - torch.searchsorted(outliers, test, right=True)
    ties = outlier_count - torch.searchsorted(outliers, test)
    # DeLong, DeLong & Clarke-Pearson 1988: variances of the shares over outliers and over test samples
    variance = (
        _variance(shares) / outlier_count
        + _variance((above + ties).double() / (2 * outlier_count)) / test_count
    )
    return {
        "auroc_sem": variance.sqrt(),
        # Mann & Whitney 1947: (#{test < s} + #{test ≤ s}) / 2 over all outliers s, exact up to the division
        "auroc": (lower + upper).sum().double() / (2 * test_count * outlier_count),
        # average precision Σ ΔR P: each of m outliers raises the recall by 1/m at the precision of its own score
        "aupr": precision.mean(),
        "fpr95": (test >= threshold).double().mean(),
    }


def _variance(values: Float64[Tensor, "sample"]) -> Float64[Tensor, ""]:
    return values.var() if len(values) > 1 else values.new_tensor(torch.nan)


def _concatenate(collected: list[Tensor] | Tensor) -> Float64[Tensor, "sample 2"]:
    return dim_zero_cat(collected) if len(collected) else torch.zeros(0, 2, dtype=torch.float64)
