"""The contract of an encoder: it turns a raw input into a fixed-length feature vector."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from framework.errors import ConfigError


class Encoder(nn.Module, ABC):
    """Base class of the modules that turn an input, or the features of the encoder before it, into features.

    A constructor takes `input_shape: tuple[int, ...]` before `*`: the shape of one sample without the batch dimension.
    It is (channels, height, width) for images, (points, columns) for point clouds and (length,) for features. The
    constructor refuses a shape that it cannot read with a ConfigError that says which shape it wants. It may also take
    `input_columns: tuple[str, ...]`, the names of the numbers in an input's last dimension (`Data.columns`). Its
    keyword-only parameters are the config.

    Images are uint8 with values 0…255 or float with values 0…1, as the data plugin gives them. An encoder that reads
    images converts uint8 to float in [0, 1] itself and then normalises as it likes.

    Point clouds are (batch, points, columns), with coordinates in the first three columns. Clouds of fewer points are
    padded at their end with rows of NaN (geometry.clouds). A cloud that cannot be read is refused with a UserError.

    Encoders chain: `encoder=[biternion_vgg,mlp]` feeds the second with the first's output. Each is built with the
    `output_shape` of the one before it.
    """

    group: ClassVar[str] = "encoder"
    bibtex: ClassVar[str]
    """Citation of the method: BibTeX entries, or their keys in the `references.bib` of the package; "" for none."""
    vectorises: bool = False
    """True if `torch.vmap` over the parameters of several such encoders is faster than one pass for each encoder.

    The features of both ways must agree to rounding. Layers of matrix products without buffers are an example. The
    constructor may set the attribute.
    """
    fixed: bool = False
    """True if the features depend on the input alone: the encoder is not trained, and draws no random numbers.

    The framework then computes them once per sample and not once per epoch, if neither the data nor an objective varies
    the inputs.
    """
    starts_flat: bool = False
    """True if the linear layer to the head starts with weights of 0 when this encoder is the last one.

    All inputs then have the same density at first. This is for heads with very many raw parameters, whose usual initial
    weights are noise that takes long to unlearn. The constructor may set it.
    """
    initial: ClassVar[frozenset[str]] = frozenset()
    """Names of constructor parameters that only set where training starts, such as a file of weights.

    A loaded model needs none of them, because its checkpoint holds the weights; each of them is then None.
    """
    output_shape: tuple[int, ...]
    """Shape of the features of one sample; set by the constructor. The last encoder's shape is (length,)."""

    @abstractmethod
    def forward(self, inputs: Tensor) -> Float[Tensor, "batch *features"]:
        """Return features of shape (batch, *output_shape), of the parameters' dtype. The batch may be empty."""


class FitsInputs(ABC):
    """Additional base class of an encoder that is fitted once to the inputs of the training split, before training.

    The fitted numbers are buffers, so that checkpoints store them. The attribute `fixed` of the encoder must be True,
    and no encoder that is trained may precede it. The encoder also returns features before it is fitted.
    """

    needs_fit: bool = True
    """False if this construction needs no fit; `fit_inputs` is then not called. The constructor may set it."""

    @abstractmethod
    def fit_inputs(self, batches: Iterable[Float[Tensor, "batch *input"]]) -> None:
        """Fit the encoder in place.

        Args:
            batches: inputs of the encoder for all samples of the training split, batch by batch. Batches of point
                clouds may be padded to different numbers of points.
        """


class ChecksTraining(ABC):
    """Additional base class of an encoder that compares its settings with the samples of the training split.

    The same rules as for `FitsInputs` hold, but nothing is fitted, so that `mode=encode` accepts the encoder.
    """

    @abstractmethod
    def check_training(self, batches: Iterable[Mapping[str, Tensor]]) -> None:
        """Check the samples before training, and change nothing.

        Args:
            batches: batches of the whole training split. "input" holds the inputs of this encoder, and "target" the
                targets, (batch, *event).

        Raises:
            ConfigError: a setting contradicts the samples; the message names the setting and a better value.
        """


def require_numbers(input_shape: tuple[int, ...], by: str) -> int:
    """Return the number of elements of a sample of shape `input_shape`; `by` is the caller's name for the message.

    Raises:
        ConfigError: a sample of this shape has no elements.
    """
    length = math.prod(input_shape)
    if length == 0:
        raise ConfigError(
            f"{by} got samples of shape {input_shape}, which hold no numbers, but at least one number is required. "
            "Check the samples of `data`, or the encoder before this one."
        )
    return length


def require_grey_or_color(input_shape: tuple[int, ...], by: str, smallest: int = 0) -> None:
    """Require that the inputs are grey or colour images, with sides of at least `smallest` pixels.

    Args:
        input_shape: shape of one input; (channels, height, width) for images.
        by: name of the encoder, for the message.
        smallest: smallest height and width, pixels.

    Raises:
        ConfigError: the input is not an image of 1 or 3 channels, or it is too small.
    """
    if len(input_shape) != 3 or input_shape[0] not in (1, 3):
        raise ConfigError(
            f"{by} reads images of shape (1 or 3 channels, height, width), but got an input of shape {input_shape}. "
            "Choose another encoder for this input, such as `mlp`."
        )
    if min(input_shape[1:]) < smallest:
        raise ConfigError(
            f"{by} needs images of at least {smallest} × {smallest} pixels, but got images of {input_shape[1]} × "
            f"{input_shape[2]}. Make the images larger, or choose `biternion_vgg`."
        )


def images_in_unit_range(inputs: Tensor, dtype: torch.dtype) -> Float[Tensor, "batch channels height width"]:
    """Return images with values from 0 to 1, of type `dtype`, channels last in memory; integers are divided by 255."""
    images = inputs.to(dtype, memory_format=torch.channels_last)
    return images if inputs.is_floating_point() else images / 255
