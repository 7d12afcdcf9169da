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
    """Structural similarity (SSIM) of each window that lies inside the image, (channel, height - 10, width - 10).

    Attributes:
        whole: SSIM.
        contrast: SSIM without its factor for luminance: the product of the factors for contrast and structure.
    """

    whole: Tensor
    contrast: Tensor


def similarity(predicted: Float[Tensor, "number height width"], true: Tensor) -> Similarity:
    """Return the structural similarity (Wang et al. 2004, eq. 13) of every window that lies inside the image."""
    first, second = predicted.double(), true.double()
    planes = torch.stack([first, second, first * first, second * second, first * second])
    mean, mean_other, square, square_other, product = blur(planes)
    both = mean * mean_other
    covariance = product - both
    variance, variance_other = square - mean * mean, square_other - mean_other * mean_other
    contrast = (2 * covariance + C2) / (variance + variance_other + C2)
    return Similarity((2 * both + C1) / (mean * mean + mean_other * mean_other + C1) * contrast, contrast)


def blur(planes: Float[Tensor, "... height width"]) -> Float[Tensor, "... height_10 width_10"]:
    """Return the Gaussian-weighted mean of every window that lies inside the image."""
    place = torch.arange(WINDOW, dtype=planes.dtype, device=planes.device) - WINDOW // 2
    weights = torch.exp(-place.square() / (2 * SIGMA**2))
    weights = weights / weights.sum()
    for axis in (-2, -1):
        length = planes.shape[axis] - WINDOW + 1
        # summing shifted planes takes half the time of a convolution in float64
        planes = sum(weights[i] * planes.narrow(axis, i, length) for i in range(WINDOW))  # type: ignore[assignment]
    return planes


def ssim(predicted: Image, true: Image, mask: Mask | None) -> list[Float[Tensor, ""]]:
    """Return the mean structural similarity over the image and, with a mask, over the windows centred on its pixels.

    The second number is NaN if no window is centred on a pixel of the mask.

    Args:
        predicted: image of at least 11 × 11 pixels.
        true: image of the same size.
        mask: pixels whose windows are averaged for the second number; None to return only the first number.
    """
    windows = similarity(predicted.movedim(-1, 0), true.movedim(-1, 0)).whole
    if mask is None:
        return [windows.mean()]
    half = WINDOW // 2
    return [windows.mean(), windows[:, mask[half:-half, half:-half]].mean()]


def ms_ssim(predicted: Image, true: Image, scales: int) -> Float[Tensor, ""]:
    """Return the multi-scale structural similarity (Wang, Simoncelli & Bovik 2003, eq. 7), averaged over channels.

    With fewer than five scales, the weights of the finest scales are used, multiplied by a factor that gives them the
    sum of all five weights. A negative mean contrast counts as 0, because its power is not defined.

    Args:
        predicted: image whose sides have at least `least_side(scales)` pixels.
        true: image of the same size.
        scales: number of scales, 1 to 5.
    """
    first, second = predicted.double().movedim(-1, 0), true.double().movedim(-1, 0)
    weights = torch.tensor(WEIGHTS[:scales], dtype=first.dtype, device=first.device) * (
        sum(WEIGHTS) / sum(WEIGHTS[:scales])
    )
    factors: list[Tensor] = []
    for scale in range(scales):
        if scale:
            first, second = halve(first), halve(second)
        level = similarity(first, second)
        factors.append((level.whole if scale == scales - 1 else level.contrast).mean((-2, -1)).clamp(min=0))
    return (torch.stack(factors) ** weights[:, None]).prod(0).mean()


def halve(planes: Float[Tensor, "number height width"]) -> Tensor:
    """Return the means of blocks of 2 × 2 pixels.

    If the number of rows or columns is odd, the last one is repeated. This equals the authors' code (Wang, Simoncelli &
    Bovik 2003): `imfilter(..., 'symmetric')` with a window of 2 × 2, followed by taking every second result. A window
    of even size covers its pixel and the next one.
    """
    odd = planes.shape[-1] % 2, planes.shape[-2] % 2
    return avg_pool2d(pad(planes, (0, odd[0], 0, odd[1]), mode="replicate"), 2)


def least_side(scales: int) -> int:
    """Return the smallest side, in pixels, of an image with a whole window at the coarsest scale (176 for 5 scales)."""
    return WINDOW * 2 ** (scales - 1)


def silhouette_iou(predicted: Mask, true: Mask) -> Float[Tensor, ""]:
    """Return the number of pixels in both masks, divided by the number in at least one; NaN if both are empty."""
    return (predicted & true).sum().double() / (predicted | true).sum()


def depth_error(predicted: Float[Tensor, "height width"], true: Tensor) -> list[Float[Tensor, ""]]:
    """Return the mean absolute depth error in metres, and the share of unmatched pixels.

    The error is over the pixels at which both images have a finite depth. The share is the number of pixels at which
    exactly one image has a finite depth, divided by the number at which at least one has. A result is NaN if there is
    no such pixel. The background has an infinite depth.
    """
    predicted_finite, true_finite = predicted.isfinite(), true.isfinite()
    both = predicted_finite & true_finite
    gap = (predicted.double()[both] - true.double()[both]).abs()
    return [
        gap.mean(),
        (predicted_finite ^ true_finite).sum().double() / (predicted_finite | true_finite).sum(),
    ]
