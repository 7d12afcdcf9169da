"""BatchEnsemble: the mixture of members that share the weights of each layer up to a matrix of rank one."""

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution

from framework.calibration.equal_mixture import equal_mixture
from framework.calibration.validation import nonempty_batches
from framework.data import Batch
from framework.distributions.batch_shapes import Reshaped
from framework.errors import ConfigError
from framework.model import Model, Predictor, SharedResult
from framework.uncertainty import Uncertainty
from plugins.uncertainty.batch_ensemble.layers import RankOne, repeat_rows, replace_layers, several_members

WORTH_TRYING = (1, 2, 3, 5, 10, 20)


class BatchEnsemble(Uncertainty):
    """Mixture, with equal weights, of T members that share most weights (BatchEnsemble; Wen et al. 2020).

    In each linear and convolutional layer of the network in front of the density head, member m multiplies the inputs
    by factors r_m and the outputs by factors s_m, and has its own bias. All other parts, also the density head, are
    shared. Every member learns from every sample: the loss is the mean over members, and a step takes about as long as
    that of T models. With `members=1` nothing is added, and the wrapper equals the wrapped model to the last bit.

    Args:
        members: T.
        spread: standard deviation of the initial factors around 1; members whose initial factors are similar stay
            similar in training.

    Attributes:
        members: number of members that are used, counted from the first; may be lowered after training (a knob).

    Raises:
        ConfigError: the model has no linear or convolutional layer in front of the density head, a layer of an encoder
            does not keep one row for each input, the model is inside another wrapper, or more members are used than
            were trained.
    """

    varies_weights = True
    bibtex = "wen2020batchensemble"

    def __init__(
        self,
        model: Callable[[], Predictor],
        *,
        members: Annotated[int, Field(ge=1, le=1000)] = 5,
        spread: Annotated[float, Field(gt=0, le=10)] = 0.5,
    ) -> None:
        super().__init__()
        self.model = model()
        self.model_count = members
        self.members = members
        self.knobs = {"members": tuple(count for count in WORTH_TRYING if count <= members)}
        self.shared_result: SharedResult[Tensor] = SharedResult()
        if any(isinstance(module, Uncertainty) for module in self.model.modules()):
            raise ConfigError(
                f"uncertainty batch_ensemble wraps a single model, but got {type(self.model).__name__}. Put "
                "batch_ensemble first: uncertainty=[batch_ensemble,...]; the next wrapper is then around it."
            )
        if members > 1:
            self._add_members(spread)

    def _add_members(self, spread: float) -> None:
        """Replace the layers of the model; those of a density head stay as they are."""
        model = self.model
        if isinstance(model, Model):
            head = model._modules.pop("head")
            count = replace_layers(model, self.model_count, spread)
            model._modules["head"] = head
        else:
            count = replace_layers(model, self.model_count, spread)
        if not count:
            raise ConfigError(
                "uncertainty batch_ensemble gives each member factors in linear and convolutional layers, but this "
                "model has no such layer. Choose another uncertainty."
            )

    def _rank_one_layers(self) -> list[RankOne]:
        return [module for module in self.model.modules() if isinstance(module, RankOne)]

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the mixture of the densities of the members in use."""
        if not 1 <= self.members <= self.model_count:
            raise ConfigError(
                f"uncertainty.batch_ensemble.members is {self.members}, expected a number from 1 to "
                f"{self.model_count}, the number of trained members."
            )
        components = self._densities(inputs, self.members)
        return components if self.model_count == 1 else equal_mixture(components, self, inputs.device)

    def _densities(self, inputs: Tensor, members: int) -> Distribution:
        """Return the densities of members, batch_shape (batch, member); those of the model if it is the only member."""
        if self.model_count == 1:
            return self.model(inputs)
        with self._several(inputs.shape[0], members):
            tiled = self._tile(inputs, members)
            if isinstance(self.model, Model):
                return self.model.head(self.model.raw(tiled).unflatten(0, (-1, members)))
            return Reshaped(self.model(tiled), (inputs.shape[0], members))

    def _several(self, samples: int, members: int) -> AbstractContextManager[None]:
        return several_members(self._rank_one_layers(), members, samples)

    def _tile(self, inputs: Tensor, members: int) -> Tensor:
        """Return the inputs, each repeated for every member; inside `one_pass`, the same tensor for the same inputs."""
        if members != self.model_count:
            return repeat_rows(inputs, members)
        return self.shared_result.get_or_compute(inputs, lambda batch: repeat_rows(batch, members))

    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """Return the mean loss of all members for each sample, nats."""
        if self.model_count == 1:
            return self.model.loss(inputs, target)
        with self._several(inputs.shape[0], self.model_count):
            losses = self.model.loss(
                self._tile(inputs, self.model_count), repeat_rows(target, self.model_count)
            )
        return losses.unflatten(0, (-1, self.model_count)).mean(1)

    def training_densities(self, inputs: Tensor) -> Distribution:
        """Return the densities of all members, batch_shape (batch, member), or (batch,) for a single member."""
        return self._densities(inputs, self.model_count)

    @torch.no_grad()
    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the model with the predictions of all members."""
        kept_batches = nonempty_batches(batches, by="batch_ensemble")
        if self.model_count == 1:
            self.model.calibrate(kept_batches)
            return
        count = self.model_count
        for layer in self._rank_one_layers():  # batches differ in their number of rows
            layer.used = count
        try:
            self.model.calibrate(
                [{name: repeat_rows(field, count) for name, field in batch.items()} for batch in kept_batches]
            )
        finally:
            for layer in self._rank_one_layers():
                layer.used = 1
