"""Risk-coverage curves, averaged over the orders of equally confident predictions."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def curve(confidence: Float[Tensor, "count"], risk: Float[Tensor, "count"]) -> Float[Tensor, "count"]:
    """Return the mean risk of the k most confident predictions for k = 1 ... n.

    Ties are predictions of equal confidence; the result is the average over all their orders. Let the a most confident
    predictions have the total risk A, and a group of ties with the mean risk g follow. Any j predictions of the group
    have the expected total risk j·g, so the mean risk of the first a + j predictions is (A + j·g)/(a + j).
    """
    count = len(risk)
    risk = risk.double()
    _, group, size = confidence.neg().unique(return_inverse=True, return_counts=True)
    total = risk.new_zeros(len(size)).index_add_(0, group, risk)
    expected = (total / size).repeat_interleave(size)
    return expected.cumsum(0) / torch.arange(1, count + 1, dtype=risk.dtype, device=risk.device)


def area(curve: Float[Tensor, "count"]) -> Float[Tensor, ""]:
    """Return the area under the curve: the mean over coverages 1/n, ..., 1 (Geifman, Uziel & El-Yaniv 2019, eq. 3).

    It is NaN without predictions.
    """
    return curve.mean()


def at_coverage(curve: Float[Tensor, "count"], coverage: float) -> Float[Tensor, ""]:
    """Return the mean risk of the most confident predictions that make up a share `coverage` of all.

    Their number is rounded up. The result is NaN without predictions.
    """
    if len(curve) == 0:
        return curve.new_tensor(torch.nan)
    # 0.95 · 20 must give 19, although 0.95 is not exact in binary
    kept_count = math.ceil(coverage * len(curve) - 1e-9)
    return curve[max(kept_count, 1) - 1]
