"""Guarded Newton steps for a few parameters in a box: never leaves it, never climbs, always ends."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

Term = Callable[[Tensor], Tensor]
"""Part of a sum to minimise: parameters (n,), float64 → a scalar, twice differentiable."""

ROUNDING = 1e-15
"""Changes of a value below this share of it are rounding."""
LARGEST_RADIUS = 1e6


@dataclass(frozen=True)
class Minimum:
    """Where `minimise` ended.

    Attributes:
        point: within the box, float64.
        value: there, a number; never above that at the start.
        active: -1 at its lower bound, 1 at its upper one, 0 between, int64; at a bound only where the function still
            falls towards it.
        hessian: second derivatives there; about 0 where the function is flat.
        iterations: derivatives taken.
        converged: whether no parameter that may move promises anything; False: the steps ran out, or nothing finite
            was found around.
    """

    point: Float[Tensor, "n"]
    value: float
    active: Int[Tensor, "n"]
    hessian: Float[Tensor, "n n"]
    iterations: int
    converged: bool


def minimise(
    terms: Sequence[Term],
    start: Float[Tensor, "n"],
    lower: Float[Tensor, "n"],
    upper: Float[Tensor, "n"],
    *,
    iterations: int = 200,
    tolerance: float = 1e-14,
) -> Minimum:
    """A local minimum of Σ terms in the box lower ≤ point ≤ upper, whose bounds may be infinite.

    Newton's step among the parameters that are not held by a bound, in a basis in which the Hessian is diagonal:
    negative curvatures count by their size, so that every step is downhill (Nocedal & Wright 2006, §3.4), and it is
    shortened to a radius that grows where the step kept its promise and shrinks where it did not (ibid., §4.1).
    A point where the sum is not finite is a step that failed. Each term's derivatives are taken on their own: only
    one term's graph is held.

    Args:
        start: read as the nearest point of the box.
        tolerance: the step's promised decrease, relative to 1 + |value|, below which nothing is left to gain.

    Raises:
        ValueError: an empty box, or the value or a derivative at the start is not finite.
    """
    lower, upper = lower.double(), upper.double()
    if not (lower <= upper).all():
        raise ValueError(f"the box from {lower.tolist()} to {upper.tolist()} is empty; wanted lower ≤ upper.")
    point = start.detach().double().clamp(lower, upper)
    value, slope, hessian = derivatives(terms, point)
    if not all(part.isfinite().all() for part in (value, slope, hessian)):
        raise ValueError(
            f"at the start {point.tolist()} the value is {value.item()} with slope {slope.tolist()}; wanted finite "
            "numbers. Start elsewhere."
        )
    radius, count, converged = 1.0, 1, False
    while count < iterations:
        size = 1 + value.abs().item()
        _, left = _step(point, slope, hessian, lower, upper, LARGEST_RADIUS)
        if left <= tolerance * size:
            converged = True
            break
        trial, promise = _step(point, slope, hessian, lower, upper, radius)
        if promise <= ROUNDING * size:
            # downhill by its derivatives, but no value shows it: as near as rounding lets one come
            converged = left <= ROUNDING**0.5 * size
            break
        gain = (value - total(terms, trial)).item()
        length = (trial - point).norm().item()
        if not gain > max(1e-4 * promise, 0.0):  # NaN too
            radius = length / 4
            continue
        new = derivatives(terms, trial)
        count += 1
        if not all(part.isfinite().all() for part in new):
            radius = length / 4
            continue
        if gain > 0.5 * promise:
            radius = min(LARGEST_RADIUS, max(radius, 4 * length))
        point, (value, slope, hessian) = trial, new
    held = _held(point, slope, lower, upper)
    active = torch.where(held, torch.where(point <= lower, -1, 1), 0)
    return Minimum(point, value.item(), active, hessian, count, converged)


def total(terms: Sequence[Term], point: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Σ terms, float64, without gradient."""
    with torch.no_grad():
        return torch.stack([term(point).double() for term in terms]).sum()


def derivatives(
    terms: Sequence[Term], point: Float[Tensor, "n"]
) -> tuple[Float[Tensor, ""], Float[Tensor, "n"], Float[Tensor, "n n"]]:
    """Value, gradient and Hessian of Σ terms, float64."""
    value, slope = point.new_zeros(()), torch.zeros_like(point)
    hessian = point.new_zeros(len(point), len(point))
    for term in terms:
        with torch.enable_grad():
            here = point.detach().clone().requires_grad_()
            part = term(here).double()
            value = value + part.detach()
            if not part.requires_grad:
                continue  # a constant
            (first,) = torch.autograd.grad(part, here, create_graph=True)
            slope = slope + first.detach()
            if not first.requires_grad:
                continue  # linear
            for row, entry in enumerate(first):
                (second,) = torch.autograd.grad(
                    entry, here, retain_graph=row + 1 < len(first), materialize_grads=True
                )
                hessian[row] += second
    return value, slope, (hessian + hessian.mT) / 2


def _held(point: Tensor, slope: Tensor, lower: Tensor, upper: Tensor) -> Bool[Tensor, "n"]:
    """Parameters at a bound beyond which the function still falls, or which have no room at all."""
    return ((point <= lower) & (slope > 0)) | ((point >= upper) & (slope < 0)) | (lower == upper)


def _step(
    point: Tensor, slope: Tensor, hessian: Tensor, lower: Tensor, upper: Tensor, radius: float
) -> tuple[Tensor, float]:
    """Where Newton's step of at most `radius` leads within the box, and the decrease that its parabola promises.

    A parameter at a bound that the step would push out of the box is held, one at a time, and the step taken anew
    among the others: whatever the Hessian couples, what is left is downhill. It ends at the first bound on its way.
    """
    trial = point.clone()
    rows = (~_held(point, slope, lower, upper)).nonzero().flatten()
    while len(rows):
        curvature, basis = torch.linalg.eigh(hessian[rows][:, rows])
        along = basis.mT @ slope[rows]
        # a curvature that is only rounding of the largest would send the step anywhere
        bent = curvature.abs().clamp(min=max(1e-13 * curvature.abs().amax().item(), 1e-100))
        move = along / bent
        if not move.isfinite().all():
            move = along
        move = -(basis @ (move * min(1.0, radius / max(move.norm().item(), 1e-300))))
        # exactly at the bound where the step ends there
        here, ends = point[rows], torch.where(move > 0, upper[rows], lower[rows])
        room = ends - here
        out = (room.abs() <= 1e-14 * (1 + here.abs())) & (move != 0)
        if out.any():
            worst = int((move.abs() * out).argmax())
            trial[rows[worst]] = ends[worst]
            rows = torch.cat([rows[:worst], rows[worst + 1 :]])
            continue
        share = torch.where(move == 0, torch.inf, room / move)
        cut = min(1.0, share.amin().item())
        trial[rows] = torch.where(share <= cut, ends, here + cut * move).clamp(lower[rows], upper[rows])
        moved = trial[rows] - here
        promise = -(slope[rows] @ moved) - ((basis.mT @ moved).square() * bent).sum() / 2
        return trial, promise.item()
    return point, 0.0
