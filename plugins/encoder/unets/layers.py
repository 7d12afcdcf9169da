"""Convolutions for pictures on an empty ground: an empty picture is 0 in every layer.

Maps hold differences from what a layer would hold on an empty picture without end. There a convolution gives 0,
normalisation and ReLU give relu(shift), and that is subtracted again. So zero padding continues the empty ground
beyond a border in every layer, and what is far from any subject need not be computed.
"""

from collections.abc import Callable
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
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
        if self.normalisation != "group":
            return self._of_batch(maps)
        scale, shift = self._of_groups(maps)
        ground = shift.relu()
        # relu(scale m + shift) - relu(shift)
        return torch.maximum(torch.addcmul((shift - ground).to(maps), maps, scale.to(maps)), -ground.to(maps))

    def _of_batch(self, maps: Tensor) -> Tensor:
        """By the moments of the batch; these enter the running ones."""
        with torch.no_grad():
            # not torch.native_batch_norm: where channels lie last its sums lose digits to a large mean
            kind, count = self.gain.dtype, maps.numel() // maps.shape[1]
            mean = _sum(maps, kind) / count
            standard = maps - _channels(mean, maps)
            variance = _sum(standard.square(), kind) / count
            deviation = (variance + EPSILON).sqrt()
            standard *= _channels(deviation.reciprocal(), maps)
            ratio, moved = torch.ones_like(mean), torch.zeros_like(mean)
            if self.normalisation == "renorm" and self.batches > 0:
                usual = (self.variance + EPSILON).sqrt()
                ratio = (deviation / usual).clamp(1 / LARGEST_RATIO, LARGEST_RATIO)
                moved = ((mean - self.mean) / usual).clamp(-LARGEST_SHIFT, LARGEST_SHIFT)
            self.batches += 1
            share = max(SLOWEST, 1 / self.batches.item())
            self.mean.lerp_(mean.to(self.mean), share)
            self.variance.lerp_(variance.to(self.variance), share)
        answer: Tensor = FromGround.apply(
            maps,
            self.gain * ratio,
            self.offset + self.gain * moved,
            standard,
            mean,
            deviation.reciprocal(),
        )
        return answer

    def _of_groups(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """Scale and shift, (batch, channels, 1, 1), by the moments of each picture's groups of channels."""
        grouped = maps.unflatten(1, (self.groups, -1))
        variance, mean = torch.var_mean(grouped, (2, 3, 4), correction=0)
        each = maps.shape[1] // self.groups
        scale = self.gain * torch.rsqrt(variance + EPSILON).repeat_interleave(each, 1)
        shift = self.offset - mean.repeat_interleave(each, 1) * scale
        return scale[..., None, None], shift[..., None, None]


class FromGround(torch.autograd.Function):
    """relu(gain s + offset) less what that is on the empty ground, where maps are 0; s are the maps, standardised.

    Written by hand, since autograd of the same formula goes over the maps many times more. The moments, of the maps and
    of the ground, are functions of the maps.
    """

    @staticmethod
    def forward(
        ctx: Any, maps: Tensor, gain: Tensor, offset: Tensor, standard: Tensor, mean: Tensor, inverse: Tensor
    ) -> Tensor:
        """`standard`, `mean` and `inverse` (of the deviation) are those of the maps over all but channels."""
        shift = offset - gain * mean * inverse
        ground = shift.relu()
        upper, factor, floor = ((offset - ground), gain, -ground)
        answer = torch.addcmul(_channels(upper, maps), standard, _channels(factor, maps))
        answer = torch.maximum(answer, _channels(floor, maps))
        ctx.save_for_backward(answer, standard, gain, mean, inverse, shift)
        return answer

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        answer, standard, gain, mean, inverse, shift = ctx.saved_tensors
        count = slope.numel() // slope.shape[1]
        of_ground = -_sum(slope, gain.dtype) * (shift > 0)
        slope = slope * (answer > _channels(-shift.relu(), answer))
        of_offset, of_gain = _sum(slope, gain.dtype), _sum(slope * standard, gain.dtype)
        # how the answer moves with mean and inverse by the ground alone; by s both are in the usual formula
        of_mean, of_inverse = -of_ground * gain * inverse, -of_ground * gain * mean
        constant = (of_mean - gain * inverse * of_offset) / count
        standardised = -(gain * inverse * of_gain + of_inverse * inverse.square()) / count
        of_maps = torch.addcmul(_channels(constant, slope), slope, _channels(gain * inverse, slope))
        of_maps = torch.addcmul(of_maps, standard, _channels(standardised, slope))
        return of_maps, of_gain - of_ground * mean * inverse, of_offset + of_ground, None, None, None


def _channels(values: Tensor, maps: Tensor) -> Tensor:
    return values.to(maps.dtype)[:, None, None]


def _sum(maps: Tensor, kind: torch.dtype) -> Float[Tensor, " channels"]:
    """Over all but channels; by rows, which lie one behind the other where channels lie last."""
    return maps.permute(0, 2, 3, 1).reshape(-1, maps.shape[1]).sum(0, dtype=kind)


def convolved(maps: Tensor, weight: Tensor, bias: Tensor | None, stride: int = 1) -> Tensor:
    return functional.conv2d(maps, weight, bias, stride, padding=weight.shape[-1] // 2 if stride == 1 else 0)
