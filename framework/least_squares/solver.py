"""Bounded nonlinear least squares for thousands of small independent problems at once (Levenberg and Marquardt)."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from framework.least_squares import compiled
from framework.least_squares.compiled import CLIPS, EPSILON, GOES_ON, SINGULAR
from framework.least_squares.solution import Solution, Status

ILL_CONDITIONED = EPSILON**0.5
"""Smallest singular value that counts towards the rank, for a Jacobian with columns scaled to unit length."""
DOUBTFUL = 1e10
"""Smallest trace of the inverse of a scaled normal matrix for which the rank is computed.

With a smaller trace, the matrix is assumed to have full rank.
"""

Model = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""`model(parameters (active, p), rows (active,)) -> (residuals (active, r), jacobian (active, r, p))`.

A call evaluates `active` problems, those that are being solved, each with p parameters and r residuals. `rows` are the
numbers of these problems among all problems. Residuals that are NaN at the start are missing, and are left out for the
whole search.
"""
Normal = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]
"""`normal(parameters, rows) -> (cost, gradient Jᵀr, gram JᵀJ, number of residuals)`.

The function gives sums over the residuals r of a model and its Jacobian J, with the shapes (active,), (active, p),
(active, p, p) and (active,). It is for models whose sums can be computed faster than their residuals and Jacobian can
be stored.
"""
Curvature = Callable[[Tensor, Tensor], Tensor]
"""`curvature(parameters, rows) -> (active, p, p)`: Σ_i residual_i ∇²residual_i over the residuals that are not missing.

It is the difference between the Hessian of the cost and JᵀJ.
"""


class _Active(NamedTuple):
    """State of the problems that are being solved; the first dimension of each tensor counts them.

    `rows` are the numbers of the problems among all problems, and `at` their parameters. `gram` is JᵀJ for the Jacobian
    J. `curve` is the difference between the Hessian of the cost and JᵀJ, and is 0 far from the minimum. `scale` is the
    largest length so far of each column of J. `damping` is in units of the square of `scale`. `streak` is the number of
    successive steps that were accepted, or minus the number of successive steps that were rejected. `quiet` counts
    successive steps without gain, and `steps` all steps.
    """

    rows: Tensor
    at: Tensor
    lower: Tensor
    upper: Tensor
    cost: Tensor
    gradient: Tensor
    gram: Tensor
    curve: Tensor
    scale: Tensor
    damping: Tensor
    streak: Tensor
    quiet: Tensor
    steps: Tensor

    def only(self, which: Tensor) -> "_Active":
        """Return the state of only some of the problems; `which` holds their indices, or true for each of them."""
        return _Active(*(part[which] for part in self))

    def arrays(self, *names: str) -> list[np.ndarray]:
        """Return the fields with the names `names` as NumPy arrays, which share memory with the tensors."""
        return [getattr(self, name).numpy() for name in names]


class _Step(NamedTuple):
    """Steps of all problems; framework.least_squares.compiled.compute_steps describes the fields."""

    move: Tensor
    gain: Tensor
    slope: Tensor
    least: Tensor
    cut: Tensor


class _Problems:
    """Functions that evaluate the problems: residuals r, Jacobians J, and the sums JᵀJ and Jᵀr.

    The user's functions are called on the device of the start; their results are converted to float64 on the CPU.

    Attributes:
        curved: True if second derivatives are available.
        residual_counts: (problem,), number of residuals that are not missing.
    """

    def __init__(
        self, model: Model, normal: Normal | None, curvature: Curvature | None, start: Tensor
    ) -> None:
        self._model, self._normal, self._curvature = model, normal, curvature
        self._count, self._device = len(start), start.device
        self.curved = curvature is not None
        self.residual_counts = torch.zeros(self._count, dtype=torch.int64)
        self._present: Tensor | None = None

    def residuals_and_jacobian(self, at: Tensor, rows: Tensor, first: bool = False) -> tuple[Tensor, Tensor]:
        """Return residuals and Jacobian of the problems `rows` at the parameters `at`, with 0 for missing residuals.

        `first` is true at the start of the search, where residuals that are NaN are recorded as missing.
        """
        residuals, jacobian = self._call(self._model, at, rows)
        if self._normal is not None:
            present = ~residuals.isnan()
        else:
            if self._present is None:
                self._present = torch.zeros(self._count, residuals.shape[1], dtype=torch.bool)
            if first:
                self._present[rows] = ~residuals.isnan()
            present = self._present[rows]
        if not bool(present.all()):
            residuals = residuals.where(present, 0.0)
            jacobian = jacobian.where(present.unsqueeze(-1), 0.0)
        if first:
            self.residual_counts[rows] = present.sum(-1)
        return residuals, jacobian

    def normal(self, at: Tensor, rows: Tensor, first: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return cost, gradient and normal matrix JᵀJ of the problems `rows` at the parameters `at`.

        `first` is true at the start of the search.
        """
        if self._normal is None:
            residuals, jacobian = self.residuals_and_jacobian(at, rows, first)
            gradient = torch.bmm(jacobian.mT, residuals.unsqueeze(-1)).squeeze(-1)
            return residuals.square().sum(-1) / 2, gradient, torch.bmm(jacobian.mT, jacobian)
        cost, gradient, gram, residual_counts = self._call(self._normal, at, rows)
        if first:
            self.residual_counts[rows] = residual_counts.long()
        return cost, gradient, gram

    def curve(self, at: Tensor, rows: Tensor) -> Tensor:
        """Return the sum of residuals times second derivatives (`Curvature`) of the problems `rows` at `at`."""
        assert self._curvature is not None
        curvature = self._curvature
        return self._call(lambda *arguments: (curvature(*arguments),), at, rows)[0]

    def _call(self, function: Callable[..., tuple[Tensor, ...]], *arguments: Tensor) -> tuple[Tensor, ...]:
        """Call a function with arguments on the device of the start, and return its results in float64 on the CPU."""
        results = function(*(part.to(self._device) for part in arguments))
        return tuple(part.to("cpu", torch.float64) for part in results)


class _Rules(NamedTuple):
    """Settings of the search: the arguments `most`, `decrease` and `step` of `least_squares`."""

    most: int
    decrease: float
    step: float


@torch.no_grad()
def least_squares(
    model: Model,
    start: Float[Tensor, "problem p"],
    lower: Tensor,
    upper: Tensor,
    *,
    normal: Normal | None = None,
    curvature: Curvature | None = None,
    most: int = 300,
    decrease: float = 1e-14,
    step: float = 1e-13,
    damping: float = 1e-1,
    together: int = 1024,
) -> Solution:
    """Minimise half the sum of squared residuals of each problem over a box.

    The method is Levenberg and Marquardt's with Marquardt's scaling, which makes it independent of the parameters'
    units. Each problem has its own damping, which is lowered ever faster while steps succeed and raised ever faster
    while they fail (Nielsen 1999). Parameters at a bound that the gradient pushes against are held (Kanzow, Yamashita &
    Fukushima 2004). A step that leaves the box is solved again with the parameters beyond a bound held there. Steps
    come from the Cholesky factor of the scaled normal matrix or, if that is too close to singular, from the singular
    values of the Jacobian. If `curvature` is given, steps near the minimum are Newton's, with which the error falls
    quadratically instead of linearly. Problems that have ended leave the batch, and waiting problems replace them.

    The model is evaluated on the device of `start`; the small systems of equations are solved on the CPU.

    Args:
        model: function that returns the residuals and their Jacobian (`Model`).
        start: (problem, p); clipped to the box.
        lower: lower bounds, broadcast to `start`; may be infinite.
        upper: upper bounds, broadcast to `start`; may be infinite.
        normal: function that returns the sums over a problem's residuals (`Normal`); `model` is then called only if a
            matrix is close to singular.
        curvature: function that returns the second derivatives (`Curvature`).
        most: largest number of steps tried for each problem.
        decrease: the search ends if no step would lower the cost by more than this share of the cost.
        step: the search ends if no step would move the parameters by more than this share of their size.
        damping: damping at the first step, as a multiple of the squared lengths of the Jacobian's columns.
        together: number of problems that are solved at once.

    Raises:
        ValueError: a start is not finite, a bound is NaN, or a lower bound is above the upper one.
    """
    start = start.double()
    lower, upper = (bound.to(start).expand_as(start) for bound in (lower, upper))
    _require_box(start, lower, upper)
    problems = _Problems(model, normal, curvature, start)
    device, count = start.device, len(start)
    start, lower, upper = start.cpu(), lower.cpu(), upper.cpu()
    solution = Solution(
        start.clamp(lower, upper),
        start.new_zeros(count),
        torch.diag_embed(torch.full_like(start, torch.inf)),
        torch.zeros(count, dtype=torch.int64),
        torch.full((count,), int(Status.NOT_FINITE)),
        torch.zeros(count, dtype=torch.int64),
    )
    rules = _Rules(most, decrease, step)
    waiting = together
    active = _begin(problems, torch.arange(min(together, count)), solution, lower, upper, damping)
    while waiting < count or len(active.rows):
        room = together - len(active.rows)
        if waiting < count and 4 * room >= together:
            rows = torch.arange(waiting, min(waiting + room, count))
            waiting += room
            fresh = _begin(problems, rows, solution, lower, upper, damping)
            active = _Active(*map(torch.cat, zip(active, fresh, strict=True)))
        if len(active.rows):
            ended = _advance(problems, rules, active)
            finished = (ended != GOES_ON).nonzero().squeeze(1)
            if len(finished):
                _finish(problems, active.only(finished), ended[finished], solution)
                active = active.only((ended == GOES_ON).nonzero().squeeze(1))
    return Solution(*(part.to(device) for part in solution))


def _require_box(start: Tensor, lower: Tensor, upper: Tensor) -> None:
    bad = ~(start.isfinite() & (lower <= upper)).all(-1)
    if bool(bad.any()):
        row = int(bad.nonzero()[0])
        raise ValueError(
            f"Least-squares problem {row} starts at {start[row].tolist()} between the bounds {lower[row].tolist()} and "
            f"{upper[row].tolist()}; expected finite numbers, and no lower bound above its upper bound."
        )


def _begin(
    problems: _Problems, rows: Tensor, solution: Solution, lower: Tensor, upper: Tensor, damping: float
) -> _Active:
    """Return the initial state of the problems `rows`, without those that are not finite at their start."""
    at = solution.parameters[rows]
    cost, gradient, gram = problems.normal(at, rows, first=True)
    active = _Active(
        rows=rows,
        at=at,
        lower=lower[rows],
        upper=upper[rows],
        # Copies, because steps change them in place and the model may keep them.
        cost=cost.clone(),
        gradient=gradient.clone(memory_format=torch.contiguous_format),
        gram=gram.clone(memory_format=torch.contiguous_format),
        curve=torch.zeros(gram.shape, dtype=gram.dtype),
        scale=gram.diagonal(dim1=-2, dim2=-1).sqrt(),
        damping=torch.full_like(cost, damping),
        streak=torch.zeros_like(rows),
        quiet=torch.zeros_like(rows),
        steps=torch.zeros_like(rows),
    )
    solution.cost[rows] = cost.nan_to_num(torch.inf, torch.inf)
    usable = problems.residual_counts[rows] > 0
    usable &= cost.isfinite() & gradient.isfinite().all(-1) & gram.isfinite().all(-1).all(-1)
    return active if bool(usable.all()) else active.only(usable)


def _advance(problems: _Problems, rules: _Rules, active: _Active) -> Tensor:
    """Advance every problem by one step, in place, and return the status of each, or GOES_ON."""
    step = _step(problems, active)
    tried = torch.minimum(torch.maximum(active.at + step.move, active.lower), active.upper)
    cost, gradient, gram = problems.normal(tried, active.rows)
    ended, near = torch.empty_like(active.rows), torch.empty(len(tried), dtype=torch.bool)
    state = ("at", "cost", "gradient", "gram", "curve", "scale", "damping", "streak", "quiet", "steps")
    compiled.judge_steps(
        *active.arrays(*state),
        *(part.numpy() for part in (*step, tried, cost, gradient.contiguous(), gram.contiguous())),
        *rules,
        ended.numpy(),
        near.numpy(),
    )
    if problems.curved and len(where := near.nonzero().squeeze(1)):
        active.curve[where] = problems.curve(tried[where], active.rows[where])
    return ended


def _step(problems: _Problems, active: _Active) -> _Step:
    """Return the damped step of every problem within its bounds."""
    gain, slope, least = (torch.empty_like(active.cost) for _ in range(3))
    cut, careful = (torch.empty(len(gain), dtype=torch.bool) for _ in range(2))
    step = _Step(torch.empty_like(active.at), gain, slope, least, cut)
    inputs = ("at", "lower", "upper", "cost", "gradient", "gram", "curve", "scale", "damping")
    compiled.compute_steps(*active.arrays(*inputs), *(part.numpy() for part in (*step, careful)))
    if len(where := careful.nonzero().squeeze(1)):
        some = _Step(*(part[where] for part in step))
        for part, mended in zip(step, _careful_step(problems, active.only(where), some), strict=True):
            part[where] = mended
    return step


def _careful_step(problems: _Problems, active: _Active, step: _Step) -> _Step:
    """Return the damped step within the bounds, computed from the singular values of the Jacobian.

    It is for problems whose matrix JᵀJ has lost too many digits. `step` is the step that was computed from JᵀJ.
    """
    fixed = (active.at <= active.lower) & (active.gradient >= 0)
    fixed |= (active.at >= active.upper) & (active.gradient <= 0)
    fixed |= active.gram.diagonal(dim1=-2, dim2=-1).sqrt() <= EPSILON * active.scale
    scale = active.scale.where(active.scale > 0, 1.0)
    below, above = (active.lower - active.at) * scale, (active.upper - active.at) * scale
    residuals, jacobian = problems.residuals_and_jacobian(active.at, active.rows)
    jacobian = jacobian / scale.unsqueeze(-2)

    known, cut = torch.zeros_like(active.at), torch.zeros_like(step.cut)
    move = _solve_damped(jacobian, residuals, fixed, known, active.damping)
    for _ in range(CLIPS):
        out = ((move < below) | (move > above)) & ~fixed
        some = out.any(-1).nonzero().squeeze(1)
        if not len(some):
            break
        known = torch.where(out, torch.minimum(torch.maximum(move, below), above), known)
        fixed, cut[some] = fixed | out, True
        system = (part[some] for part in (jacobian, residuals, fixed, known, active.damping))
        move[some] = _solve_damped(*system)
    move = torch.minimum(torch.maximum(move, below), above)
    after = residuals + torch.bmm(jacobian, move.unsqueeze(-1)).squeeze(-1)
    least = step.least.where(step.least >= SINGULAR**2, 0.0)
    return _Step(move / scale, active.cost - after.square().sum(-1) / 2, step.slope, least, cut)


def _solve_damped(
    jacobian: Tensor, residuals: Tensor, fixed: Tensor, known: Tensor, damping: Tensor
) -> Tensor:
    """Return the scaled step m that minimises |J m + r|² + damping |m|², for the residuals r and the scaled Jacobian J.

    Parameters that are `fixed` do not take part: their step is `known`.
    """
    residuals = residuals + torch.bmm(jacobian, known.unsqueeze(-1)).squeeze(-1)
    left, values, right = torch.linalg.svd(jacobian * ~fixed.unsqueeze(-2), full_matrices=False)
    values = values.where(values > EPSILON * values.amax(-1, keepdim=True), 0.0)
    shares = values / (values.square() + damping.unsqueeze(-1))
    shares = shares * torch.bmm(left.mT, residuals.unsqueeze(-1)).squeeze(-1)
    return torch.where(fixed, known, -torch.bmm(right.mT, shares.unsqueeze(-1)).squeeze(-1))


def _finish(problems: _Problems, active: _Active, status: Tensor, solution: Solution) -> None:
    """Store in `solution` the results of the problems in `active`, which have ended, with covariance and rank."""
    size = active.at.shape[-1]
    inverse, trace = torch.empty_like(active.gram), torch.empty_like(active.cost)
    compiled.invert(active.gram.numpy(), inverse.numpy(), trace.numpy())
    rank = torch.full_like(active.rows, size)
    # The trace is between 1/σ² and p/σ², with the smallest singular value σ.
    doubtful = (~(trace < DOUBTFUL)).nonzero().squeeze(1)
    if len(doubtful):
        doubtful_problems = active.only(doubtful)
        _, jacobian = problems.residuals_and_jacobian(doubtful_problems.at, doubtful_problems.rows)
        length = doubtful_problems.gram.diagonal(dim1=-2, dim2=-1).sqrt()
        length = length.where(length > 0, 1.0)
        _, values, right = torch.linalg.svd(jacobian / length.unsqueeze(-2), full_matrices=False)
        above_cutoff = values > ILL_CONDITIONED * values.amax(-1, keepdim=True)
        spread = (
            torch.where(above_cutoff, values.reciprocal(), 0.0).unsqueeze(-1) * right / length.unsqueeze(-2)
        )
        inverse[doubtful] = spread.mT @ spread
        rank[doubtful] = above_cutoff.sum(-1)
    rows = active.rows
    variance = 2 * active.cost / (problems.residual_counts[rows] - size).clamp(min=1)
    solution.parameters[rows], solution.cost[rows] = active.at, active.cost
    solution.covariance[rows] = variance[:, None, None] * inverse
    solution.rank[rows], solution.steps[rows] = rank, active.steps
    solution.status[rows] = torch.where((rank < size) & (status > 0), int(Status.ILL_POSED), status)
