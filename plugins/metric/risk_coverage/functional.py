"""Risk-coverage curves whose ties are averaged over their orders."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def curve(confidence: Float[Tensor, "count"], risk: Float[Tensor, "count"]) -> Float[Tensor, "count"]:
    """Mean risk of the k most confident, k = 1 ... n, in expectation over the orders of equally confident ones.

    Of a run of ties that starts after a samples of summed risk A and has mean risk g, any j have summed risk j·g in
    expectation: the mean risk of a + j is (A + j·g)/(a + j).
    """
    count = len(risk)
    risk = risk.double()
    _, group, size = confidence.neg().unique(return_inverse=True, return_counts=True)
    total = risk.new_zeros(len(size)).index_add_(0, group, risk)
    expected = (total / size).repeat_interleave(size)
    return expected.cumsum(0) / torch.arange(1, count + 1, dtype=risk.dtype, device=risk.device)


def area(curve: Float[Tensor, "count"]) -> Float[Tensor, ""]:
    """Under the curve: its mean over the coverages 1/n, ..., 1 (Geifman, Uziel & El-Yaniv 2019, eq. 3); NaN of none."""
    return curve.mean()


def at_coverage(curve: Float[Tensor, "count"], coverage: float) -> Float[Tensor, ""]:
    """Risk of the smallest number of samples that is at least that share; NaN of none."""
    if len(curve) == 0:
        return curve.new_tensor(torch.nan)
    # 0.95 · 20 is 19, whatever the binary fraction nearest 0.95 says
    kept = math.ceil(coverage * len(curve) - 1e-9)
    return curve[max(kept, 1) - 1]
