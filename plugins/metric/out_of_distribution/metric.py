"""Entropy on outliers, and how well a score separates outliers from the test split."""

from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.distributions import Distribution
from torchmetrics.utilities.data import dim_zero_cat

from framework.distributions.checks import refuse_nan
from framework.distributions.class_probabilities import class_probabilities
from framework.metric import Metric
from framework.prediction import Prediction, Split


class OutOfDistribution(Metric):
    """Mean entropy on outliers (thesis eq. 2.32), nats, and how well a score separates them from the test split.

    The entropy is eq. 2.32 as a mean.

    - `ood_entropy`, `ood_entropy_sem`: mean entropy on outliers and its standard error; `entropy_test`: mean entropy on
      the test split. One infinite entropy makes the mean infinite.
    - `auroc`: probability that an outlier has a higher score than a test sample; equal scores count half.
    - `aupr`: average precision. Outliers are the positives, so the number depends on their share.
    - `fpr95`: share of test samples that are taken for outliers at the highest threshold that finds 95 % of the
      outliers. A score equal to the threshold counts as above it (Hendrycks et al. 2019). Papers that take the test
      split as the positives report a different number.

    The last three are NaN where outliers or test samples are missing.

    Args:
        score: score that is high on outliers. "entropy" is the entropy of the density. "confidence" is the negative
            confidence: of classes the largest probability (Hendrycks & Gimpel 2017), of other targets the log-density
            at the mode.

    Raises:
        UserError: entropies or scores are NaN; the message says how many.
    """

    bibtex = """@inproceedings{hendrycks2019deep,
  author    = {Hendrycks, Dan and Mazeika, Mantas and Dietterich, Thomas},
  title     = {Deep Anomaly Detection with Outlier Exposure},
  booktitle = {International Conference on Learning Representations},
  year      = {2019}
}"""
    splits: ClassVar[tuple[Split, ...]] = ("test", "outliers")
    columns: ClassVar[dict[str, str]] = {
        "ood_entropy": "OOD entropy",
        "auroc": "AUROC",
        "aupr": "AUPR",
        "fpr95": "FPR95",
    }
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {
        "ood_entropy": "higher",
        "auroc": "higher",
        "aupr": "higher",
        "fpr95": "lower",
    }
    test: list[Tensor] | Tensor
    outliers: list[Tensor] | Tensor

    def __init__(self, *, score: Literal["entropy", "confidence"] = "entropy") -> None:
        super().__init__()
        self.score = score
        # (entropy, score) of each sample: a ranking needs all samples
        self.add_state("test", [], dist_reduce_fx="cat")
        self.add_state("outliers", [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        if prediction.density.batch_shape.numel() == 0:
            return
        where = "outliers" if prediction.split == "outliers" else "the test split"
        entropy = refuse_nan(prediction.entropy.double(), f"entropies of {where}")
        score = entropy
        if self.score == "confidence":
            score = refuse_nan(doubt(prediction.density), f"confidences in {where}")
        seen = self.outliers if prediction.split == "outliers" else self.test
        assert isinstance(seen, list)
        seen.append(torch.stack([entropy, score], -1))

    def compute(self) -> dict[str, Tensor]:
        test, outliers = _joined(self.test), _joined(self.outliers)
        entropy = outliers[:, 0]
        # the sample deviation of one value is NaN, and torch would warn
        spread = entropy.std() if len(entropy) > 1 else entropy.new_tensor(torch.nan)
        return {
            "ood_entropy": entropy.mean(),
            "ood_entropy_sem": spread / len(entropy) ** 0.5 if len(entropy) else spread,
            "entropy_test": test[:, 0].mean(),
            **ranking(outliers[:, 1], test[:, 1]),
        }


def doubt(density: Distribution) -> Float64[Tensor, "batch"]:
    """Return a score that is high where a density is unsure.

    For classes it is 1 - max_k p_k, for other targets the negative log-density at the mode. 1 - p is computed as the
    sum over the other classes, which keeps its digits where p rounds to 1, and so the order of almost certain samples.
    """
    if density.has_enumerate_support:
        return class_probabilities(density).sort(-1).values[:, :-1].sum(-1)
    return -density.log_prob(density.mode).double()


def ranking(
    outliers: Float[Tensor, "outlier"], test: Float[Tensor, "sample"]
) -> dict[str, Float64[Tensor, ""]]:
    """Return `auroc`, `aupr` and `fpr95` of two sets of scores, outliers being the positives; NaN if one is empty."""
    samples, strangers = len(test), len(outliers)
    if samples == 0 or strangers == 0:
        nothing = outliers.new_tensor(torch.nan, dtype=torch.float64)
        return {"auroc": nothing, "aupr": nothing.clone(), "fpr95": nothing.clone()}
    test, outliers = test.sort().values, outliers.sort().values
    lower = torch.searchsorted(test, outliers)  # test samples below each outlier
    upper = torch.searchsorted(test, outliers, right=True)  # and those not above it
    found = strangers - torch.searchsorted(outliers, outliers)  # outliers not below it, itself among them
    precision = found.double() / (found + samples - lower)
    # the fewest outliers that are 95 %, in integers: 0.95 × 20 must not round to 20
    threshold = outliers[strangers - (95 * strangers + 99) // 100]
    return {
        # Mann & Whitney 1947: (#{test < s} + #{test ≤ s}) / 2 over all outliers s, exact up to the division
        "auroc": (lower + upper).sum().double() / (2 * samples * strangers),
        # average precision Σ ΔR P: every outlier raises the recall by 1/m at the precision of its own score
        "aupr": precision.mean(),
        "fpr95": (test >= threshold).double().mean(),
    }


def _joined(seen: list[Tensor] | Tensor) -> Float64[Tensor, "sample 2"]:
    return dim_zero_cat(seen) if len(seen) else torch.zeros(0, 2, dtype=torch.float64)
