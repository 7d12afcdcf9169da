"""The result of framework.least_squares.solver."""

from enum import IntEnum
from typing import NamedTuple

from jaxtyping import Bool, Float, Int
from torch import Tensor


class Status(IntEnum):
    """End of the search for a problem; a value above 0 means a minimum that the data determine."""

    GRADIENT = 1
    """The residuals are orthogonal to the Jacobian, except for parameters held at bounds."""
    COST = 2
    """No step would lower the cost by more than a share `decrease` of it."""
    STEP = 3
    """No step would move the parameters by more than a share `step` of them."""
    LIMIT = 0
    """The search did not end within `most` steps; the parameters are the best found."""
    ILL_POSED = -1
    """The search ended at a minimum with a rank-deficient Jacobian: the data do not determine every parameter."""
    NOT_FINITE = -2
    """The start, which is returned, has no residual, an infinite residual, or a Jacobian that is not finite."""


class Solution(NamedTuple):
    """Results of each problem; no number is NaN.

    Attributes:
        parameters: (problem, p), within the bounds.
        cost: (problem,), half the sum of squared residuals, as in SciPy.
        covariance: (problem, p, p): s² (JᵀJ)⁻¹ with s² the mean squared residual, 2 cost / (residuals - p), and J as if
            there were no bounds. The pseudo-inverse if the rank is less than p: directions that the data do not
            determine then have variance 0. Infinite on the diagonal if the status is NOT_FINITE.
        rank: (problem,), rank of the Jacobian with its columns scaled to unit length; p if all parameters are
            determined.
        status: (problem,), values of `Status`.
        steps: (problem,), number of steps tried.
    """

    parameters: Float[Tensor, "problem p"]
    cost: Float[Tensor, "problem"]
    covariance: Float[Tensor, "problem p p"]
    rank: Int[Tensor, "problem"]
    status: Int[Tensor, "problem"]
    steps: Int[Tensor, "problem"]

    @property
    def well_posed(self) -> Bool[Tensor, "problem"]:
        """True for each problem that ended at a minimum that the data determine, (problem,)."""
        return self.status > 0
