"""The Gaussian head: a mean and standard deviations for each input."""

import math
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.nn.functional import hardtanh, mse_loss

from framework.errors import ConfigError
from framework.heads.parameters import require_finite, require_validation
from framework.heads.scales import balance_losses, scale_of_raw
from framework.heads.unit import HeadOfReals
from framework.storage.weights import require_state
from framework.target import Target
from plugins.density_head.gaussian.density import Gaussian

LARGEST_MEAN = 1e8
"""Bound to which means are clamped, because squares of larger standardised residuals overflow float32."""
WIDEST_SCALE = 1e18
"""Largest standard deviation that calibration sets and that a stored state may hold."""
LARGEST_COEFFICIENT = 1e3
SMALLEST_SCALE = 1e-6


class GaussianHead(HeadOfReals):
    """Gaussian over one or more reals, heteroscedastic or not (thesis eq. 2.7-2.8).

    With `scale="predicted"` each input has its own standard deviations, trained by likelihood (eq. 2.8). With "fixed"
    it trains by squared error, which is likelihood with σ = 1, and `calibrate` fits one covariance to the validation
    residuals by maximum likelihood. If `Target` has the mean and the standard deviations of the training targets, raw
    parameters describe the target minus this mean, in these standard deviations. The density is then in the target's
    own unit and in double precision.

    Args:
        scale: source of the standard deviations.
        covariance: "diagonal": independent numbers; "full": with regression coefficients of each number on the previous
            ones.
        balance: β of Seitzer et al. 2022 for `scale="predicted"`: the gradient of each number, not the loss, is
            multiplied by its scale to the power 2β. With 0 (the likelihood alone) a mean is learned more slowly the
            wider its scale is. With 1 all means are learned as with squared error.
        floor: smallest σ, in the same unit as the raw parameters; it prevents ever narrower densities around training
            values.

    Raises:
        ConfigError: `balance` is set although no scale is predicted.
    """

    bibtex = "nix1994estimating, seitzer2022pitfalls"

    scale: Tensor
    coefficients: Tensor

    def __init__(
        self,
        target: Target,
        *,
        scale: Literal["predicted", "fixed"] = "predicted",
        covariance: Literal["diagonal", "full"] = "diagonal",
        balance: Annotated[float, Field(ge=0, le=1)] = 0.0,
        floor: Annotated[float, Field(ge=SMALLEST_SCALE, le=1.0)] = 1e-4,
    ) -> None:
        super().__init__(target, "gaussian", floor)
        self.balance = balance
        self.predicted = scale == "predicted"
        if balance and not self.predicted:
            raise ConfigError(
                f"density_head.balance is {balance:g}, but it has no effect with scale=fixed, where all means are "
                "learned by squared error. Leave balance out, or set scale=predicted."
            )
        self.full = covariance == "full" and self.numbers > 1
        pairs = self.numbers * (self.numbers - 1) // 2 if self.full else 0
        self.size = 2 * self.numbers + pairs if self.predicted else self.numbers
        if not self.predicted:
            self.register_buffer("scale", torch.ones(self.numbers, dtype=torch.float64))
            side = (
                self.numbers if self.full else 0
            )  # none for a diagonal covariance, which may have very many numbers
            self.register_buffer("coefficients", torch.zeros(side, side, dtype=torch.float64))
            # calibration sets no σ below the floor, except for rounding; squares above WIDEST_SCALE overflow float32
            coefficient = (-LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)
            require_state(self, scale=(0.99 * floor, WIDEST_SCALE), coefficients=coefficient)

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Gaussian:
        """Return the density for raw parameters."""
        return Gaussian(*self.unit.to_target_unit(*self._parts(raw)))

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """Return the negative log-likelihood of each sample, nats; with `scale="fixed"` it is computed with σ = 1.

        `balance` changes its gradient, not its value.
        """
        if self.predicted and not self.balance:
            return -self(raw).log_prob(target)
        if self.predicted:
            mean, scale, coefficients = self._parts(raw)
            value = self.unit.standardise(target).to(mean)
            losses = -Gaussian(mean, scale, coefficients).each_log_prob(value)
            return balance_losses(losses, scale, self.balance).sum(-1) + self.unit.log_volume
        # σ = 1 here also after calibration. There may be very many numbers, so that few passes over them are made.
        target = self.unit.standardise(target).to(raw)
        mean, target = torch.broadcast_tensors(self._mean(require_finite(raw, self.size)), target)
        constant = self.numbers * math.log(2 * math.pi) / 2 + self.unit.log_volume
        return mse_loss(mean, target, reduction="none").sum(-1) / 2 + constant

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        """Fit one covariance by maximum likelihood with `scale="fixed"`; do nothing with `scale="predicted"`."""
        if self.predicted:
            return
        require_validation(raw, "A fixed covariance is")
        residual = (
            self.unit.standardise(target).double() - self._mean(require_finite(raw, self.size)).double()
        )
        if not self.full:  # each σ on its own
            self.scale.copy_(residual.square().mean(0).sqrt().clamp(self.floor, WIDEST_SCALE))
            return
        scale, coefficients = fit(residual)
        self.scale.copy_(scale.clamp(self.floor, WIDEST_SCALE))
        self.coefficients.copy_(coefficients)

    def _parts(self, raw: Float[Tensor, "*batch size"]) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return mean, scale and regression coefficients in the unit of the raw parameters."""
        raw = require_finite(raw, self.size)
        mean = self._mean(raw)
        if not self.predicted:
            scale = self.scale.to(raw).expand_as(mean)
            coefficients = self.coefficients.to(raw).expand(*mean.shape, self.numbers) if self.full else None
        else:
            scale = self.floor + scale_of_raw(raw[..., self.numbers : 2 * self.numbers])
            coefficients = self._coefficients(raw[..., 2 * self.numbers :]) if self.full else None
        return mean, scale, coefficients

    def _mean(self, raw: Float[Tensor, "*batch size"]) -> Float[Tensor, "*batch number"]:
        # a clamp whose gradient takes one pass, not four
        return hardtanh(raw[..., : self.numbers], -LARGEST_MEAN, LARGEST_MEAN)

    def _coefficients(self, raw: Tensor) -> Tensor:
        bounded = LARGEST_COEFFICIENT * torch.tanh(raw / LARGEST_COEFFICIENT)
        row, column = torch.tril_indices(self.numbers, self.numbers, -1, device=raw.device)
        coefficients = raw.new_zeros(*raw.shape[:-1], self.numbers, self.numbers)
        coefficients[..., row, column] = bounded
        return coefficients


def fit(
    residual: Float[Tensor, "sample number"],
) -> tuple[Float[Tensor, "number"], Float[Tensor, "number number"]]:
    """Return the maximum-likelihood scales σ and coefficients φ of `Gaussian` for residuals of mean 0.

    Both come from a least-squares regression of each number on the numbers before it.
    """
    count = residual.shape[-1]
    scale, coefficients = residual.new_zeros(count), residual.new_zeros(count, count)
    for number in range(count):
        left = residual[:, number]
        if number:
            before = residual[:, :number]
            # this driver handles collinear residuals
            solution = torch.linalg.lstsq(before, left[:, None], driver="gelsd").solution[:, 0]
            coefficients[number, :number] = solution.clamp(-LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)
            left = left - before @ coefficients[number, :number]
        scale[number] = left.square().mean().sqrt()
    return scale, coefficients
