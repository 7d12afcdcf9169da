"""Convolutions for images on an empty ground: an empty image is 0 in every layer.

Maps hold differences from the values that a layer would have on an infinite empty image. On that image a convolution
gives 0, and normalisation and ReLU give relu(shift), which is subtracted again. Zero padding therefore continues the
empty ground beyond a border in every layer, and regions far from any subject need not be computed.
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
"""Smallest share of a batch in the running moments; at first they are the mean of all batches so far."""
LARGEST_RATIO, LARGEST_SHIFT = 3.0, 5.0
"""Bounds on the correction of deviation and mean by batch renormalisation (Ioffe 2017, §4)."""
GROUPS = 8


class Layer(nn.Module):
    """A convolution, normalisation and ReLU of differences from the empty ground.

    Args:
        size: side of the kernel, pixels; 3 keeps the size of the image, 2 halves it.
        normalisation: "batch" normalises by the moments of the batch; "renorm" by those of the batch, corrected to the
            running ones (Ioffe 2017); "group" by the moments of each image's groups of channels. The first two use
            running moments in evaluation.
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
        """Return the maps after the layer as in training; "group" normalisation is the same in evaluation."""
        return self._normalised(convolved(maps, self.weight, None, self.stride))

    def folded(self, dtype: torch.dtype) -> Step:
        """Return the layer as a function for evaluation, with normalisation folded into the convolution."""
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
        """Return maps normalised by the moments of the batch, after ReLU, and update the running moments."""
        with torch.no_grad():
            # not torch.native_batch_norm: with channels last its sums lose digits if the mean is large
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
        """Return scale and shift, (batch, channels, 1, 1), from the moments of each image's groups of channels."""
        grouped = maps.unflatten(1, (self.groups, -1))
        variance, mean = torch.var_mean(grouped, (2, 3, 4), correction=0)
        each = maps.shape[1] // self.groups
        scale = self.gain * torch.rsqrt(variance + EPSILON).repeat_interleave(each, 1)
        shift = self.offset - mean.repeat_interleave(each, 1) * scale
        return scale[..., None, None], shift[..., None, None]


class FromGround(torch.autograd.Function):
    """The function relu(gain s + offset) less its value on the empty ground, where s are the standardised maps.

    The maps are 0 on the empty ground. The gradient is written by hand, since autograd of the same formula makes many
    more passes over the maps. The moments are functions of the maps, and so is the value on the ground.
    """

    @staticmethod
    def forward(
        ctx: Any, maps: Tensor, gain: Tensor, offset: Tensor, standard: Tensor, mean: Tensor, inverse: Tensor
    ) -> Tensor:
        """Return the maps after ReLU; `standard`, `mean` and `inverse` (of the deviation) are over all but channels."""
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
        """Return the gradients in the maps, the gain and the offset."""
        answer, standard, gain, mean, inverse, shift = ctx.saved_tensors
        count = slope.numel() // slope.shape[1]
        of_ground = -_sum(slope, gain.dtype) * (shift > 0)
        slope = slope * (answer > _channels(-shift.relu(), answer))
        of_offset, of_gain = _sum(slope, gain.dtype), _sum(slope * standard, gain.dtype)
        # Derivatives in mean and inverse through the ground alone. The usual formula of batch norm holds those
        # through s.
        of_mean, of_inverse = -of_ground * gain * inverse, -of_ground * gain * mean
        constant = (of_mean - gain * inverse * of_offset) / count
        standardised = -(gain * inverse * of_gain + of_inverse * inverse.square()) / count
        of_maps = torch.addcmul(_channels(constant, slope), slope, _channels(gain * inverse, slope))
        of_maps = torch.addcmul(of_maps, standard, _channels(standardised, slope))
        return of_maps, of_gain - of_ground * mean * inverse, of_offset + of_ground, None, None, None


def _channels(values: Tensor, maps: Tensor) -> Tensor:
    return values.to(maps.dtype)[:, None, None]


def _sum(maps: Tensor, kind: torch.dtype) -> Float[Tensor, " channels"]:
    """Return the sum over all but channels; it adds rows, which are contiguous where channels are last."""
    return maps.permute(0, 2, 3, 1).reshape(-1, maps.shape[1]).sum(0, dtype=kind)


def convolved(maps: Tensor, weight: Tensor, bias: Tensor | None, stride: int = 1) -> Tensor:
    """Return the convolution of the maps; of stride 1 it keeps their size."""
    return functional.conv2d(maps, weight, bias, stride, padding=weight.shape[-1] // 2 if stride == 1 else 0)
