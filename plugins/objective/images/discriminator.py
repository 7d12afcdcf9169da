"""Discriminators that give a score to every patch of an image: near 1 for true images, near 0 for predicted ones."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, leaky_relu

STEEP = 0.2
"""Slope of the leaky ReLU below 0."""


class PatchDiscriminator(nn.Module):
    """A discriminator of overlapping patches at one scale (Isola et al. 2017, §3.2.2; Wang et al. 2018, §3.2).

    Args:
        width: channels of the first layer; each further layer has twice as many, at most eight times as many.
        layers: number of layers of stride 2; with three layers a patch has 70 × 70 pixels.
    """

    def __init__(self, width: int, layers: int) -> None:
        super().__init__()
        widths = [3, *(width * min(2**layer, 8) for layer in range(layers + 1)), 1]
        steps = [2] * layers + [1, 1]
        self.layers = nn.ModuleList(
            nn.Conv2d(channels, next_channels, 4, step, padding=2)
            for (channels, next_channels), step in zip(pairwise(widths), steps, strict=True)
        )

    def forward(self, images: Float[Tensor, "image 3 height width"]) -> list[Tensor]:
        """Return the output of each layer; the last one is the score of each patch, trained to be 1 for true images."""
        outputs = []
        for number, layer in enumerate(self.layers):
            images = layer(images)
            if number + 1 < len(self.layers):
                images = leaky_relu(normalise(images) if number else images, STEEP)
            outputs.append(images)
        return outputs


def normalise(features: Float[Tensor, "image channel height width"]) -> Tensor:
    """Normalise each channel of each image to mean 0 and variance 1 (Ulyanov et al. 2016)."""
    centred = features - features.mean((-2, -1), keepdim=True)
    return centred * (centred.square().mean((-2, -1), keepdim=True) + 1e-5).rsqrt()


class Discriminators(nn.Module):
    """Patch discriminators at several scales, each with half the resolution of the previous one.

    Args:
        scales: number of discriminators.
        width: channels of the first layer of each discriminator.
        layers: number of layers of stride 2 of each discriminator.
    """

    def __init__(self, scales: int, width: int, layers: int) -> None:
        super().__init__()
        self.scales = nn.ModuleList(PatchDiscriminator(width, layers) for _ in range(scales))

    def forward(self, images: Float[Tensor, "image 3 height width"]) -> list[list[Tensor]]:
        """Return, for each scale, the outputs of all layers of its `PatchDiscriminator`."""
        outputs = []
        for number, discriminator in enumerate(self.scales):
            if number:
                images = avg_pool2d(images, 3, 2, padding=1, count_include_pad=False)
            outputs.append(discriminator(images))
        return outputs


def build_discriminators(scales: int, width: int, layers: int, seed: int) -> Discriminators:
    """Return `Discriminators` with the given arguments, whose initial weights depend only on `seed`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Discriminators(scales, width, layers)
