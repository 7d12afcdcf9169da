"""Class probabilities of any density over classes, and a check of class labels, shared by the metrics of classes."""

import math

from jaxtyping import Float64, Real
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.checks import refuse_nan
from framework.distributions.protocol import estimate
from framework.errors import DataError, UserError

LARGEST_DEFECT = 0.01
"""Largest accepted difference between 1 and a sum of class probabilities; float32 rounds logits of 1e4 by 1e-3."""


def class_probabilities(density: Distribution) -> Float64[Tensor, "batch class"]:
    """Return p(y = k) for each sample and class k, in [0, 1]; the sum over the classes is 1 in float64.

    For each class, exp(log_prob) is computed in float64 and divided by the sum over all classes. Before this division,
    the sum differs from 1: by 1e-7 for a float32 log_prob, by 1e-3 if its logits reach 1e4, and by a random amount if
    log_prob of each class is estimated from draws (`estimate`). Before the division, the largest probability of a
    mixture may exceed 1 by the same amounts.

    Args:
        density: density over classes, with batch_shape (batch,); class k is the k-th of `enumerate_support`.

    Raises:
        UserError: the density does not list its values, a probability is NaN, a sum is 0, or a sum differs from 1 by 1
            % or more although log_prob does not use draws.
    """
    if not density.has_enumerate_support or tuple(density.event_shape):
        raise UserError(
            f"A metric reads class probabilities, but the model predicts a {type(density).__name__} with event_shape "
            f"{tuple(density.event_shape)}, which is not a density over classes. Choose a density head that predicts "
            "classes, such as density_head=categorical, or leave the metric out."
        )
    estimates = estimate(density, density.enumerate_support())
    log_prob = estimates.log_mean.double().T
    total = refuse_nan(log_prob.exp().sum(-1), "predicted distributions over classes")
    is_drawn = (estimates.samples > 0).any(0) & (log_prob > -math.inf).any(-1)
    wrong = ~((total - 1).abs() < LARGEST_DEFECT) & ~is_drawn
    if wrong.any():
        raise UserError(
            f"{int(wrong.sum())} of {len(total)} predicted distributions over classes do not sum to 1: the "
            f"distribution in row {int(wrong.nonzero()[0])} sums to {total[wrong][0].item():.6g}. Correct log_prob of "
            "the density head or the uncertainty wrapper that predicts them (`mode=check`)."
        )
    return log_prob.softmax(-1)


def require_labels(target: Real[Tensor, "batch"], classes: int) -> Real[Tensor, "batch"]:
    """Return `target` unchanged if every label is a class index from 0 to `classes` - 1.

    Raises:
        DataError: a label is below 0, above `classes` - 1, or NaN; the message says which.
    """
    wrong = ~((target >= 0) & (target < classes))
    if wrong.any():
        raise DataError(
            f"{int(wrong.sum())} of {len(target)} targets of this batch are not a class index: the target in row "
            f"{int(wrong.nonzero()[0])} is {target[wrong][0].item():g}, but class indices go from 0 to {classes - 1}. "
            "Correct the labels of the data."
        )
    return target
