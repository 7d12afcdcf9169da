"""Maxima of a network's outputs over the points of each cloud, where possible without the outputs of every point.

The network is one that `layers.layers` builds. A training step of PointNet takes a quarter of the time and a third of
the memory that it takes if the outputs of every point are computed (benchmarks/clouds/set_steps.md).
"""

from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import linear

from plugins.encoder.point_sets.point_sets import largest

POINTS = 64
"""Smallest mean number of points of a cloud for which the shortcut of `largest_after` is used.

With fewer points, too large a share of them attains a maximum. The limit is estimated from operations, not measured.
"""


def largest_after(
    network: nn.Sequential, values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "batch channels"]:
    """Return `largest(network(values), counts)` up to rounding, with the same gradient.

    ReLU is monotone, and so is batch norm in each channel. The maximum over a cloud is therefore attained by the point
    with the largest number before batch norm (the smallest number if the factor of batch norm is negative). In
    evaluation, batch norm is folded into the last linear layer. In training, the moments over all points follow from
    the mean m and the covariance C of the inputs of the last linear layer, whose weight is W: the mean is W m, the
    variances are the diagonal of W C Wᵀ. Only the points that attain a maximum therefore pass the linear layer with a
    gradient. If several points attain a maximum, one of them has the gradient.

    Args:
        network: repetitions of linear layer, batch norm and ReLU, built by `plugins.encoder.point_sets.layers.layers`.
        values: concatenated points.
        counts: number of points of each cloud.
    """
    *earlier, final, norm, _ = network.children()
    for layer in earlier:
        values = layer(values)
    final, norm = cast(nn.Linear, final), cast(nn.BatchNorm1d, norm)
    if type(norm) is nn.BatchNorm1d and not norm.training and norm.running_mean is not None:
        weight, bias = fold_norm(final, norm)
        return (largest(linear(values, weight), counts) + bias).relu()
    maxima = (
        _maxima_of_attaining(final, norm, values, counts)
        if _shortcut_pays(final, norm, values, counts)
        else None
    )
    return (largest(norm(final(values)), counts) if maxima is None else maxima).relu()


def fold_norm(
    final: nn.Linear, norm: nn.BatchNorm1d
) -> tuple[Float[Tensor, "channels columns"], Float[Tensor, "channels"]]:
    """Return weight and bias of the linear layer that equals `final` without bias, then `norm` in evaluation."""
    assert norm.running_mean is not None and norm.running_var is not None
    factor = norm.weight * (norm.running_var + norm.eps).rsqrt()
    return final.weight * factor.unsqueeze(1), norm.bias - norm.running_mean * factor


def _shortcut_pays(final: nn.Linear, norm: nn.Module, values: Tensor, counts: Tensor) -> bool:
    """Return whether the shortcut of `largest_after` in training can be used and needs less computation.

    It can be used if a gradient is computed, on a CPU, in the layer's own precision. Its costs are shares of the cost
    of a pass of all points through the linear layer: columns / channels for the covariance of the inputs, and clouds /
    points for the points that attain a maximum.
    """
    return (
        torch.is_grad_enabled()
        and type(norm) is nn.BatchNorm1d  # SyncBatchNorm also uses the moments of other processes
        and values.device.type == "cpu"
        and not torch.is_autocast_enabled("cpu")
        and final.out_features >= 2 * final.in_features
        and len(values) >= POINTS * len(counts) > 0
    )


def _maxima_of_attaining(
    final: nn.Linear,
    norm: nn.BatchNorm1d,
    values: Float[Tensor, "point columns"],
    counts: Int[Tensor, "batch"],
) -> Float[Tensor, "batch channels"] | None:
    """Return the maxima after linear layer and batch norm in training, or None if a variance would be too inexact.

    A variance is too inexact if it is a small difference of large entries of the inputs' covariance.
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
        rows = rows_of_maxima(centred, weight * norm.weight.sign().unsqueeze(1), counts)
        _update_moments(norm, weight @ mean, variance, len(values))
    chosen = centred.index_select(0, rows.flatten()).unflatten(0, rows.shape)
    maxima = (chosen * weight).sum(-1)
    return maxima * (norm.weight * (variance + norm.eps).rsqrt()) + norm.bias


def rows_of_maxima(
    values: Float[Tensor, "point columns"],
    weight: Float[Tensor, "channels columns"],
    counts: Int[Tensor, "batch"],
) -> Int[Tensor, "batch channels"]:
    """Return for each cloud and channel the point for which the output of a linear layer is largest.

    Args:
        values: concatenated points of all clouds, the inputs of the layer.
        weight: weight of the layer, which has no bias.
        counts: number of points of each cloud.

    Returns:
        Rows of `values`.
    """
    start = (counts.cumsum(0) - counts).tolist()
    parts = values.split(counts.tolist())  # one cloud at a time, so that its numbers stay in a CPU's cache
    # transposed, so that the numbers of a channel are contiguous
    return torch.stack(
        [first + (weight @ part.mT).argmax(1) for first, part in zip(start, parts, strict=True)]
    )


def _update_moments(norm: nn.BatchNorm1d, mean: Tensor, variance: Tensor, points: int) -> None:
    """Update the running moments as `nn.BatchNorm1d` does."""
    if norm.running_mean is None or norm.running_var is None or norm.num_batches_tracked is None:
        return
    norm.num_batches_tracked.add_(1)
    momentum = norm.momentum if norm.momentum is not None else 1 / float(norm.num_batches_tracked)
    norm.running_mean.lerp_(mean.to(norm.running_mean.dtype), momentum)
    unbiased = variance * (points / (points - 1))
    norm.running_var.lerp_(unbiased.to(norm.running_var.dtype), momentum)
