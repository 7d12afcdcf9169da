"""Class probabilities of any density over classes, and labels that fit them: what metrics of classes share."""

import math

from jaxtyping import Float64, Real
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.checks import refuse_nan
from framework.distributions.protocol import estimate
from framework.errors import DataError, UserError

LARGEST_DEFECT = 0.01
"""How far from 1 the probabilities may sum up: float32 rounds logits of 1e4 to 1e-3."""


def class_probabilities(density: Distribution) -> Float64[Tensor, "batch class"]:
    """p(y = k) of each sample, in [0, 1], each row with sum 1 to float64.

    exp of log_prob at each class, in float64, over their sum: a float32 log_prob leaves sums of 1 ± 1e-7 (± 1e-3 where
    logits reach 1e4), and a mixture's largest probability may exceed 1 by as much. Where log_prob is estimated from
    draws (`estimate`), class by class, the sum is as far from 1 as chance has it.

    Args:
        density: over classes, with batch_shape (batch,): `enumerate_support` lists them, class k the k-th.

    Raises:
        UserError: a density that does not list its values, a probability that is NaN, a sum that is not 1 within 1 %
            though nothing is drawn, or is 0.
    """
    if not density.has_enumerate_support or tuple(density.event_shape):
        raise UserError(
            f"Class probabilities were asked of a {type(density).__name__} with event_shape "
            f"{tuple(density.event_shape)}, which does not list classes; wanted a density over classes, such as "
            "density_head=categorical predicts. Leave out the metric that reads them, or choose such a head."
        )
    found = estimate(density, density.enumerate_support())
    log_prob = found.log_mean.double().T
    total = refuse_nan(log_prob.exp().sum(-1), "predicted distributions over classes")
    drawn = (found.samples > 0).any(0) & (log_prob > -math.inf).any(-1)
    wrong = ~((total - 1).abs() < LARGEST_DEFECT) & ~drawn
    if wrong.any():
        raise UserError(
            f"{int(wrong.sum())} of {len(total)} predicted distributions over classes do not sum to 1: that of row "
            f"{int(wrong.nonzero()[0])} sums to {total[wrong][0].item():.6g}. Mend log_prob of the density head or "
            "wrapper that predicts them (`mode=check`)."
        )
    return log_prob.softmax(-1)


def require_labels(target: Real[Tensor, "batch"], classes: int) -> Real[Tensor, "batch"]:
    """`target` itself, if every label is that of one of the classes.

    Raises:
        DataError: a label below 0 or above `classes` - 1, or NaN; says which.
    """
    wrong = ~((target >= 0) & (target < classes))
    if wrong.any():
        raise DataError(
            f"{int(wrong.sum())} of {len(target)} targets of this batch are no class: that of row "
            f"{int(wrong.nonzero()[0])} is {target[wrong][0].item():g}, wanted 0 to {classes - 1}. Mend the data's "
            "labels."
        )
    return target
