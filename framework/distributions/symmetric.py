"""Base class of densities that are symmetric about one point and decrease on all sides of it."""

from torch import Tensor
from torch.distributions import constraints

from framework.distributions.description import PlainDensity
from framework.distributions.protocol import median


class Symmetric(PlainDensity):
    """Base class of densities whose mean, mode and median are their `location`.

    Args:
        location: point of symmetry, (*batch, *event).
        event_dimensions: number of dimensions of an event.
    """

    location: Tensor

    def __init__(self, location: Tensor, event_dimensions: int = 1) -> None:
        self.location = location
        batch, event = location.shape[:-event_dimensions], location.shape[-event_dimensions:]
        super().__init__(batch, event, validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        """Support of the density; the default is all real numbers."""
        return constraints.real_vector

    @property
    def mean(self) -> Tensor:
        """Mean of each number; for angles the mean direction, radians."""
        return self.location

    @property
    def mode(self) -> Tensor:
        """Value of highest density."""
        return self.location

    def half_width(self, mass: float) -> Tensor | None:
        """Return half the width of the interval around `location` with probability `mass`; None if it is not known.

        The result is float64, (*batch, number). The default returns None. Callers then invert the distribution
        function.
        """
        return None


@median.register
def _(density: Symmetric, samples: int) -> Tensor:
    return density.location
