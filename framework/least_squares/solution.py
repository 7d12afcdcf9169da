"""Solutions of many least-squares problems, as framework.least_squares.solver returns them."""

from enum import IntEnum
from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor


class Status(IntEnum):
    """Reason for which the search for the minimum of a problem ended; above 0 for a minimum that the data determine."""

    GRADIENT = 1
    """The residuals are orthogonal to the columns of the Jacobian, except for parameters held at bounds."""
    COST = 2
    """No step would lower the cost by more than the share `decrease` of it (an argument of `least_squares`)."""
    STEP = 3
    """No step would move the parameters by more than the share `step` of them (an argument of `least_squares`)."""
    LIMIT = 0
    """The search did not end within `most` steps (an argument of `least_squares`); the best parameters are returned."""
    ILL_POSED = -1
    """The search ended at a minimum with a rank-deficient Jacobian: the data do not determine every parameter."""
    NOT_FINITE = -2
    """There was no search, and the start is returned.

    At the start all residuals are missing, a residual is infinite, or the Jacobian is not finite.
    """


class Solution(NamedTuple):
    """Results of each problem; no number is NaN.

    Attributes:
        parameters: (problem, p), within the bounds.
        cost: (problem,), half the sum of squared residuals, as in SciPy.
        covariance: (problem, p, p), covariance of the parameters, s² (JᵀJ)⁻¹. J is the Jacobian with respect to all
            parameters, including those at a bound, and s² = 2 cost / (number of residuals - p). If the rank is less
            than p, the inverse is the pseudo-inverse: directions that the data do not determine then have variance 0.
            If the status is NOT_FINITE, the diagonal is infinite.
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
