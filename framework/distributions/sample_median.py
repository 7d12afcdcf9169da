"""Median of a sample, and its standard error."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


def sample_median(values: Float[Tensor, "sample"]) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return the median of a sample and its standard error.

    The median of an even number of values is the mean of the middle two. The standard error is that of J. S. Maritz &
    R. G. Jarrett (1978), "A note on estimating the variance of the sample median", Journal of the American Statistical
    Association 73, 194-196: the standard deviation of the (n + 1)/2-th smallest of n draws from the sample, which is
    the limit of the bootstrap with many resamples. It needs no density of the values.

    Args:
        values: the sample, of size n.

    Returns:
        Both numbers are NaN without values or if a value is NaN. With one value only the standard error is NaN.
    """
    from scipy.special import betainc  # importing SciPy takes longer than most commands need it

    count, unknown = len(values), values.new_tensor(torch.nan)
    if count == 0 or bool(values.isnan().any()):
        return unknown, unknown.clone()
    ordered = values.sort().values
    median = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2
    if count == 1:
        return median, unknown
    half = (count + 1) / 2
    shares = torch.from_numpy(betainc(half, half, np.arange(count + 1) / count))
    weight = shares.diff().to(values)
    offset = torch.where(weight > 0, ordered - median, 0.0)  # far values have the weight 0, also if infinite
    mean = (weight * offset).sum()
    return median, (weight * (offset - mean).square()).sum().sqrt()
