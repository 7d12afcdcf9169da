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

    The area is NaN without predictions.
    """
    return curve.mean()


def at_coverage(curve: Float[Tensor, "count"], coverage: float) -> Float[Tensor, ""]:
    """Return the mean risk of the most confident predictions that make up a share `coverage` of all.

    Their number is rounded up. The result is NaN without predictions.
    """
    if len(curve) == 0:
        return curve.new_tensor(torch.nan)
    return curve[_kept_count(len(curve), coverage) - 1]


def _kept_count(count: int, coverage: float) -> int:
    # 0.95 · 20 must give 19, although 0.95 is not exact in binary
    return max(math.ceil(coverage * count - 1e-9), 1)


def areas_without_each(
    confidence: Float[Tensor, "count"], risk: Float[Tensor, "count"]
) -> Float[Tensor, "count"]:
    """Return the areas under the n curves that each leave out one of n predictions; n is at least 2.

    Let S(k) be the expected total risk of the k most confident predictions, and let the positions a + 1 to e of the
    order be the group of ties with prediction j. Without j, the total risk of the k most confident is S(k) for k ≤ a,
    and S(k + 1) - r_j for k ≥ e - 1. In between, the total risk is S(a) + (k - a) g, where g is the mean risk of the
    other ties. Sums of these totals divided by k are differences of cumulative sums, so that all n areas take n log n
    operations.
    """
    count, risk = len(risk), risk.double()
    _, group, size = confidence.neg().unique(return_inverse=True, return_counts=True)
    group_total = risk.new_zeros(len(size)).index_add_(0, group, risk)
    zero = risk.new_zeros(1)
    total = torch.cat([zero, (group_total / size).repeat_interleave(size).cumsum(0)])  # S(0), ..., S(n)
    inverse = 1 / torch.arange(1, count + 1, dtype=risk.dtype, device=risk.device)
    harmonic = torch.cat([zero, inverse.cumsum(0)])  # Σ 1/k for k ≤ 0, ..., n
    before = torch.cat([zero, (total[1:] * inverse).cumsum(0)])  # Σ S(k)/k
    after = torch.cat([zero, (total[2:] * inverse[:-1]).cumsum(0)])  # Σ S(k + 1)/k for k ≤ 0, ..., n - 1
    end = size.cumsum(0)[group]
    start = end - size[group]
    others = (group_total[group] - risk) / (size[group] - 1).clamp(min=1)
    tail = torch.maximum(end - 1, start + 1)  # the smallest k > a with k ≥ e - 1
    between = harmonic[tail - 1] - harmonic[start]
    middle = total[start] * between + others * (tail - 1 - start - start * between)
    rest = after[-1] - after[tail - 1] - risk * (harmonic[count - 1] - harmonic[tail - 1])
    return (before[start] + middle + rest) / (count - 1)


def error_at_coverage(
    confidence: Float[Tensor, "count"], risk: Float[Tensor, "count"], coverage: float
) -> Float[Tensor, ""]:
    """Return the standard error of `at_coverage`; NaN for fewer than 2 predictions.

    The statistic is the mean risk θ of the share c of predictions with the highest confidence. These predictions lie
    above a quantile of the confidence. A prediction with the risk r has the influence a (r - m)/c + m - θ on θ, where a
    is 1 above the quantile and 0 below, and m is the mean risk at the quantile (delta method; Hampel 1974). m is
    estimated by the mean over the 2√n + 1 predictions around the quantile. The jackknife is not used, because it would
    replace m by the risk of a single prediction. If n predictions have exactly the confidence at the quantile, and θ
    includes j of them, a is j/n for each of the n predictions.
    """
    count = len(risk)
    if count < 2:
        return risk.new_tensor(torch.nan, dtype=torch.float64)
    risk = risk.double()
    _, group, size = confidence.neg().unique(return_inverse=True, return_counts=True)
    expected = (risk.new_zeros(len(size)).index_add_(0, group, risk) / size).repeat_interleave(size)
    kept_count, reach = _kept_count(count, coverage), math.isqrt(count)
    at_quantile = expected[max(kept_count - reach, 0) : kept_count + reach + 1].mean()
    share = kept_count / count
    start = (size.cumsum(0) - size)[group]
    above = ((kept_count - start).double() / size[group]).clamp(0, 1)
    influence = above * (risk - at_quantile) / share + at_quantile - expected[:kept_count].mean()
    return influence.std() / math.sqrt(count)
