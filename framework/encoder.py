"""The contract of an encoder: raw input in, a fixed-length feature vector out."""

from abc import ABC, abstractmethod
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn


class Encoder(nn.Module, ABC):
    """Turns an input, or the features of the encoder before it, into features.

    A constructor asks for `input_shape: tuple[int, ...]` before `*`: the shape of one sample without the batch
    dimension, (channels, height, width) for images, (length,) for features. It refuses a shape it cannot read with
    a ConfigError that says which shape it wants. Its keyword-only parameters are the config.

    Images come as uint8 with values 0…255 or as float with values 0…1, whatever the data plugin yields; an encoder
    that reads images converts uint8 to float in [0, 1] itself and then normalises as it likes.

    Encoders chain: `encoder=[biternion_vgg,mlp]` feeds the second with the first's output; each is built with the
    `output_shape` of the one before it.
    """

    group: ClassVar[str] = "encoder"
    bibtex: ClassVar[str]
    """What to cite, as BibTeX."""
    vectorises: bool = False
    """Whether `torch.vmap` over its parameters computes several such encoders in one pass, to rounding, and faster than
    one after the other: layers of matrix products without buffers. May be set by the constructor."""
    output_shape: tuple[int, ...]
    """Shape of the features of one sample; set by the constructor. The last encoder's is (length,)."""

    @abstractmethod
    def forward(self, inputs: Tensor) -> Float[Tensor, "batch *features"]:
        """Features of shape (batch, *output_shape), of the parameters' dtype. The batch may be empty."""
