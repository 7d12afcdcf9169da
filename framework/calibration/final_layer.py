"""Functions that find the final linear layer of a model, before the density head, and return its input and output."""

from typing import Any, NamedTuple

from jaxtyping import Float
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.errors import ConfigError
from framework.model import Model, Predictor


class FinalLayerPass(NamedTuple):
    """Input and output of the final layer in one prediction.

    Attributes:
        features: input of the layer.
        raw: output of the layer, the raw parameters.
        density: density of the prediction; None if the predictor is a `Model`, whose head is not called.
    """

    features: Float[Tensor, "batch feature"]
    raw: Float[Tensor, "batch raw"]
    density: Distribution | None


def find_final_layer(model: Predictor) -> nn.Linear | None:
    """Return the projection of a `Model`, or the last linear layer of any other predictor; None if there is none."""
    if isinstance(model, Model):
        return model.projection if isinstance(model.projection, nn.Linear) else None
    layers = [module for module in model.modules() if isinstance(module, nn.Linear)]
    return layers[-1] if layers else None


def run_final_layer(model: Predictor, layer: nn.Linear, inputs: Tensor, by: str) -> FinalLayerPass:
    """Return the input and the output of a model's final layer for a batch of inputs.

    Args:
        model: the predictor.
        layer: its final layer, as `find_final_layer` returns it.
        inputs: batch of inputs of the model.
        by: name of the uncertainty wrapper that calls this function, for the error message.

    Raises:
        ConfigError: a predictor that is no `Model` calls the layer several times, or not with vectors.
    """
    if isinstance(model, Model):
        features = model.encoders(inputs)
        return FinalLayerPass(features, layer(features), None)
    calls: list[tuple[Tensor, Tensor]] = []

    def record(_: nn.Module, arguments: tuple[Any, ...], output: Any) -> None:
        calls.append((arguments[0], output))

    hook = layer.register_forward_hook(record)
    try:
        density = model(inputs)
    finally:
        hook.remove()
    features, raw = calls[0] if len(calls) == 1 else (inputs, inputs.unsqueeze(-1))
    if len(calls) != 1 or features.dim() != 2:
        raise ConfigError(
            f"uncertainty {by} needs a model that calls its final linear layer once with one vector for each input, "
            f"but {type(model).__name__} calls it {len(calls)} times, with features of {features.dim() - 1} "
            "dimensions. Choose another uncertainty."
        )
    return FinalLayerPass(features, raw, density)
