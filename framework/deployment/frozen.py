"""The deployable form of a trained model, without gradients and without the parts that only training needs.

The computation from features to raw parameters is read from the model's graph (torch.export), so no encoder has to
declare its layers. If the graph contains fully connected layers only, batch norm is folded into the weights of the
neighbouring layers, and dropout is removed. A compiled function then computes the raw parameters if the batch has one
sample, and ONNX Runtime or torch computes them if it has more. The networks of any other model are computed by ONNX
Runtime if the extra `export` is installed, and by torch otherwise; the density is computed by torch.
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

from framework.configuration.loading import load_with_description, reader, user_batch
from framework.data import Data, Frame
from framework.deployment.frozen_network import Layer, Network, read_network, to_probabilities
from framework.deployment.onnx_networks import use_onnx
from framework.distributions.affine import AffineDensity
from framework.distributions.class_probabilities import class_probabilities
from framework.distributions.description import CategoricalDensity
from framework.distributions.protocol import median
from framework.errors import ConfigError, count_of
from framework.model import FrozenFrontEnd, Model, Predictor


def freeze(
    run_or_checkpoint: str | Path, *, uri: str | None = None, paths: Mapping[str, Any] | None = None
) -> "Frozen":
    """Return the deployable form of a trained model.

    Args:
        run_or_checkpoint: a run folder, a checkpoint file, or an MLflow run id.
        uri: tracking store of the run id; None for the local store under `outputs/`.
        paths: files and folders by their keys in the model's config, such as {"data.root": "/my/data"}.

    Raises:
        CheckpointError: there is no checkpoint, or it is damaged.
        ConfigError: the model needs a path that `paths` does not give.
    """
    predictor, description = load_with_description(run_or_checkpoint, uri=uri, paths=paths)
    return Frozen(predictor, description.input_shape, reader(description))


def freeze_predictor(predictor: Predictor, input_shape: Sequence[int] | None = None) -> "Frozen":
    """Return the deployable form of a copy of a predictor; training the original later does not change the copy.

    Args:
        predictor: a trained predictor that was not loaded from a run or checkpoint.
        input_shape: shape of one input, for a predictor that does not begin with fixed encoders. If it is None, it is
            read from the inputs of the first call, which then takes seconds.

    Raises:
        ConfigError: the predictor was loaded from a run and reads raw input; use `freeze` instead.
    """
    if predictor.description is not None:
        raise ConfigError(
            "This model was loaded from a run or checkpoint. Pass the run or checkpoint to framework.freeze instead."
        )
    return Frozen(predictor, input_shape)


@final
class Frozen:
    """Deployable form of a predictor: a function from inputs to predictions.

    Its predictions have the data type of the predictor's parameters. The probabilities of fully connected classifiers
    differ by at most 1e-6 from those of the predictor. The raw parameters that ONNX Runtime computes differ from those
    of torch by at most 1e-5 · max(1, largest raw parameter); a network whose raw parameters differ more is run by
    torch.

    Args:
        predictor: the trained predictor; a copy of it is used.
        input_shape: shape of one input; None: it is read from the fixed encoders before the predictor
            (`FrozenFrontEnd`) or, without these, from the first call.
        data: data set that converts raw input; None if inputs are those of the predictor.

    Attributes:
        form: sentence that describes how the predictions are computed.
    """

    def __init__(
        self, predictor: Predictor, input_shape: Sequence[int] | None = None, data: Data | None = None
    ) -> None:
        self.data = data
        self.predictor = copy.deepcopy(predictor).cpu().eval().requires_grad_(False)
        self.front_end = self.predictor if isinstance(self.predictor, FrozenFrontEnd) else None
        self.inner = self.predictor if self.front_end is None else self.front_end.predictor
        floats = (tensor.dtype for tensor in self.predictor.parameters())
        self.dtype = next(floats, torch.get_default_dtype())
        self.network: Network | None = None
        self.form = "not known before the first call"
        if self.front_end is not None:
            input_shape = list(self.front_end.encoders)[-1].output_shape  # pyright: ignore
        self.shape = None if input_shape is None else tuple(input_shape)
        if self.shape is not None:
            self._read(self.shape)

    def __call__(self, inputs: Any) -> np.ndarray:
        """Return the prediction for inputs.

        For class targets, this is the probability of each class, (batch, class). For image targets, it is the mean,
        (batch, height, width, number), because the median of a mixture of images is not a plausible image. Otherwise,
        it is the point prediction, (batch, number).

        Args:
            inputs: inputs that the model of `framework.load` accepts. After `freeze_predictor`, the inputs of the
                predictor, batch dimension first, as NumPy array or torch tensor on the CPU.

        Raises:
            DataError: `inputs` is not an input of this model.
            ValueError: a raw parameter is not finite; the message names the first row of the batch with such a
                parameter.
        """
        features, network, frame = self._features(inputs)
        if network is not None and network.classes:
            probability, all_finite = to_probabilities(network(features))
            if not all_finite:
                row = int(np.isnan(probability[:, 0]).argmax())
                raise ValueError(
                    f"The raw parameters are not finite in batch row {row}. Check the inputs of this row."
                )
            return probability
        with torch.inference_mode():
            density = self._density(features, network)
            if density.has_enumerate_support and not density.event_shape:
                return class_probabilities(density).to(self.dtype).numpy()
            value = density.mean if len(density.event_shape) == 3 else median(density, 1000)
            return (value if frame is None else frame.location + frame.scale * value).numpy()

    @torch.no_grad()  # not inference mode, because the density is used outside of it
    def density(self, inputs: Any) -> Distribution:
        """Return the density of the target, batch_shape (batch,); see `__call__` for the inputs."""
        features, network, frame = self._features(inputs)
        density = self._density(features, network)
        return density if frame is None else AffineDensity(density, *frame)

    def _features(self, inputs: Any) -> tuple[Any, Network | None, Frame | None]:
        """Return the features, the network that reads them, and the map from predictions to the user's unit (`Frame`).

        If torch computes the raw parameters, the network is None and the features are a tensor. Otherwise the features
        are an array (batch, length). The map is None if predictions are in the user's unit already.
        """
        frame = None
        if self.data is not None:
            batch = user_batch(self.data, inputs)
            inputs, frame = batch["input"], self.data.frame(batch)
        if self.front_end is not None:
            # detached instead of computed without gradient, because the parameters of the copy require none
            inputs = self.front_end.features(_to_tensor(inputs).detach())
        if self.shape is None:
            self.shape = tuple(inputs.shape[1:])
            self._read(self.shape)
        network = self.network
        if network is None or not _is_floating(inputs):
            return _to_tensor(inputs), None, frame
        array = inputs.detach().numpy() if isinstance(inputs, Tensor) else inputs
        if array.shape[1:] != self.shape:
            raise ValueError(
                f"Got inputs of shape {tuple(array.shape)}, but shape (batch, {', '.join(map(str, self.shape))}) is "
                "required. Reshape the inputs."
            )
        flat = array.reshape(len(array), math.prod(self.shape))
        return np.ascontiguousarray(flat, dtype=network.dtype), network, frame

    def _density(self, features: Any, network: Network | None) -> Distribution:
        """Return the density for features, computed with `network` or, if it is None, by torch."""
        if network is None:
            return self.inner(features)
        raw = torch.from_numpy(network(features))
        if network.classes:
            return CategoricalDensity(logits=raw, validate_args=False)
        assert isinstance(self.inner, Model)
        return self.inner.head(raw)

    def _read(self, shape: tuple[int, ...]) -> None:
        """Set `form`; set `network` if all layers of the model are fully connected, else let ONNX Runtime compute them.

        Args:
            shape: shape of the features of one sample.
        """
        network = read_network(self.inner, shape) if isinstance(self.inner, Model) else None
        if network is None:
            # images are bytes
            dtype = torch.uint8 if len(shape) == 3 and self.front_end is None else self.dtype
            count = use_onnx(self.inner, shape, dtype)
            name = type(self.inner.head if isinstance(self.inner, Model) else self.inner).__name__
            self.form = (
                f"{count_of(count, 'network')} in ONNX Runtime, then {name} in torch"
                if count
                else f"{type(self.inner).__name__} in torch, without gradient"
            )
            return
        self.network = network
        layers = sum(isinstance(step, Layer) for step in network.steps)
        assert isinstance(self.inner, Model)
        after = "softmax" if network.classes else f"{type(self.inner.head).__name__} in torch"
        self.form = f"{layers} fully connected layers with batch norm folded, compiled, then {after}"


def _to_tensor(inputs: np.ndarray | Tensor) -> Tensor:
    # torch requires writable memory.
    return (
        inputs
        if isinstance(inputs, Tensor)
        else torch.from_numpy(np.require(inputs, requirements=["C", "W"]))
    )


def _is_floating(inputs: np.ndarray | Tensor) -> bool:
    return inputs.is_floating_point() if isinstance(inputs, Tensor) else inputs.dtype.kind == "f"
