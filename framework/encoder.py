"""The contract of an encoder: raw input in, a fixed-length feature vector out."""

from abc import ABC, abstractmethod
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn


class Encoder(nn.Module, ABC):
    """Turns an input, or the features of the encoder before it, into features.

    A constructor asks for `input_shape: tuple[int, ...]` before `*`: the shape of one sample without the batch
    dimension, (channels, height, width) for images, (points, columns) for point clouds, (length,) for features. It
    refuses a shape it cannot read with a ConfigError that says which shape it wants. It may ask for
    `input_columns: tuple[str, ...]` too: what the numbers of an input's last dimension are called (`Data.columns`).
    Its keyword-only parameters are the config.

    Images come as uint8 with values 0…255 or as float with values 0…1, whatever the data plugin yields; an encoder
    that reads images converts uint8 to float in [0, 1] itself and then normalises as it likes.

    Point clouds come as (batch, points, columns), coordinates in the first three columns; those of fewer points are
    padded at their end with rows of NaN (geometry.clouds). A cloud that cannot be read is refused with a UserError.

    Encoders chain: `encoder=[biternion_vgg,mlp]` feeds the second with the first's output; each is built with the
    `output_shape` of the one before it.
    """

    group: ClassVar[str] = "encoder"
    bibtex: ClassVar[str]
    """What to cite, as BibTeX."""
    vectorises: bool = False
    """Whether `torch.vmap` over its parameters computes several such encoders in one pass, to rounding, and faster than
    one after the other: layers of matrix products without buffers. May be set by the constructor."""
    fixed: bool = False
    """Whether features are a function of the input alone: nothing in them is learned or drawn. The framework computes
    them once per sample then, not once per epoch, where neither the data nor an objective varies its inputs."""
    starts_flat: bool = False
    """Whether the linear layer to the head starts with weights of 0 where this encoder is last, so that all inputs are
    given one density at first: for heads of very many numbers, whose usual first weights are noise that takes long to
    unlearn. May be set by the constructor."""
    initial: ClassVar[frozenset[str]] = frozenset()
    """Parameters that only say what training starts from: a file of weights, say. A loaded model needs none of them,
    for its checkpoint holds the weights; it is built with None for each."""
    output_shape: tuple[int, ...]
    """Shape of the features of one sample; set by the constructor. The last encoder's is (length,)."""

    @abstractmethod
    def forward(self, inputs: Tensor) -> Float[Tensor, "batch *features"]:
        """Features of shape (batch, *output_shape), of the parameters' dtype. The batch may be empty."""
