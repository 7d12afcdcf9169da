"""Convolutions for images on an empty background; an image without a subject is 0 in every layer.

Maps are differences from the values that a layer would have on an infinite empty image. For such an image, a
convolution of these differences gives 0. Normalisation and ReLU then give relu(shift), which the layer subtracts. Zero
padding therefore continues the empty background beyond the border in every layer, and regions far from any subject need
not be computed.
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
"""Smallest weight of the newest batch in the running moments.

The weight of batch number n is 1/n as long as 1/n exceeds SLOWEST, so that the running moments of the first batches are
means over all batches so far.
"""
LARGEST_RATIO, LARGEST_SHIFT = 3.0, 5.0
"""Bounds on the factor and on the shift with which batch renormalisation corrects a batch (Ioffe 2017, §4)."""
GROUPS = 8


class Layer(nn.Module):
    """A convolution, normalisation and ReLU, applied to maps that are differences from the empty background.

    Args:
        channels: number of channels of the input maps.
        outputs: number of channels of the output maps.
        size: side of the kernel, pixels; 3 keeps the size of the image, 2 halves it.
        normalisation: "batch" normalises by the moments of the batch. "renorm" normalises by the moments of the batch,
            and then moves the normalised numbers towards those that the running moments would give (Ioffe 2017).
            "group" normalises by the moments of each image's groups of channels. "batch" and "renorm" use the running
            moments in evaluation.
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
        """Return the output maps of the layer, as training computes them.

        With the normalisation "group", evaluation computes the same maps. With "batch" and "renorm", evaluation does
        not call this method, but the function that `fold` returns.
        """
        return self._normalise(convolve(maps, self.weight, None, self.stride))

    def fold(self, dtype: torch.dtype) -> Step:
        """Return the layer as a function for evaluation, with normalisation folded into the convolution."""
        if self.normalisation == "group":
            weight = self.weight.to(dtype)
            return lambda maps: self._normalise(convolve(maps, weight, None, self.stride))
        scale = self.gain * torch.rsqrt(self.variance + EPSILON)
        shift = self.offset - self.mean * scale
        ground = shift.relu()
        weight = (self.weight * scale[:, None, None, None]).to(dtype, memory_format=torch.channels_last)
        bias, floor = (shift - ground).to(dtype), -ground.to(dtype)[:, None, None]

        def evaluate(maps: Tensor) -> Tensor:
            raw = convolve(maps, weight, bias, self.stride)
            # in place where nothing needs the gradient, because new memory takes as long as the maximum
            return torch.maximum(raw, floor, out=None if raw.requires_grad else raw)

        return evaluate

    def _normalise(self, maps: Tensor) -> Tensor:
        if self.normalisation != "group":
            return self._normalise_by_batch(maps)
        scale, shift = self._group_scale_and_shift(maps)
        ground = shift.relu()
        # relu(scale m + shift) - relu(shift)
        return torch.maximum(torch.addcmul((shift - ground).to(maps), maps, scale.to(maps)), -ground.to(maps))

    def _normalise_by_batch(self, maps: Tensor) -> Tensor:
        """Return maps normalised by the moments of the batch, after ReLU, and update the running moments."""
        with torch.no_grad():
            # not torch.native_batch_norm, whose sums lose digits if channels are last and the mean is large
            dtype, count = self.gain.dtype, maps.numel() // maps.shape[1]
            mean = _sum(maps, dtype) / count
            standard = maps - _per_channel(mean, maps)
            variance = _sum(standard.square(), dtype) / count
            deviation = (variance + EPSILON).sqrt()
            standard *= _per_channel(deviation.reciprocal(), maps)
            ratio, correction = torch.ones_like(mean), torch.zeros_like(mean)
            if self.normalisation == "renorm" and self.batches > 0:
                running_deviation = (self.variance + EPSILON).sqrt()
                ratio = (deviation / running_deviation).clamp(1 / LARGEST_RATIO, LARGEST_RATIO)
                correction = ((mean - self.mean) / running_deviation).clamp(-LARGEST_SHIFT, LARGEST_SHIFT)
            self.batches += 1
            share = max(SLOWEST, 1 / self.batches.item())
            self.mean.lerp_(mean.to(self.mean), share)
            self.variance.lerp_(variance.to(self.variance), share)
        rectified: Tensor = FromGround.apply(
            maps,
            self.gain * ratio,
            self.offset + self.gain * correction,
            standard,
            mean,
            deviation.reciprocal(),
        )
        return rectified

    def _group_scale_and_shift(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """Return scale and shift, (batch, channels, 1, 1), from the moments of each image's groups of channels."""
        grouped = maps.unflatten(1, (self.groups, -1))
        variance, mean = torch.var_mean(grouped, (2, 3, 4), correction=0)
        group_size = maps.shape[1] // self.groups
        scale = self.gain * torch.rsqrt(variance + EPSILON).repeat_interleave(group_size, 1)
        shift = self.offset - mean.repeat_interleave(group_size, 1) * scale
        return scale[..., None, None], shift[..., None, None]


class FromGround(torch.autograd.Function):
    """The function relu(gain s + offset) minus its value on the background, where s are the standardised maps.

    The background is the part of an image in which the maps are 0; there, s is -mean · inverse standard deviation. The
    backward pass is written out, because autograd of the same formula makes many more passes over the maps. Mean and
    variance, and with them the value on the background, are functions of the maps; the backward pass takes this into
    account.
    """

    @staticmethod
    def forward(
        ctx: Any, maps: Tensor, gain: Tensor, offset: Tensor, standard: Tensor, mean: Tensor, inverse: Tensor
    ) -> Tensor:
        """Return relu(gain s + offset) minus the value of this function on the background.

        Args:
            ctx: context of autograd.
            maps: maps before normalisation.
            gain: factor of each channel.
            offset: summand of each channel.
            standard: s, the standardised maps: (maps - mean) · inverse.
            mean: mean of each channel, for the value on the background and for the gradients.
            inverse: inverse standard deviation of each channel, for the same purpose.
        """
        shift = offset - gain * mean * inverse
        ground = shift.relu()
        upper, factor, floor = ((offset - ground), gain, -ground)
        rectified = torch.addcmul(_per_channel(upper, maps), standard, _per_channel(factor, maps))
        rectified = torch.maximum(rectified, _per_channel(floor, maps))
        ctx.save_for_backward(rectified, standard, gain, mean, inverse, shift)
        return rectified

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the gradients with respect to maps, gain and offset, and None for the other arguments."""
        rectified, standard, gain, mean, inverse, shift = ctx.saved_tensors
        count = gradient.numel() // gradient.shape[1]
        of_ground = -_sum(gradient, gain.dtype) * (shift > 0)
        gradient = gradient * (rectified > _per_channel(-shift.relu(), rectified))
        of_offset, of_gain = _sum(gradient, gain.dtype), _sum(gradient * standard, gain.dtype)
        # Derivatives in mean and inverse through the value on the background. The usual formula of batch norm contains
        # the derivatives through s.
        of_mean, of_inverse = -of_ground * gain * inverse, -of_ground * gain * mean
        constant = (of_mean - gain * inverse * of_offset) / count
        standardised = -(gain * inverse * of_gain + of_inverse * inverse.square()) / count
        of_maps = torch.addcmul(
            _per_channel(constant, gradient), gradient, _per_channel(gain * inverse, gradient)
        )
        of_maps = torch.addcmul(of_maps, standard, _per_channel(standardised, gradient))
        return of_maps, of_gain - of_ground * mean * inverse, of_offset + of_ground, None, None, None


def _per_channel(values: Tensor, maps: Tensor) -> Tensor:
    return values.to(maps.dtype)[:, None, None]


def _sum(maps: Tensor, dtype: torch.dtype) -> Float[Tensor, " channels"]:
    """Return the sum of each channel over all pixels of all images.

    The maps are summed as rows with one number for each channel. If the maps are stored with channels last, these rows
    are contiguous in memory, and nothing is copied.
    """
    return maps.permute(0, 2, 3, 1).reshape(-1, maps.shape[1]).sum(0, dtype=dtype)


def convolve(maps: Tensor, weight: Tensor, bias: Tensor | None, stride: int = 1) -> Tensor:
    """Return the convolution of the maps; with stride 1 the size of the maps stays the same."""
    return functional.conv2d(maps, weight, bias, stride, padding=weight.shape[-1] // 2 if stride == 1 else 0)
