"""The Laplace image head: an image, and the scale of the error of each of its numbers."""

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor
from torch.nn.functional import hardtanh

from framework.density_head import DensityHead
from framework.heads.parameters import require_finite
from framework.storage.weights import require_state
from framework.target import Target
from plugins.density_head.laplace_image.density import LaplaceImage

FURTHEST = 1e6
"""Bound to which locations are clamped, so that no sum over an image overflows."""
SMALLEST_SCALE, LARGEST_SCALE = 1e-4, 1e6
"""Bounds on scales. A step of 8 bits is 4e-3: a scale below a fortieth of it carries no information."""
WHITE = 1 - 0.5 / 255
"""Value above which a number is stored as 1: rounding of white between linear RGB and sRGB makes no foreground."""


class LaplaceImageHead(DensityHead):
    """Laplace densities over the numbers of an image (`LaplaceImage`), read from an image of an encoder.

    Features are (channel, height, width): first the image, one channel for each of the target's, then log-scales. The
    loss is the mean over the numbers of an image, in nats per number, so that it does not grow with the image. With one
    fixed scale it is the L1 distance and a constant.

    Args:
        scale: "fixed": one b for all images and pixels, 1 in training, fitted to the validation split; "pixel": one
            predicted for each pixel, "number": for each number. Predicted scales are trained by likelihood and
            multiplied by one factor that is fitted to the validation split.
        cover: mass of the central intervals that the factor is fitted to: this share of the validation split's numbers,
            in pixels that are not white, lies in their intervals (split conformal prediction). null: the most likely
            factor, of all pixels. For scales of each pixel that factor is a bad one: three quarters of an image of a
            person are a background with errors far smaller than any useful scale, and the factor makes the person's
            scales too small with them.
        balance: β of Seitzer et al. 2022: the gradient of each number, not the loss, is multiplied by its scale to this
            power. By likelihood alone (0) a location is learned more slowly if its scale is wider, so that large errors
            persist. At 1 all locations are learned as by the L1 distance.
        floor: constant that is added to every predicted scale. Files hold steps of 8 bits. Where an image is exactly
            white the likelihood would grow as the scale shrinks, until one wrong pixel outweighs a whole image. Half a
            step, 0.002, prevents that.
        foreground: weight in the loss of pixels where the true image is not white (1 in all channels, as 8 bits store
            it), relative to white ones. Most of an image of a person is background, and white everywhere is a good
            first prediction.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {}
    direct: ClassVar[bool] = True
    bibtex = """@inproceedings{kendall2017uncertainties,
  title = {What Uncertainties Do We Need in {B}ayesian Deep Learning for Computer Vision?},
  author = {Kendall, Alex and Gal, Yarin},
  booktitle = {Advances in Neural Information Processing Systems (NeurIPS)},
  year = {2017}
}
@inproceedings{seitzer2022pitfalls,
  title = {On the Pitfalls of Heteroscedastic Uncertainty Estimation with Probabilistic Neural Networks},
  author = {Seitzer, Maximilian and Tavakoli, Arash and Antic, Dimitrije and Martius, Georg},
  booktitle = {International Conference on Learning Representations (ICLR)},
  year = {2022}
}"""

    factor: Tensor

    def __init__(
        self,
        target: Target,
        *,
        scale: Literal["fixed", "pixel", "number"] = "fixed",
        cover: Annotated[float, Field(gt=0, lt=1)] | None = None,
        balance: Annotated[float, Field(ge=0, le=1)] = 0.0,
        floor: Annotated[float, Field(ge=0, le=1)] = 0.0,
        foreground: Annotated[float, Field(ge=1, le=1e3)] = 1.0,
    ) -> None:
        super().__init__()
        target.require("image", by="density_head laplace_image")
        self.numbers = len(target.names)
        self.scales = {"fixed": 0, "pixel": 1, "number": self.numbers}[scale]
        self.shape = (self.numbers + self.scales, *target.size)
        self.size = math.prod(self.shape)
        self.cover = cover
        self.balance = balance
        self.floor = floor
        self.foreground = foreground
        self.register_buffer("factor", torch.ones((), dtype=torch.float64))
        require_state(self, factor=(SMALLEST_SCALE, LARGEST_SCALE))

    def forward(self, raw: Float[Tensor, "*batch size"]) -> LaplaceImage:
        """Return the density for raw parameters."""
        location, scale = self._parts(raw)
        return LaplaceImage(location, (scale * self.factor.to(scale)).clamp(SMALLEST_SCALE, LARGEST_SCALE))

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """Return the weighted mean negative log-density of the numbers of each image, nats per number."""
        # without the calibrated factor, so that the loss does not change with calibration
        density = LaplaceImage(*self._parts(raw))
        each = -density.each_log_prob(target)
        if self.balance:
            share = density.scale.detach() ** self.balance
            each = share * each + ((1 - share) * each).detach()
        if self.foreground != 1:
            weight = 1 + (self.foreground - 1) * coloured(target).to(each)
            return (each * weight).mean((-3, -2, -1)) / weight.mean((-3, -2, -1))
        return each.mean((-3, -2, -1))

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        """Fit the factor of the scales to the validation split."""
        if len(raw) == 0:
            raise ValueError(
                "the scale of an image's numbers is fitted to validation data, but got none of it."
            )
        parts = zip(target, map(self._parts, raw), strict=True)
        each = (((value - location).abs() / scale) for value, (location, scale) in parts)
        if self.cover is None:
            # the most likely factor of all scales: the mean of |y - μ|/b
            found = sum(distance.double().mean() for distance in each) / len(raw)
        else:
            # |y - μ|/b is exponential: its quantile of mass c is -log(1 - c)
            pairs = zip(each, target, strict=True)
            inside = torch.cat([distance[coloured(true).expand_as(distance)] for distance, true in pairs])
            if len(inside) == 0:
                raise ValueError(
                    "`cover` is fitted to pixels that are not white, but there is none in the validation data."
                )
            rank = min(len(inside), math.ceil(self.cover * (len(inside) + 1)))
            found = inside.kthvalue(rank).values.double() / -math.log1p(-self.cover)
        self.factor.copy_(torch.as_tensor(found).clamp(SMALLEST_SCALE, LARGEST_SCALE))

    def _parts(self, raw: Float[Tensor, "*batch size"]) -> tuple[Tensor, Tensor]:
        """Return locations (*batch, height, width, number) and scales, broadcastable, before calibration."""
        image = require_finite(raw, self.size).unflatten(-1, self.shape).movedim(-3, -1)
        location = hardtanh(image[..., : self.numbers], -FURTHEST, FURTHEST)
        if not self.scales:
            return location, location.new_ones(())
        log_scale = hardtanh(image[..., self.numbers :], math.log(SMALLEST_SCALE), math.log(LARGEST_SCALE))
        return location, log_scale.exp() + self.floor


def coloured(image: Float[Tensor, "*batch number"]) -> Bool[Tensor, "*batch 1"]:
    """Return which pixels are not white once they are stored."""
    return (image < WHITE).any(-1, keepdim=True)
