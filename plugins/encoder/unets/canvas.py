"""Input and output of a U-Net: reading images, restricting computation to the subject's box, forming colours."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn
from torch.nn import functional

from framework.errors import ConfigError
from plugins.encoder.unets.layers import Layer, Step, convolved

Precision = Literal["auto", "float32", "bfloat16"]


WHITE = 6.0
"""Slope of the colours, which are sigmoid(WHITE (1 + raw)).

A raw 0 is white but for 0.6 of 255, -1 is grey, -2 black. An empty image is therefore white from the start, also in
regions where training sees nothing because they are far from a subject. A colour leaves white in steps of usual size.
"""
EMPTY_LOG_SCALE = -5.0
"""Initial value of the logarithms of scales: a scale of 0.007, near the error of that white.

The reason is the one for `WHITE`: outside the subject's box evaluation returns the bias alone, which training hardly
changes, and exp(0) would be the whole range of colours.
"""


class Box(NamedTuple):
    """A box with rows from `top` to before `bottom`, columns from `left` to before `right`."""

    top: int
    bottom: int
    left: int
    right: int


@dataclass(frozen=True)
class Report:
    """The areas that were computed of a batch of images.

    Attributes:
        boxes: the area of each image that the network ran on, None if the image is empty; a box may end beyond the
            border, at a multiple of the network's stride.
        computed: number of pixels in the boxes.
        left_out: number of pixels of the images outside the boxes; they have the value for an empty image.
    """

    boxes: tuple[Box | None, ...]
    computed: int
    left_out: int


Maps = Callable[[Tensor, Iterator[Step]], Tensor]
"""Function of images and layers that returns the maps that the head reads.

The images are differences from the empty ground, and their sides are multiples of the stride.
"""


@dataclass(frozen=True)
class Canvas:
    """Settings of a U-Net's input and output: colours, padding, crop, precision and unshuffling.

    Attributes:
        colors: number of outputs that are colours; the others stay raw.
        stride: pixels; the sides of the images that a network reads are multiples of it. Images are padded with empty
            ground to the next multiple.
        crop: margin around the subject's box, pixels; None computes everything.
        precision: precision of evaluation, for float32 weights.
        shuffle: side, pixels, of the squares for which the head predicts all values at once.
        residual: whether colours are the sum of the input's first channels and the network's output.
    """

    colors: int
    stride: int
    crop: int | None
    precision: Precision
    shuffle: int = 1
    residual: bool = False

    def painted(
        self,
        inputs: Shaped[Tensor, "batch channels height width"],
        maps: Maps,
        layers: nn.ModuleList,
        head: nn.Conv2d,
        training: bool,
    ) -> tuple[Float[Tensor, "batch outputs height width"], Report | None]:
        """Return the outputs of the network, and the report of a cropped evaluation, None otherwise.

        In evaluation normalisation is folded into the convolutions in every call. That costs less than to check that no
        weight has changed.
        """
        weight, bias = head.weight, head.bias
        assert bias is not None
        if not len(inputs):
            outputs = head.out_channels // self.shuffle**2
            return weight.new_zeros(0, outputs, *inputs.shape[2:]), None
        pictures = inputs.to(weight.dtype)
        if not inputs.is_floating_point():
            pictures = pictures / 255
        pictures = pictures - 1
        kind = weight.dtype if training else self._kind(weight)
        steps: list[Step] = [
            layer if training else layer.folded(kind) for layer in layers if isinstance(layer, Layer)
        ]
        head_weight, head_bias = weight.to(kind), bias.to(kind)

        def answer(pictures: Tensor) -> Tensor:
            height, width = pictures.shape[2:]
            whole = functional.pad(pictures.to(kind), (0, -width % self.stride, 0, -height % self.stride))
            raw = convolved(maps(whole, iter(steps)), head_weight, head_bias)
            answers = functional.pixel_shuffle(raw, self.shuffle)[..., :height, :width].to(weight)
            return self._colored(answers, pictures)

        if training or self.crop is None:
            return answer(pictures), None
        empty = functional.pixel_shuffle(head_bias[None, :, None, None], self.shuffle)
        boxes = tuple(subject(picture, self.stride, self.crop) for picture in pictures)
        ground = pictures.new_zeros(1, pictures.shape[1], *empty.shape[2:])
        return self._in_boxes(pictures, boxes, answer, self._colored(empty.to(weight), ground))

    def _in_boxes(
        self, pictures: Tensor, boxes: tuple[Box | None, ...], answer: Step, empty: Tensor
    ) -> tuple[Tensor, Report]:
        """Return the outputs and the report, one box at a time, so that no image depends on the rest of the batch."""
        count, _, height, width = pictures.shape
        side = empty.shape[-1]
        answers = empty.new_empty(count, empty.shape[1], height, width)
        for row in range(min(side, height)):
            line = empty[:, :, row : row + 1].repeat(1, 1, 1, -(-width // side))
            answers[:, :, row::side] = line[..., :width]
        computed, left_out = 0, count * height * width
        for index, box in enumerate(boxes):
            if box is None:
                continue
            rows, columns = slice(box.top, box.bottom), slice(box.left, box.right)
            found = answer(pictures[index : index + 1, :, rows, columns])[0]
            answers[index, :, rows, columns] = found
            computed += (box.bottom - box.top) * (box.right - box.left)
            left_out -= found[0].numel()
        return answers, Report(boxes, computed, left_out)

    def _colored(self, raw: Tensor, pictures: Tensor) -> Tensor:
        """Return colours and raw scales from the network's output and the images (as differences from empty ground)."""
        if self.residual:
            # Colours may lie a little beyond [0, 1]. They are not clamped: a clamped colour that should become darker
            # than its input would have no gradient.
            colors = 1 + pictures[:, : self.colors] + raw[:, : self.colors]
        else:
            colors = (WHITE + WHITE * raw[:, : self.colors]).sigmoid()
        return colors if raw.shape[1] == self.colors else torch.cat([colors, raw[:, self.colors :]], 1)

    def _kind(self, weight: Tensor) -> torch.dtype:
        """Return the dtype in which evaluation computes."""
        if weight.dtype != torch.float32 or self.precision == "float32":
            return weight.dtype
        return (
            torch.bfloat16 if self.precision == "bfloat16" or fast_bfloat16(weight.device) else torch.float32
        )


def fast_bfloat16(device: torch.device) -> bool:
    """Return whether the device multiplies matrices of bfloat16 faster than of float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()


def subject(picture: Float[Tensor, "channels height width"], stride: int, margin: int) -> Box | None:
    """Return the box of the pixels that are not empty (0 in every channel), with a margin, widened to whole strides."""
    most = picture.detach().abs().amax(0)  # NaN where any channel is NaN
    ends: list[int] = []
    for line in (most.amax(1), most.amax(0)):
        where = line.nonzero()
        if len(where) == 0:
            return None
        first, last = int(where[0]) - margin, int(where[-1]) + 1 + margin
        ends += [max(0, first // stride * stride), -(-min(last, len(line)) // stride) * stride]
    return Box(*ends)


def head(
    channels: int, size: int, colors: int, scales: int, places: int = 1, *, residual: bool = False
) -> nn.Conv2d:
    """Return the last convolution, from maps to colours and scales at `places` pixels of each position.

    Before training its output for an empty image is 0, and EMPTY_LOG_SCALE for scales. With `residual` its output is
    then the same for any image.
    """
    made = nn.Conv2d(channels, (colors + scales) * places, size)
    assert made.bias is not None
    nn.init.zeros_(made.bias)
    nn.init.constant_(made.bias[colors * places :], EMPTY_LOG_SCALE)
    if residual:
        nn.init.zeros_(made.weight)
    return made


def require_pictures(
    name: str, input_shape: tuple[int, ...], normalisation: str, crop: int | None, least: int = 1
) -> None:
    """Require images with enough channels, and compatible settings of crop and normalisation.

    Args:
        name: name of the encoder, for messages.
        input_shape: (channels, height, width).
        normalisation: as of `unet.UNet`.
        crop: as of `unet.UNet`.
        least: smallest number of channels of the input.

    Raises:
        ConfigError: the input is no image, or has too few channels, or crop and normalisation exclude each other.
    """
    if len(input_shape) != 3 or min(input_shape) < 1:
        raise ConfigError(
            f"{name} reads images of shape (channels, height, width), one pixel at least; this input has the shape "
            f"{input_shape}. Choose another encoder for it, or put one before it that makes an image."
        )
    if input_shape[0] < least:
        raise ConfigError(
            f"encoder.{name}.residual adds to {least} colours of its input, which has {input_shape[0]} channels. Set "
            "residual=false, or put an encoder before it that draws colours."
        )
    if normalisation == "group" and crop is not None:
        raise ConfigError(
            f"encoder.{name}.normalisation=group normalises by all of a picture, and crop={crop} computes a part "
            "of it: the colours would depend on the box. Set crop=null, or normalisation=renorm."
        )
