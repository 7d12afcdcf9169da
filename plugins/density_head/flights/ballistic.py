"""Density head of a ball's flight: it estimates the state of the ball and integrates the equation of motion."""

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution

from framework.density_head import DensityHead, Fitted
from framework.distributions.density import Mixture
from framework.distributions.normals import IndependentNormals, JointNormal
from framework.errors import ConfigError, NonFiniteParameters
from framework.flights.estimation import (
    Estimate,
    ObservedFrames,
    Prior,
    covariance_root,
    estimate_states,
    observed_frames,
)
from framework.flights.frames import PARTS, future_frames
from framework.flights.physics import Constants
from framework.flights.reference_frame import require_frame
from framework.flights.trajectories import simulate, simulate_with_jacobian
from framework.heads.parameters import require_finite
from framework.storage.weights import require_state
from framework.target import Target
from plugins.density_head.flights.identification import (
    FITTED,
    UNITS,
    constant_bounds,
    fitted_constants,
    identify,
    replace_constants,
)

WINDOWS = 32
"""Largest number of training samples (windows of flights) from which `fit` identifies the constants."""
LEAST_NOISE, MOST_NOISE = 1e-4, 1.0
"""Bounds of the standard deviation of the noise of a coordinate, metres."""
SPREAD = (0.1, 1e3)
"""Smallest and largest factor on a standard deviation that `calibrate` fits."""
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class BallisticHead(DensityHead, Fitted):
    """A ball's flight by its differential equation (thesis §4.2, "physics-based"; Mülling et al. 2011).

    Position, velocity and spin at the first frame are estimated from the frames by robust least squares. The equation
    is integrated to the requested times, through a bounce if there is one. `fit` identifies the constants of ball and
    table that make whole training windows most likely, and measures the noise. `calibrate` fits one factor for the
    standard deviation of each number.

    The density of the state is N(estimate, (JᵀJ)⁻¹) with the Jacobian J of the residuals. This density is propagated to
    the future: "linearised" gives a normal density. "sampled" gives a mixture with one component for each sampled
    flight, which can also describe that a ball may hit or miss the edge of the table. Input and target are in metres.
    The gradient of the density with respect to the input is set to 0.

    Args:
        observed, step: number of observed frames, and time between frames in seconds; the same values as in the config
            of the data.
        density: method by which the state's uncertainty is propagated, "linearised" or "sampled".
        samples: number of sampled flights in the mixture; may be set at any time.
        spin: prior standard deviation of each component of the spin, rad/s.
        noise: standard deviation of the measurement error of each coordinate, m; initial value of `fit`.
        steps: largest number of steps of the search for a state; real flights take about ten.
        identify: whether `fit` identifies the constants; otherwise the constants of the config are used.
        constants: constants of the ball and the table; initial values of `fit`.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"samples": (1, 3, 10, 30, 100)}
    bibtex = "mulling2011biomimetic"

    found: Tensor
    noise: Tensor
    spread: Tensor

    # More than eight parameters: each keyword is a config key that a user sets alone.
    def __init__(
        self,
        target: Target,
        *,
        observed: Annotated[int, Field(ge=3, le=1000)] = 20,
        step: Positive = 0.016,
        density: Literal["linearised", "sampled"] = "linearised",
        samples: Annotated[int, Field(ge=1)] = 30,
        spin: Positive = 60.0,
        noise: Positive = 0.003,
        steps: Annotated[int, Field(ge=1)] = 40,
        identify: bool = True,
        constants: Constants,
    ) -> None:
        super().__init__()
        target.require("real", by="density_head ballistic")
        self.future = future_frames(target.names, by="density_head ballistic")
        self.observed, self.step = observed, step
        self.density: Literal["linearised", "sampled"] = density
        self.samples = samples
        self.prior = Prior(spin=spin)
        self.steps = steps
        self.identify = identify
        self.initial_constants = constants
        self.size = observed * len(PARTS)
        self.register_buffer("found", fitted_constants(constants))
        self.register_buffer("noise", torch.tensor(noise).double())
        self.register_buffer("spread", torch.ones(3 * self.future, dtype=torch.float64))
        within = min(LEAST_NOISE, noise), max(MOST_NOISE, noise)
        require_state(self, found=constant_bounds(constants), noise=within, spread=SPREAD)

    @property
    def constants(self) -> Constants:
        """Constants of the config, with the values that `fit` found."""
        return replace_constants(self.initial_constants, self.found)

    @torch.no_grad()
    def fit(self, features: Float[Tensor, "sample size"], target: Tensor, seed: int) -> None:
        """Fit the constants that make whole training windows most likely (`identify`), and measure the noise.

        With `identify=False` in the config, only the noise is measured.
        """
        chosen = torch.linspace(0, len(features) - 1, min(WINDOWS, len(features))).round().long()
        observations = observed_frames(
            features[chosen].unflatten(-1, (self.observed, len(PARTS))).cpu(), self.step
        )
        after = self._after(observations)
        future = target[chosen].double().cpu().unflatten(-1, (self.future, 3))
        whole = ObservedFrames(
            torch.cat([observations.times, after], 1),
            torch.cat([observations.places, torch.where(future.abs() < 50, future, torch.nan)], 1),
        )
        constants = require_frame(whole, self.constants, "density_head ballistic")
        if self.identify:
            self.found.copy_(fitted_constants(constants))
        elif constants != self.constants:
            raise ConfigError(
                f"The ball bounces at a height of {constants.touching:.3f} m, but density_head.surface and "
                f"density_head.radius put the bounces at {self.constants.touching:.3f} m. Set density_head.surface="
                f"{constants.surface:.3f}, or density_head.identify=true."
            )
        estimate = estimate_states(whole, self.constants, float(self.noise), self.prior, most=self.steps)
        self._measure_noise(whole, estimate.state)
        if self.identify:
            before = float(self.noise)
            numbers, states, errors = identify(whole, self.constants, estimate.state, before, self.prior)
            self.found.copy_(numbers)
            self._measure_noise(whole, states)
            self.remark = self._describe(errors * float(self.noise) / before, len(chosen))

    def _describe(self, errors: Float[Tensor, "constant"], flights: int) -> str:
        """Return a sentence about the constants that were identified, with their standard errors."""
        parts = [
            f"{name} {_state_with_error(value, error)}{unit}"
            for name, value, error, unit in zip(
                FITTED, self.found.tolist(), errors.tolist(), UNITS, strict=True
            )
        ]
        return (
            f"ballistic: {', '.join(parts)}, noise {1000 * float(self.noise):.1f} mm, from {flights} windows of "
            "flights. ± is the standard error if the equation is right."
        )

    def _measure_noise(self, observations: ObservedFrames, states: Tensor) -> None:
        residuals = simulate(states, observations.times, self.constants)[..., :3] - observations.places
        magnitudes = residuals[~residuals.isnan()].abs()
        if len(magnitudes):  # the median of |r| is 0.6745 of a normal's standard deviation
            self.noise.copy_((magnitudes.median() / 0.6745).clamp(LEAST_NOISE, MOST_NOISE))

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """Return the density for raw parameters."""
        raw = require_finite(raw, self.size)
        flat = raw.detach().reshape(math.prod(raw.shape[:-1]), self.size)
        observations = observed_frames(flat.unflatten(-1, (self.observed, len(PARTS))).cpu(), self.step)
        estimate = estimate_states(
            observations, self.constants, float(self.noise), self.prior, most=self.steps
        )
        build = self._linearised if self.density == "linearised" else self._sampled
        # The gradient is 0: the search is not differentiated.
        return build(observations, estimate, raw, (raw * 0).sum(-1, keepdim=True))

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        """Fit a factor of the standard deviation of each number.

        With many samples, the variance of a number then equals its mean squared residual.
        """
        self.spread.fill_(1.0)
        observations = observed_frames(raw.unflatten(-1, (self.observed, len(PARTS))).cpu(), self.step)
        estimate = estimate_states(
            observations, self.constants, float(self.noise), self.prior, most=self.steps
        )
        mean, factor = self._carried(observations, estimate)
        variance = factor.square().sum(-1) + float(self.noise) ** 2
        ratio = (target.double().cpu() - mean).square() / variance
        if len(ratio):
            # A mean of n squares has a relative error of √(2/n). With few windows, the factor of each number is
            # therefore averaged with the common factor of all numbers.
            weight = len(ratio) / (len(ratio) + 20)
            self.spread.copy_((weight * ratio.mean(0) + (1 - weight) * ratio.mean()).sqrt().clamp(*SPREAD))

    def _after(self, observations: ObservedFrames) -> Float[Tensor, "flight time"]:
        moments = self.step * torch.arange(1, self.future + 1, dtype=torch.float64)
        return moments.expand(len(observations.times), -1)

    def _whole(self, observations: ObservedFrames) -> Float[Tensor, "flight time"]:
        return torch.cat([observations.times, self._after(observations)], 1)

    def _carried(self, observations: ObservedFrames, estimate: Estimate) -> tuple[Tensor, Tensor]:
        """Return the mean of the future positions and a factor F of their covariance F Fᵀ.

        The mean has the shape (flight, coordinate), with three coordinates for each frame. F has the shape
        (flight, coordinate, 9) and comes from the linearised flight.
        """
        places, slopes = simulate_with_jacobian(estimate.state, self._whole(observations), self.constants)
        mean = places[:, -self.future :].flatten(1)
        self._require_course(mean, estimate)
        return mean, slopes[:, -self.future :].flatten(1, 2) @ covariance_root(estimate.covariance)

    def _require_course(self, places: Tensor, estimate: Estimate) -> None:
        """Require that the positions and the covariance of every flight are finite.

        They can be infinite if the constants are implausible.

        Raises:
            NonFiniteParameters: a flight is not finite; the message names the first such batch row.
        """
        finite = estimate.covariance.flatten(1).isfinite().all(-1) & places.flatten(1).isfinite().all(-1)
        if not finite.all():
            raise NonFiniteParameters(
                f"The flight in batch row {int((~finite).nonzero()[0])} has no finite course with step={self.step:g} "
                f"and {self.constants}. Set density_head.step and density_head.constants to the values of "
                "the recordings."
            )

    def _linearised(
        self, observations: ObservedFrames, estimate: Estimate, raw: Tensor, zero: Tensor
    ) -> Distribution:
        mean, factor = self._carried(observations, estimate)
        spread = self.spread.cpu()
        factor = spread.unsqueeze(-1) * factor
        covariance = factor @ factor.mT + torch.diag((float(self.noise) * spread).square())
        scale, failed = torch.linalg.cholesky_ex(covariance)
        if failed.any():
            deviation, noise = float(factor.square().sum(-1).amax().sqrt()), float(self.noise)
            raise NonFiniteParameters(
                f"The covariance of the flight in batch row {int(failed.nonzero()[0])} is not positive definite: its "
                f"largest standard deviation is {deviation:.2g} m, and the noise is {noise:.2g} m. Training never ends "
                "with such constants, so the checkpoint is probably damaged: train the head again, or copy the "
                "checkpoint again from its source."
            )
        shape = raw.shape[:-1]
        joint = scale.reshape(*shape, *scale.shape[-2:]).to(raw)
        return JointNormal(mean.reshape(*shape, mean.shape[-1]).to(raw) + zero, joint)

    def _sampled(
        self, observations: ObservedFrames, estimate: Estimate, raw: Tensor, zero: Tensor
    ) -> Distribution:
        count, flights = self.samples, len(estimate.state)
        # every call uses the same points, so that the density is a fixed function and not a random estimate
        points = torch.quasirandom.SobolEngine(9, scramble=True, seed=0).draw(count, dtype=torch.float64)
        noise = torch.special.ndtri(points.clamp(1e-9, 1 - 1e-9))
        self._require_course(estimate.state, estimate)
        states = estimate.state.unsqueeze(1) + noise @ covariance_root(estimate.covariance).mT
        times = self._whole(observations).repeat_interleave(count, 0)
        places = simulate(states.reshape(-1, 9), times, self.constants)[:, -self.future :, :3]
        places = places.reshape(flights, count, 3 * self.future)
        self._require_course(places, estimate)
        middle = places.mean(1, keepdim=True)
        places = middle + self.spread.cpu() * (places - middle)
        shape = (*raw.shape[:-1], count)
        mean = places.reshape(*shape, 3 * self.future).to(raw) + zero.unsqueeze(-2)
        scale = (float(self.noise) * self.spread).to(raw).expand_as(mean)
        weights = torch.zeros(shape, dtype=raw.dtype, device=raw.device)
        return Mixture(weights, IndependentNormals(mean, scale))


def _state_with_error(value: float, error: float) -> str:
    """Return a value and its standard error with two digits, or that the flights do not determine the value."""
    if not 0 < error < math.inf:
        return f"{value:.4g} (not determined by these flights)"
    decimals = max(0, 1 - math.floor(math.log10(error)))
    return f"{value:.{decimals}f} ± {error:.{decimals}f}"
