"""What framework.least_squares.solver answers."""

from enum import IntEnum
from typing import NamedTuple

from jaxtyping import Bool, Float, Int
from torch import Tensor


class Status(IntEnum):
    """How a problem ended. Above 0: a minimum that the data determine."""

    GRADIENT = 1
    """The residuals are orthogonal to the Jacobian, but for what bounds hold."""
    COST = 2
    """No step would lower the cost by more than a share `decrease` of it."""
    STEP = 3
    """No step would move the parameters by more than a share `step` of them."""
    LIMIT = 0
    """`most` steps were not enough; the parameters are the best found."""
    ILL_POSED = -1
    """A minimum, but the Jacobian there is rank-deficient: the data do not determine every parameter."""
    NOT_FINITE = -2
    """No residual is there, or one is infinite, or the Jacobian is not finite, at the start; which is returned."""


class Solution(NamedTuple):
    """What was found for each problem; no number is NaN.

    Attributes:
        parameters: (problem, p), within the bounds.
        cost: (problem,), half the sum of squared residuals, as SciPy's.
        covariance: (problem, p, p): s² (JᵀJ)⁻¹ with s² the mean squared residual, 2 cost / (residuals - p), and J as if
            there were no bounds. The pseudo-inverse where the rank is less than p: directions that the data do not
            determine have variance 0 there. Infinite on the diagonal where the status is NOT_FINITE.
        rank: (problem,), of the Jacobian with its columns scaled to unit length; p where all is determined.
        status: (problem,), of `Status`.
        steps: (problem,), how many were tried.
    """

    parameters: Float[Tensor, "problem p"]
    cost: Float[Tensor, "problem"]
    covariance: Float[Tensor, "problem p p"]
    rank: Int[Tensor, "problem"]
    status: Int[Tensor, "problem"]
    steps: Int[Tensor, "problem"]

    @property
    def well_posed(self) -> Bool[Tensor, "problem"]:
        return self.status > 0
