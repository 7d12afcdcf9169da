"""The deployable form of a trained model: one CPU core, no gradient, nothing that only training needs.

What a model computes from features to raw numbers is read off its own graph (torch.export), so that no encoder has to
say what it is made of. Where that is fully connected layers, batch norm is folded into the weights beside it, dropout
is gone, and what runs is NumPy and one compiled function. Anything else is run by torch as it is, without gradient.
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
from framework.distributions.class_probabilities import class_probabilities
from framework.distributions.description import CategoricalDensity
from framework.distributions.moved import Moved
from framework.distributions.protocol import median
from framework.errors import ConfigError
from framework.model import FrozenFrontEnd, Model, Predictor


def freeze(
    run_or_checkpoint: str | Path, *, uri: str | None = None, paths: Mapping[str, Any] | None = None
) -> "Frozen":
    """The deployable form of a trained model.

    Args:
        run_or_checkpoint, uri, paths: as of `framework.load`.

    Raises:
        CheckpointError, ConfigError: as `framework.load`.
    """
    predictor, description = load_with_description(run_or_checkpoint, uri=uri, paths=paths)
    return Frozen(predictor, description.input_shape, reader(description))


def frozen(predictor: Predictor, input_shape: Sequence[int] | None = None) -> "Frozen":
    """The deployable form of a predictor, a copy: training it further does not change what was frozen.

    Args:
        input_shape: of one sample. Needed by a predictor without fixed encoders in front; where it is not given, the
            first call tells, and takes seconds.

    Raises:
        ConfigError: it was loaded, and so takes raw input, which `freeze` makes ready in the frozen form too.
    """
    if predictor.description is not None:
        raise ConfigError("This model was loaded from a run or checkpoint. Give that to framework.freeze.")
    return Frozen(predictor, input_shape)


@final
class Frozen:
    """Inputs in, numbers out; the predictor's own to 1e-6, in the type of its parameters.

    Attributes:
        form: what computes them, in words.
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
        """Of a model of classes their probabilities, (batch, class); of images their mean, (batch, height, width,
        number), for no draws of a mixture of them show a picture; else the point prediction, (batch, number).

        Args:
            inputs: what `framework.load`'s model takes; of a predictor that was frozen by itself its inputs, with the
                batch dimension first, in NumPy or on the CPU in torch.

        Raises:
            DataError: it is no input of this model.
            ValueError: what is computed is not finite; names the first such batch row.
        """
        features, network, frame = self._features(inputs)
        if network is not None and network.classes:
            probability = network(features)
            softmax(probability)
            if np.isnan(probability[:, 0]).any():
                row = int(np.isnan(probability[:, 0]).argmax())
                raise ValueError(f"raw numbers are not finite in batch row {row}.")
            return probability
        with torch.inference_mode():
            density = self._density(features, network)
            if density.has_enumerate_support and not density.event_shape:
                return class_probabilities(density).to(self.dtype).numpy()
            found = density.mean if len(density.event_shape) == 3 else median(density, 1000)
            return (found if frame is None else frame.location + frame.scale * found).numpy()

    @torch.no_grad()  # not in inference mode: whoever asks the density later is outside of it
    def density(self, inputs: Any) -> Distribution:
        """The density over the target, with batch_shape (batch,); inputs as above."""
        features, network, frame = self._features(inputs)
        density = self._density(features, network)
        return density if frame is None else Moved(density, *frame)

    def _features(self, inputs: Any) -> tuple[Any, Network | None, Frame | None]:
        """What the inner predictor reads, in the form that the network reads, if there is one for it; and the frame of
        the answers."""
        frame = None
        if self.data is not None:
            batch = self.data.asked(inputs)
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
        if network is None:
            return self.inner(features)
        raw = torch.from_numpy(network(features))
        if network.classes:
            return CategoricalDensity(logits=raw, validate_args=False)
        assert isinstance(self.inner, Model)
        return self.inner.head(raw)

    def _read(self, shape: tuple[int, ...]) -> None:
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
    # torch wants memory that it might write to
    return (
        inputs
        if isinstance(inputs, Tensor)
        else torch.from_numpy(np.require(inputs, requirements=["C", "W"]))
    )


def _floating(inputs: np.ndarray | Tensor) -> bool:
    return inputs.is_floating_point() if isinstance(inputs, Tensor) else inputs.dtype.kind == "f"
