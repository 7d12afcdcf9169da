"""The von Mises head: one mean and one concentration per angle."""

from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.density_head import DensityHead
from framework.heads.parameters import require_finite, require_validation
from framework.storage.weights import FROM_0, require_state
from framework.target import Target
from plugins.density_head.von_mises import functions
from plugins.density_head.von_mises.angles import half_angle
from plugins.density_head.von_mises.density import VonMises

LARGEST_CONCENTRATION = 1e12
"""Largest κ; its standard deviation is a microradian, which is the resolution of float32 angles."""
LEAST_SCALE = 0.25
"""Smallest value of the scale g(r), so that κ can reach 0 only if the pair (cos, sin) does.

If the scale could reach 0 too, the pair's gradient would vanish, and an angle that the network at first treats as
unpredictable could not be learned later.
"""


class VonMisesHead(DensityHead):
    """One von Mises density per angle, with a concentration that is predicted or common to all inputs (thesis §3.4).

    With `concentration="predicted"` the head reads (cos, sin, r) per angle and trains by likelihood (eq. 3.7), with κ =
    |(cos, sin)| g(r). The scale g(r) stays above a quarter. The pair (cos, sin) times g(r) is the density's natural
    parameter κ (cos μ, sin μ), so that the uniform density needs no special case. If the pair were normalised, as in
    eq. 3.1, and κ were g(r), the gradients in the pair and in r would vanish with κ. A network that cannot predict an
    angle at first would then never learn it (README).

    With `concentration="fixed"` the head reads (cos, sin) and trains with κ = 1, which is the cosine loss of Biternion
    networks up to constants (eq. 3.8-3.9); `calibrate` sets one κ per angle by maximum likelihood on the validation
    split (eq. 3.5).

    Args:
        concentration: source of κ.
        floor: smallest κ.
    """

    bibtex = "prokudin2018deep"

    concentration: Tensor

    def __init__(
        self,
        target: Target,
        *,
        concentration: Literal["predicted", "fixed"] = "predicted",
        floor: Annotated[float, Field(ge=0, le=LARGEST_CONCENTRATION)] = 0.0,
    ) -> None:
        super().__init__()
        target.require("angle", by="density_head von_mises")
        self.angles = len(target.names)
        self.floor = floor
        self.predicted = concentration == "predicted"
        self.size = self.angles * (3 if self.predicted else 2)
        if not self.predicted:
            self.register_buffer("concentration", torch.ones(self.angles, dtype=torch.float64))
            require_state(self, concentration=FROM_0)

    def forward(self, raw: Float[Tensor, "*batch size"]) -> VonMises:
        """Return the density for raw parameters."""
        number = self._per_angle(raw)
        mean, length = polar(number[..., 0], number[..., 1])
        if self.predicted:
            concentration = self.floor + length.clamp(max=1e24) * scale_of_raw(number[..., 2])
            return VonMises(mean, concentration.clamp(max=LARGEST_CONCENTRATION))
        return VonMises(mean, self.concentration.to(mean).expand_as(mean))

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """Return the negative log-likelihood of each sample, nats; with `concentration="fixed"` it uses κ = 1."""
        density = self(raw)
        if not self.predicted:  # the cosine loss does not change with calibration
            density = VonMises(density.mean, torch.ones_like(density.mean))
        return -density.log_prob(target)

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        """Fit one κ per angle by maximum likelihood with `concentration="fixed"`; do nothing with "predicted"."""
        if self.predicted:
            return
        require_validation(raw, "A fixed concentration is")
        sine, _ = half_angle(target.double(), self(raw).mean.double())
        deviation = 2 * sine.square()
        concentration = functions.concentration_of_moments((1 - deviation).mean(0), deviation.mean(0))
        self.concentration.copy_(concentration.clamp(self.floor, LARGEST_CONCENTRATION))

    def _per_angle(self, raw: Tensor) -> Tensor:
        return require_finite(raw, self.size).unflatten(-1, (self.angles, -1))


def polar(
    cosine: Float[Tensor, "*shape"], sine: Float[Tensor, "*shape"]
) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
    """Return the angle, radians, and the length of the vector (cosine, sine) (thesis eq. 3.1).

    Gradients are finite for every vector, also for the zero vector.
    """
    shortest = 1e-18
    # A pair at zero is moved a little, because its angle has no gradient; length × cos(φ - angle) keeps its gradient.
    cosine = torch.where((cosine.abs() < shortest) & (sine.abs() < shortest), cosine + 2 * shortest, cosine)
    # both are divided by the larger one, so that no square over- or underflows
    size = torch.maximum(cosine.detach().abs(), sine.detach().abs())
    cosine, sine = cosine / size, sine / size
    return torch.atan2(sine, cosine), size * (cosine.square() + sine.square()).sqrt()


def scale_of_raw(raw: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return the scale g(r), which rises from LEAST_SCALE to LARGEST_CONCENTRATION, and is 1 and smooth at r = 0.

    With c = LEAST_SCALE, g(r) = c + (1 - c) exp(r / (1 - c)) for r ≤ 0, and (1 + r/4)⁴ for r > 0. The Fisher
    information of log κ is nearly constant (1/2 for large κ), so that a logarithmic map trains best. The fourth power
    is similar to the exponential over the values of κ that occur, but κ and the gradient of an outlier do not explode.
    """
    most = 4 * (LARGEST_CONCENTRATION**0.25 - 1)
    high = (1 + raw.clamp(0.0, most) / 4).square().square()
    room = 1 - LEAST_SCALE
    return torch.where(raw < 0, LEAST_SCALE + room * torch.exp(raw.clamp(max=0.0) / room), high)
