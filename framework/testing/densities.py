"""Checks of the densities of density heads and uncertainty wrappers; each check records its largest error.

A check is a function of a density and of `worst`, which records the largest error (`framework.testing.finding.Worst`).
"""

import math
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, angular_distance, wrap
from framework.distributions.density import circular_grid
from framework.distributions.protocol import (
    arc_probability,
    cdf,
    marginal,
    median,
    mode_candidates,
    quadratic_bound,
    trigonometric_moments,
)
from framework.errors import UserError
from framework.testing.adaptive import boxes
from framework.testing.finding import SEED, Finding, Worst, seed
from framework.testing.flattened import flatten
from framework.testing.head_subject import TIME_LIMIT, HeadSubject
from framework.testing.protocol_checks import (
    apply_to_powers,
    check_estimate,
    check_marginal_cdfs,
    check_marginals,
    check_medians,
    check_mode_candidates,
    check_moments,
    check_normals,
    check_pick,
    check_powers,
    check_quadratic_bound,
    check_recentre,
    mix_pairs,
)
from framework.testing.quadrature import cells, cells_around_draws, count_samples, density_at, side

DRAWS = 20_000
"""Number of draws that are compared with a density."""
UNSEEN = 3.3
"""Number of draws that, divided by DRAWS, is added to the standard error of an average over draws.

If the averaged numbers are nearly always 0, all rare draws may be missing, and the estimated standard error is too
small. Draws that are expected 20 times are missing with probability e⁻²⁰. The limit of 6 standard errors allows for
6 · UNSEEN = 20 missing draws.
"""
SCALES = (1e-2, 0.1, 1.0, 10.0, 1e2, 1e3)
"""Standard deviations of the random raw parameters at which densities are checked, in addition to the row's `scale`."""
GRID = 2880
"""Number of angles of the grid with which trigonometric moments are compared."""
CELLS = 24
"""Number of cells of about equal mass in which draws of one number are counted."""
STRIPS = 12
"""Number of strips of about equal mass in which draws of two numbers are counted; each strip has as many cells."""
MEDIAN_DRAWS = 2000
"""Number of draws from which a median is estimated, where it has no closed form."""
Check = Callable[[Distribution, Worst], None]


class Property(NamedTuple):
    """Check of densities, its limit, and the raw parameters at which it runs.

    Attributes:
        name: Name of the property.
        limit: Largest error that passes.
        check: Function that runs the check.
        batch: Choice of the raw parameters. "scales": each scale of SCALES and the row's `scale`. "own": the row's
            `scale`, at which a fixed grid resolves the densities. "many": 64 items of the batch for each of the scales
            0.01, 1 and 100.
    """

    name: str
    limit: float
    check: Check
    batch: str


def examine_densities(subject: HeadSubject) -> Iterator[Finding]:
    """Yield one finding for each property of the densities of a contract row, in float64.

    A density whose log_prob draws random numbers is checked only at the row's `scale`, since its log_prob varies
    between calls by more than the error of any quadrature.
    """
    draws = subject.draws()

    @cache
    def densities(batch: str) -> tuple[Distribution, list[str]]:
        own, repeats = subject.row.scale, 1 if _numbers(subject) > 1 else 3
        scales = {"own": [own] * 3, "many": [s for s in (1e-2, 1.0, 1e2) for _ in range(64)]}.get(
            batch, [s for s in (*SCALES, own) for _ in range(repeats)]
        )
        raw = subject.scaled_parameters(scales)
        head = subject.make().double()
        head.requires_grad_(False)
        names = [f"raw parameters of size {scale:g}, batch row {row}" for row, scale in enumerate(scales)]
        return flatten(head(raw)), names

    for name, limit, check, batch in CHECKS:
        if not subject.includes(name) or not applies(name, subject, draws):
            continue
        # densities of more than two numbers are integrated over the cells of a fixed grid, in which draws of more than
        # one number are counted
        grid = {"integral": 2, "samples follow log_prob": 1}.get(name, math.inf)
        too_slow = subject.seconds < TIME_LIMIT  # an earlier check was, most likely at extreme parameters
        chosen = "own" if draws or too_slow or _numbers(subject) > grid else batch
        if chosen == "own" and batch == "many":
            continue

        def run(worst: Worst, check: Check = check, chosen: str = chosen) -> None:
            with torch.no_grad():
                density, worst.rows = densities(chosen)
                check(density, worst)

        yield subject.run_check(name, limit, run)
    yield from _examine_protocol(subject, draws)


def _examine_protocol(subject: HeadSubject, draws: bool) -> Iterator[Finding]:
    """Yield findings for the optional functions of framework.distributions.protocol, and for mixtures and powers.

    Args:
        subject: Contract row of the head.
        draws: True if log_prob draws random numbers.
    """

    @cache
    def pairs() -> Distribution:
        """Return densities of the head with batch_shape (3, 2)."""
        head = subject.make().double()
        head.requires_grad_(False)
        return head(subject.row.scale * subject.raw_parameters(3, 2).double())

    @cache
    def rows() -> Distribution:
        """Return densities of the head with batch_shape (3,)."""
        head = subject.make().double()
        head.requires_grad_(False)
        return head(subject.row.scale * subject.raw_parameters(3).double())

    @cache
    def mixture() -> Distribution:
        """Return mixtures of two densities of the head, batch_shape (3,)."""
        return mix_pairs(pairs())

    numbers, kind = _numbers(subject), subject.row.target.kind
    is_scalar, classes = numbers == 1 and kind in ("real", "angle"), kind == "class"
    few = kind in ("real", "angle") and 2 <= numbers <= 6
    several = kind == "image" or few
    checks: list[tuple[str, float, Callable[[], Distribution], Check, bool]] = [
        ("estimate", 1.0, rows, check_estimate, True),
        ("pick", 1.0, pairs, check_pick, True),
        ("quadratic_bound", 1.0, rows, check_quadratic_bound, not classes and not draws and kind != "image"),
        ("recentre", 1.0, rows, check_recentre, is_scalar and not draws),
        ("normals", 1.0, rows, check_normals, kind == "real" and not draws),
        ("mode candidates and peak widths", 0.0, rows, check_mode_candidates, not classes and not draws),
        ("marginal_cdfs", 1.0, rows, check_marginal_cdfs, kind in ("real", "image") and not draws),
        (
            "mean and variance",
            1.0,
            rows,
            check_moments,
            kind in ("real", "image") and numbers > 2 and not draws,
        ),
        ("median", 1.0, rows, check_medians, several and not draws),
        ("marginals", 1.0, rows, check_marginals, few and not draws),
        ("tempered: power", 1.0, rows, check_powers, not draws),
        ("mixture: estimate", 1.0, mixture, check_estimate, not draws),
        ("mixture: quadratic_bound", 1.0, mixture, check_quadratic_bound, is_scalar and not draws),
    ]
    for name in MIXTURE_PROPERTIES:
        limit, check = next((limit, check) for known, limit, check, _ in CHECKS if known == name)
        suits = applies(name, subject, draws) and (is_scalar or classes) and not draws
        if name == "mode":
            limit, check = 1.0, mode_of_mixture
        checks.append((f"mixture: {name}", limit, mixture, check, suits))
        if name in ("integral", "samples follow log_prob", "entropy"):
            power = partial(apply_to_powers, check=check)
            checks.append((f"tempered: {name}", limit, rows, power, suits))
    for name, limit, density, check, suits in checks:
        # a property that a row leaves out is left out for its mixtures and powers too
        if not suits or not subject.includes(name) or name.rpartition(": ")[2] in subject.row.leave_out:
            continue

        def run(worst: Worst, density: Callable[[], Distribution] = density, check: Check = check) -> None:
            with torch.no_grad():
                check(density(), worst)

        yield subject.run_check(name, limit, run)


def _numbers(subject: HeadSubject) -> int:
    """Return how many numbers a target of the contract row has."""
    return math.prod(subject.row.target.event_shape)


def applies(name: str, subject: HeadSubject, draws: bool = False) -> bool:
    """Return whether a property applies to the row's target; `draws` tells whether log_prob draws random numbers."""
    kind, numbers = subject.row.target.kind, _numbers(subject)
    kind = "real" if kind == "image" else kind
    expected = {
        "integral": numbers <= 3,
        "integral by draws": kind in ("angle", "real") and numbers >= 3 and not draws,
        "samples follow log_prob": numbers <= 3,
        "samples follow marginals": kind in ("angle", "real") and numbers == 2 and not draws,
        "2π-periodic": kind == "angle",
        "median": kind in ("angle", "real") and numbers == 1,
        "marginals": kind == "angle" and numbers in (2, 3),
        "mean and variance": kind == "real" and numbers <= 2,
        "cdf": kind in ("angle", "real") and numbers == 1 and not draws,
    }
    return expected.get(name, True)


def integral(density: Distribution, worst: Worst) -> None:
    """Check that the density integrates to 1.

    A density of one or two numbers or of three angles is integrated by adaptive quadrature. A density of three real
    numbers is integrated on a grid, whose centre and width are determined by draws. Densities of two numbers for which
    the quadrature does not converge are checked by draws (`integral_by_draws`), with a limit of 6 standard errors.
    """
    resolved = torch.ones(density.batch_shape, dtype=torch.bool)
    if density.event_shape in ((1,), (2,)):
        quadrature = boxes(density)
        total = quadrature.mean(torch.ones_like(quadrature.log_prob))
        resolved = quadrature.resolved & quadrature.converged
        if not bool(quadrature.converged.all()):
            by_draws = Worst()
            by_draws.rows = worst.rows
            integral_by_draws(density, by_draws, ~quadrature.converged)
            worst.record(by_draws.error * 1e-6 / 6, by_draws.case)
    elif density.event_shape == (3,) and not isinstance(density.support, Circular):
        total = cells_around_draws(density).mass.sum((0, 1, 2))
    else:
        _, mass = cells(density)
        total = mass.sum(tuple(range(max(1, len(density.event_shape) and density.event_shape[0]))))
    gap = (total - 1).abs().where(resolved, 0.0)
    worst.record(gap, lambda at: f"{worst.row(at[0])}: {total[at].item():.9g}")


def integral_by_draws(density: Distribution, worst: Worst, chosen: Tensor | bool = True) -> None:
    """Check by draws that the density integrates to 1; the error is in standard errors.

    Let p be the density and q a normal density. The check compares E_p[q/(p + q)] with E_q[p/(p + q)]. Both are equal
    to ∫ pq/(p + q) if p integrates to 1 and its draws follow it. All averaged values are in [0, 1], also for heavy
    tails. q is fitted to one half of the draws from p, and the average over p is taken over the other half. With the
    same draws, q would be too high at them: for ten numbers, the error would be several standard errors.

    Args:
        density: Density with batch_shape (rows,).
        worst: Recorder of the largest error.
        chosen: Rows that are checked, (rows,); True for all.
    """
    fit_draws, test_draws = density.sample(torch.Size((2 * DRAWS,))).double().chunk(2)
    support = density.support
    circular = isinstance(support, Circular)
    center = density.mode.double() if circular else fit_draws.mean(0)
    offset, other = (wrap(part - center) if circular else part - center for part in (test_draws, fit_draws))
    shift = other.mean(0)
    _, root = torch.linalg.qr((other - shift).movedim(0, 1) / DRAWS**0.5)  # (rows, numbers, numbers)
    normal = torch.randn(DRAWS, *offset.shape[1:], dtype=torch.float64)
    volume = root.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)

    def log_ratio(offset: Tensor, standard: Tensor) -> Tensor:
        value = center + offset
        log_prob = torch.cat([density.log_prob(part) for part in value.split(4000)])
        inside = torch.ones_like(log_prob, dtype=torch.bool)
        if circular:
            inside = (offset.abs() <= math.pi).all(-1)
            for number, (low, high) in enumerate((isinstance(support, Circular) and support.ranges) or ()):
                angle = wrap(value[..., number])
                inside &= (angle >= low) & (angle <= high)
        log_normal = -(standard.square() + math.log(2 * math.pi)).sum(-1) / 2 - volume
        return torch.where(inside, log_prob, -math.inf) - log_normal

    standard = torch.linalg.solve_triangular(root.mT, (offset - shift).movedim(0, -1), upper=False)
    of_p = torch.sigmoid(-log_ratio(offset, standard.movedim(-1, 0)))
    of_q = torch.sigmoid(log_ratio(shift + torch.einsum("dbi,bij->dbj", normal, root), normal))
    noise = ((of_p.var(0) + of_q.var(0)) / DRAWS).sqrt()
    # nothing can be said where draws are rounded by more than the width of the density
    least = root.diagonal(dim1=-2, dim2=-1).abs().amin(-1)
    resolved = least > 1e4 * torch.finfo(torch.float64).eps * test_draws.abs().amax(0).amax(-1)
    resolved = resolved & chosen
    gap = (of_p.mean(0) - of_q.mean(0)).abs() / (noise + UNSEEN / DRAWS)
    worst.record(
        gap.where(resolved, 0),
        lambda at: f"{worst.row(at[0])}: averages differ by {(of_p.mean(0) - of_q.mean(0))[at]:.3g}",
    )


def samples_follow_log_prob(density: Distribution, worst: Worst) -> None:
    """Check by a χ² test over cells that draws follow log_prob; the error is a standard normal deviate.

    χ² is converted to a normal deviate by the formula of Wilson & Hilferty (1931). Draws of one or two numbers are
    counted in cells of about equal mass from the adaptive quadrature, draws of three numbers on a grid. If three
    numbers are real, further draws determine the centre, the width and the axes of the grid. Cells with an expectation
    of fewer than five draws are merged into one.
    """
    seed(SEED)
    draws = density.sample(torch.Size((DRAWS,)))
    if density.event_shape == (1,):
        _compare_draws(density, draws, worst, "")
        return
    if density.event_shape == (2,):
        _compare_pairs(density, draws, worst)
        return
    if density.event_shape and not isinstance(density.support, Circular):
        grid = cells_around_draws(density)
        borders, mass, draws = grid.borders, grid.mass, grid.standardise(draws)
    else:
        borders, mass = cells(density)
    count = count_samples(density, borders, draws)
    batch = density.batch_shape
    _chi_square(DRAWS * mass.reshape(-1, *batch), count.reshape(-1, *batch), worst, "")


def samples_follow_marginals(density: Distribution, worst: Worst) -> None:
    """Check that draws of each number follow `marginal(density, number)`."""
    draws = density.sample(torch.Size((DRAWS,)))
    for number in range(density.event_shape[0]):
        try:
            marginal_density = marginal(density, number)
        except UserError:
            worst.count(isinstance(density.support, Circular), "the density has no marginals")
            return
        _compare_draws(marginal_density, draws[..., number : number + 1], worst, f"number {number}, ")


def _compare_draws(density: Distribution, draws: Tensor, worst: Worst, prefix: str) -> None:
    """Check by a χ² test that draws follow a density of one number; `prefix` begins the description of a case."""
    quadrature = boxes(density)
    coordinate, border = (
        quadrature.mapping.coordinates(draws)[..., 0],
        quadrature.mapping.coordinates(quadrature.border[1:-1].unsqueeze(-1))[..., 0],
    )
    box = torch.searchsorted(border.T.contiguous(), coordinate.T.contiguous()).T
    middle = quadrature.mass.cumsum(0) - quadrature.mass / 2
    cell = (CELLS * middle / quadrature.mass.sum(0)).long().clamp(0, CELLS - 1)
    expected = torch.zeros(CELLS, len(quadrature.mapping.mode), dtype=torch.float64).scatter_add_(
        0, cell, quadrature.mass
    )
    count = torch.zeros_like(expected).scatter_add_(0, cell.gather(0, box), torch.ones_like(coordinate))
    worst.finite(f"{prefix}draws", draws)
    _chi_square(DRAWS * expected, count, worst, prefix)


def _compare_pairs(density: Distribution, draws: Tensor, worst: Worst) -> None:
    """Check by a χ² test that draws follow a density of two numbers.

    The boxes of the quadrature are sorted by their first number and divided into strips of about equal mass; the boxes
    of each strip are sorted by their second number and divided into cells of about equal mass.
    """
    worst.finite("draws", draws)
    quadrature = boxes(density)
    count, mass = quadrature.count(draws), quadrature.mass
    middle = (quadrature.low + quadrature.high) / 2
    strip = _equal_shares(middle[..., 0], mass, STRIPS)
    # the strips lie one after another along the second axis, whose coordinates all are in one interval
    length = 1 + (quadrature.mapping.ends[1] - quadrature.mapping.ends[0])[:, 1]
    cell = _equal_shares(strip * length + middle[..., 1], mass, STRIPS**2)
    expected, counted = (
        torch.zeros(STRIPS**2, mass.shape[1], dtype=torch.float64).scatter_add_(0, cell, part)
        for part in (DRAWS * mass.where(quadrature.resolved, 0.0), count.where(quadrature.resolved, 0.0))
    )
    _chi_square(expected, counted, worst, "")


def _equal_shares(place: Tensor, mass: Tensor, count: int) -> Tensor:
    """Return the number of the share, 0 to `count` - 1, to which each box belongs if the boxes are sorted by `place`.

    All shares have about the same mass; `place` and `mass` have the shape (box, rows).
    """
    order = place.argsort(0)
    sorted_mass = mass.gather(0, order)
    middle = sorted_mass.cumsum(0) - sorted_mass / 2
    share = (count * middle / sorted_mass.sum(0)).long().clamp(0, count - 1)
    return torch.zeros_like(share).scatter_(0, order, share)


def _chi_square(expected: Tensor, count: Tensor, worst: Worst, prefix: str) -> None:
    """Record the standard normal deviate of χ² for expected and actual counts of draws, (cell, *batch)."""
    rare = expected < 5
    score = ((count - expected).square() / expected).where(~rare, 0).sum(0)
    rest, rest_count = expected.where(rare, 0).sum(0), count.where(rare, 0).sum(0)
    score = score + (rest_count - rest).square() / rest.clamp(min=5)
    freedom = ((~rare).sum(0) - 1 + (rest >= 5)).clamp(min=1)
    spread = 2 / (9 * freedom)
    normal = ((score / freedom).pow(1 / 3) - 1 + spread) / spread.sqrt()
    worst.record(normal, lambda at: f"{prefix}{worst.row(at[0])}, {freedom[at].item()} degrees of freedom")


def draws_are_independent(density: Distribution, worst: Worst) -> None:
    """Check that a draw is independent of the previous draw, and of the draw for the next item of the batch.

    The error is the correlation of the signs of the distances from the median, in standard errors. For classes, the
    sign says whether the draw is the mode.
    """
    draws = density.sample(torch.Size((4000,))).double()
    if density.event_shape:
        offset = draws - density.mode.double()
        offset = wrap(offset) if isinstance(density.support, Circular) else offset
        sign = torch.where(offset > offset.median(0).values, 1.0, -1.0).double().flatten(1)
    else:
        sign = torch.where(draws == density.mode, 1.0, -1.0).double()
    sign = sign - sign.mean(0)
    numbers = max(1, sign.shape[1] // density.batch_shape.numel())
    spread = sign.square().mean(0).sqrt()
    for neighbour, first, second, scale in (
        ("the previous draw", sign[1:], sign[:-1], spread * spread),
        ("the next row", sign[:, numbers:], sign[:, :-numbers], spread[numbers:] * spread[:-numbers]),
    ):
        together = (first * second).mean(0) / scale.clamp(min=1e-3) * len(first) ** 0.5
        worst.record(
            together.abs(),
            lambda at, neighbour=neighbour: f"{worst.row(at[0] // numbers)}: correlation with {neighbour}",
        )


def periodic(density: Distribution, worst: Worst) -> None:
    """Check that log_prob is the same after up to a thousand turns.

    The error is divided by a measure of the rounding error that must be expected, since 2π is not exact in floating
    point: (max(1, |log p|) + Σ|∂log p/∂φ|) · (1 + max|φ|) for the angles φ.
    """
    generator = torch.Generator().manual_seed(SEED)
    shape = torch.Size((8, *density.batch_shape, *density.event_shape))
    value = 6 * torch.randn(shape, dtype=torch.float64, generator=generator)
    value[0], value[1], value[2] = math.pi, -math.pi, 0.0
    with torch.enable_grad():
        log_prob = density.log_prob(value.requires_grad_())
        slope = torch.zeros_like(value)
        if log_prob.requires_grad:  # that of a uniform density has no gradient
            (slope,) = torch.autograd.grad(log_prob.sum(), value)
    for turns in (1, -1, 7, -1000):
        moved = value.detach() + turns * 2 * math.pi
        scale = log_prob.detach().abs().clamp(min=1) + slope.abs().sum(-1)
        # the rounding error of the number of turns times 2π is relative to its size
        scale = scale * (1 + moved.abs().amax(-1))
        error = (density.log_prob(moved) - log_prob.detach()).abs() / scale
        worst.record(
            error, lambda at, turns=turns: f"shift by {turns} · 2π, value {at[0]}, {worst.row(at[1])}"
        )


def entropy(density: Distribution, worst: Worst) -> None:
    """Check that the entropy is -∫ p log p.

    The integral is a sum for classes, is computed by quadrature for one or two numbers, and is a mean over draws for
    more numbers. The unit of the error is 1e-6 nats (relative above 1 nat). Where the entropy or the integral is
    estimated from draws, the statistical error is added to this unit.
    """
    entropies = torch.stack([_call_seeded(number, density.entropy) for number in range(2)]).double()
    noise = torch.zeros_like(entropies[0])
    if not torch.equal(*entropies):
        further = [_call_seeded(number, density.entropy) for number in range(2, 16)]
        entropies = torch.cat([entropies, torch.stack(further).double()])
        noise = 2 * entropies.std(0) / 4
    if density.event_shape == ():
        log_prob = density.log_prob(density.enumerate_support()).double()
        expected = -(log_prob.exp() * log_prob.clamp(min=-1e4)).sum(0)
    elif density.event_shape in ((1,), (2,)):
        quadrature = boxes(density)
        # of a density that float64 does not resolve, only the entropy is left
        expected = torch.where(quadrature.resolved, quadrature.entropy(), entropies.mean(0))
        if not bool(quadrature.converged.all()):
            surprise = _surprise(density, density.sample(torch.Size((DRAWS,))))
            open_rows = quadrature.resolved & ~quadrature.converged
            expected = torch.where(open_rows, surprise.mean(0), expected)
            noise = noise + 1.2 * torch.where(open_rows, surprise.std(0), 0.0) / DRAWS**0.5
    else:
        draws = density.sample(torch.Size((DRAWS,)))
        surprise = _surprise(density, draws)
        expected, noise = surprise.mean(0), noise + 1.2 * surprise.std(0) / DRAWS**0.5
        # A draw of several numbers may be rounded by more than the width of the density. Rounding it once more shows
        # the effect.
        size = draws.abs().clamp(min=math.pi if isinstance(density.support, Circular) else 0.0)
        once_more = draws + torch.finfo(draws.dtype).eps * size * (torch.rand_like(draws) - 0.5).sign()
        noise = noise + (_surprise(density, once_more) - surprise).abs().mean(0)
    error = (entropies.mean(0) - expected).abs() / (noise + 1e-6 * expected.abs().clamp(min=1))
    worst.record(
        error,
        lambda at: (
            f"{worst.row(at[0])}: {entropies.mean(0)[at].item():.9g}, expected {expected[at].item():.9g}"
        ),
    )


def _surprise(density: Distribution, value: Tensor) -> Tensor:
    """Return -log_prob of `value` in float64."""
    return torch.cat([-density.log_prob(part) for part in value.split(2000)]).double()


def _call_seeded(number: int, function: Callable[[], Tensor]) -> Tensor:
    seed(number)
    return function()


def mode_is_highest(density: Distribution, worst: Worst) -> None:
    """Check that no draw and no node of the quadrature has a higher density than the mode; the error is in nats."""
    seed(SEED)
    count = max(64, 36_000 // max(18, density.batch_shape.numel()))
    draws = density.sample(torch.Size((count,)))
    highest = density.log_prob(draws).amax(0)
    if density.event_shape in ((1,), (2,)) and density.batch_shape.numel() < 64:
        highest = torch.maximum(highest, boxes(density).log_prob.amax(0))
    above = highest - density.log_prob(density.mode)
    worst.record(above, lambda at: f"{worst.row(at[0])}: {above[at].item():.3g} nats above the mode")


def mode_of_mixture(density: Distribution, worst: Worst) -> None:
    """Check that no draw and no node of the quadrature has a higher density than the mode of a mixture.

    An error of 0.05 nats is allowed for classes, and for densities with a known `quadratic_bound`, with which the
    search for the mode can climb from the modes of the components. For other densities, log 2 nats are allowed. The
    recorded error is divided by the allowed error.
    """
    known = density.has_enumerate_support or quadratic_bound(density, density.mode) is not None
    inner = Worst()
    mode_is_highest(density, inner)
    worst.record(inner.error / (0.05 if known else math.log(2)), inner.case)


def marginals(density: Distribution, worst: Worst) -> None:
    """Check that `marginal(density, i)` is the density of all angles, integrated over every angle but angle i."""
    numbers = density.event_shape[0]
    points = (
        4096 if numbers == 2 else 64
    )  # only one of two angles is integrated, so that narrow peaks cost little
    sides = [side(density, number, points, points // 8) for number in range(numbers)]
    for index in range(numbers):
        points_of_index, unit_weights = side(density, index, 12, 12)[0], torch.ones(12, dtype=torch.float64)
        nodes = [points_of_index if number == index else sides[number][0] for number in range(numbers)]
        weights = [unit_weights if number == index else sides[number][1] for number in range(numbers)]
        axes = torch.meshgrid(*nodes, indexing="ij")
        weight = torch.stack(torch.meshgrid(*weights, indexing="ij")).prod(0)
        joint = density_at(density, torch.stack(axes, -1).flatten(0, -2))
        joint = joint.reshape(*axes[0].shape, *density.batch_shape)
        joint = joint * weight.reshape(*weight.shape, *(1,) * len(density.batch_shape))
        expected = joint.sum([number for number in range(numbers) if number != index])
        actual = density_at(marginal(density, index), points_of_index[:, None])
        worst.record(
            (actual - expected).abs() / expected.clamp(min=1),
            lambda at, index=index: f"angle {index}, point {at[0]}, {worst.row(at[1])}",
        )


def median_is_best(density: Distribution, worst: Worst) -> None:
    """Check that half of the mass lies on each side of the median.

    The median of an angle must also have the smallest expected distance. If the median depends on draws, the error is
    in standard errors of a median of MEDIAN_DRAWS draws. Otherwise it is in units of 1e-6 of the mass.
    """
    chosen = _call_seeded(SEED, lambda: median(density, MEDIAN_DRAWS)).double()
    deterministic = torch.equal(
        chosen, _call_seeded(SEED + 1, lambda: median(density, MEDIAN_DRAWS)).double()
    )
    quadrature = boxes(density)
    below = quadrature.mass_below(chosen[..., 0].unsqueeze(0))[0]
    if isinstance(density.support, Circular):
        # mass from the antipode of the median to the median; both are counted from half a turn before the mode
        below_antipode = quadrature.mass_below(
            wrap(chosen[..., 0] + math.pi - quadrature.mapping.mode[:, 0]).unsqueeze(0)
            + quadrature.mapping.mode[:, 0]
        )
        below = (below - below_antipode[0]).remainder(1.0)
        deviation = angular_distance(chosen[..., 0], quadrature.value[..., 0])
        mean = quadrature.mean(deviation)
        spread = (quadrature.mean(deviation.square()) - mean.square()).clamp(min=1e-30).sqrt()
        # every seventh node suffices, since the nodes are dense
        best = torch.stack(
            [
                quadrature.mean(angular_distance(node, quadrature.value[..., 0]))
                for node in quadrature.value[::7, :, 0]
            ]
        )
        worst.record(
            (mean - best.amin(0)) / (2 * spread / MEDIAN_DRAWS**0.5),
            lambda at: (
                f"{worst.row(at[0])}: mean distance {mean[at].item():.4g} rad, smallest {best.amin(0)[at].item():.4g}"
            ),
        )
    unit = 1e-6 if deterministic else 0.5 / MEDIAN_DRAWS**0.5
    worst.record(
        (below - 0.5).abs() / unit,
        lambda at: f"{worst.row(at[0])}: {below[at].item():.6g} of the mass before the median",
    )


def moments(density: Distribution, worst: Worst) -> None:
    """Compare mean and variance, if the density has them, with the quadrature; errors are in standard deviations.

    For two numbers, the boxes of the quadrature are refined for the variance. For heavy tails the moments by the
    quadrature still have an error, and only differences beyond this error count. If the density states that its
    variance does not exist, the variance by the quadrature must be huge, and the mean need not exist either.
    """
    quadrature = boxes(density)
    if density.event_shape == (2,):
        origin, scale = quadrature.mapping.mode, quadrature.mapping.scale
        quadrature = quadrature.split_for(lambda value: ((value - origin) / scale).square().sum(-1))
    offset = quadrature.value - quadrature.mapping.mode  # keeps the digits of a narrow density far from 0
    mean = torch.stack([quadrature.mean(part) for part in offset.unbind(-1)], -1)
    variance = torch.stack([quadrature.mean(part) for part in (offset - mean).square().unbind(-1)], -1)
    numbers = range(offset.shape[-1])
    # error bounds of the mean distance from the mode and of the mean square distance
    first, second = (
        torch.stack(
            [
                quadrature.error_bound(
                    lambda value, i=i, power=power: (value - quadrature.mapping.mode)[..., i].abs() ** power
                )
                for i in numbers
            ],
            -1,
        )
        for power in (1, 2)
    )
    if density.event_shape == (2,):
        # The quadrature may have missed a peak of little mass, whose moments are large if it is far away.
        missed = (quadrature.mean(torch.ones_like(quadrature.log_prob)) - 1).abs().unsqueeze(-1)
        distances = [
            (peak - quadrature.mapping.mode).abs() + 3 * quadrature.mapping.widths(peak)
            for peak in mode_candidates(density).double()
        ]
        farthest = torch.stack(distances).amax(0)
        first, second = first + missed * farthest, second + missed * farthest.square()
    stated = {}
    for name in ("mean", "variance"):
        try:
            stated[name] = getattr(density, name).double()
        except (NotImplementedError, AttributeError):
            worst.count(False, f"the density has no {name}")
    none = ~(quadrature.resolved & quadrature.converged).unsqueeze(-1).expand_as(variance)
    if "variance" in stated:
        huge = variance + second > 1e6 * quadrature.mapping.scale.square()
        # for tails just too heavy for a variance, the integral is not huge within the range of the quadrature
        none = none | (~stated["variance"].isfinite() & (huge | (100 * second > variance)))
        gap = ((stated["variance"] - variance).abs() - 10 * second).clamp(min=0) / variance
        worst.record(gap.where(~none, 0.0), lambda at: f"variance, {worst.row(at[0])}")
    if "mean" in stated:
        gap = ((stated["mean"] - quadrature.mapping.mode - mean).abs() - 10 * first).clamp(
            min=0
        ) / variance.sqrt()
        worst.record(gap.where(~none, 0.0), lambda at: f"mean, {worst.row(at[0])}")


def masses(density: Distribution, worst: Worst) -> None:
    """Compare `cdf`, or `arc_probability` and `trigonometric_moments`, if known, with the quadrature.

    Probabilities are compared at the mode ± {0, 0.3, 1, 3, 30} widths of the density. Moments are compared for the
    densities that a fixed grid integrates to 1.
    """
    quadrature = boxes(density)
    offset = torch.tensor([-30, -3, -1, -0.3, 0, 0.3, 1, 3, 30], dtype=torch.float64)[:, None]
    value = quadrature.mapping.mode[:, 0] + offset * quadrature.mapping.scale[:, 0]
    if isinstance(density.support, Circular):
        known = trigonometric_moments(density, 8)
        if known is not None:
            angles, log_density = circular_grid(density, GRID)
            mass = log_density.double().exp() * (2 * math.pi / GRID)
            turns = torch.polar(
                torch.ones(8, GRID).double(), torch.arange(8).double()[:, None] * angles.double()
            )
            gap = (known - torch.einsum("np,p...->n...", turns, mass.to(turns.dtype))).abs()
            exact = (mass.sum(0) - 1).abs() < 1e-9
            worst.record(gap.where(exact, 0.0), lambda at: f"moment {at[0]}, {worst.row(at[1])}")
        value = value.clamp(quadrature.mapping.mode[:, 0] - 3.1, quadrature.mapping.mode[:, 0] + 3.1)
        actual = arc_probability(
            density, quadrature.border[:1].unsqueeze(-1).expand(len(offset), -1, 1), value.unsqueeze(-1)
        )
    else:
        actual = cdf(density, value.unsqueeze(-1))
    if actual is None:
        worst.count(False, "cdf or arc_probability is not known in closed form")
        return
    expected = quadrature.mass_below(value)
    worst.record(
        (actual - expected).abs(), lambda at: f"mode + {offset[at[0]].item():g} widths, {worst.row(at[1])}"
    )


MIXTURE_PROPERTIES = (
    "integral",
    "samples follow log_prob",
    "entropy",
    "mode",
    "median",
    "mean and variance",
    "cdf",
)
"""Properties that are also checked for mixtures of two densities of one number or of classes."""
CHECKS = (
    Property("integral", 1e-6, integral, "scales"),
    Property("integral by draws", 6.0, integral_by_draws, "scales"),
    Property("samples follow log_prob", 5.0, samples_follow_log_prob, "scales"),
    Property("samples follow marginals", 5.0, samples_follow_marginals, "scales"),
    Property("draws are independent", 6.0, draws_are_independent, "own"),
    Property("2π-periodic", 1e-13, periodic, "own"),
    Property("entropy", 5.0, entropy, "scales"),
    Property("mode", 0.05, mode_is_highest, "scales"),
    Property("mode", 0.5, mode_is_highest, "many"),
    Property("marginals", 1e-6, marginals, "own"),
    Property("median", 5.0, median_is_best, "scales"),
    Property("mean and variance", 1e-5, moments, "scales"),
    Property("cdf", 1e-6, masses, "scales"),
)
"""All checks of densities."""
