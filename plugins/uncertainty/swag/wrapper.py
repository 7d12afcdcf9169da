"""SWA-Gaussian (SWAG): a mixture over draws from a Gaussian around the weights of the last epochs."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.distributions import Distribution
from torch.func import functional_call, vmap

from framework.calibration.equal_mixture import equal_mixture
from framework.calibration.module_flags import BATCH_NORM
from framework.calibration.validation import nonempty_batches
from framework.calibration.weight_draws import weight_noise
from framework.data import Batch
from framework.density_head import DensityHead
from framework.distributions.batch_shapes import Stacked
from framework.errors import ConfigError
from framework.model import Model, Predictor
from framework.storage.limits import MOST_DRAWS
from framework.storage.weights import FINITE, FROM_0, require_state
from framework.uncertainty import FollowsTraining, Uncertainty
from plugins.uncertainty.swag.moments import Moments, add, draw

MOST_CACHED = 2**24
"""Largest number of weights of all draws together that are kept between predictions (64 MiB in float32)."""


class Swag(Uncertainty, FollowsTraining):
    """Mixture, with equal weights, of the densities under S draws of all weights (SWAG; Maddox et al. 2019).

    The draws are from a Gaussian whose mean and covariance are those of the weights after the last epochs of training;
    the covariance is half diagonal and half of low rank (moments.py). Training is that of the wrapped model; the method
    assumes a learning rate that stays large enough for the weights to move. The wrapped model is calibrated with the
    mean weights. The S draws use the same noise in every prediction. Before the first collected epoch the densities are
    those of the model.

    Args:
        start: share of the training after which the weights of each epoch are collected.
        rank: K, the number of last deviations that the covariance of low rank uses; 0 for a diagonal covariance.

    Attributes:
        samples: S, which may be changed after training (a knob).
        count: number of collected epochs, an int64 buffer.

    Raises:
        ConfigError: the model has batch norm, a density head with weights of its own, or nothing to train; or `samples`
            was set below 1.
    """

    knobs = {"samples": (1, 3, 10, 30, 100)}  # noqa: RUF012 - never written
    varies_weights = True
    bibtex = "maddox2019simple"
    count: Tensor
    mean: Tensor
    squares: Tensor
    deviations: Tensor
    next_epoch: Tensor

    def __init__(
        self,
        model: Callable[[], Predictor],
        *,
        start: Annotated[float, Field(ge=0, lt=1)] = 0.75,
        rank: Annotated[int, Field(ge=0, le=1000)] = 20,
        samples: Annotated[int, Field(ge=1, le=MOST_DRAWS)] = 30,
    ) -> None:
        super().__init__()
        self.model = model()
        self.start = start
        self.samples = samples
        require_plain_weights(self.model)
        weights = self._weights()
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))
        self.register_buffer("next_epoch", torch.zeros((), dtype=torch.int64))
        self.register_buffer("mean", torch.zeros_like(weights))
        self.register_buffer("squares", torch.zeros_like(weights))
        self.register_buffer("deviations", weights.new_zeros(rank, len(weights)))
        numbers = {"mean": FINITE, "squares": FROM_0, "deviations": FINITE}
        require_state(self, count=FROM_0, next_epoch=FROM_0, **numbers)
        self._cached: tuple[Any, list[Tensor]] | None = None

    def _parameters_by_name(self) -> dict[str, nn.Parameter]:
        return dict(self.model.named_parameters())

    def _weights(self) -> Float[Tensor, "weight"]:
        """Return all weights of the model as one vector."""
        return nn.utils.parameters_to_vector(self.model.parameters()).detach()

    def _by_name(self, weights: Float[Tensor, "*draw weight"]) -> dict[str, Tensor]:
        """Return weights by the names of the model's parameters, (*draw, *shape) each."""
        parameters = self._parameters_by_name()
        parts = weights.split([parameter.numel() for parameter in parameters.values()], -1)
        return {
            name: part.unflatten(-1, parameter.shape) if parameter.dim() else part.squeeze(-1)
            for part, (name, parameter) in zip(parts, parameters.items(), strict=True)
        }

    @property
    def _moments(self) -> Moments:
        return Moments(self.count, self.mean, self.squares, self.deviations)

    @torch.no_grad()
    def after_epoch(self, epoch: int, epochs: int) -> None:
        """Add the present weights to the moments in the last epochs of the training."""
        if epoch + 1 > self.start * epochs and epoch >= int(self.next_epoch):
            add(self._moments, self._weights().to(self.mean))
            self.next_epoch.fill_(epoch + 1)

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the model's density in training and before the first collected epoch, and the mixture otherwise."""
        if self.samples < 1:
            raise ConfigError(f"uncertainty.swag.samples is {self.samples}, expected 1 or more.")
        draws = [] if self.training else self._draws()
        if not draws:
            return self.model(inputs)
        model = self.model
        if isinstance(model, Model):
            components: Distribution = model.head(self._raws(model, inputs, draws))
        else:
            components = Stacked(
                [functional_call(model, self._by_name(weights), (inputs,)) for weights in draws]
            )
        return equal_mixture(components, self.model, inputs.device)

    def _raws(self, model: Model, inputs: Tensor, draws: list[Tensor]) -> Float[Tensor, "batch sample *raw"]:
        """Return the raw parameters of the head for every input under each draw of the weights."""
        network = nn.ModuleDict({"encoders": model.encoders, "projection": model.projection})

        def compute(parameters: dict[str, Tensor], inputs: Tensor) -> Tensor:
            return functional_call(
                _Chain(network), {f"parts.{key}": part for key, part in parameters.items()}, (inputs,)
            )

        vectorises = all(encoder.vectorises for encoder in model.encoders)
        if not vectorises or torch.compiler.is_exporting():  # vmap cannot be traced
            return torch.stack([compute(self._by_name(weights), inputs) for weights in draws], 1)
        stacked = self._by_name(torch.stack(draws))
        return vmap(compute, in_dims=(0, None), out_dims=1, randomness="different")(stacked, inputs)

    def _draws(self) -> list[Tensor]:
        """Return S draws of the weights, (weight,) each; none without moments.

        If they fit into MOST_CACHED, they are computed once for each state of the buffers and each number of samples.
        """
        if torch.compiler.is_exporting() and self._cached is not None:  # as in the call before the export
            return self._cached[1]
        key = (self.samples, *((id(part), part._version, part.dtype, part.device) for part in self._moments))
        if self._cached is not None and self._cached[0] == key:
            return self._cached[1]
        draws = []
        if int(self.count):
            size = len(self.mean) + len(self.deviations)
            noises = (weight_noise(number, size).to(self.mean) for number in range(self.samples))
            draws = [draw(self._moments, noise) for noise in noises]
        self._cached = (key, draws) if self.samples * len(self.mean) <= MOST_CACHED else None
        return draws

    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the wrapped model with the mean weights."""
        kept_batches = nonempty_batches(batches, by="swag")
        with self._mean_weights():
            self.model.calibrate(kept_batches)
        if int(self.count):
            spread = (self.squares / self.count).sqrt().mean().item()
            self.remark = (
                f"swag: weights of {int(self.count)} epochs; standard deviation {spread:.3g} on average."
            )

    @contextmanager
    def _mean_weights(self) -> Iterator[None]:
        """Give the model the mean weights inside the block, if there are moments."""
        if not int(self.count):
            yield
            return
        parameters = self._parameters_by_name()
        own_weights = {name: parameter.data for name, parameter in parameters.items()}
        try:
            for name, part in self._by_name(self.mean).items():
                parameters[name].data = part.to(parameters[name])
            yield
        finally:
            for name, parameter in parameters.items():
                parameter.data = own_weights[name]


class _Chain(nn.Module):
    """Encoders and projection of a model as one module, whose parameters have the model's names after "parts."."""

    def __init__(self, parts: nn.ModuleDict) -> None:
        super().__init__()
        self.parts = parts

    def forward(self, inputs: Tensor) -> Tensor:
        raw: Tensor = self.parts["projection"](self.parts["encoders"](inputs))
        return raw


def require_plain_weights(model: Predictor) -> None:
    """Refuse a model whose draws would be wrong.

    Raises:
        ConfigError: the model has batch norm, a density head with weights, or no weights at all.
    """
    if any(isinstance(module, BATCH_NORM) for module in model.modules()):
        raise ConfigError(
            "uncertainty swag draws weights, but this model has batch norm, whose stored means and variances belong to "
            "the trained weights alone. Choose an encoder without batch norm, e.g. encoder.mlp.batch_norm=false."
        )
    heads = [
        module for module in model.modules() if isinstance(module, DensityHead) and list(module.parameters())
    ]
    if heads:
        raise ConfigError(
            "uncertainty swag draws the weights of the networks in front of the density head, but "
            f"{type(heads[0]).__name__} has weights of its own. Choose another density_head, or another uncertainty."
        )
    if not any(parameter.requires_grad for parameter in model.parameters()):
        raise ConfigError("uncertainty swag draws weights, but this model has none to train. Leave swag out.")
