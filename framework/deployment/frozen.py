"""The deployable form of a trained model: one CPU core, no gradient, and no parts that only training needs.

The computation from features to raw parameters is read from the model's own graph (torch.export), so that no encoder
has to declare its layers. If the graph holds fully connected layers only, batch norm is folded into the neighbouring
weights, dropout is removed, and NumPy and one compiled function compute the result. Torch runs any other model as it
is, without gradient.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.configuration.loading import load_with_description, reader
from framework.data import Data, Frame
from framework.deployment.frozen_network import Layer, Network, read, softmax
from framework.distributions.affine import AffineDensity
from framework.distributions.class_probabilities import class_probabilities
from framework.distributions.description import CategoricalDensity
from framework.distributions.protocol import median
from framework.errors import ConfigError
from framework.model import FrozenFrontEnd, Model, Predictor


def freeze(
    run_or_checkpoint: str | Path, *, uri: str | None = None, paths: Mapping[str, Any] | None = None
) -> "Frozen":
    """Return the deployable form of a trained model.

    Args:
        run_or_checkpoint: run or checkpoint, as in `framework.load`.
        uri: store, as in `framework.load`.
        paths: paths, as in `framework.load`.

    Raises:
        CheckpointError, ConfigError: as in `framework.load`.
    """
    predictor, description = load_with_description(run_or_checkpoint, uri=uri, paths=paths)
    return Frozen(predictor, description.input_shape, reader(description))


def frozen(predictor: Predictor, input_shape: Sequence[int] | None = None) -> "Frozen":
    """Return the deployable form of a predictor. It is a copy, so later training does not change it.

    Args:
        predictor: a predictor that was not loaded from a run.
        input_shape: shape of one sample, for a predictor without fixed encoders in front. If it is not given, the first
            call determines it and takes seconds.

    Raises:
        ConfigError: the predictor was loaded, so it takes raw input; `freeze` handles raw input.
    """
    if predictor.description is not None:
        raise ConfigError("This model was loaded from a run or checkpoint. Give that to framework.freeze.")
    return Frozen(predictor, input_shape)


@final
class Frozen:
    """Function from inputs to numbers that equal the predictor's own to 1e-6, in the type of its parameters.

    Attributes:
        form: description of what computes the numbers.
    """

    def __init__(
        self, predictor: Predictor, input_shape: Sequence[int] | None = None, data: Data | None = None
    ) -> None:
        self.data = data
        self.predictor = copy.deepcopy(predictor).cpu().eval().requires_grad_(False)
        self.preceded = self.predictor if isinstance(self.predictor, FrozenFrontEnd) else None
        self.inner = self.predictor if self.preceded is None else self.preceded.predictor
        floats = (tensor.dtype for tensor in self.predictor.parameters())
        self.dtype = next(floats, torch.get_default_dtype())
        self.network: Network | None = None
        self.form = "not known before the first call"
        if self.preceded is not None:
            input_shape = list(self.preceded.encoders)[-1].output_shape  # pyright: ignore
        self.shape = None if input_shape is None else tuple(input_shape)
        if self.shape is not None:
            self._read(self.shape)

    def __call__(self, inputs: Any) -> np.ndarray:
        """Return the prediction for inputs.

        It is the probabilities, (batch, class), of a model of classes, and the mean, (batch, height, width, number), of
        a model of images, because draws of a mixture of images show no image. Otherwise it is the point prediction,
        (batch, number).

        Args:
            inputs: inputs as the model of `framework.load` takes them. A predictor that was frozen by `frozen` takes
                its own inputs, with the batch dimension first, in NumPy or in torch on the CPU.

        Raises:
            DataError: it is no input of this model.
            ValueError: a computed number is not finite; the message names the first such batch row.
        """
        features, network, frame = self._features(inputs)
        if network is not None and network.classes:
            probability = network(features)
            softmax(probability)
            if np.isnan(probability[:, 0]).any():
                row = int(np.isnan(probability[:, 0]).argmax())
                raise ValueError(f"The raw parameters are not finite in batch row {row}.")
            return probability
        with torch.inference_mode():
            density = self._density(features, network)
            if density.has_enumerate_support and not density.event_shape:
                return class_probabilities(density).to(self.dtype).numpy()
            found = density.mean if len(density.event_shape) == 3 else median(density, 1000)
            return (found if frame is None else frame.location + frame.scale * found).numpy()

    @torch.no_grad()  # not in inference mode, because the density is used outside of it later
    def density(self, inputs: Any) -> Distribution:
        """Return the density over the target, with batch_shape (batch,); inputs are the same as for a call."""
        features, network, frame = self._features(inputs)
        density = self._density(features, network)
        return density if frame is None else AffineDensity(density, *frame)

    def _features(self, inputs: Any) -> tuple[Any, Network | None, Frame | None]:
        """Return the features that the inner predictor reads, its network, and the frame of the predictions.

        The features are in the form that the network reads. The network is None if torch computes the prediction.
        """
        frame = None
        if self.data is not None:
            batch = self.data.user_batch(inputs)
            inputs, frame = batch["input"], self.data.frame(batch)
        if self.preceded is not None:
            with torch.no_grad():
                inputs = self.preceded.features(_tensor(inputs))
        if self.shape is None:
            self.shape = tuple(inputs.shape[1:])
            self._read(self.shape)
        network = self.network
        if network is None or not _floating(inputs):
            return _tensor(inputs), None, frame
        found = inputs.detach().numpy() if isinstance(inputs, Tensor) else inputs
        if found.shape[1:] != self.shape:
            raise ValueError(
                f"inputs of shape {tuple(found.shape)}; wanted (batch, {', '.join(map(str, self.shape))})."
            )
        flat = found.reshape(len(found), math.prod(self.shape))
        return np.ascontiguousarray(flat, dtype=network.dtype), network, frame

    def _density(self, features: Any, network: Network | None) -> Distribution:
        """Return the density for features."""
        if network is None:
            return self.inner(features)
        raw = torch.from_numpy(network(features))
        if network.classes:
            return CategoricalDensity(logits=raw, validate_args=False)
        assert isinstance(self.inner, Model)
        return self.inner.head(raw)

    def _read(self, shape: tuple[int, ...]) -> None:
        """Read the network of the model for features of this shape, if it has one."""
        if not isinstance(self.inner, Model):
            self.form = f"{type(self.inner).__name__} in torch, without gradient"
            return
        network = read(self.inner, shape)
        if network is None:
            self.form = "the model in torch, without gradient: it is not of fully connected layers alone"
            return
        self.network = network
        layers = sum(isinstance(step, Layer) for step in network.steps)
        after = "softmax" if network.classes else f"{type(self.inner.head).__name__} in torch"
        self.form = f"{layers} fully connected layers with batch norm folded, compiled, then {after}"


def _tensor(inputs: np.ndarray | Tensor) -> Tensor:
    # torch accepts only memory that it may write to
    return (
        inputs
        if isinstance(inputs, Tensor)
        else torch.from_numpy(np.require(inputs, requirements=["C", "W"]))
    )


def _floating(inputs: np.ndarray | Tensor) -> bool:
    return inputs.is_floating_point() if isinstance(inputs, Tensor) else inputs.dtype.kind == "f"
