"""The Bernoulli image head: the probability that each number of an image is 1 and not 0."""

import math
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import hardtanh

from framework.density_head import DensityHead
from framework.heads.parameters import require_finite, require_validation
from framework.storage.weights import require_state
from framework.target import Target
from plugins.density_head.bernoulli_image.density import BernoulliImage

SMALLEST = 1e-3
"""Smallest probability; the largest is 1 - SMALLEST.

The log-probability of a number is therefore at least log SMALLEST, about -7 nats, before calibration. A step of an
8-bit image is 4e-3, so that smaller probabilities carry no information about an image.
"""
LEAST, MOST, ROUNDS = 1e-2, 1e2, 60
"""Bounds of the factor by which calibration multiplies the log-odds, and number of bisections that find this factor."""


class BernoulliImageHead(DensityHead):
    """Bernoulli densities over the numbers of an image (`BernoulliImage`), read from an image on white background.

    Features are (channel, height, width), with one channel for each channel of the target. A feature of 1 is the white
    of the background, where the number is almost certainly 0; a feature of 0 is black, where the number is almost
    certainly 1. Features outside [0, 1] are clamped. The loss is the cross-entropy in nats per number, so that it does
    not grow with the size of the image. One factor on all log-odds, an inverse temperature (Guo et al. 2017), is fitted
    to the validation split.
    """

    direct: ClassVar[bool] = True
    bibtex = "guo2017calibration"

    factor: Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("image", by="density_head bernoulli_image")
        self.target = target
        self.size = math.prod(self.raw_shape)
        self.register_buffer("factor", torch.ones((), dtype=torch.float64))
        require_state(self, factor=(LEAST / 2, 2 * MOST))

    @property
    def raw_shape(self) -> tuple[int, ...]:
        """Shape of the features that the head reads: (channel, height, width)."""
        return (len(self.target.names), *self.target.size)

    def forward(self, raw: Float[Tensor, "*batch channel height width"]) -> BernoulliImage:
        """Return the density for raw parameters."""
        logits = self._logits(raw)
        return BernoulliImage(logits * self.factor.to(logits))

    def loss(
        self, raw: Float[Tensor, "*batch channel height width"], target: Tensor
    ) -> Float[Tensor, "*batch"]:
        """Return the mean cross-entropy of the numbers of each image, nats per number."""
        # without the calibrated factor, so that the loss does not change with calibration
        return -BernoulliImage(self._logits(raw)).each_log_prob(target).mean((-3, -2, -1))

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch channel height width"], target: Tensor) -> None:
        """Fit the factor by which all log-odds are multiplied, by maximum likelihood."""
        # the log-likelihood is concave in the factor, so that its derivative has a single zero
        require_validation(raw, "The factor of the log-odds is")
        low, high = math.log(LEAST), math.log(MOST)
        for _ in range(ROUNDS):
            middle = (low + high) / 2
            rising = self._slope(raw, target, math.exp(middle)) > 0
            low, high = (middle, high) if rising else (low, middle)
        self.factor.fill_(math.exp((low + high) / 2))

    def _slope(self, raws: Tensor, target: Tensor, factor: float) -> float:
        """Return the derivative of the log-likelihood with respect to the factor f of the log-odds: Σ r (y - σ(f r)).

        The sum is over all numbers y in `target`, with their log-odds r before calibration; σ is the logistic function.
        It is computed image by image.
        """
        total = 0.0
        for raw, value in zip(raws, target, strict=True):
            logits = self._logits(raw).double()
            total += float((logits * (value.double().clamp(0, 1) - (factor * logits).sigmoid())).sum())
        return total

    def _logits(
        self, raw: Float[Tensor, "*batch channel height width"]
    ) -> Float[Tensor, "*batch height width number"]:
        # a network in training gives channels last; sums over an image then have another order and other last bits
        image = require_finite(raw, self.raw_shape).contiguous().movedim(-3, -1)
        # log((1 - w) / w) for the feature w, in float64, because near 1 a float32 has too few digits of 1 - w
        return -hardtanh(image.double(), SMALLEST, 1 - SMALLEST).logit().to(image.dtype)
