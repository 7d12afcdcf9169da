"""Errors and similarities of one image, (height, width) or (height, width, number), in float64."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

WINDOW, SIGMA = 11, 1.5
"""Side and standard deviation of SSIM's Gaussian window, pixels (Wang et al. 2004, §III.C)."""
C1, C2 = 0.01**2, 0.03**2
"""Constants (K1 L)² and (K2 L)² for a range L of 1 (Wang et al. 2004, §III.C)."""
WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Weights of the scales of MS-SSIM, the finest scale first (Wang, Simoncelli & Bovik 2003, §3.2)."""

Image = Float[Tensor, "height width number"]
Pixels = Float[Tensor, "*pixels number"]
Mask = Bool[Tensor, "height width"]


def psnr(predicted: Pixels, true: Pixels, ceiling: float) -> Float[Tensor, ""]:
    """Return 10 log₁₀(1 / mean squared error), dB, at most `ceiling`; NaN if there is no pixel."""
    error = (predicted.double() - true.double()).square().mean()
    return (-10 * error.log10()).clamp(max=ceiling)


class Similarity(NamedTuple):
    """SSIM of each window in the image, and its contrast and structure alone, (number, height - 10, width - 10)."""

    whole: Tensor
    contrast: Tensor


def similarity(predicted: Float[Tensor, "number height width"], true: Tensor) -> Similarity:
    """Return the structural similarity (Wang et al. 2004, eq. 13) of every window that lies in the image."""
    one, other = predicted.double(), true.double()
    planes = torch.stack([one, other, one * one, other * other, one * other])
    mean, mean_other, square, square_other, product = blurred(planes)
    both = mean * mean_other
    covariance = product - both
    variance, variance_other = square - mean * mean, square_other - mean_other * mean_other
    contrast = (2 * covariance + C2) / (variance + variance_other + C2)
    return Similarity((2 * both + C1) / (mean * mean + mean_other * mean_other + C1) * contrast, contrast)


def blurred(planes: Float[Tensor, "... height width"]) -> Float[Tensor, "... height_10 width_10"]:
    """Return the means under the Gaussian window, only for windows that lie in the image; rows first, then columns."""
    place = torch.arange(WINDOW, dtype=planes.dtype, device=planes.device) - WINDOW // 2
    weights = torch.exp(-place.square() / (2 * SIGMA**2))
    weights = weights / weights.sum()
    for axis in (-2, -1):
        length = planes.shape[axis] - WINDOW + 1
        # sums of shifted planes: half the time of a convolution in float64
        planes = sum(weights[i] * planes.narrow(axis, i, length) for i in range(WINDOW))  # type: ignore[assignment]
    return planes


def ssim(predicted: Image, true: Image, mask: Mask | None) -> list[Float[Tensor, ""]]:
    """Return the mean structural similarity over the image and, with a mask, over the windows centred on its pixels.

    The second number is NaN where the mask has no such pixel.

    Args:
        predicted: image of at least 11 pixels a side.
        true: image of the same size.
        mask: pixels whose windows are averaged for the second number; None for the first number alone.
    """
    found = similarity(predicted.movedim(-1, 0), true.movedim(-1, 0)).whole
    if mask is None:
        return [found.mean()]
    half = WINDOW // 2
    return [found.mean(), found[:, mask[half:-half, half:-half]].mean()]


def ms_ssim(predicted: Image, true: Image, scales: int) -> Float[Tensor, ""]:
    """Return the multi-scale structural similarity (Wang, Simoncelli & Bovik 2003, eq. 7), the mean over channels.

    With fewer than five scales the weights of the finest ones are taken, scaled to the sum of all five weights. A
    negative mean contrast counts as 0, because its power is not defined.

    Args:
        predicted: image of at least `least_side(scales)` pixels a side.
        true: image of the same size.
        scales: number of scales, 1 to 5.
    """
    one, other = predicted.double().movedim(-1, 0), true.double().movedim(-1, 0)
    weights = torch.tensor(WEIGHTS[:scales], dtype=one.dtype, device=one.device) * (
        sum(WEIGHTS) / sum(WEIGHTS[:scales])
    )
    factors: list[Tensor] = []
    for scale in range(scales):
        if scale:
            one, other = halved(one), halved(other)
        found = similarity(one, other)
        factors.append((found.whole if scale == scales - 1 else found.contrast).mean((-2, -1)).clamp(min=0))
    return (torch.stack(factors) ** weights[:, None]).prod(0).mean()


def halved(planes: Float[Tensor, "number height width"]) -> Tensor:
    """Return the means of 2 × 2 pixels.

    The last one of an odd number of rows or columns is mirrored, as in the authors' code (Wang, Simoncelli & Bovik
    2003): `imfilter(..., 'symmetric')` with a window of 2 × 2, of whose results every second is kept, the first
    included; a window of even size covers its pixel and the next one.
    """
    odd = planes.shape[-1] % 2, planes.shape[-2] % 2
    return avg_pool2d(pad(planes, (0, odd[0], 0, odd[1]), mode="replicate"), 2)


def least_side(scales: int) -> int:
    """Return the side, in pixels, of the smallest image in whose coarsest scale a window lies: 176 for five scales."""
    return WINDOW * 2 ** (scales - 1)


def silhouette_iou(predicted: Mask, true: Mask) -> Float[Tensor, ""]:
    """Return the number of pixels in both masks divided by that in either mask; NaN where both are empty."""
    return (predicted & true).sum().double() / (predicted | true).sum()


def depth_error(predicted: Float[Tensor, "height width"], true: Tensor) -> list[Float[Tensor, ""]]:
    """Return the mean absolute depth error in metres, and the share of unmatched pixels.

    The error is over the pixels where both images have a finite depth. The share is that of the pixels where only one
    of them has, among those where at least one has. Each is NaN where there is no such pixel. A depth is infinite where
    nothing is seen.
    """
    seen, there = predicted.isfinite(), true.isfinite()
    both = seen & there
    gap = (predicted.double()[both] - true.double()[both]).abs()
    return [gap.mean(), (seen ^ there).sum().double() / (seen | there).sum()]
