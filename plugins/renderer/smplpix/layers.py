"""Convolutions for pictures on an empty ground: an empty picture is 0 in every layer.

Maps hold differences from what a layer would hold on an empty picture without end. There a convolution gives 0,
normalisation and ReLU give relu(shift), and that is subtracted again. So zero padding continues the empty ground
beyond a border in every layer, and what is far from any subject need not be computed.
"""

from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

Normalisation = Literal["batch", "renorm", "group"]
Step = Callable[[Tensor], Tensor]
EPSILON = 1e-5
SLOWEST = 0.02
"""Share of a batch in the running moments, at the least; at first they are the mean of all batches so far."""
LARGEST_RATIO, LARGEST_SHIFT = 3.0, 5.0
"""How far batch renormalisation may correct deviation and mean (Ioffe 2017, §4)."""
GROUPS = 8


class Layer(nn.Module):
    """A convolution, normalisation and ReLU, of differences from the empty ground.

    Args:
        size: side of the kernel, pixels; 3 keeps the size of the picture, 2 halves it.
        normalisation: by the moments of the batch; of the batch, but corrected to the running ones (Ioffe 2017); of
            each picture's groups of channels. The first two read running moments in evaluation.
    """

    mean: Tensor
    variance: Tensor
    batches: Tensor

    def __init__(self, channels: int, outputs: int, size: int, normalisation: Normalisation) -> None:
        super().__init__()
        self.normalisation: Normalisation = normalisation
        self.stride = 2 if size == 2 else 1
        self.weight = nn.Parameter(torch.empty(outputs, channels, size, size))
        nn.init.kaiming_normal_(self.weight, nonlinearity="relu")
        self.gain = nn.Parameter(torch.ones(outputs))
        self.offset = nn.Parameter(torch.zeros(outputs))
        self.groups = next(count for count in range(min(GROUPS, outputs), 0, -1) if outputs % count == 0)
        if normalisation != "group":
            self.register_buffer("mean", torch.zeros(outputs))
            self.register_buffer("variance", torch.ones(outputs))
            self.register_buffer("batches", torch.zeros((), dtype=torch.long))

    def forward(self, maps: Float[Tensor, "batch channels height width"]) -> Tensor:
        """As in training; in evaluation too where the moments are the picture's own."""
        return self._normalised(convolved(maps, self.weight, None, self.stride))

    def folded(self, dtype: torch.dtype) -> Step:
        """The same in evaluation: normalisation within the convolution, one pass over its numbers."""
        if self.normalisation == "group":
            weight = self.weight.to(dtype)
            return lambda maps: self._normalised(convolved(maps, weight, None, self.stride))
        scale = self.gain * torch.rsqrt(self.variance + EPSILON)
        shift = self.offset - self.mean * scale
        ground = shift.relu()
        weight = (self.weight * scale[:, None, None, None]).to(dtype, memory_format=torch.channels_last)
        bias, floor = (shift - ground).to(dtype), -ground.to(dtype)[:, None, None]
        return lambda maps: torch.maximum(convolved(maps, weight, bias, self.stride), floor)

    def _normalised(self, maps: Tensor) -> Tensor:
        scale, shift = (self._of_groups if self.normalisation == "group" else self._of_batch)(maps)
        ground = shift.relu()
        # relu(scale m + shift) - relu(shift)
        return torch.maximum(torch.addcmul((shift - ground).to(maps), maps, scale.to(maps)), -ground.to(maps))

    def _of_batch(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """Scale and shift, (channels, 1, 1), by the moments of the batch; these enter the running ones."""
        variance, mean = torch.var_mean(maps, (0, 2, 3), correction=0)
        deviation = (variance + EPSILON).sqrt()
        ratio, moved = 1.0, 0.0
        with torch.no_grad():
            if self.normalisation == "renorm" and self.batches > 0:
                usual = (self.variance + EPSILON).sqrt()
                ratio = (deviation / usual).clamp(1 / LARGEST_RATIO, LARGEST_RATIO)
                moved = ((mean - self.mean) / usual).clamp(-LARGEST_SHIFT, LARGEST_SHIFT)
            self.batches += 1
            share = max(SLOWEST, 1 / self.batches.item())
            self.mean.lerp_(mean.to(self.mean), share)
            self.variance.lerp_(variance.to(self.variance), share)
        scale = self.gain * ratio / deviation
        shift = self.offset + self.gain * moved - mean * scale
        return scale[:, None, None], shift[:, None, None]

    def _of_groups(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """Scale and shift, (batch, channels, 1, 1), by the moments of each picture's groups of channels."""
        grouped = maps.unflatten(1, (self.groups, -1))
        variance, mean = torch.var_mean(grouped, (2, 3, 4), correction=0)
        each = maps.shape[1] // self.groups
        scale = self.gain * torch.rsqrt(variance + EPSILON).repeat_interleave(each, 1)
        shift = self.offset - mean.repeat_interleave(each, 1) * scale
        return scale[..., None, None], shift[..., None, None]


def convolved(maps: Tensor, weight: Tensor, bias: Tensor | None, stride: int = 1) -> Tensor:
    return functional.conv2d(maps, weight, bias, stride, padding=weight.shape[-1] // 2 if stride == 1 else 0)
