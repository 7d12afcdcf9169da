"""Input and output of a U-Net: reading images, restricting computation to the subject's box, computing colours."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import torch
from jaxtyping import Float, Shaped
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from framework.encoder import Encoder
from framework.errors import ConfigError
from framework.storage.processor import fast_bfloat16
from plugins.encoder.unets.layers import Layer, Normalisation, Step, convolve

Precision = Literal["auto", "float32", "bfloat16"]
WHITE = 6.0
"""Factor in the colours sigmoid(WHITE (1 + raw)), where raw is the output of the last convolution.

A raw output of 0 gives white with an error of 0.6/255, -1 gives grey, and -2 gives black. An empty image is therefore
white before training, also in regions far from a subject, from which training learns nothing. Optimiser steps of usual
size still suffice to change a colour.
"""
EMPTY = 1.0
"""Value of every channel of the input on empty background."""
EMPTY_LOG_SCALE = -5.0
"""Initial value of the logarithms of scales: a scale of 0.007, near the error of an untrained network's white.

Outside the subject's box evaluation returns the bias of the last convolution. Training hardly changes this bias, and a
bias of 0 would be a scale of 1, the whole range of colours.
"""


class Box(NamedTuple):
    """A box of pixels: rows from `top` up to but not including `bottom`, columns from `left` up to but not `right`."""

    top: int
    bottom: int
    left: int
    right: int


@dataclass(frozen=True)
class CropReport:
    """The areas of a batch of images that a network computed in evaluation, if it computes only the subject's box.

    Attributes:
        boxes: box of each image that the network computed, or None for an empty image; a box may end beyond the border
            of the image, at a multiple of the network's stride.
        computed: number of pixels in all boxes.
        left_out: number of pixels of the images outside the boxes; their output is that of an empty image.
    """

    boxes: tuple[Box | None, ...]
    computed: int
    left_out: int


Maps = Callable[[Tensor, Iterator[Step]], Tensor]
"""Function of images and layers that returns the maps that the last convolution reads.

The images are differences from the empty background, and their sides are multiples of the stride. The layers are an
iterator over functions, one for each layer of the network; the function takes one after the other.
"""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings that all U-Nets share.

    Attributes:
        normalisation: "batch", by the moments of the batch; "renorm", by the moments of the batch, corrected towards
            the running moments; or "group", by the moments of each image's groups of channels. See `layers.Layer`.
        colors: number of output channels that are colours, whose values are in [0, 1].
        scales: number of further output channels: logarithms of the scales of a density of the colours.
        crop: margin, pixels. Evaluation computes only the subject's bounding box and this margin around it; None: the
            whole image.
        precision: precision of evaluation; "auto" is bfloat16 on processors with fast bfloat16 matrix products, else
            float32.
        residual: whether the network's output is added to the input's first `colors` channels, which are colours of a
            rasterised mesh. Before training the output is then the input. Colours may lie a little beyond [0, 1].
    """

    normalisation: Normalisation = "renorm"
    colors: Annotated[int, Field(gt=0)] = 3
    scales: Literal[0, 1, 3] = 0
    crop: Annotated[int, Field(ge=0)] | None = 32
    precision: Precision = "float32"
    residual: bool = False


@dataclass(frozen=True)
class Canvas:
    """Settings of a U-Net's input and output: colours, padding, crop, precision and unshuffling.

    Attributes:
        colors: number of the leading output channels that are colours; the other channels stay raw.
        stride: number of pixels. The network reads images whose sides are multiples of this number; other images are
            padded with empty background.
        crop: margin around the subject's box, pixels; None computes everything.
        precision: precision of evaluation, for float32 weights.
        shuffle: side, pixels, of the squares whose values the last convolution returns as channels.
        residual: whether colours are the sum of the input's first channels and the network's output.
    """

    colors: int
    stride: int
    crop: int | None
    precision: Precision
    shuffle: int = 1
    residual: bool = False

    def compute(
        self,
        inputs: Shaped[Tensor, "batch channels height width"],
        maps: Maps,
        layers: nn.ModuleList,
        head: nn.Conv2d,
        training: bool,
    ) -> tuple[Float[Tensor, "batch outputs height width"], CropReport | None]:
        """Return the outputs of the network and, for evaluation with a crop, a report of the areas that were computed.

        With a crop, evaluation computes only the subject's box in each image. The report is None in training, without a
        crop, and for an empty batch.

        In evaluation, each call folds the normalisation into the convolutions again. This costs less than checking
        whether a weight has changed.

        Args:
            inputs: images; integers are divided by 255.
            maps: function that returns the feature maps that `head` reads.
            layers: layers of the network, in the order in which `maps` uses them.
            head: last convolution.
            training: whether the network is in training; everything is then computed.
        """
        weight, bias = head.weight, head.bias
        assert bias is not None
        if inputs.shape[0] == 0:
            outputs = head.out_channels // self.shuffle**2
            return weight.new_zeros(0, outputs, *inputs.shape[2:]), None
        images = inputs.to(weight.dtype)
        if not inputs.is_floating_point():
            images = images / 255
        dtype = weight.dtype if training else self._evaluation_dtype(weight)
        steps: list[Step] = [
            layer if training else layer.fold(dtype) for layer in layers if isinstance(layer, Layer)
        ]
        head_weight, head_bias = weight.to(dtype), bias.to(dtype)

        def evaluate(images: Tensor) -> Tensor:
            height, width = images.shape[2:]
            images = images - EMPTY
            whole = functional.pad(images.to(dtype), (0, -width % self.stride, 0, -height % self.stride))
            raw = convolve(maps(whole, iter(steps)), head_weight, head_bias)
            raw_outputs = functional.pixel_shuffle(raw, self.shuffle)[..., :height, :width].to(weight)
            return self._color(raw_outputs, images)

        if training or self.crop is None:
            return evaluate(images), None
        empty = functional.pixel_shuffle(head_bias[None, :, None, None], self.shuffle)
        boxes = tuple(subject_box(image, self.stride, self.crop) for image in images)
        ground = images.new_zeros(1, images.shape[1], *empty.shape[2:])
        return self._in_boxes(images, boxes, evaluate, self._color(empty.to(weight), ground))

    def _in_boxes(
        self, images: Tensor, boxes: tuple[Box | None, ...], evaluate: Step, empty: Tensor
    ) -> tuple[Tensor, CropReport]:
        """Return the outputs of the network and the report of the cropped evaluation.

        The boxes are computed one at a time, so that the output of an image does not depend on the rest of the batch.

        Args:
            images: images.
            boxes: box of each image that is computed, or None for an empty image.
            evaluate: function that returns the outputs for a part of an image.
            empty: outputs for an empty square of `shuffle`² pixels, which are repeated outside the boxes.
        """
        count, _, height, width = images.shape
        side = empty.shape[-1]
        outputs = empty.new_empty(count, empty.shape[1], height, width)
        for row in range(min(side, height)):
            line = empty[:, :, row : row + 1].repeat(1, 1, 1, -(-width // side))
            outputs[:, :, row::side] = line[..., :width]
        computed, left_out = 0, count * height * width
        for index, box in enumerate(boxes):
            if box is None:
                continue
            rows, columns = slice(box.top, box.bottom), slice(box.left, box.right)
            part = evaluate(images[index : index + 1, :, rows, columns])[0]
            outputs[index, :, rows, columns] = part
            computed += (box.bottom - box.top) * (box.right - box.left)
            left_out -= part[0].numel()
        return outputs, CropReport(boxes, computed, left_out)

    def _color(self, raw: Tensor, images: Tensor) -> Tensor:
        """Return the colours, followed by the other outputs of the network, which stay raw.

        Args:
            raw: output of the last convolution.
            images: images as differences from the empty background.
        """
        if self.residual:
            # Colours may lie a little beyond [0, 1]. They are not clamped: a clamped colour that should become darker
            # than its input would have no gradient.
            colors = 1 + images[:, : self.colors] + raw[:, : self.colors]
        else:
            colors = (WHITE + WHITE * raw[:, : self.colors]).sigmoid()
        return colors if raw.shape[1] == self.colors else torch.cat([colors, raw[:, self.colors :]], 1)

    def _evaluation_dtype(self, weight: Tensor) -> torch.dtype:
        """Return the dtype in which evaluation computes."""
        if weight.dtype != torch.float32 or self.precision == "float32":
            return weight.dtype
        return (
            torch.bfloat16 if self.precision == "bfloat16" or fast_bfloat16(weight.device) else torch.float32
        )


class CroppedUNet(Encoder):
    """Base class of the U-Nets, which compute only the subject's box in evaluation.

    Args:
        name: name of the encoder, for messages.
        input_shape: (channels, height, width); the network also reads images of other heights and widths.
        settings: normalisation, output channels, crop and precision.

    Attributes:
        settings: the argument `settings`.
        layers: layers of the network, in the order in which `maps` uses them.
        head: last convolution.
        canvas: settings of the input and the output.
        report: areas of the images of the last batch that evaluation computed; None after training, and without crop.

    Raises:
        ConfigError: the input is not an image, or has too few channels, or `crop` with `normalisation="group"`.
    """

    layers: nn.ModuleList
    head: nn.Conv2d
    canvas: Canvas
    report: CropReport | None = None

    def __init__(self, name: str, input_shape: tuple[int, ...], settings: Settings) -> None:
        super().__init__()
        require_images(name, input_shape, settings)
        self.settings = settings
        self.output_shape = (settings.colors + settings.scales, *input_shape[1:])

    def build_layers(
        self, shapes: Sequence[tuple[int, int, int]], size: int, stride: int, shuffle: int = 1
    ) -> None:
        """Build `layers`, `head` and `canvas`; the constructor of a network calls this method.

        Args:
            shapes: channels, outputs and side of the kernel of each layer.
            size: side of the kernel of the last convolution, pixels.
            stride: number of pixels of which the sides of the images are multiples (`Canvas`).
            shuffle: side, pixels, of the squares whose values the last convolution returns as channels.
        """
        settings = self.settings
        self.layers = nn.ModuleList(Layer(*shape, settings.normalisation) for shape in shapes)
        _, channels, _ = shapes[-1]
        self.head = build_head(
            channels, size, settings.colors, settings.scales, shuffle**2, residual=settings.residual
        )
        self.canvas = Canvas(
            settings.colors, stride, settings.crop, settings.precision, shuffle, residual=settings.residual
        )
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @abstractmethod
    def maps(self, images: Tensor, layers: Iterator[Step]) -> Tensor:
        """Return the feature maps that the last convolution reads.

        Args:
            images: differences from the empty background; sides are multiples of the network's stride.
            layers: iterator over functions, one for each layer of the network.
        """

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch outputs height width"]:
        """Return colours and scales of the images."""
        outputs, self.report = self.canvas.compute(inputs, self.maps, self.layers, self.head, self.training)
        return outputs


def subject_box(image: Float[Tensor, "channels height width"], stride: int, margin: int) -> Box | None:
    """Return the box around the pixels in which a channel is not `EMPTY`, or None if there are no such pixels.

    The box is widened by `margin` pixels within the image, then to multiples of `stride`.
    """
    if torch.compiler.is_exporting():
        raise ConfigError(
            "A crop cannot be exported, because it depends on the pixels of each image. Train the model with crop=null."
        )
    shown = (image.detach() != EMPTY).view(torch.uint8).amax(0)  # true for NaN; bytes have a faster maximum
    ends: list[int] = []
    for line in (shown.amax(1), shown.amax(0)):
        positions = line.nonzero()
        if len(positions) == 0:
            return None
        first, last = int(positions[0]) - margin, int(positions[-1]) + 1 + margin
        ends += [max(0, first // stride * stride), -(-min(last, len(line)) // stride) * stride]
    return Box(*ends)


def build_head(
    channels: int, size: int, colors: int, scales: int, pixels: int = 1, *, residual: bool = False
) -> nn.Conv2d:
    """Return the last convolution of a U-Net, from maps to raw colours and logarithms of scales.

    Before training, its output for an empty image is 0 for colours and EMPTY_LOG_SCALE for scales. With `residual`,
    this is its output for every image before training.

    Args:
        channels: number of channels of the maps.
        size: side of the kernel, pixels.
        colors: number of colours of a pixel.
        scales: number of scales of a pixel.
        pixels: number of pixels whose colours and scales are outputs at each position of the maps.
        residual: whether the outputs are added to the input's colours.
    """
    convolution = nn.Conv2d(channels, (colors + scales) * pixels, size)
    assert convolution.bias is not None
    nn.init.zeros_(convolution.bias)
    nn.init.constant_(convolution.bias[colors * pixels :], EMPTY_LOG_SCALE)
    if residual:
        nn.init.zeros_(convolution.weight)
    return convolution


def require_images(name: str, input_shape: tuple[int, ...], settings: Settings) -> None:
    """Require images with enough channels, and compatible settings of crop and normalisation.

    Args:
        name: name of the encoder, for messages.
        input_shape: (channels, height, width).
        settings: settings of the network.

    Raises:
        ConfigError: the input is not an image, or has too few channels, or crop and normalisation exclude each other.
    """
    if len(input_shape) != 3 or min(input_shape) < 1:
        raise ConfigError(
            f"{name} reads images of shape (channels, height, width) with at least one pixel, but got an input of "
            f"shape {input_shape}. Choose another encoder for this input, or put one before {name} that returns an "
            "image."
        )
    if settings.residual and input_shape[0] < settings.colors:
        raise ConfigError(
            f"encoder.{name}.residual=true adds to {settings.colors} colours of the input, but the input has "
            f"{input_shape[0]} channels. Set residual=false, or put an encoder before {name} that returns colours."
        )
    if settings.normalisation == "group" and settings.crop is not None:
        raise ConfigError(
            f"encoder.{name}.normalisation=group normalises by the whole image, but crop={settings.crop} computes only "
            "a part of the image, so that the colours would depend on this part. Set crop=null, or "
            "normalisation=renorm."
        )
