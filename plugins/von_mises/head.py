"""The von Mises head: one mean and one concentration per angle."""

from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.density_head import DensityHead
from framework.target import Target
from plugins.von_mises import functions
from plugins.von_mises.density import VonMises

LARGEST_CONCENTRATION = 1e12
"""A standard deviation of a microradian; float32 angles resolve no more."""


class VonMisesHead(DensityHead):
    """One von Mises density per angle: biternion mean, predicted or one global concentration (thesis §3.4).

    With `concentration="predicted"` it reads (cos, sin, raw concentration) per angle and trains by likelihood
    (eq. 3.7). With "fixed" it reads (cos, sin), trains with κ = 1, which is the cosine loss of Biternion networks up
    to constants (eq. 3.8-3.9), and `calibrate` sets one κ per angle by maximum likelihood (eq. 3.5).

    Args:
        concentration: where κ comes from.
        floor: the least κ that can be predicted.
    """

    knobs = {}
    bibtex = """@inproceedings{prokudin2018deep,
  title = {Deep Directional Statistics: Pose Estimation with Uncertainty Quantification},
  author = {Prokudin, Sergey and Gehler, Peter and Nowozin, Sebastian},
  booktitle = {European Conference on Computer Vision (ECCV)},
  year = {2018}
}"""

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

    def forward(self, raw: Float[Tensor, "*batch size"]) -> VonMises:
        number = self._per_angle(raw)
        mean = biternion_angle(number[..., 0], number[..., 1])
        if self.predicted:
            return VonMises(mean, self.floor + concentration_of_raw(number[..., 2]))
        return VonMises(mean, self.concentration.to(mean).expand_as(mean))

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        if self.predicted:
            return -self(raw).log_prob(target)
        number = self._per_angle(raw)
        mean = biternion_angle(number[..., 0], number[..., 1])
        return -VonMises(mean, torch.ones_like(mean)).log_prob(target)

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        if self.predicted:
            return
        if len(raw) == 0:
            raise ValueError("a fixed concentration is calibrated on validation data, but got none of it.")
        sine, _ = functions.half_angle(target.double(), self(raw).mean.double())
        deviation = 2 * sine.square()
        found = functions.concentration_of_moments((1 - deviation).mean(0), deviation.mean(0))
        self.concentration.copy_(found.clamp(self.floor, LARGEST_CONCENTRATION))

    def _per_angle(self, raw: Tensor) -> Tensor:
        if raw.shape[-1] != self.size:
            raise ValueError(
                f"raw numbers of shape {tuple(raw.shape)}; wanted {self.size} in the last dimension."
            )
        bad = ~raw.isfinite().all(-1)
        if bad.any():
            row = tuple(bad.nonzero()[0].tolist())
            raise ValueError(f"raw numbers are not finite in batch row {row[0] if len(row) == 1 else row}.")
        number = raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw
        return number.unflatten(-1, (self.angles, -1))


def biternion_angle(
    cosine: Float[Tensor, "*shape"], sine: Float[Tensor, "*shape"]
) -> Float[Tensor, "*shape"]:
    """The angle of the normalised pair (eq. 3.1), radians; 0 with zero gradient for a pair shorter than 1e-18."""
    # the angle does not depend on the pair's length: divided away so that squares neither over- nor underflow
    length = torch.maximum(cosine.detach().abs(), sine.detach().abs())
    none = length < 1e-18
    length = torch.where(none, 1, length)
    return torch.atan2(torch.where(none, 0, sine / length), torch.where(none, 1, cosine / length))


def concentration_of_raw(raw: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """exp(r) for r ≤ 0 and (1 + r/4)⁴ above: κ = 1 at 0, smooth, at most LARGEST_CONCENTRATION.

    The Fisher information of log κ is nearly constant (1/2 for large κ), so a logarithmic map trains best; the power
    keeps that shape over the κ that occur, but neither overflows nor lets one outlier's gradient explode as exp does.
    """
    most = 4 * (LARGEST_CONCENTRATION**0.25 - 1)
    high = (1 + raw.clamp(0, most) / 4).square().square()
    return torch.where(raw < 0, torch.exp(raw.clamp(max=0)), high)
