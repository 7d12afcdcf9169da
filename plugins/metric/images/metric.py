"""Metrics of predicted images: peak signal-to-noise ratio, structural similarity, silhouette overlap, depth error."""

from typing import Annotated, ClassVar, Literal

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.errors import DataError
from framework.geometry.srgb import srgb_from_linear
from framework.metric import Directions
from plugins.metric.images import functional
from plugins.metric.images.per_image import PerImage

Encoding = Literal["srgb", "linear"]
"""Encoding in which colours are compared: sRGB, not rounded to 8 bits (usual in the literature); or linear RGB."""


def encode_colors(light: Float[Tensor, "height width number"], encoding: Encoding) -> Tensor:
    """Return colours of linear RGB in the encoding `encoding`, clipped to [0, 1], float64."""
    return srgb_from_linear(light.double()) if encoding == "srgb" else light.double().clamp(0, 1)


def require_side(image: Tensor, least: int, remedy: str) -> None:
    """Check that an image is large enough for the windows of SSIM; `remedy` is the last sentence of the message.

    Raises:
        DataError: the shorter side has fewer than `least` pixels.
    """
    height, width = image.shape[:2]
    if min(height, width) < least:
        raise DataError(
            f"the images have {height} × {width} pixels, but structural similarity with these settings requires sides "
            "of "
            f"at least {least} pixels. {remedy}"
        )


class PSNR(PerImage):
    """Peak signal-to-noise ratio of each image, 10 log₁₀(1 / mean squared error) dB, as a mean over images.

    The result is the mean of the decibels of all images, as in the literature, and not the decibels of a mean error.
    `psnr_masked_db` uses only the pixels of the true mask, because a white background raises the ratio of every image;
    images with an empty mask do not count.

    Args:
        encoding: encoding in which colours are compared, "srgb" or "linear" RGB.
        masked: whether to compute the ratio also inside the true mask; batches must then have the field "mask".
        ceiling_db: upper limit of the ratio; it replaces the infinite ratio of images without error. 100 dB is an error
            of 1e-5, which is 1/400 of a step of 8 bits. `psnr_exact` is the share of images at the ceiling.
    """

    bibtex = "huynhthu2008scope"
    columns: ClassVar[dict[str, str]] = {"psnr_db": "PSNR dB", "psnr_masked_db": "PSNR in mask, dB"}
    better: ClassVar[Directions] = dict.fromkeys(columns, "higher")
    figure_name: ClassVar[str] = "psnr"

    def __init__(
        self,
        *,
        encoding: Encoding = "srgb",
        masked: bool = True,
        ceiling_db: Annotated[float, Field(gt=0, le=300)] = 100.0,
    ) -> None:
        super().__init__()
        self.encoding: Encoding = encoding
        self.ceiling = ceiling_db
        self.start("psnr_db", "psnr_exact", *(["psnr_masked_db"] if masked else []), masked=masked)

    def judge(self, predicted: Tensor, true: Tensor, mask: Tensor | None) -> list[Float[Tensor, ""]]:
        first, second = (encode_colors(image, self.encoding) for image in (predicted, true))
        whole = functional.psnr(first, second, self.ceiling)
        inside = [] if mask is None else [functional.psnr(first[mask], second[mask], self.ceiling)]
        return [whole, (whole == self.ceiling).double(), *inside]


class SSIM(PerImage):
    """Mean structural similarity of each image, at most 1, as a mean over images.

    As in the authors' code, Gaussian windows of 11 × 11 pixels (σ = 1.5 pixels) that lie inside the image are used for
    red, green and blue separately, and the results are averaged. `ssim_masked` is the mean over windows centred on
    pixels of the true mask; these windows extend 5 pixels beyond the mask. Images without such a window do not count.

    Args:
        encoding: encoding in which colours are compared, "srgb" or "linear" RGB.
        masked: whether to compute the similarity also inside the true mask; batches must then have the field "mask".

    Raises:
        DataError: a side of an image has fewer than 11 pixels.
    """

    bibtex = "wang2004image"
    columns: ClassVar[dict[str, str]] = {"ssim": "SSIM", "ssim_masked": "SSIM in mask"}
    better: ClassVar[Directions] = dict.fromkeys(columns, "higher")
    figure_name: ClassVar[str] = "ssim"

    def __init__(self, *, encoding: Encoding = "srgb", masked: bool = True) -> None:
        super().__init__()
        self.encoding: Encoding = encoding
        self.start("ssim", *(["ssim_masked"] if masked else []), masked=masked)

    def judge(self, predicted: Tensor, true: Tensor, mask: Tensor | None) -> list[Float[Tensor, ""]]:
        require_side(true, functional.WINDOW, "Choose larger images, or leave this metric out.")
        first, second = (encode_colors(image, self.encoding) for image in (predicted, true))
        return functional.ssim(first, second, mask)


class MSSSIM(PerImage):
    """Multi-scale structural similarity of each image over the whole image, in [0, 1], as a mean over images.

    Args:
        encoding: encoding in which colours are compared, "srgb" or "linear" RGB.
        scales: number of scales; each further scale halves the image. Wang et al. (2003) use five scales, which require
            sides of 176 pixels; four scales require 88, three 44, and two 22. Results with different numbers of scales
            are not comparable.

    Raises:
        DataError: images are too small for the scales.
    """

    bibtex = "wang2003multiscale"
    columns: ClassVar[dict[str, str]] = {"ms_ssim": "MS-SSIM"}
    better: ClassVar[Directions] = dict.fromkeys(columns, "higher")
    figure_name: ClassVar[str] = "ms_ssim"

    def __init__(self, *, encoding: Encoding = "srgb", scales: Annotated[int, Field(ge=1, le=5)] = 5) -> None:
        super().__init__()
        self.encoding: Encoding = encoding
        self.scales = scales
        self.start("ms_ssim")

    def judge(self, predicted: Tensor, true: Tensor, mask: Tensor | None) -> list[Float[Tensor, ""]]:
        require_side(
            true, functional.least_side(self.scales), "Set fewer `scales`, or leave this metric out."
        )
        first, second = (encode_colors(image, self.encoding) for image in (predicted, true))
        return [functional.ms_ssim(first, second, self.scales)]


class SilhouetteIoU(PerImage):
    """Intersection over union of predicted and true masks of each image, in [0, 1], as a mean over images.

    Images whose predicted and true masks are both empty do not count.
    """

    bibtex = "everingham2010pascal"
    reads: ClassVar[frozenset[str]] = frozenset({"mask"})
    columns: ClassVar[dict[str, str]] = {"silhouette_iou": "silhouette IoU"}
    better: ClassVar[Directions] = dict.fromkeys(columns, "higher")
    figure_name: ClassVar[str] = "silhouette_iou"

    def __init__(self) -> None:
        super().__init__()
        self.start("silhouette_iou")

    def judge(self, predicted: Tensor, true: Tensor, mask: Tensor | None) -> list[Float[Tensor, ""]]:
        return [functional.silhouette_iou(predicted, true)]


class DepthError(PerImage):
    """Mean absolute depth error of each image, metres, as a mean over images.

    The error is over the pixels at which both images have a finite depth. `depth_unmatched` is the number of pixels
    with a finite depth in exactly one image, divided by the number with a finite depth in at least one. Read both
    results together, because the error ignores unmatched pixels.
    """

    bibtex = "eigen2014depth"
    reads: ClassVar[frozenset[str]] = frozenset({"depth"})
    columns: ClassVar[dict[str, str]] = {"depth_error_m": "depth error m", "depth_unmatched": "unmatched"}
    better: ClassVar[Directions] = dict.fromkeys(columns, "lower")
    figure_name: ClassVar[str] = "depth_error"

    def __init__(self) -> None:
        super().__init__()
        self.start("depth_error_m", "depth_unmatched")

    def judge(self, predicted: Tensor, true: Tensor, mask: Tensor | None) -> list[Float[Tensor, ""]]:
        return functional.depth_error(predicted, true)
