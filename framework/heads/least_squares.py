"""Bounded nonlinear least squares for thousands of small independent problems at once (Levenberg and Marquardt)."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from framework.heads.least_squares_solution import Solution, Status

EPSILON = torch.finfo(torch.float64).eps
LEAST_DAMPING, MOST_DAMPING = 1e-30, 1e20
SLIGHT = 1e-2
"""Damping, in squares of the least pivot of the factor, below which a step is as good as undamped: what it gains is all
there is to gain, and more damping would change nothing."""
QUIET = 4
"""So many steps in a row without gain, or less than rounding hides, end a problem."""
SINGULAR = 1e-7
"""Least pivot of a scaled normal matrix at which its Cholesky factor still gives a step of two right digits."""
ILL_CONDITIONED = EPSILON**0.5
"""Least singular value, columns of the Jacobian scaled to unit length, that counts towards its rank."""
DOUBTFUL = 1e10
"""Trace of the inverse of a scaled normal matrix from which on the rank is counted, and not taken for full."""
NEAR = 0.1
"""Share of the cost that a step may save at most where the minimum is near."""
GOES_ON = 10
"""In place of a status."""
CLIPS = 3
"""How often a step that leaves the bounds is solved again with what it leaves through held there."""

Model = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""`model(parameters (active, p), rows (active,)) -> (residuals (active, r), jacobian (active, r, p))`; `rows` says
which problems these are. NaN residuals at the start are missing, and are left out for good."""
Curvature = Callable[[Tensor, Tensor, Tensor], Tensor]
"""`curvature(parameters, rows, residuals) -> (active, p, p)`: Σ_i residual_i ∇²residual_i, which JᵀJ lacks of the
Hessian of the cost. Residuals that are missing come as 0."""


class _Active(NamedTuple):
    """The problems at work, first dimension the problem. `gram` is JᵀJ; `curve` what it lacks of the Hessian, 0 far
    from the minimum; `scale` the greatest length of each column of the Jacobian so far; `damping` in its square;
    `streak` counts steps accepted (above 0) or refused (below) in a row, `quiet` those without gain."""

    rows: Tensor
    at: Tensor
    lower: Tensor
    upper: Tensor
    present: Tensor
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
        return _Active(*(part[which] for part in self))


class _Rules(NamedTuple):
    """What does not change from step to step."""

    model: Model
    curvature: Curvature | None
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
    curvature: Curvature | None = None,
    most: int = 300,
    decrease: float = 1e-14,
    step: float = 1e-13,
    damping: float = 1e-1,
    together: int = 512,
) -> Solution:
    """Minimise half the sum of squared residuals of each problem over a box.

    Levenberg and Marquardt's method with Marquardt's scaling, which makes it independent of the parameters' units, and
    a damping for each problem, lowered ever faster while steps succeed and raised ever faster while they fail (Nielsen
    1999). Parameters at a bound that the gradient pushes against are held (Kanzow, Yamashita & Fukushima 2004); a step
    that leaves the box is solved again with what it leaves through held at the bound. Steps come from the Cholesky
    factor of the scaled normal matrix, or, where that is too close to singular, from the singular values of the
    Jacobian. Where `curvature` is given, steps near the minimum are Newton's: errors are squared, not divided. Problems
    that have converged leave the batch and others take their place.

    Args:
        model: residuals and their Jacobian, see `Model`.
        start: (problem, p); moved into the box.
        lower, upper: broadcast to `start`; may be infinite.
        curvature: the second derivatives, see `Curvature`.
        most: steps tried for each problem.
        decrease, step: see `Status`.
        damping: at the first step, in squared lengths of the Jacobian's columns.
        together: how many problems are at work at once.

    Raises:
        ValueError: a start or bound that is NaN, or a lower bound above the upper one.
    """
    start = start.double()
    lower, upper = (bound.to(start).expand_as(start) for bound in (lower, upper))
    _require_box(start, lower, upper)
    count = len(start)
    found = Solution(
        start.clamp(lower, upper),
        start.new_zeros(count),
        torch.diag_embed(torch.full_like(start, torch.inf)),
        torch.zeros(count, dtype=torch.int64, device=start.device),
        torch.full((count,), int(Status.NOT_FINITE), device=start.device),
        torch.zeros(count, dtype=torch.int64, device=start.device),
    )
    rules = _Rules(model, curvature, most, decrease, step)
    waiting = together
    active = _begin(rules, torch.arange(min(together, count)), found, lower, upper, damping)
    while waiting < count or len(active.rows):
        room = together - len(active.rows)
        if waiting < count and 4 * room >= together:
            rows = torch.arange(waiting, min(waiting + room, count))
            waiting += room
            fresh = _begin(rules, rows, found, lower, upper, damping)
            active = _Active(*map(torch.cat, zip(active, fresh, strict=True)))
        if len(active.rows):
            active, ended = _advance(rules, active)
            done = (ended != GOES_ON).nonzero().squeeze(1)
            if len(done):
                _finish(model, active.only(done), ended[done], found)
                active = active.only((ended == GOES_ON).nonzero().squeeze(1))
    return found


def _require_box(start: Tensor, lower: Tensor, upper: Tensor) -> None:
    bad = ~(start.isfinite() & (lower <= upper)).all(-1)
    if bool(bad.any()):
        row = int(bad.nonzero()[0])
        raise ValueError(
            f"problem {row} of the least squares starts at {start[row].tolist()} between {lower[row].tolist()} and "
            f"{upper[row].tolist()}; wanted finite numbers, and lower bounds that are not above the upper ones."
        )


def _evaluate(
    model: Model, at: Tensor, rows: Tensor, present: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Residuals and Jacobian with 0 for what is missing, and what is there, (active, r)."""
    residuals, jacobian = model(at, rows)
    if present is None:
        present = ~residuals.isnan()
    if not bool(present.all()):
        residuals = residuals.where(present, 0.0)
        jacobian = jacobian.where(present.unsqueeze(-1), 0.0)
    return residuals, jacobian, present


def _normal(residuals: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cost, gradient and normal matrix JᵀJ."""
    gradient = torch.bmm(jacobian.mT, residuals.unsqueeze(-1)).squeeze(-1)
    return residuals.square().sum(-1) / 2, gradient, torch.bmm(jacobian.mT, jacobian)


def _begin(
    rules: _Rules, rows: Tensor, found: Solution, lower: Tensor, upper: Tensor, damping: float
) -> _Active:
    rows = rows.to(lower.device)
    at = found.parameters[rows]
    residuals, jacobian, present = _evaluate(rules.model, at, rows, None)
    cost, gradient, gram = _normal(residuals, jacobian)
    zero = torch.zeros_like(rows)
    active = _Active(
        rows=rows,
        at=at,
        lower=lower[rows],
        upper=upper[rows],
        present=present,
        cost=cost,
        gradient=gradient,
        gram=gram,
        curve=torch.zeros_like(gram),
        scale=gram.diagonal(dim1=-2, dim2=-1).sqrt(),
        damping=torch.full_like(cost, damping),
        streak=zero,
        quiet=zero,
        steps=zero,
    )
    found.cost[rows] = cost.nan_to_num(torch.inf, torch.inf)
    usable = present.any(-1) & cost.isfinite() & gradient.isfinite().all(-1) & gram.isfinite().all(-1).all(-1)
    return active if bool(usable.all()) else active.only(usable)


def _advance(rules: _Rules, active: _Active) -> tuple[_Active, Tensor]:
    """Every problem one step further; and of each its status, or GOES_ON."""
    move, gain, slope, least, cut = _step(rules.model, active)
    short = (active.scale * move).norm(dim=-1) <= rules.step * (active.scale * active.at).norm(dim=-1)
    stuck = short & cut  # in a corner of the box, which steps of more damping leave
    tried = torch.minimum(torch.maximum(active.at + move, active.lower), active.upper)
    residuals, jacobian, _ = _evaluate(rules.model, tried, active.rows, active.present)
    cost, gradient, gram = _normal(residuals, jacobian)
    gained = active.cost - cost  # NaN where the model is not finite there
    ratio = gained / gain
    negligible = (gain.abs() <= rules.decrease * active.cost) & ~stuck
    good = (ratio > 1e-4) & (gain > 0) | negligible & (gained >= -8 * EPSILON * active.cost)
    # rounding of the residuals hides what a weak direction gains, unless it is damped less
    rounding = 8 * EPSILON * (2 * active.cost).sqrt() * (active.scale * active.at).norm(dim=-1)
    hidden = (gain.abs() <= rounding) & ~stuck
    good |= hidden & (gain > 0) & (gained >= -rounding)
    good &= gram.sum((-1, -2)).isfinite() & gradient.sum(-1).isfinite() & ~stuck
    easy = good & ((ratio > 0.5) | negligible | hidden)
    streak = torch.where(easy, active.streak.clamp(min=0) + 1, 0)
    streak = torch.where(good, streak, active.streak.clamp(max=0) - 1)
    # divided by 10, 100, 10⁴, ... in a row, or multiplied by 4, 8, 16, ...
    lowered = active.damping * 0.1 ** torch.exp2((streak - 1).clamp(0, 5).double())
    raised = torch.maximum(active.damping, SLIGHT * least) * torch.exp2(1.0 - streak)
    wide, wider = good.unsqueeze(-1), good[:, None, None]
    longest = torch.maximum(active.scale, gram.diagonal(dim1=-2, dim2=-1).sqrt())
    after = active._replace(
        at=torch.where(wide, tried, active.at),
        cost=torch.where(good, cost, active.cost),
        gradient=torch.where(wide, gradient, active.gradient),
        gram=torch.where(wider, gram, active.gram),
        scale=torch.where(wide, longest, active.scale),
        damping=torch.where(good, torch.where(easy, lowered, active.damping), raised).clamp(
            min=LEAST_DAMPING
        ),
        streak=streak,
        quiet=torch.where(negligible | hidden, active.quiet + 1, 0),
        steps=active.steps + 1,
    )
    settled = (negligible & (active.damping <= SLIGHT * least)) | (after.quiet >= QUIET)
    ended = torch.full_like(active.rows, GOES_ON)
    ended = torch.where(after.steps >= rules.most, int(Status.LIMIT), ended)
    ended = torch.where((short & ~stuck) | (after.damping > MOST_DAMPING), int(Status.STEP), ended)
    ended = torch.where(settled, int(Status.COST), ended)
    ended = torch.where(slope <= 4 * EPSILON, int(Status.GRADIENT), ended)
    if rules.curvature is not None:
        curve = torch.where(wider, 0.0, active.curve)
        near = (good & (gained <= NEAR * active.cost) & (ended == GOES_ON)).nonzero().squeeze(1)
        if len(near):
            curve[near] = rules.curvature(tried[near], active.rows[near], residuals[near])
        after = after._replace(curve=curve)
    return after, ended


def _step(model: Model, active: _Active) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The damped step within the box, what it is expected to gain, the cosine of gradient and residuals, the square
    of the factor's least pivot, and whether the box cut it."""
    held = (active.at <= active.lower) & (active.gradient >= 0)
    held |= (active.at >= active.upper) & (active.gradient <= 0)
    length = active.gram.diagonal(dim1=-2, dim2=-1).sqrt()
    held |= length <= EPSILON * active.scale  # nothing is known of it here
    cosine = active.gradient / (length * (2 * active.cost).sqrt().unsqueeze(-1))
    slope = cosine.where(~held, 0.0).abs().nan_to_num(0.0).amax(-1)

    scale = active.scale.where(active.scale > 0, 1.0)
    area = scale.unsqueeze(-1) * scale.unsqueeze(-2)
    pull = active.gradient / scale
    below, above = (active.lower - active.at) * scale, (active.upper - active.at) * scale
    normal = (active.gram + active.curve) / area
    factor, weak = _factor(normal, held, active.damping)
    if len(weak):  # the Hessian is not positive there
        normal[weak] = active.gram[weak] / area[weak]
        factor[weak], still = _factor(normal[weak], held[weak], active.damping[weak])
        weak = weak[still]
    least = factor.diagonal(dim1=-2, dim2=-1).where(~held, torch.inf).amin(-1).square()
    least[weak] = 0.0
    known, feeble = torch.zeros_like(pull), weak
    cut = torch.zeros(len(pull), dtype=torch.bool, device=pull.device)
    move = _solved(model, active, _System(scale, normal, pull, held, known), factor, weak)
    for _ in range(CLIPS):
        out = ((move < below) | (move > above)) & ~held
        some = out.any(-1).nonzero().squeeze(1)
        if not len(some):
            break
        known = torch.where(out, torch.minimum(torch.maximum(move, below), above), known)
        held, cut[some] = held | out, True
        fewer = _System(*(part[some] for part in (scale, normal, pull, held, known)))
        factor, weak = _factor(fewer.normal, fewer.held, active.damping[some])
        move[some] = _solved(model, active.only(some), fewer, factor, weak)
    move = torch.minimum(torch.maximum(move, below), above)
    gain = -(move * (pull + torch.bmm(normal, move.unsqueeze(-1)).squeeze(-1) / 2)).sum(-1)
    told = (move * (active.damping.unsqueeze(-1) * move - pull)).sum(-1) / 2  # the same, were the step exact
    wrong = ((gain - told).abs() > told / 10) & ~cut
    wrong[feeble] = False
    again = wrong.nonzero().squeeze(1)
    if len(again):
        fewer = _System(*(part[again] for part in (scale, normal, pull, held, known)))
        each = torch.arange(len(again), device=again.device)
        longer = _solved(model, active.only(again), fewer, torch.empty_like(fewer.normal), each)
        move[again] = torch.minimum(torch.maximum(longer, below[again]), above[again])
        feeble = torch.cat((feeble, again))
    if len(feeble):  # where the matrix has lost what the Jacobian knows
        residuals, jacobian, _ = _evaluate(
            model, active.at[feeble], active.rows[feeble], active.present[feeble]
        )
        residuals += torch.bmm(jacobian, (move / scale)[feeble].unsqueeze(-1)).squeeze(-1)
        gain[feeble] = active.cost[feeble] - residuals.square().sum(-1) / 2
    return move / scale, gain, slope, least, cut


class _System(NamedTuple):
    """Of scaled steps: Hessian, gradient, what is held, and how far it moves nevertheless."""

    scale: Tensor
    normal: Tensor
    pull: Tensor
    held: Tensor
    known: Tensor


def _factor(normal: Tensor, held: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """The Cholesky factor of the damped matrix of what is not held, and the problems where it is worth nothing."""
    free = ~held
    matrix = normal * (free.unsqueeze(-1) & free.unsqueeze(-2))
    matrix.diagonal(dim1=-2, dim2=-1).add_(torch.where(free, damping.unsqueeze(-1), 1.0))
    factor, failed = torch.linalg.cholesky_ex(matrix)
    weak = (failed > 0) | ~(factor.diagonal(dim1=-2, dim2=-1).amin(-1) >= SINGULAR)
    return factor, weak.nonzero().squeeze(1)


def _solved(model: Model, active: _Active, system: _System, factor: Tensor, weak: Tensor) -> Tensor:
    """The scaled step of least |J m + r|² + damping |m|², with the singular values of J where the factor is `weak`."""
    scale, normal, pull, held, known = system
    push = pull + torch.bmm(normal, known.unsqueeze(-1)).squeeze(-1)
    factor[weak] = torch.eye(pull.shape[-1], dtype=factor.dtype, device=factor.device)
    move = torch.cholesky_solve(-push.where(~held, 0.0).unsqueeze(-1), factor).squeeze(-1)
    if len(weak):
        residuals, jacobian, _ = _evaluate(model, active.at[weak], active.rows[weak], active.present[weak])
        jacobian = jacobian / scale[weak].unsqueeze(-2)
        residuals = residuals + torch.bmm(jacobian, known[weak].unsqueeze(-1)).squeeze(-1)
        jacobian = jacobian * ~held[weak].unsqueeze(-2)
        left, values, right = torch.linalg.svd(jacobian, full_matrices=False)
        values = values.where(values > EPSILON * values.amax(-1, keepdim=True), 0.0)
        shares = values / (values.square() + active.damping[weak].unsqueeze(-1))
        shares = shares * torch.bmm(left.mT, residuals.unsqueeze(-1)).squeeze(-1)
        move[weak] = -torch.bmm(right.mT, shares.unsqueeze(-1)).squeeze(-1)
    return torch.where(held, known, move)


def _finish(model: Model, active: _Active, status: Tensor, found: Solution) -> None:
    """Write down problems that have ended, with their covariance and rank."""
    size, scale = active.at.shape[-1], active.gram.diagonal(dim1=-2, dim2=-1).sqrt()
    scale = scale.where(scale > 0, 1.0)
    area = scale.unsqueeze(-1) * scale.unsqueeze(-2)
    factor, failed = torch.linalg.cholesky_ex(active.gram / area)
    factor[failed > 0] = torch.eye(size, dtype=factor.dtype, device=factor.device)
    inverse = torch.cholesky_inverse(factor)
    rank = torch.full_like(active.rows, size)
    # the trace is 1/σ² of the least singular value σ, or up to p times as much
    trace = inverse.diagonal(dim1=-2, dim2=-1).sum(-1)
    doubtful = ((failed > 0) | ~(trace < DOUBTFUL)).nonzero().squeeze(1)
    if len(doubtful):
        one = active.only(doubtful)
        _, jacobian, _ = _evaluate(model, one.at, one.rows, one.present)
        _, values, right = torch.linalg.svd(jacobian / scale[doubtful].unsqueeze(-2), full_matrices=False)
        kept = values > ILL_CONDITIONED * values.amax(-1, keepdim=True)
        spread = torch.where(kept, values.reciprocal(), 0.0).unsqueeze(-1) * right
        inverse[doubtful] = spread.mT @ spread
        rank[doubtful] = kept.sum(-1)
    rows, variance = active.rows, 2 * active.cost / (active.present.sum(-1) - size).clamp(min=1)
    found.parameters[rows], found.cost[rows] = active.at, active.cost
    found.covariance[rows] = variance[:, None, None] * (inverse / area)
    found.rank[rows], found.steps[rows] = rank, active.steps
    found.status[rows] = torch.where((rank < size) & (status > 0), int(Status.ILL_POSED), status)
