"""The Laplace image head: an image, and how far off each of its numbers may be."""

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.nn.functional import hardtanh

from framework.density_head import DensityHead
from framework.heads.parameters import require_finite
from framework.target import Target
from plugins.density_head.laplace_image.density import LaplaceImage

FURTHEST = 1e6
"""Locations are cut off here, so that no sum over an image overflows."""
SMALLEST_SCALE, LARGEST_SCALE = 1e-4, 1e6
"""A step of 8 bits is 4e-3: no scale below a fortieth of it says anything about a stored picture."""


class LaplaceImageHead(DensityHead):
    """Laplace densities over the numbers of an image (`LaplaceImage`); it reads an image as an encoder gives it.

    Features are (channel, height, width): first the image, one channel for each of the target's, then log-scales. The
    loss is the mean over the numbers of an image, nats a number, so that it does not grow with the image; with one
    fixed scale it is the L1 distance and a constant.

    Args:
        scale: "fixed": one b for all images and pixels, 1 in training, fitted to the validation split; "pixel": one
            predicted for each pixel, "number": for each number, trained by likelihood and multiplied by one factor
            that is fitted to the validation split.
        floor: added to every predicted scale. Files hold steps of 8 bits, and where a picture is exactly white the
            likelihood would be the higher the narrower, until one wrong pixel outweighs a whole picture: half a step,
            0.002, ends that.
        foreground: how much more a pixel counts in the loss where the true image is not white (1 in all channels):
            most of a picture of a person is background, and white everywhere is a good first answer.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {}
    direct: ClassVar[bool] = True
    bibtex = """@inproceedings{kendall2017uncertainties,
  title = {What Uncertainties Do We Need in {B}ayesian Deep Learning for Computer Vision?},
  author = {Kendall, Alex and Gal, Yarin},
  booktitle = {Advances in Neural Information Processing Systems (NeurIPS)},
  year = {2017}
}"""

    factor: Tensor

    def __init__(
        self,
        target: Target,
        *,
        scale: Literal["fixed", "pixel", "number"] = "fixed",
        floor: Annotated[float, Field(ge=0, le=1)] = 0.0,
        foreground: Annotated[float, Field(ge=1, le=1e3)] = 1.0,
    ) -> None:
        super().__init__()
        target.require("image", by="density_head laplace_image")
        self.numbers = len(target.names)
        self.scales = {"fixed": 0, "pixel": 1, "number": self.numbers}[scale]
        self.shape = (self.numbers + self.scales, *target.size)
        self.size = math.prod(self.shape)
        self.floor = floor
        self.foreground = foreground
        self.register_buffer("factor", torch.ones((), dtype=torch.float64))

    def forward(self, raw: Float[Tensor, "*batch size"]) -> LaplaceImage:
        location, scale = self._parts(raw)
        return LaplaceImage(location, (scale * self.factor.to(scale)).clamp(SMALLEST_SCALE, LARGEST_SCALE))

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        # before what calibrate fits: it is the same loss whenever it is asked
        each = -LaplaceImage(*self._parts(raw)).each_log_prob(target)
        if self.foreground != 1:
            weight = 1 + (self.foreground - 1) * (target < 1).any(-1, keepdim=True).to(each)
            return (each * weight).mean((-3, -2, -1)) / weight.mean((-3, -2, -1))
        return each.mean((-3, -2, -1))

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        # the most likely factor of all scales: the mean of |y - μ|/b
        if len(raw) == 0:
            raise ValueError(
                "the scale of an image's numbers is fitted to validation data, but got none of it."
            )
        total = sum(
            ((value - location).abs() / scale).double().mean()
            for value, (location, scale) in zip(target, map(self._parts, raw), strict=True)
        )
        self.factor.copy_(torch.as_tensor(total / len(raw)).clamp(SMALLEST_SCALE, LARGEST_SCALE))

    def _parts(self, raw: Float[Tensor, "*batch size"]) -> tuple[Tensor, Tensor]:
        """Locations (*batch, height, width, number) and scales, broadcastable, before calibration."""
        image = require_finite(raw, self.size).unflatten(-1, self.shape).movedim(-3, -1)
        location = hardtanh(image[..., : self.numbers], -FURTHEST, FURTHEST)
        if not self.scales:
            return location, location.new_ones(())
        log_scale = hardtanh(image[..., self.numbers :], math.log(SMALLEST_SCALE), math.log(LARGEST_SCALE))
        return location, log_scale.exp() + self.floor
