"""Network of one hidden layer."""

from typing import Annotated

from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.encoder import Encoder, require_numbers


class Example(Encoder):
    """Network of one hidden layer over all numbers of a sample; images of type uint8 are scaled to 0…1.

    Args:
        input_shape: shape of one sample.
        width: number of features, and of hidden units.

    Raises:
        ConfigError: a sample holds no numbers.
    """

    bibtex = ""
    vectorises = True

    def __init__(self, input_shape: tuple[int, ...], *, width: Annotated[int, Field(ge=1)] = 64) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(require_numbers(input_shape, by="example"), width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
        )
        self.output_shape = (width,)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch width"]:
        """Return features, (batch, width)."""
        weight = next(self.parameters())
        numbers = inputs.to(weight.dtype) if inputs.is_floating_point() else inputs.to(weight.dtype) / 255
        return self.layers(numbers.flatten(1))
