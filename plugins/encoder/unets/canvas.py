"""What surrounds a network's convolutions: it reads pictures, computes the subject's box alone, gives colours."""

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
"""Colours are sigmoid(WHITE (1 + raw)): a raw 0 is white but for 0.6 of 255, -1 is grey, -2 black. An empty picture is
white so from the start, also where training sees nothing far from a subject, and leaves it in steps of usual size."""
EMPTY_LOG_SCALE = -5.0
"""What logarithms of scales start from: 0.007, near the error of that white. For the same reason: beyond the subject's
box evaluation answers with the bias alone, which training hardly moves, and exp(0) would be the whole range."""


class Box(NamedTuple):
    """Rows from `top` to before `bottom`, columns from `left` to before `right`."""

    top: int
    bottom: int
    left: int
    right: int


@dataclass(frozen=True)
class Report:
    """What was computed of a batch of pictures.

    Attributes:
        boxes: in each picture what the network ran on, None where that is empty; a box may end beyond the border, at a
            multiple of the network's stride.
        computed: pixels in the boxes.
        left_out: pixels of the pictures outside of the boxes; they got the answer to an empty picture.
    """

    boxes: tuple[Box | None, ...]
    computed: int
    left_out: int


Maps = Callable[[Tensor, Iterator[Step]], Tensor]
"""Pictures, as differences from the empty ground and of whole strides, and layers in order → what the head reads."""


@dataclass(frozen=True)
class Canvas:
    """How pictures come to a network and its answers become pictures.

    Attributes:
        colors: outputs that are colours; the others stay raw.
        stride: sides of what a network reads are multiples of it, pixels; pictures continue empty to the next one.
        crop: margin around the subject's box, pixels; None: all is computed.
        precision: of evaluation, where weights are float32.
        shuffle: the head answers for squares of this side at once.
        residual: whether colours are the input's first channels and what the network adds to them.
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
        """The answer, and of a cropped one what was computed. In evaluation normalisation is folded into convolutions:
        anew in every call, which costs less than to know for certain that no weight has changed."""
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
        """One box after the other: what else is in the batch does not matter."""
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
        """Of raw numbers and of what they answer to, as differences from the empty ground."""
        if self.residual:
            # a little beyond [0, 1] at times: cut off, what should be darker than its input could not be told so
            colors = 1 + pictures[:, : self.colors] + raw[:, : self.colors]
        else:
            colors = (WHITE + WHITE * raw[:, : self.colors]).sigmoid()
        return colors if raw.shape[1] == self.colors else torch.cat([colors, raw[:, self.colors :]], 1)

    def _kind(self, weight: Tensor) -> torch.dtype:
        """The type of numbers that evaluation computes with."""
        if weight.dtype != torch.float32 or self.precision == "float32":
            return weight.dtype
        return (
            torch.bfloat16 if self.precision == "bfloat16" or fast_bfloat16(weight.device) else torch.float32
        )


def fast_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies matrices of bfloat16 faster than of float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()


def subject(picture: Float[Tensor, "channels height width"], stride: int, margin: int) -> Box | None:
    """The box around what is not empty (0 in every channel), a margin wider and out to whole strides."""
    most = picture.detach().abs().amax(0)  # NaN where any is
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
    """From maps to colours and scales, each of so many places; to an empty picture it answers 0, of scales
    EMPTY_LOG_SCALE, before training, and where it is `residual` to any."""
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
    """
    Args:
        least: channels that the input has at least.

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
