"""Density whose images show a ball, for checks of metrics that read predicted images."""

from collections.abc import Collection
from typing import ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.distributions.batch_shapes import Reshaped
from framework.distributions.density import Mixture
from framework.distributions.protocol import images

CHANNELS = frozenset({"color", "mask", "depth"})


def ball(place: Tensor, size: tuple[int, int], channels: Collection[str] = CHANNELS) -> dict[str, Tensor]:
    """Return images of a ball whose position depends on `place`.

    For each unit of `place`, the ball moves by an eighth of the image's width or height.

    Args:
        place: Location of a density, (batch, number). The first number moves the ball to the right, the last one
            downwards.
        size: Height and width of the images, pixels.
        channels: Names of the channels to draw.

    Returns:
        Channel → images, (batch, height, width) or, for colour, (batch, height, width, 3).
    """
    height, width = size
    row, column = ((torch.arange(side, device=place.device) + 0.5) / side for side in size)
    across, down = (
        (side - 0.5 - place[:, number, None].float() / 8) * length / min(size)
        for side, number, length in ((column, 0, width), (row, -1, height))
    )
    bulge = 0.3**2 - across[:, None, :].square() - down[:, :, None].square()
    mask = bulge >= 0
    shade = torch.stack(
        [0.2 + 8 * bulge, 0.5 + across[:, None, :].expand_as(bulge), torch.full_like(bulge, 0.3)], -1
    )
    channel_images = {
        "color": torch.where(mask[..., None], shade, 0.0).clamp(0, 1),
        "mask": mask,
        "depth": torch.where(mask, 3 - bulge.clamp(min=0).sqrt(), torch.inf),
    }
    return {channel: channel_images[channel] for channel in sorted(channels)}


class Ball(Mixture):
    """Density that equals a given one to the last bit, and whose images show a ball.

    Args:
        density: Density of batch_shape (batch,).
        place: Location of each density, (batch, number), which determines where its ball is (`ball`).
        size: Height and width of the images, pixels.

    Attributes:
        requested_channels: Channels of each call of `images`, in order.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, density: Distribution, place: Tensor, size: tuple[int, int]) -> None:
        self.place = place
        self.size = size
        self.requested_channels: list[frozenset[str]] = []
        shape = (*density.batch_shape, 1)
        super().__init__(place.new_zeros(shape), Reshaped(density, shape))


@images.register
def _(density: Ball, channels: Collection[str]) -> dict[str, Tensor]:
    density.requested_channels.append(frozenset(channels))
    return ball(density.place, density.size, channels)
