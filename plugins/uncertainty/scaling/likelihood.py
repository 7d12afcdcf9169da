"""Maximum-likelihood estimation of parameters within bounds, by SciPy's L-BFGS-B (Byrd et al. 1995)."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import optimize
from torch import Tensor

Term = Callable[[Tensor], Tensor]
"""Part of the mean negative log-likelihood, as a differentiable function of the parameters (n,), float64."""


RESTARTS = 20
NEAREST = 1e-9
"""Step, as a factor on the gradient, below which the search ends.

Steps become this short beside a region in which the minimised sum is not finite.
"""


class Minimum(NamedTuple):
    """Result of `minimise`.

    Attributes:
        point: position of the minimum within the bounds, float64.
        value: value at the minimum, never above the value at the start.
        active: for each parameter, -1 at its lower bound, 1 at its upper bound, and 0 otherwise. A bound counts only if
            the minimised sum would be lower beyond this bound.
    """

    point: Float[Tensor, "n"]
    value: float
    active: Int[Tensor, "n"]


def minimise(
    terms: Sequence[Term],
    start: Float[Tensor, "n"],
    lower: Float[Tensor, "n"],
    upper: Float[Tensor, "n"],
    *,
    rounding: float = 2e-16,
) -> Minimum:
    """Return a local minimum of the sum of `terms` within lower ≤ point ≤ upper.

    Only the autograd graph of one term is in memory at a time.

    Args:
        terms: differentiable functions of the point, whose values are added.
        start: first point, within the bounds.
        lower: lower bounds.
        upper: upper bounds.
        rounding: rounding error of the values, relative to 1 + |value|; smaller gains end the search.
    """
    low, high = lower.cpu().numpy(), upper.cpu().numpy()
    first, _ = value_and_slope(terms, start)
    # a point where the sum is not finite gets a value above the first one and the gradient 0, so that the step fails
    worse = first + 1 + abs(first)
    walled: list[np.ndarray] = []

    def trial(numbers: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = value_and_slope(terms, torch.tensor(numbers).to(start))
        if np.isfinite([value, *slope]).all():
            return value, slope
        walled.append(numbers)
        return worse, np.zeros_like(slope)

    options = {"ftol": rounding, "gtol": 1e-12, "maxiter": 200}
    bounds = np.stack([low, high], 1)
    x, least = start.cpu().numpy(), first
    for _ in range(RESTARTS):
        result = optimize.minimize(trial, x, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        gained = least - result.fun
        if gained >= 0:
            x, least = result.x, result.fun
        # L-BFGS-B ends after one step without gain, even if the gradient is large; so it is started again
        if gained <= rounding * (1 + abs(least)):
            break
    step = 1.0 if walled else 0.0
    # SciPy's line search stops before a region without finite values; halved steps approach the region
    while step > NEAREST:
        value, slope = trial(x)
        ahead = np.clip(x - step * slope, low, high)
        further = trial(ahead)[0]
        x, step = (ahead, step) if further < value else (x, step / 2)
    point = torch.tensor(x).to(start)
    value, slope = value_and_slope(terms, point)
    down, up = (x <= low) & (slope > 0), (x >= high) & (slope < 0)
    return Minimum(point, value, torch.from_numpy(up.astype(int) - down.astype(int)))


def total(terms: Sequence[Term], point: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Return the sum of `terms` at a point, float64, without gradient."""
    with torch.no_grad():
        return torch.stack([term(point).double() for term in terms]).sum()


def value_and_slope(terms: Sequence[Term], point: Float[Tensor, "n"]) -> tuple[float, np.ndarray]:
    """Return the sum of `terms` at a point, and its gradient (n,), float64."""
    value, slope = 0.0, torch.zeros_like(point)
    for term in terms:
        with torch.enable_grad():
            leaf = point.detach().clone().requires_grad_()
            part = term(leaf).double()
            value += part.item()
            if part.requires_grad:  # False for a constant
                slope += torch.autograd.grad(part, leaf)[0]
    return value, slope.cpu().numpy()
