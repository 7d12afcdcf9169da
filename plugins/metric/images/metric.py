"""Metrics of predicted images: peak signal-to-noise ratio, structural similarity, silhouettes, depths."""

from typing import Annotated, ClassVar, Literal

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.errors import DataError
from framework.geometry.srgb import srgb_from_linear
from plugins.metric.images import functional
from plugins.metric.images.per_image import PerImage

Encoding = Literal["srgb", "linear"]
"""Numbers in which colours are compared: sRGB as in 8-bit files, but not rounded (as in papers); or linear RGB."""


def compared(light: Float[Tensor, "height width number"], encoding: Encoding) -> Tensor:
    """Return the colours in the given encoding, clipped to [0, 1] as a file would clip them, float64."""
    return srgb_from_linear(light.double()) if encoding == "srgb" else light.double().clamp(0, 1)


def require_side(image: Tensor, least: int, remedy: str) -> None:
    """Refuse an image that is smaller than the window of SSIM.

    Raises:
        DataError: the shorter side has fewer than `least` pixels.
    """
    height, width = image.shape[:2]
    if min(height, width) < least:
        raise DataError(
            f"images have {height} × {width} pixels, and structural similarity looks through windows that need {least} "
            f"a side here. {remedy}"
        )


class PSNR(PerImage):
    """Peak signal-to-noise ratio of each image, 10 log₁₀(1 / mean squared error) dB, as a mean over images.

    Decibels of images are averaged, as in the literature; the result is not the ratio of a mean error. `psnr_masked_db`
    is over the pixels of the true mask alone, because a white background raises the number of every image; an image
    with an empty mask has no such number and does not count.

    Args:
        encoding: encoding of the compared colours: "srgb" as files hold them, or "linear" RGB.
        masked: also compute the ratio inside the true mask, which batches must then have.
        ceiling_db: the largest ratio that is counted; an image without error, whose ratio is infinite, counts as this.
            100 dB is an error of 1e-5, a four-hundredth of a step of 8 bits. `psnr_exact` is the share of images at the
            ceiling.
    """

    bibtex = """@article{huynhthu2008scope,
  author  = {Huynh-Thu, Quan and Ghanbari, Mohammed},
  title   = {Scope of Validity of {PSNR} in Image/Video Quality Assessment},
  journal = {Electronics Letters},
  volume  = {44},
  number  = {13},
  pages   = {800--801},
  year    = {2008}
}"""
    reads: ClassVar[frozenset[str]] = frozenset({"color"})
    columns: ClassVar[dict[str, str]] = {"psnr_db": "PSNR dB", "psnr_masked_db": "inside dB"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = dict.fromkeys(columns, "higher")
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
        one, other = (compared(image, self.encoding) for image in (predicted, true))
        whole = functional.psnr(one, other, self.ceiling)
        inside = [] if mask is None else [functional.psnr(one[mask], other[mask], self.ceiling)]
        return [whole, (whole == self.ceiling).double(), *inside]


class SSIM(PerImage):
    """Mean structural similarity of each image, at most 1, as a mean over images.

    It is measured as its authors do: with Gaussian windows of 11 pixels with σ = 1.5 pixels that lie in the image, for
    red, green and blue separately, and then averaged over the three. `ssim_masked` is the mean over the windows centred
    on pixels of the true mask, which reach 5 pixels beyond the mask; an image without such a pixel does not count.

    Args:
        encoding: encoding of the compared colours: "srgb" as files hold them, or "linear" RGB.
        masked: also compute the similarity inside the true mask, which batches must then have.

    Raises:
        DataError: images have fewer than 11 pixels a side.
    """

    bibtex = """@article{wang2004image,
  author  = {Wang, Zhou and Bovik, Alan C. and Sheikh, Hamid R. and Simoncelli, Eero P.},
  title   = {Image Quality Assessment: From Error Visibility to Structural Similarity},
  journal = {IEEE Transactions on Image Processing},
  volume  = {13},
  number  = {4},
  pages   = {600--612},
  year    = {2004}
}"""
    reads: ClassVar[frozenset[str]] = frozenset({"color"})
    columns: ClassVar[dict[str, str]] = {"ssim": "SSIM", "ssim_masked": "inside"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = dict.fromkeys(columns, "higher")
    figure_name: ClassVar[str] = "ssim"

    def __init__(self, *, encoding: Encoding = "srgb", masked: bool = True) -> None:
        super().__init__()
        self.encoding: Encoding = encoding
        self.start("ssim", *(["ssim_masked"] if masked else []), masked=masked)

    def judge(self, predicted: Tensor, true: Tensor, mask: Tensor | None) -> list[Float[Tensor, ""]]:
        require_side(true, functional.WINDOW, "Choose larger images, or leave this metric out.")
        one, other = (compared(image, self.encoding) for image in (predicted, true))
        return functional.ssim(one, other, mask)


class MSSSIM(PerImage):
    """Multi-scale structural similarity of each image over the full frame, in [0, 1], as a mean over images.

    Args:
        encoding: encoding of the compared colours: "srgb" as files hold them, or "linear" RGB.
        scales: number of scales; each next one halves the image. The authors use five, which need 176 pixels a side;
            four need 88, three 44, two 22. Results with different numbers of scales cannot be compared.

    Raises:
        DataError: images are too small for the scales.
    """

    bibtex = """@inproceedings{wang2003multiscale,
  author    = {Wang, Zhou and Simoncelli, Eero P. and Bovik, Alan C.},
  title     = {Multiscale Structural Similarity for Image Quality Assessment},
  booktitle = {Asilomar Conference on Signals, Systems and Computers},
  pages     = {1398--1402},
  year      = {2003}
}"""
    reads: ClassVar[frozenset[str]] = frozenset({"color"})
    columns: ClassVar[dict[str, str]] = {"ms_ssim": "MS-SSIM"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = dict.fromkeys(columns, "higher")
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
        one, other = (compared(image, self.encoding) for image in (predicted, true))
        return [functional.ms_ssim(one, other, self.scales)]


class SilhouetteIoU(PerImage):
    """Intersection over union of predicted and true masks of each image, in [0, 1], as a mean over images.

    An image whose predicted and true masks are both empty has no such number and does not count.
    """

    bibtex = """@article{everingham2010pascal,
  author  = {Everingham, Mark and Van Gool, Luc and Williams, Christopher K. I. and Winn, John and Zisserman, Andrew},
  title   = {The {PASCAL} Visual Object Classes ({VOC}) Challenge},
  journal = {International Journal of Computer Vision},
  volume  = {88},
  number  = {2},
  pages   = {303--338},
  year    = {2010}
}"""
    reads: ClassVar[frozenset[str]] = frozenset({"mask"})
    columns: ClassVar[dict[str, str]] = {"silhouette_iou": "silhouette IoU"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = dict.fromkeys(columns, "higher")
    figure_name: ClassVar[str] = "silhouette_iou"

    def __init__(self) -> None:
        super().__init__()
        self.start("silhouette_iou")

    def judge(self, predicted: Tensor, true: Tensor, mask: Tensor | None) -> list[Float[Tensor, ""]]:
        return [functional.silhouette_iou(predicted, true)]


class DepthError(PerImage):
    """Mean absolute depth error of each image over the pixels that both images see, metres, as a mean over images.

    `depth_unmatched` is the share of pixels that only one image sees, among the pixels that at least one sees. An image
    pair without a common pixel has no error; therefore only both numbers together say how good the depths are.
    """

    bibtex = """@inproceedings{eigen2014depth,
  author    = {Eigen, David and Puhrsch, Christian and Fergus, Rob},
  title     = {Depth Map Prediction from a Single Image using a Multi-Scale Deep Network},
  booktitle = {Advances in Neural Information Processing Systems (NeurIPS)},
  pages     = {2366--2374},
  year      = {2014}
}"""
    reads: ClassVar[frozenset[str]] = frozenset({"depth"})
    columns: ClassVar[dict[str, str]] = {"depth_error_m": "depth error m", "depth_unmatched": "unmatched"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = dict.fromkeys(columns, "lower")
    figure_name: ClassVar[str] = "depth_error"

    def __init__(self) -> None:
        super().__init__()
        self.start("depth_error_m", "depth_unmatched")

    def judge(self, predicted: Tensor, true: Tensor, mask: Tensor | None) -> list[Float[Tensor, ""]]:
        return functional.depth_error(predicted, true)
