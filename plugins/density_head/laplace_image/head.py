"""The Laplace image head: an image, and the scale of the error of each of its numbers."""

import math
from typing import Annotated, ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor
from torch.nn.functional import hardtanh

from framework.density_head import DensityHead
from framework.heads.parameters import require_finite, require_validation
from framework.storage.weights import require_state
from framework.target import Target
from plugins.density_head.laplace_image.density import LaplaceImage

FURTHEST = 1e6
"""Bound to which locations are clamped, so that no sum over an image overflows."""
SMALLEST_SCALE, LARGEST_SCALE = 1e-4, 1e6
"""Bounds on scales; a scale below a fortieth of a step of an 8-bit image (4e-3) carries no information."""
WHITE = 1 - 0.5 / 255
"""Value above which an 8-bit file stores a number as 1.

White that was rounded in a conversion between linear RGB and sRGB is therefore not read as foreground.
"""


class LaplaceImageHead(DensityHead):
    """Laplace densities over the numbers of an image (`LaplaceImage`), read from an image of an encoder.

    Features are (channel, height, width): first the image, with one channel for each channel of the target, then
    log-scales. The loss is the mean over the numbers of an image, in nats per number, so that it does not grow with the
    size of the image. With one fixed scale the loss is the L1 distance plus a constant.

    Args:
        scale: "fixed": one scale b for all images and pixels, which is 1 in training and is fitted to the validation
            split; "pixel": a predicted scale for each pixel; "number": a predicted scale for each number of each pixel.
            Predicted scales are trained by likelihood and multiplied by one factor that is fitted to the validation
            split.
        cover: probability c of the central intervals to which the factor is fitted: a share c of the validation
            split's numbers, in pixels that are not white, lies in these intervals (split conformal prediction). null:
            the most likely factor over all pixels. That factor suits predicted scales badly: three quarters of an image
            of a person are background, whose errors are far smaller than any useful scale, and they make the factor too
            small for the person.
        balance: β of Seitzer et al. 2022: the gradient of each number, not the loss, is multiplied by the number's
            scale to the power β. With 0 (the likelihood alone) a location is learned more slowly the wider its scale
            is, so that large errors persist. With 1 all locations are learned as with the L1 distance.
        floor: constant that is added to every predicted scale. Where an image is exactly white, the likelihood would
            otherwise grow without end as the scale shrinks, until one wrong pixel outweighs a whole image. Half a step
            of an 8-bit image, 0.002, prevents that.
        foreground: weight in the loss of pixels where the true image is not white, relative to white pixels. A pixel
            is white if an 8-bit file stores 1 in all channels. Most of an image of a person is background, so that
            without a weight the network may predict white everywhere.
    """

    direct: ClassVar[bool] = True
    bibtex = "kendall2017uncertainties, seitzer2022pitfalls"

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
        self.image_size = target.size
        self.size = math.prod(self.raw_shape)
        self.cover = cover
        self.balance = balance
        self.floor = floor
        self.foreground = foreground
        self.register_buffer("factor", torch.ones((), dtype=torch.float64))
        require_state(self, factor=(SMALLEST_SCALE, LARGEST_SCALE))

    @property
    def raw_shape(self) -> tuple[int, ...]:
        """Shape of the features that the head reads: (channel, height, width)."""
        return (self.numbers + self.scales, *self.image_size)

    def forward(self, raw: Float[Tensor, "*batch channel height width"]) -> LaplaceImage:
        """Return the density for raw parameters."""
        location, scale = self._parts(raw)
        return LaplaceImage(location, (scale * self.factor.to(scale)).clamp(SMALLEST_SCALE, LARGEST_SCALE))

    def loss(
        self, raw: Float[Tensor, "*batch channel height width"], target: Tensor
    ) -> Float[Tensor, "*batch"]:
        """Return the weighted mean negative log-density of the numbers of each image, nats per number."""
        # without the calibrated factor, so that the loss does not change with calibration
        density = LaplaceImage(*self._parts(raw))
        losses = -density.each_log_prob(target)
        if self.balance:
            share = density.scale.detach() ** self.balance
            losses = share * losses + ((1 - share) * losses).detach()
        if self.foreground != 1:
            weight = 1 + (self.foreground - 1) * coloured(target).to(losses)
            return (losses * weight).mean((-3, -2, -1)) / weight.mean((-3, -2, -1))
        return losses.mean((-3, -2, -1))

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch channel height width"], target: Tensor) -> None:
        """Fit the factor by which all scales are multiplied to the validation split."""
        require_validation(raw, "The scale of an image's numbers is")
        parts = zip(target, map(self._parts, raw), strict=True)
        distances = (((value - location).abs() / scale) for value, (location, scale) in parts)
        if self.cover is None:
            # the most likely factor of all scales: the mean of |y - μ|/b
            factor = sum(distance.double().mean() for distance in distances) / len(raw)
        else:
            # |y - μ|/b is exponential: its quantile of mass c is -log(1 - c)
            pairs = zip(distances, target, strict=True)
            inside = torch.cat([distance[coloured(true).expand_as(distance)] for distance, true in pairs])
            if len(inside) == 0:
                raise ValueError(
                    "density_head.cover is fitted to pixels that are not white, but all pixels of the validation split "
                    "are white. Set density_head.cover=null."
                )
            rank = min(len(inside), math.ceil(self.cover * (len(inside) + 1)))
            factor = inside.kthvalue(rank).values.double() / -math.log1p(-self.cover)
        self.factor.copy_(torch.as_tensor(factor).clamp(SMALLEST_SCALE, LARGEST_SCALE))

    def _parts(self, raw: Float[Tensor, "*batch channel height width"]) -> tuple[Tensor, Tensor]:
        """Return the locations, (*batch, height, width, number), and the scales before calibration.

        The scales broadcast to the locations.
        """
        # a network in training gives channels last; sums over an image then have another order and other last bits
        image = require_finite(raw, self.raw_shape).contiguous().movedim(-3, -1)
        location = hardtanh(image[..., : self.numbers], -FURTHEST, FURTHEST)
        if not self.scales:
            return location, location.new_ones(())
        log_scale = hardtanh(image[..., self.numbers :], math.log(SMALLEST_SCALE), math.log(LARGEST_SCALE))
        return location, log_scale.exp() + self.floor


def coloured(image: Float[Tensor, "*batch number"]) -> Bool[Tensor, "*batch 1"]:
    """Return a mask of the pixels that are not white: an 8-bit file stores at least one of their channels below 1."""
    return (image < WHITE).any(-1, keepdim=True)
