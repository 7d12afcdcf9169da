"""Fully connected layers, for features, point clouds and images small enough to flatten."""

from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.encoder import Encoder, require_numbers
from framework.errors import ConfigError

Width = Annotated[int, Field(gt=0)]
Probability = Annotated[float, Field(ge=0, lt=1)]


class MLP(Encoder):
    """Fully connected layers on the flattened input.

    Each layer consists of a linear map, batch norm if requested, an activation and dropout, in this order. With
    `batch_norm="after_relu"` batch norm follows the activation, as in the blocks of thesis §6.5.1.

    Args:
        input_shape: any; a sample is flattened.
        widths: output length of each layer; with an empty list the features are the flattened input.
        dropout: probability of dropping an output of a layer; one number for all layers, or one for each.
        batch_norm: whether to normalise over the batch: True before the activation, "after_relu" after it; training
            then needs batches of at least two samples.
        activation: "relu" (rectified linear units), "elu" (exponential linear units) or "silu" (x times its logistic
            function, Elfwing et al. 2018).
        initial: "torch": torch's initial weights and biases, uniform within 1/√n for n inputs; "he": normal weights of
            variance 2/n and biases of 0 (He et al. 2015), and weights of 0 in the linear layer to the head. Small
            smooth networks then learn more of a target with little noise.

    Raises:
        ConfigError: a sample holds no numbers, or the number of probabilities differs from the number of layers.
    """

    bibtex = "rumelhart1986learning"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        widths: list[Width] = [512, 512],  # noqa: B006 - never written
        dropout: Probability | list[Probability] = 0.0,
        batch_norm: bool | Literal["after_relu"] = False,
        activation: Literal["relu", "elu", "silu"] = "relu",
        initial: Literal["torch", "he"] = "torch",
    ) -> None:
        super().__init__()
        length = require_numbers(input_shape, by="mlp")
        drops = dropout if isinstance(dropout, list) else [dropout] * len(widths)
        if len(drops) != len(widths):
            raise ConfigError(
                f"encoder.mlp.dropout has {len(drops)} probabilities for {len(widths)} layers. Set one probability for "
                "each layer, or one number for all layers."
            )
        layers: list[nn.Module] = []
        before, after = batch_norm is True, batch_norm == "after_relu"
        units = {"relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}[activation]
        for width, drop in zip(widths, drops, strict=True):
            layers.append(
                nn.Linear(length, width, bias=not before)
            )  # the batch norm after it has its own bias
            layers += [nn.BatchNorm1d(width)] * before
            layers.append(units(inplace=True))
            layers += [nn.BatchNorm1d(width)] * after
            layers.append(nn.Dropout(drop))
            length = width
        if initial == "he":
            for layer in layers:
                if isinstance(layer, nn.Linear):
                    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                    if layer.bias is not None:
                        nn.init.zeros_(layer.bias)
        self.starts_flat = initial == "he"
        self.layers = nn.Sequential(*layers)
        self.vectorises = not batch_norm  # the running moments of batch norm are buffers
        self.output_shape = (length,)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        """Return the features of the flattened inputs."""
        numbers = inputs.flatten(1)
        default = inputs.dtype if inputs.is_floating_point() else torch.get_default_dtype()
        dtype = next((parameter.dtype for parameter in self.parameters()), default)
        if inputs.dtype == torch.uint8:
            numbers = numbers.to(dtype) / 255
        return self.layers(numbers.to(dtype))
