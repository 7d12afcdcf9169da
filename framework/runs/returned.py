"""Checks of what the parts of a model return for the first samples; the messages name the part at fault."""

import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch, Data, Splits, shape_fits
from framework.density_head import DensityHead
from framework.encoder import Encoder
from framework.errors import ConfigError, DataError
from framework.model import Model, Predictor
from framework.target import Target
from framework.uncertainty import Uncertainty


def require_splits(data: Data) -> Splits:
    """Return the splits of a data set.

    Raises:
        DataError: The method `splits` returns something else than `framework.data.Splits`.
    """
    splits = data.splits()
    if not isinstance(splits, Splits):
        raise DataError(
            f"{type(data).__name__}.splits returned {_describe(splits)}, but framework.data.Splits is required. "
            f"Correct {_locate(data, 'splits')}: return Splits(train, validation, test)."
        )
    return splits


def require_inputs(batch: Batch, data: Data) -> None:
    """Require that the inputs have the shape that the data set states, because the encoders are built for this shape.

    Raises:
        DataError: The inputs have another shape.
    """
    shape, expected = tuple(batch["input"].shape[1:]), tuple(data.input_shape)
    if not shape_fits(shape, expected):
        raise DataError(
            f"{type(data).__name__} gives inputs of shape {shape}, but states input_shape = {expected}. Correct "
            f"input_shape in {_locate(data, 'prepare')}, or the samples of {_locate(data, 'splits')}."
        )


@contextmanager
def check_parts(predictor: Predictor, target: Target) -> Iterator[None]:
    """Check, inside the block, what each encoder, each model's density head and each wrapper returns.

    Raises:
        ConfigError: An encoder returns features of another shape than its `output_shape`, or of another type than its
            parameters; or a head or wrapper returns no density, or a density of other dimensions.
    """
    handles = []
    for module in predictor.modules():
        if isinstance(module, Encoder):
            handles.append(module.register_forward_hook(_check_features))
        elif isinstance(module, Predictor):
            handles.append(module.register_forward_hook(partial(_check_density, target)))
            if isinstance(module, Model):
                handles.append(module.head.register_forward_hook(partial(_check_density, target)))
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def _check_features(encoder: nn.Module, arguments: tuple[Any, ...], features: Any) -> None:
    assert isinstance(encoder, Encoder)
    expected = (len(arguments[0]), *encoder.output_shape)
    if not isinstance(features, Tensor) or tuple(features.shape) != expected:
        raise ConfigError(
            f"{type(encoder).__name__} returned {_describe(features)} for {expected[0]} samples, but its output_shape "
            f"{tuple(encoder.output_shape)} states features of shape {expected}. Correct output_shape in its "
            f"constructor, or {_locate(encoder, 'forward')}."
        )
    weights = {parameter.dtype for parameter in encoder.parameters() if parameter.is_floating_point()}
    if len(weights) == 1 and features.dtype not in weights:
        raise ConfigError(
            f"{type(encoder).__name__} returned features of type {features.dtype}, but its parameters have the type "
            f"{weights.pop()}, which the features must have too. Correct {_locate(encoder, 'forward')}."
        )


def _check_density(target: Target, part: nn.Module, arguments: tuple[Any, ...], density: Any) -> None:
    inputs = arguments[0]
    batch = tuple(inputs.shape[: -len(part.raw_shape)] if isinstance(part, DensityHead) else inputs.shape[:1])
    if not isinstance(density, Distribution):
        raise ConfigError(
            f"{type(part).__name__} returned {_describe(density)}, but a torch.distributions.Distribution is required. "
            f"Correct {_locate(part, 'forward')}."
        )
    event = tuple(target.event_shape)
    if tuple(density.batch_shape) != batch or tuple(density.event_shape) != event:
        raise ConfigError(
            f"{type(part).__name__} returned a {type(density).__name__} with the batch_shape "
            f"{tuple(density.batch_shape)} and the event_shape {tuple(density.event_shape)}, but {batch} and {event} "
            f"are required for targets of kind {target.kind!r} ({target.listed_names}). "
            "torch.distributions.Independent turns batch dimensions into event dimensions. "
            f"Correct {_locate(part, 'forward')}."
        )


def require_losses(losses: Any, predictor: Predictor, samples: int) -> None:
    """Require one training loss for each sample, because a loss of another shape would be averaged without an error.

    Raises:
        ConfigError: The losses have another shape.
    """
    if isinstance(losses, Tensor) and tuple(losses.shape) == (samples,):
        return
    defaults = (DensityHead.loss, Uncertainty.loss)
    parts = [part for part in predictor.modules() if isinstance(part, DensityHead | Uncertainty)]
    own = [part for part in parts if type(part).loss not in defaults] or parts
    raise ConfigError(
        f"The training loss of {samples} samples is {_describe(losses)}, but one number for each sample is required, "
        f"shape ({samples},). Correct {' or '.join(_locate(part, 'loss') for part in own)}."
    )


def _describe(result: Any) -> str:
    """Return the shape of a tensor, or the type of another result, as words."""
    if isinstance(result, Tensor):
        return f"a tensor of shape {tuple(result.shape)}"
    return f"an object of type {type(result).__name__}"


def _locate(part: object, method: str) -> str:
    """Return the name of a part's method, with its file and line if the source is known."""
    function = getattr(type(part), method)
    name = f"the method {function.__qualname__}"
    try:
        file, line = Path(inspect.getfile(function)), inspect.getsourcelines(function)[1]
    except (OSError, TypeError):
        return name
    return f"{name} ({file.parent.name}/{file.name}, line {line})"
