"""The head of Student's t: a location and a scale for each input, and degrees of freedom."""

import math
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.nn.functional import hardtanh

from framework.heads.parameters import require_finite, require_validation
from framework.heads.scales import balance_losses, scale_of_raw
from framework.heads.unit import HeadOfReals
from framework.storage.weights import require_state
from framework.target import Target
from plugins.density_head.student_t.density import NORMAL, StudentT

LARGEST_LOCATION = 1e8
"""Bound to which locations are clamped, in the unit of the raw parameters."""
LEAST_PREDICTED, TYPICAL = 3.0, 8.0
"""Predicted degrees of freedom are LEAST_PREDICTED + TYPICAL · σ(r), with the map σ of `scale_of_raw`."""
FREEDOMS = (3.0, 4.0, 5.0, 7.0, 10.0, 15.0, 30.0, NORMAL)
"""Degrees of freedom from which `calibrate` chooses."""
LOG_FACTORS = torch.linspace(-1.4, 1.0, 25, dtype=torch.float64)
"""Logarithms of the factors on the scale from which `calibrate` chooses; one of them is 0."""
FACTOR_PRIOR, FREEDOM_PRIOR = 2.5, 0.5
"""Weights, nats, of the penalties that `calibrate` subtracts from the log-likelihood.

The penalties are ln² of the factor and, for ν below 30, ln(30/ν). With few samples, the factor
therefore stays near 1 and the density near a normal one.
"""


class StudentTHead(HeadOfReals):
    """Student's t over one or more independent reals, with a location and a scale for each input.

    The tails of the density fall with a power. A target far from the location therefore has a loss of a few nats, where
    the loss of a Gaussian is hundreds of nats. With `degrees_of_freedom="calibrated"` the head trains as a Gaussian,
    and `calibrate` then chooses, by their penalised likelihood, the degrees of freedom and a factor by which all scales
    are multiplied. If `Target` has the mean and the standard deviations of the training targets, raw parameters
    describe the target minus this mean, in these standard deviations. The density is then in the target's own unit and
    in double precision.

    Args:
        degrees_of_freedom: "calibrated": `calibrate` chooses one value for each number of the target. "predicted": the
            network predicts a value for each input and each number. A number above 2: this value is used everywhere.
        balance: β of Seitzer et al. 2022: the gradient of each number, not the loss, is multiplied by its scale to the
            power 2β. With 0 (the likelihood alone) a location is learned more slowly the wider its scale is. With 1 all
            locations are learned as with squared error.
        floor: smallest scale, in the unit of the raw parameters; it prevents ever narrower densities around training
            values.
    """

    bibtex = "student1908probable, seitzer2022pitfalls"

    factor: Tensor
    freedom: Tensor

    def __init__(
        self,
        target: Target,
        *,
        degrees_of_freedom: Literal["calibrated", "predicted"]
        | Annotated[float, Field(gt=2, le=NORMAL)] = "calibrated",
        balance: Annotated[float, Field(ge=0, le=1)] = 0.5,
        floor: Annotated[float, Field(ge=1e-6, le=1.0)] = 1e-3,
    ) -> None:
        super().__init__(target, "student_t", floor)
        self.balance = balance
        self.calibrated = degrees_of_freedom == "calibrated"
        self.predicted = degrees_of_freedom == "predicted"
        self.size = (3 if self.predicted else 2) * self.numbers
        self.fixed = NORMAL if isinstance(degrees_of_freedom, str) else float(degrees_of_freedom)
        if self.calibrated:
            self.register_buffer("factor", torch.ones(self.numbers, dtype=torch.float64))
            self.register_buffer("freedom", torch.full((self.numbers,), NORMAL, dtype=torch.float64))
            require_state(self, factor=(math.exp(-1.5), math.exp(1.1)), freedom=(3.0, NORMAL))

    def forward(self, raw: Float[Tensor, "*batch size"]) -> StudentT:
        """Return the density for raw parameters."""
        location, scale, freedom = self._parts(raw)
        if self.calibrated:
            scale, freedom = scale * self.factor.to(scale), self.freedom.to(scale)
        location, scale, _ = self.unit.to_target_unit(location, scale)
        return StudentT(location, scale, freedom)

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """Return the negative log-likelihood of each sample, nats.

        With `degrees_of_freedom="calibrated"` the density is normal, and its scales are not multiplied by the factor
        that `calibrate` sets. `balance` changes the gradient of the loss, not its value.
        """
        location, scale, freedom = self._parts(raw)
        value = self.unit.standardise(target).to(location)
        if self.calibrated:  # the density with ν = NORMAL, in fewer passes
            bend = torch.log1p(((value - location) / scale).square() / NORMAL)
            losses = (NORMAL + 1) / 2 * bend + scale.log() + math.log(2 * math.pi) / 2
        else:
            losses = -StudentT(location, scale, freedom).each_log_prob(value)
        if self.balance:
            losses = balance_losses(losses, scale, self.balance)
        return losses.sum(-1) + self.unit.log_volume

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        """Choose the degrees of freedom of each number and the factor of its scales, by their penalised likelihood.

        FACTOR_PRIOR and FREEDOM_PRIOR are the weights of the penalties. Both values are chosen from a grid that holds
        their values before calibration, at which the penalties are 0, so that the likelihood does not fall.
        """
        if not self.calibrated:
            return
        require_validation(raw, "The degrees of freedom are")
        location, scale, _ = self._parts(raw.double())
        value = self.unit.standardise(target).double()
        best = torch.full((self.numbers,), -math.inf, dtype=torch.float64, device=raw.device)
        for freedom in FREEDOMS:
            degrees = torch.full_like(best, freedom)
            prior = FREEDOM_PRIOR * math.log(30 / min(freedom, 30.0))
            for log_factor in LOG_FACTORS.tolist():
                density = StudentT(location, scale * math.exp(log_factor), degrees)
                total = density.each_log_prob(value).sum(0) - FACTOR_PRIOR * log_factor**2 - prior
                better = total > best
                best = torch.where(better, total, best)
                self.factor[better] = math.exp(log_factor)
                self.freedom[better] = freedom

    def _parts(self, raw: Float[Tensor, "*batch size"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return location and scale, (*batch, number), and degrees of freedom that broadcast to them.

        They are in the unit of the raw parameters, and do not contain the values that `calibrate` chooses.
        """
        raw = require_finite(raw, self.size)
        parts = raw.unflatten(-1, (-1, self.numbers)).unbind(-2)
        location = hardtanh(parts[0], -LARGEST_LOCATION, LARGEST_LOCATION)
        scale = self.floor + scale_of_raw(parts[1])
        if self.predicted:
            freedom = LEAST_PREDICTED + (TYPICAL * scale_of_raw(parts[2])).clamp(max=NORMAL)
        else:
            freedom = raw.new_full((self.numbers,), self.fixed)
        return location, scale, freedom
