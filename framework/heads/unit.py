"""The unit of a target of reals: a head computes in standard deviations and returns a density in the target's unit."""

from typing import NamedTuple

import torch
from torch import Tensor

from framework.density_head import DensityHead
from framework.target import Target


class Unit(NamedTuple):
    """Location and scale of each number of a target, (number,), in double precision.

    A head computes with (number - location) / scale. Location and scale are None if the head computes in the target's
    own unit.
    """

    location: Tensor | None
    scale: Tensor | None

    @classmethod
    def of(cls, target: Target) -> "Unit":
        """Return the unit of a target."""
        if not target.scale:
            return cls(None, None)
        return cls(
            torch.tensor(target.location, dtype=torch.float64),
            torch.tensor(target.scale, dtype=torch.float64),
        )

    @property
    def log_volume(self) -> float:
        """Logarithm of the factor by which the map from the head's unit to the target's unit multiplies volumes, nats.

        It is the sum of the logarithms of `scale`, or 0 if there is no scale.
        """
        return 0.0 if self.scale is None else float(self.scale.log().sum())

    def standardise(self, target: Tensor) -> Tensor:
        """Return (target - location) / scale, the target in the unit in which the head computes."""
        if self.location is None or self.scale is None:
            return target
        return (target.double() - self.location.to(target.device)) / self.scale.to(target.device)

    def to_target_unit(
        self, mean: Tensor, scale: Tensor, coefficients: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return mean, scale and regression coefficients of a Gaussian, converted to the target's own unit.

        The map is x → l + s x with l = `location` and s = `scale` of this unit. It maps the mean m to l + s m, the
        scale σ to s σ, and the coefficient φ_ij of number i on number j to s_i φ_ij / s_j.
        """
        if self.location is None or self.scale is None:
            return mean, scale, coefficients
        location, unit = self.location.to(mean.device), self.scale.to(mean.device)
        if coefficients is not None:
            coefficients = unit[:, None] * coefficients.double() / unit
        return location + unit * mean.double(), unit * scale.double(), coefficients


class HeadOfReals(DensityHead):
    """Base class of heads that predict real numbers as multiples of the standard deviations of the training targets.

    Args:
        target: the predicted quantity, real numbers.
        by: name of the head, for the message about a target of another kind.
        floor: smallest scale of a predicted density, in standard deviations of the training targets.

    Attributes:
        numbers: number of real numbers in the target.
        floor: the argument `floor`.
        unit: location and scale of each number, which convert between standard deviations and the target's own unit.
    """

    def __init__(self, target: Target, by: str, floor: float) -> None:
        super().__init__()
        target.require("real", by=f"density_head {by}")
        self.numbers = len(target.names)
        self.floor = floor
        self.unit = Unit.of(target)
