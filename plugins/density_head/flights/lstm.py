"""A recurrent network that predicts a flight frame by frame; each prediction is the input of the next one."""

import math
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.density_head import DensityHead
from framework.distributions.normals import IndependentNormals
from framework.flights.frames import PARTS, future_frames
from framework.heads.parameters import require_finite
from framework.target import Target

FARTHEST = 100.0
"""Bound to which the absolute values of the inputs, metres or seconds, are clamped."""
LEAST, WIDEST = 1e-4, 1e3
"""Smallest and largest standard deviation, metres."""


class LSTMHead(DensityHead):
    """LSTM over the observed and then the future frames (Hochreiter & Schmidhuber 1997; reference [121] of the thesis).

    At each frame the network predicts the ball's displacement to the next frame. At each future frame it also predicts
    the standard deviations of the coordinates of this frame. If the next frame is missing or in the future, the network
    reads the position that it predicted for this frame. So errors accumulate with time, which this head is meant to
    demonstrate. The coordinates of a frame are independent and normal; the head is trained by likelihood.

    Args:
        observed: number of frames of an input; the same value as in the config of the data.
        hidden: width of the network.
    """

    direct = True
    bibtex = "hochreiter1997long"

    def __init__(
        self,
        target: Target,
        *,
        observed: Annotated[int, Field(ge=2, le=1000)] = 20,
        hidden: Annotated[int, Field(ge=1)] = 64,
    ) -> None:
        super().__init__()
        target.require("real", by="density_head lstm")
        self.future = future_frames(target.names, by="density_head lstm")
        self.observed = observed
        self.size = observed * len(PARTS)
        self.cell = nn.LSTMCell(7, hidden)  # position, last displacement, and whether the ball was seen
        self.out = nn.Linear(hidden, 6)

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """Return the density for raw parameters."""
        raw = require_finite(raw, self.size)
        flat = (
            raw.reshape(math.prod(raw.shape[:-1]), self.size)
            .to(self.out.weight.dtype)
            .clamp(-FARTHEST, FARTHEST)
        )
        frames = flat.unflatten(-1, (self.observed, len(PARTS)))
        place, move = frames.new_zeros(flat.shape[0], 3), frames.new_zeros(flat.shape[0], 3)
        begun = frames.new_zeros(flat.shape[0], 1)
        state = None
        for frame in frames.unbind(1):
            visible = (frame[:, 4:] > 0.5).to(frames.dtype)
            expected = place + move
            now = torch.where(visible > 0, frame[:, 1:4], expected)
            # the first frame that is seen has no known displacement
            moved = begun * (now - place)
            begun = torch.maximum(begun, visible)
            place = begun * now
            move, _, state = self._next(place, moved, visible, state)
            move = begun * move
        places, widths = [], []
        unseen = torch.zeros_like(begun)
        for _ in range(self.future):
            place = (place + move).clamp(-FARTHEST, FARTHEST)
            places.append(place)
            last, width, state = self._next(place, move, unseen, state)
            move = last
            widths.append(width)
        shape = (*raw.shape[:-1], 3 * self.future)
        mean, scale = (torch.stack(part, 1).reshape(shape) for part in (places, widths))
        return IndependentNormals(require_finite(mean, shape[-1]), require_finite(scale, shape[-1]))

    def _next(
        self, place: Tensor, move: Tensor, visible: Tensor, state: tuple[Tensor, Tensor] | None
    ) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
        """Return the displacement to the next frame, standard deviations, (batch, 3) each, and the network's new state.

        The standard deviations are those of the coordinates of the current frame, if it is a future frame.

        Args:
            place: position at the current frame, (batch, 3).
            move: displacement from the frame before.
            visible: 1 if the current frame was observed, 0 if its position is predicted.
            state: state of the network before this frame; None at the first frame.
        """
        hidden, memory = self.cell(torch.cat([place, 10 * move, visible], -1), state)
        numbers = self.out(hidden)
        # a frame's displacement is about a tenth of a metre; the network predicts the change of the last displacement
        width = (0.05 * nn.functional.softplus(numbers[:, 3:])).clamp(max=WIDEST) + LEAST
        return move + 0.1 * numbers[:, :3], width, (hidden, memory)
