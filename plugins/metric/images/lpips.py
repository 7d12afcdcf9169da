"""Learned perceptual image patch similarity of predicted images."""

import math
from typing import ClassVar, Literal

from jaxtyping import Float
from torch import Tensor

from framework.configuration.paths import FilePath
from framework.errors import DataError
from plugins.metric.images.metric import compared
from plugins.metric.images.per_image import PerImage
from plugins.metric.images.perceptual import LEAST_SIDE, Backbone, Distance


class LPIPS(PerImage):
    """Learned perceptual distance of each image (Zhang et al. 2018, version 0.1), as a mean over images.

    It is computed in float32 from colours as 8-bit files hold them, but not rounded. For `lpips_masked`, everything
    outside of the true mask is made white in both images; an image with an empty mask has no such number and does not
    count.

    The networks were trained on photographs, and their weights are not shipped. Without a file of weights there is no
    number, and the table says "not available"; random weights are never used.

    Args:
        backbone: "alex", which the authors recommend for comparing methods and which papers report; or "vgg".
        weights: a local file of the backbone in torchvision's format: alexnet-owt-7be5be79.pth, vgg16-397923af.pth.
        masked: also compute the distance inside the true mask, which batches must then have.

    Raises:
        ConfigError: the file of weights does not exist.
        CheckpointError: the file holds the weights of another network.
        DataError: images do not have three colours, or are smaller than 31 ("vgg": 16) pixels a side.
    """

    bibtex = """@inproceedings{zhang2018unreasonable,
  author    = {Zhang, Richard and Isola, Phillip and Efros, Alexei A. and Shechtman, Eli and Wang, Oliver},
  title     = {The Unreasonable Effectiveness of Deep Features as a Perceptual Metric},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition (CVPR)},
  pages     = {586--595},
  year      = {2018}
}"""
    reads: ClassVar[frozenset[str]] = frozenset({"color"})
    columns: ClassVar[dict[str, str]] = {"lpips": "LPIPS", "lpips_masked": "inside"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = dict.fromkeys(columns, "lower")
    figure_name: ClassVar[str] = "lpips"

    def __init__(
        self, *, backbone: Backbone = "alex", weights: FilePath | None = None, masked: bool = True
    ) -> None:
        super().__init__()
        self.least = LEAST_SIDE[backbone]
        self.distance = None if weights is None else Distance(backbone, weights)
        self.start("lpips", *(["lpips_masked"] if masked else []), masked=masked)

    def judge(self, predicted: Tensor, true: Tensor, mask: Tensor | None) -> list[Float[Tensor, ""]]:
        if self.distance is None:
            return [true.new_full((), math.nan)] * len(self.keys)
        height, width, number = true.shape
        if number != 3 or min(height, width) < self.least:
            raise DataError(
                f"images of {height} × {width} pixels and {number} colours came; wanted 3 colours and {self.least} "
                "pixels a side, which the network of LPIPS reads. Choose larger images, or leave this metric out."
            )
        one, other = (compared(image, "srgb").float() for image in (predicted, true))
        found = [self._apart(one, other)]
        if mask is not None:
            outside = ~mask[..., None]
            inside = self._apart(one.masked_fill(outside, 1), other.masked_fill(outside, 1))
            found.append(inside if mask.any() else inside.new_full((), math.nan))
        return found

    def _apart(self, one: Tensor, other: Tensor) -> Float[Tensor, ""]:
        assert self.distance is not None
        return self.distance(one.movedim(-1, 0)[None], other.movedim(-1, 0)[None])[0]
