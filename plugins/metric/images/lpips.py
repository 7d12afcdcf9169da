"""Learned perceptual image patch similarity of predicted images."""

import math
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from framework.configuration.paths import FilePath
from framework.errors import DataError
from framework.metric import Directions
from plugins.metric.images.metric import encode_colors
from plugins.metric.images.per_image import PerImage
from plugins.metric.images.perceptual import LEAST_SIDE, Backbone, Distance


class LPIPS(PerImage):
    """Learned perceptual distance of each image (Zhang et al. 2018, version 0.1), as a mean over images.

    The distance is computed in float32 from sRGB colours that are not rounded to 8 bits. For `lpips_masked`, all pixels
    outside of the true mask are white in both images; images with an empty mask do not count.

    The networks were trained on photographs, and their weights are not part of this project. Without a file of weights
    the result is NaN ("not available" in tables); random weights are never used.

    Args:
        backbone: "alex", which the authors recommend for comparisons and which papers report; or "vgg".
        weights: local file of the backbone in torchvision's format: alexnet-owt-7be5be79.pth or vgg16-397923af.pth.
        masked: whether to compute the distance also inside the true mask; batches must then have the field "mask".

    Raises:
        ConfigError: the file of weights does not exist.
        CheckpointError: the file holds the weights of another network.
        DataError: images do not have three channels, or a side has fewer than 31 ("vgg": 16) pixels.
    """

    bibtex = "zhang2018unreasonable"
    columns: ClassVar[dict[str, str]] = {"lpips": "LPIPS", "lpips_masked": "LPIPS in mask"}
    better: ClassVar[Directions] = dict.fromkeys(columns, "lower")
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
                f"got images of {height} × {width} pixels with {number} channels, but the network of LPIPS requires 3 "
                "channels "
                f"and sides of at least {self.least} pixels. Choose larger images, or leave this metric out."
            )
        first, second = (encode_colors(image, "srgb").float() for image in (predicted, true))
        distances = [self._distance_between(first, second)]
        if mask is not None:
            outside = ~mask[..., None]
            inside = self._distance_between(first.masked_fill(outside, 1), second.masked_fill(outside, 1))
            distances.append(inside if mask.any() else inside.new_full((), math.nan))
        return distances

    def _distance_between(self, first: Tensor, second: Tensor) -> Float[Tensor, ""]:
        assert self.distance is not None
        return self.distance(first.movedim(-1, 0)[None], second.movedim(-1, 0)[None])[0]
