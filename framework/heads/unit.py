"""The unit of a target of reals, in which a density is given back; a head computes in standard deviations."""

from typing import NamedTuple

import torch
from torch import Tensor

from framework.target import Target


class Unit(NamedTuple):
    """Location and scale, (number,) each in double precision; None where the target's own unit is the head's."""

    location: Tensor | None
    scale: Tensor | None

    @classmethod
    def of(cls, target: Target) -> "Unit":
        if not target.scale:
            return cls(None, None)
        return cls(
            torch.tensor(target.location, dtype=torch.float64),
            torch.tensor(target.scale, dtype=torch.float64),
        )

    @property
    def log_volume(self) -> float:
        """log |det| of the map from the head's numbers to the target's, nats."""
        return 0.0 if self.scale is None else float(self.scale.log().sum())

    def standardised(self, target: Tensor) -> Tensor:
        if self.location is None or self.scale is None:
            return target
        return (target.double() - self.location.to(target.device)) / self.scale.to(target.device)

    def given_back(
        self, mean: Tensor, scale: Tensor, coefficients: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """A Gaussian's parameters in the target's own unit; x → l + s x takes φ_ij to s_i φ_ij / s_j."""
        if self.location is None or self.scale is None:
            return mean, scale, coefficients
        location, unit = self.location.to(mean.device), self.scale.to(mean.device)
        if coefficients is not None:
            coefficients = unit[:, None] * coefficients.double() / unit
        return location + unit * mean.double(), unit * scale.double(), coefficients
