"""Last-layer Laplace approximation: a mixture over draws of the weights of the final linear layer."""

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.calibration.equal_mixture import equal_mixture
from framework.calibration.final_layer import find_final_layer, run_final_layer
from framework.calibration.module_flags import evaluation_mode
from framework.calibration.validation import nonempty_batches, require_numbers
from framework.calibration.weight_draws import weight_noise
from framework.data import Batch
from framework.distributions.batch_shapes import Stacked
from framework.errors import ConfigError
from framework.model import Model, Predictor
from framework.storage.limits import MOST_DRAWS
from framework.storage.weights import FINITE, FROM_0, require_state
from framework.uncertainty import ReadsTraining, Uncertainty
from plugins.uncertainty.laplace.posterior import (
    Covariance,
    Eigen,
    collect,
    draw_deviations,
    fisher_of_raw,
    most_likely_precision,
)

MOST_WEIGHTS = 2048
"""Largest number of weights of the final layer with a full covariance (32 MiB in a checkpoint)."""
DECADES = torch.linspace(-3, 5, 17, dtype=torch.float64)
"""Decimal logarithms of the factors on the most likely precision that are tried on the validation split."""
Precision = Literal["marginal", "validation"] | Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Laplace(Uncertainty, ReadsTraining):
    """Mixture, with equal weights, of the densities under S draws of the final layer's weights (Daxberger et al. 2021).

    The posterior of the weights is N(W*, (H + λ I)⁻¹): W* are the trained weights, H is the Fisher information of the
    training split, and λ is the precision of a normal prior (posterior.py). If the raw parameters are natural
    parameters, H is the generalised Gauss-Newton matrix. The wrapped model may have any density head that has a final
    linear layer; the model trains as it would without the wrapper. The S draws use the same noise in every prediction.
    Before `calibrate`, the wrapper returns the densities of the model. If `calibrate` gets no training split, it fits H
    to the samples that it is given.

    Args:
        covariance: "full" for all weights together; "kronecker" for a product of a matrix over raw parameters and one
            over features; "diagonal" for independent weights.
        prior_precision: λ, or how it is chosen: "marginal" by the marginal likelihood of the training split,
            "validation" by the likelihood of the validation split. "validation" may also choose an infinite λ, with
            which all draws are the trained weights.

    Attributes:
        samples: S, which may be changed after training (a knob).
        precision: λ, a float64 buffer; infinite before `calibrate`, and if "validation" chooses an infinite λ.

    Raises:
        ConfigError: the model has no final linear layer, or too many weights for a full covariance; it is inside
            another wrapper; or `samples` was set below 1.
        UserError: the validation split is empty, or the gradient of a log-density is not finite.
    """

    knobs = {"samples": (1, 3, 10, 30, 100)}  # noqa: RUF012 - never written
    varies_weights = True
    bibtex = "daxberger2021laplace, kristiadi2020being, mackay1992practical"
    precision: Tensor
    eigenvalues: Tensor

    def __init__(
        self,
        model: Callable[[], Predictor],
        *,
        covariance: Covariance = "full",
        prior_precision: Precision = "marginal",
        samples: Annotated[int, Field(ge=1, le=MOST_DRAWS)] = 30,
    ) -> None:
        super().__init__()
        self.model = model()
        self.samples = samples
        self.covariance: Covariance = covariance
        self.prior_precision = prior_precision
        layer = final_layer(self.model)
        self.shape = (layer.out_features, layer.in_features + (layer.bias is not None))
        count = math.prod(self.shape)
        if covariance == "full" and count > MOST_WEIGHTS:
            raise ConfigError(
                f"The final layer has {count:,} weights, but uncertainty.laplace.covariance=full stores a matrix of "
                f"all pairs and allows at most {MOST_WEIGHTS:,}. Set covariance to kronecker or diagonal."
            )
        sizes = {"full": (count,), "kronecker": self.shape, "diagonal": ()}[covariance]
        self.register_buffer("precision", torch.tensor(math.inf, dtype=torch.float64))
        self.register_buffer("eigenvalues", torch.zeros(count, dtype=torch.float64))
        for number, size in enumerate(sizes):
            self.register_buffer(f"vectors{number}", torch.eye(size, dtype=torch.float64))
        bounds = {f"vectors{number}": FINITE for number in range(len(sizes))}
        require_state(self, precision=(0.0, math.inf), eigenvalues=FROM_0, **bounds)
        self._cached: tuple[Any, Tensor | None] | None = None

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the density of the model in training and before `calibrate`, and the mixture otherwise."""
        if self.samples < 1:
            raise ConfigError(f"uncertainty.laplace.samples is {self.samples}, expected 1 or more.")
        deviations = None if self.training else self._deviations()
        if deviations is None:
            return self.model(inputs)
        features, raw = self._features_and_raw(inputs)
        return self._mixture(inputs, features, raw, deviations)

    def _mixture(
        self,
        inputs: Tensor,
        features: Float[Tensor, "batch feature"],
        raw: Float[Tensor, "batch raw"],
        deviations: Float[Tensor, "sample raw feature"],
    ) -> Distribution:
        change = torch.einsum("bf,srf->bsr", features, deviations.to(features))
        raws = raw.unsqueeze(1) + change.to(raw)
        if isinstance(self.model, Model):
            components: Distribution = self.model.head(raws)
        else:
            components = Stacked([self._density(inputs, part) for part in raws.unbind(1)])
        return equal_mixture(components, self.model, inputs.device)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the wrapped model; fit the posterior to the training split, and λ as `prior_precision` says."""
        kept_batches = nonempty_batches(batches, by="laplace")
        self.model.calibrate(kept_batches)
        with evaluation_mode(self):
            self._fit(kept_batches if self.training_split is None else self.training_split)
            if self.prior_precision == "validation":
                self._choose_precision(kept_batches)
        spread = (
            f"{self.precision.item():.3g}" if self.precision.isfinite() else "infinite (no spread is best)"
        )
        self.remark = (
            f"laplace: precision of the prior {spread}; {self._count} samples determine {self._determined():.3g} of "
            f"{math.prod(self.shape)} weights of the final layer."
        )

    @torch.no_grad()
    def _fit(self, batches: Iterable[Batch]) -> None:
        """Fit the posterior to the samples of `batches`."""
        self.precision.fill_(math.inf)
        eigen, self._count = collect(self._parts(batches), self.covariance)
        self.eigenvalues.copy_(eigen.values)
        for number, vectors in enumerate(eigen.vectors):
            self.get_buffer(f"vectors{number}").copy_(vectors)
        layer = final_layer(self.model)
        square = sum(parameter.double().square().sum().item() for parameter in layer.parameters())
        chosen = self.prior_precision
        number = chosen if isinstance(chosen, float) else most_likely_precision(eigen.values, square)
        self.precision.fill_(number)

    def _parts(self, batches: Iterable[Batch]) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield the features and the Fisher information of the raw parameters of each batch, float64."""
        for batch in batches:
            features, raw = self._features_and_raw(batch["input"])

            def density_of(raw: Tensor, inputs: Tensor = batch["input"]) -> Distribution:
                return self._density(inputs, raw)

            yield features.double(), fisher_of_raw(density_of, raw)

    @torch.no_grad()
    def _choose_precision(self, batches: list[Batch]) -> None:
        """Set λ to the candidate for which the likelihood of the validation split is highest.

        The candidates are infinity, and the present λ times 10 to the powers DECADES.
        """
        passes = [(batch, *self._features_and_raw(batch["input"])) for batch in batches]
        start = self.precision.clone()
        best, best_value = start.new_tensor(math.inf), -math.inf
        for precision in [best.clone(), *(start * 10**decade for decade in DECADES.to(start))]:
            self.precision.copy_(precision)
            deviations = self._deviations()
            parts = []
            for batch, features, raw in passes:
                density = (
                    self._density(batch["input"], raw)
                    if deviations is None
                    else self._mixture(batch["input"], features, raw, deviations)
                )
                parts.append(density.log_prob(batch["target"]).double())
            log_prob = torch.cat(parts)
            require_numbers(log_prob, batches, "log-likelihood")
            if log_prob.mean() > best_value:
                best, best_value = precision, log_prob.mean().item()
        self.precision.copy_(best)

    def _determined(self) -> float:
        """Return the number of weights that the data determine, Σ h/(h + λ), with eigenvalues h of H (MacKay 1992)."""
        return (self.eigenvalues / (self.eigenvalues + self.precision)).sum().item()

    def _deviations(self) -> Float[Tensor, "sample raw feature"] | None:
        """Return S deviations of the final layer's weights from their mean, float64; None if there is no spread.

        They are computed once for each state of the buffers and each number of samples.
        """
        if torch.compiler.is_exporting() and self._cached is not None:  # as in the call before the export
            return self._cached[1]
        vectors = [buffer for name, buffer in self.named_buffers(recurse=False) if name.startswith("vectors")]
        state = [self.precision, self.eigenvalues, *vectors]
        key = (self.samples, *((id(part), part._version, part.dtype, part.device) for part in state))
        if self._cached is None or self._cached[0] != key:
            deviations = None
            if self.precision.isfinite():
                doubles = [part.double() for part in state]
                draws = [weight_noise(draw, len(self.eigenvalues)) for draw in range(self.samples)]
                noise = torch.stack(draws).to(self.precision.device)
                eigen = Eigen(doubles[1], tuple(doubles[2:]))
                deviations = draw_deviations(eigen, doubles[0], noise, self.shape)
            self._cached = (key, deviations)
        return self._cached[1]

    def _features_and_raw(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return what the final layer reads, with a 1 appended if it has a bias, and what it returns."""
        layer = final_layer(self.model)
        features, raw, _ = run_final_layer(self.model, layer, inputs, by="laplace")
        if layer.bias is not None:
            features = torch.cat([features, torch.ones_like(features[:, :1])], 1)
        return features, raw

    def _density(self, inputs: Tensor, raw: Tensor) -> Distribution:
        """Return the density of the model for `inputs` if the final layer returns `raw`."""
        if isinstance(self.model, Model):
            return self.model.head(raw)
        hook = final_layer(self.model).register_forward_hook(lambda *_: raw)
        try:
            return self.model(inputs)
        finally:
            hook.remove()


def final_layer(model: Predictor) -> nn.Linear:
    """Return the final linear layer: the projection of a `Model`, or the last linear layer of any other predictor.

    Raises:
        ConfigError: the model has no linear layer, or it is inside another wrapper.
    """
    if any(isinstance(module, Uncertainty) for module in model.modules()):
        raise ConfigError(
            f"uncertainty laplace wraps a single model, but got {type(model).__name__}. Put laplace first: "
            "uncertainty=[laplace,...]; the next wrapper is then around it."
        )
    layer = find_final_layer(model)
    if layer is None:
        raise ConfigError(
            "uncertainty laplace draws the weights of the linear layer in front of the density head, but this model "
            "has no such layer: its head reads the features themselves, or is fitted at once, or has several networks. "
            "Choose another density_head, or another uncertainty."
        )
    return layer
