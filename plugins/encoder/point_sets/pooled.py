"""Maxima over each cloud after layers of `layers`, without computing the outputs of every point where possible.

A step of PointNet then takes a quarter of the time and a third of the memory (benchmarks/clouds/set_steps.md).
"""

from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import linear

from plugins.encoder.point_sets.point_sets import largest

POINTS = 64
"""Smallest mean number of points of a cloud for which few rows attain a maximum; by count, not by a measured limit."""


def largest_after(
    network: nn.Sequential, values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "batch channels"]:
    """Return `largest(network(values), counts)`, to rounding, with its gradient.

    ReLU and, for one channel, batch norm are monotone. The maximum over a cloud therefore belongs to the point with the
    largest number before them (the smallest where the norm's factor is negative). In evaluation the norm is folded into
    the last linear layer. In training its moments over all points follow from those of the layer's inputs, W m and Wᵀ C
    W, so that only the points which attain a maximum pass the layer with a gradient. Where several points attain a
    maximum, one of them has the gradient.
    """
    *others, final, norm, _ = network.children()
    for layer in others:
        values = layer(values)
    final, norm = cast(nn.Linear, final), cast(nn.BatchNorm1d, norm)
    if type(norm) is nn.BatchNorm1d and not norm.training and norm.running_mean is not None:
        weight, bias = folded(final, norm)
        return (largest(linear(values, weight), counts) + bias).relu()
    found = _of_attaining(final, norm, values, counts) if _pays(final, norm, values, counts) else None
    return (largest(norm(final(values)), counts) if found is None else found).relu()


def folded(
    final: nn.Linear, norm: nn.BatchNorm1d
) -> tuple[Float[Tensor, "channels columns"], Float[Tensor, "channels"]]:
    """Return weight and bias of a linear layer without bias merged with the batch norm after it, by running moments."""
    assert norm.running_mean is not None and norm.running_var is not None
    factor = norm.weight * (norm.running_var + norm.eps).rsqrt()
    return final.weight * factor.unsqueeze(1), norm.bias - norm.running_mean * factor


def _pays(final: nn.Linear, norm: nn.Module, values: Tensor, counts: Tensor) -> bool:
    """Return whether the shortcut applies and needs less computation.

    It applies with a gradient, on a CPU, in the layer's own precision. The covariance of the inputs takes columns /
    channels of a pass, the gathered rows clouds / points.
    """
    return (
        torch.is_grad_enabled()
        and type(norm) is nn.BatchNorm1d  # SyncBatchNorm also uses the moments of other processes
        and values.device.type == "cpu"
        and not torch.is_autocast_enabled("cpu")
        and final.out_features >= 2 * final.in_features
        and len(values) >= POINTS * len(counts) > 0
    )


def _of_attaining(
    final: nn.Linear,
    norm: nn.BatchNorm1d,
    values: Float[Tensor, "point columns"],
    counts: Int[Tensor, "batch"],
) -> Float[Tensor, "batch channels"] | None:
    """Return the maxima after linear layer and batch norm in training, or None if the variance would be too inexact.

    The covariance of the inputs then leaves too few digits of a channel's variance, which is a small difference of
    large numbers.
    """
    weight = final.weight
    mean = values.mean(0)
    centred = values - mean
    covariance = centred.mT @ centred / len(values)
    variance = ((weight @ covariance) * weight).sum(1)
    with torch.no_grad():
        size = ((weight.abs() @ covariance.abs()) * weight.abs()).sum(1)
        if bool((variance < torch.finfo(values.dtype).eps ** 0.5 * size).any()):
            return None
        rows = attaining(centred, weight * norm.weight.sign().unsqueeze(1), counts)
        _moved(norm, weight @ mean, variance, len(values))
    chosen = centred.index_select(0, rows.flatten()).unflatten(0, rows.shape)
    found = (chosen * weight).sum(-1)
    return found * (norm.weight * (variance + norm.eps).rsqrt()) + norm.bias


def attaining(
    values: Float[Tensor, "point columns"],
    weight: Float[Tensor, "channels columns"],
    counts: Int[Tensor, "batch"],
) -> Int[Tensor, "batch channels"]:
    """Return for each cloud and channel the row, among all points, with the largest product."""
    start = (counts.cumsum(0) - counts).tolist()
    parts = values.split(counts.tolist())  # the numbers of one cloud stay in a CPU's cache
    # transposed, so that the numbers of a channel are contiguous
    return torch.stack(
        [first + (weight @ part.mT).argmax(1) for first, part in zip(start, parts, strict=True)]
    )


def _moved(norm: nn.BatchNorm1d, mean: Tensor, variance: Tensor, points: int) -> None:
    """Update the running moments as `nn.BatchNorm1d` does."""
    if norm.running_mean is None or norm.running_var is None or norm.num_batches_tracked is None:
        return
    norm.num_batches_tracked.add_(1)
    momentum = norm.momentum if norm.momentum is not None else 1 / float(norm.num_batches_tracked)
    norm.running_mean.lerp_(mean.to(norm.running_mean.dtype), momentum)
    unbiased = variance * (points / (points - 1))
    norm.running_var.lerp_(unbiased.to(norm.running_var.dtype), momentum)
