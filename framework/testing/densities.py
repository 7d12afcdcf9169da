"""Checks of any density, whatever plugin made it; each check reports its worst case."""

import math
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, angular_distance, wrap
from framework.distributions.protocol import arc_probability, cdf, marginal, median, quadratic_bound
from framework.errors import UserError
from framework.testing.adaptive import boxes
from framework.testing.finding import SEED, Finding, Worst, seed
from framework.testing.flattened import flattened
from framework.testing.heads import PATIENCE, HeadSubject
from framework.testing.quadrature import cells, counted, density_at, side
from framework.testing.questions import (
    candidates,
    estimated,
    marginals_of_draws,
    medians_of_draws,
    mixed,
    moments_of_draws,
    moved_places,
    normal_forms,
    picks,
    powers,
    powers_of,
    shares_below,
    slopes,
)

DRAWS = 20_000
SCALES = (1e-2, 0.1, 1.0, 10.0, 1e2, 1e3)
"""Standard deviations of the distribution parameters at which densities are checked, beside the row's own scale."""
CELLS = 24
"""Number of cells of about equal mass in which draws of one number are counted."""
MEDIAN_DRAWS = 2000
Check = Callable[[Distribution, Worst], None]


class Property(NamedTuple):
    """Check of densities, its limit, and the distribution parameters at which it runs.

    Attributes:
        name: Name of the property.
        limit: Largest error that passes.
        check: Function that runs the check.
        batch: "scales": every scale of SCALES and the row's own; "own": the row's own scale, at which a fixed grid
            resolves the densities; "many": 64 rows each of small, ordinary and large distribution parameters.
    """

    name: str
    limit: float
    check: Check
    batch: str


def examine_densities(subject: HeadSubject) -> Iterator[Finding]:
    """Yield one finding for each property of the row's densities, in float64.

    A density that draws random numbers is checked at the row's own scale only: its log_prob at the same distribution
    parameters varies between calls by more than the error of any quadrature.
    """
    draws = subject.draws()

    @cache
    def made(batch: str) -> tuple[Distribution, list[str]]:
        own, several = subject.row.scale, 1 if _numbers(subject) > 1 else 3
        scales = {"own": [own] * 3, "many": [s for s in (1e-2, 1.0, 1e2) for _ in range(64)]}.get(
            batch, [s for s in (*SCALES, own) for _ in range(several)]
        )
        raw = subject.raws(len(scales)).double() * torch.tensor(scales, dtype=torch.float64).unsqueeze(-1)
        head = subject.make().double()
        head.requires_grad_(False)
        names = [f"raw numbers of size {scale:g}, batch row {row}" for row, scale in enumerate(scales)]
        return flattened(head(raw)), names

    for name, limit, check, batch in CHECKS:
        if not subject.wants(name) or not applies(name, subject, draws):
            continue
        # densities of more than two numbers are integrated on a fixed grid, and draws of more than one number
        # counted on one
        grid = {"integral": 2, "samples follow log_prob": 1}.get(name, math.inf)
        hangs = subject.seconds < PATIENCE  # a check took too long, most likely at extreme parameters
        chosen = "own" if draws or hangs or _numbers(subject) > grid else batch
        if chosen == "own" and batch == "many":
            continue

        def look(worst: Worst, check: Check = check, chosen: str = chosen) -> None:
            with torch.no_grad():
                density, worst.rows = made(chosen)
                check(density, worst)

        yield subject.examined(name, limit, look)
    yield from _examine_questions(subject, draws)


def _examine_questions(subject: HeadSubject, draws: bool) -> Iterator[Finding]:
    """Yield findings for the optional functions of the protocol, and for mixtures and tempered densities."""

    @cache
    def pairs() -> Distribution:
        """Return densities of batch_shape (3, 2)."""
        head = subject.make().double()
        head.requires_grad_(False)
        return head(subject.row.scale * subject.raws(3, 2).double())

    @cache
    def rows() -> Distribution:
        head = subject.make().double()
        head.requires_grad_(False)
        return head(subject.row.scale * subject.raws(3).double())

    @cache
    def mixture() -> Distribution:
        return mixed(pairs())

    numbers, kind = _numbers(subject), subject.row.target.kind
    one, classes = numbers == 1 and kind in ("real", "angle"), kind == "class"
    few = kind in ("real", "angle") and 2 <= numbers <= 6
    several = kind == "image" or few
    asked: list[tuple[str, float, Callable[[], Distribution], Check, bool]] = [
        ("estimate", 1.0, rows, estimated, True),
        ("pick", 1.0, pairs, picks, True),
        ("quadratic_bound", 1.0, rows, slopes, not classes and not draws and kind != "image"),
        ("recentre", 1.0, rows, moved_places, one and not draws),
        ("normals", 1.0, rows, normal_forms, kind == "real" and not draws),
        ("mode candidates and peak widths", 0.0, rows, candidates, not classes and not draws),
        ("marginal_cdfs", 1.0, rows, shares_below, kind in ("real", "image") and not draws),
        (
            "mean and variance",
            1.0,
            rows,
            moments_of_draws,
            kind in ("real", "image") and numbers > 2 and not draws,
        ),
        ("median", 1.0, rows, medians_of_draws, several and not draws),
        ("marginals", 1.0, rows, marginals_of_draws, few and not draws),
        ("tempered: power", 1.0, rows, powers, not draws),
        ("mixture: estimate", 1.0, mixture, estimated, not draws),
        ("mixture: slope", 1.0, mixture, slopes, one and not draws),
    ]
    for name in OF_ONE:
        limit, check = next((limit, check) for known, limit, check, _ in CHECKS if known == name)
        suits = applies(name, subject, draws) and (one or classes) and not draws
        if name == "mode":
            limit, check = 1.0, mode_of_mixture
        asked.append((f"mixture: {name}", limit, mixture, check, suits))
        if name in ("integral", "samples follow log_prob", "entropy"):
            power = partial(powers_of, check=check)
            asked.append((f"tempered: {name}", limit, rows, power, suits))
    for name, limit, density, check, suits in asked:
        # a property that a row leaves out is left out for its mixtures and powers too
        if not suits or not subject.wants(name) or name.rpartition(": ")[2] in subject.row.leave_out:
            continue

        def look(worst: Worst, density: Callable[[], Distribution] = density, check: Check = check) -> None:
            with torch.no_grad():
                check(density(), worst)

        yield subject.examined(name, limit, look)


def _numbers(subject: HeadSubject) -> int:
    return math.prod(subject.row.target.event_shape)


def applies(name: str, subject: HeadSubject, draws: bool = False) -> bool:
    """Return whether a property can be checked for the row's target."""
    kind, numbers = subject.row.target.kind, _numbers(subject)
    kind = "real" if kind == "image" else kind
    wanted = {
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
    return wanted.get(name, True)


def integral(density: Distribution, worst: Worst) -> None:
    """Check that the density integrates to 1.

    A density of one or two numbers is integrated in boxes that adapt to it, a density of three numbers on a grid.
    """
    if density.event_shape in ((1,), (2,)):
        found = boxes(density)
        total = found.mean(torch.ones_like(found.log_prob))
    else:
        _, mass = cells(density)
        total = mass.sum(tuple(range(max(1, len(density.event_shape) and density.event_shape[0]))))
    worst.see((total - 1).abs(), lambda at: f"{worst.row(at[0])}: {total[at].item():.9g}")


def integral_by_draws(density: Distribution, worst: Worst) -> None:
    """Check by draws that the density integrates to 1, in standard errors.

    The check compares E_p[q/(p + q)] with E_q[p/(p + q)], where p is the density and q a normal fitted to other draws
    of it. Both are ∫ pq/(p + q) if p is normalised and draws follow it. The averaged quantities lie in [0, 1], however
    heavy the tails are. If q were fitted to the draws that are averaged, it would be too high there, which for ten
    numbers amounts to some standard errors.
    """
    others, drawn = density.sample(torch.Size((2 * DRAWS,))).double().chunk(2)
    support = density.support
    circular = isinstance(support, Circular)
    center = density.mode.double() if circular else others.mean(0)
    offset, other = (wrap(part - center) if circular else part - center for part in (drawn, others))
    shift = other.mean(0)
    _, root = torch.linalg.qr((other - shift).movedim(0, 1) / DRAWS**0.5)  # (rows, numbers, numbers)
    normal = torch.randn(DRAWS, *offset.shape[1:], dtype=torch.float64)
    volume = root.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)

    def log_ratio(offset: Tensor, standard: Tensor) -> Tensor:
        value = center + offset
        found = torch.cat([density.log_prob(part) for part in value.split(4000)])
        inside = torch.ones_like(found, dtype=torch.bool)
        if circular:
            inside = (offset.abs() <= math.pi).all(-1)
            for number, (low, high) in enumerate((isinstance(support, Circular) and support.ranges) or ()):
                place = wrap(value[..., number])
                inside &= (place >= low) & (place <= high)
        log_normal = -(standard.square() + math.log(2 * math.pi)).sum(-1) / 2 - volume
        return torch.where(inside, found, -math.inf) - log_normal

    standard = torch.linalg.solve_triangular(root.mT, (offset - shift).movedim(0, -1), upper=False)
    of_p = torch.sigmoid(-log_ratio(offset, standard.movedim(-1, 0)))
    of_q = torch.sigmoid(log_ratio(shift + torch.einsum("dbi,bij->dbj", normal, root), normal))
    noise = ((of_p.var(0) + of_q.var(0)) / DRAWS).sqrt()
    # no verdict is possible where rounding of the draws is coarser than the density is narrow
    least = root.diagonal(dim1=-2, dim2=-1).abs().amin(-1)
    told = least > 1e4 * torch.finfo(torch.float64).eps * drawn.abs().amax(0).amax(-1)
    gap = (of_p.mean(0) - of_q.mean(0)).abs() / (noise + 1e-9)
    worst.see(
        gap.where(told, 0), lambda at: f"{worst.row(at[0])}: off by {(of_p.mean(0) - of_q.mean(0))[at]:.3g}"
    )


def samples_follow_log_prob(density: Distribution, worst: Worst) -> None:
    """Check by a χ² test over cells that draws follow log_prob; the error is a standard normal deviate.

    χ² is converted after Wilson & Hilferty (1931). Draws of one number are counted in cells of equal mass by
    quadrature, draws of several numbers on a grid. Cells that expect fewer than five draws are merged into one.
    """
    seed(SEED)
    drawn = density.sample(torch.Size((DRAWS,)))
    if density.event_shape == (1,):
        _one_number(density, drawn, worst, "")
        return
    borders, mass = cells(density)
    count = counted(density, borders, drawn)
    batch = density.batch_shape
    _chi_square(DRAWS * mass.reshape(-1, *batch), count.reshape(-1, *batch), worst, "")


def samples_follow_marginals(density: Distribution, worst: Worst) -> None:
    """Check that each number of the draws follows marginal(density, number)."""
    drawn = density.sample(torch.Size((DRAWS,)))
    for number in range(density.event_shape[0]):
        try:
            one = marginal(density, number)
        except UserError:
            worst.count(isinstance(density.support, Circular), "no marginal is given")
            return
        _one_number(one, drawn[..., number : number + 1], worst, f"number {number}, ")


def _one_number(density: Distribution, drawn: Tensor, worst: Worst, what: str) -> None:
    found = boxes(density)
    place, border = found.way.back(drawn)[..., 0], found.way.back(found.border[1:-1].unsqueeze(-1))[..., 0]
    box = torch.searchsorted(border.T.contiguous(), place.T.contiguous()).T
    middle = found.mass.cumsum(0) - found.mass / 2
    cell = (CELLS * middle / found.mass.sum(0)).long().clamp(0, CELLS - 1)
    expected = torch.zeros(CELLS, len(found.way.mode), dtype=torch.float64).scatter_add_(0, cell, found.mass)
    count = torch.zeros_like(expected).scatter_add_(0, cell.gather(0, box), torch.ones_like(place))
    worst.finite(f"{what}draws", drawn)
    _chi_square(DRAWS * expected, count, worst, what)


def _chi_square(expected: Tensor, count: Tensor, worst: Worst, what: str) -> None:
    rare = expected < 5
    score = ((count - expected).square() / expected).where(~rare, 0).sum(0)
    rest, rest_count = expected.where(rare, 0).sum(0), count.where(rare, 0).sum(0)
    score = score + (rest_count - rest).square() / rest.clamp(min=5)
    freedom = ((~rare).sum(0) - 1 + (rest >= 5)).clamp(min=1)
    spread = 2 / (9 * freedom)
    normal = ((score / freedom).pow(1 / 3) - 1 + spread) / spread.sqrt()
    worst.see(normal, lambda at: f"{what}{worst.row(at[0])}, {freedom[at].item()} degrees of freedom")


def independent(density: Distribution, worst: Worst) -> None:
    """Check that draws are independent of the draw before and of the next batch row.

    The error is the correlation of their signs in standard errors.
    """
    drawn = density.sample(torch.Size((4000,))).double()
    if density.event_shape:
        offset = drawn - density.mode.double()
        offset = wrap(offset) if isinstance(density.support, Circular) else offset
        sign = torch.where(offset > offset.median(0).values, 1.0, -1.0).double().flatten(1)
    else:
        sign = torch.where(drawn == density.mode, 1.0, -1.0).double()
    sign = sign - sign.mean(0)
    numbers = max(1, sign.shape[1] // density.batch_shape.numel())
    spread = sign.square().mean(0).sqrt()
    for what, first, second, scale in (
        ("the draw before", sign[1:], sign[:-1], spread * spread),
        ("the next row", sign[:, numbers:], sign[:, :-numbers], spread[numbers:] * spread[:-numbers]),
    ):
        together = (first * second).mean(0) / scale.clamp(min=1e-3) * len(first) ** 0.5
        worst.see(together.abs(), lambda at, what=what: f"{worst.row(at[0] // numbers)} with {what}")


def periodic(density: Distribution, worst: Worst) -> None:
    """Check that log_prob is the same up to a thousand turns on; relative to its slope, since 2π has no exact float."""
    generator = torch.Generator().manual_seed(SEED)
    shape = torch.Size((8, *density.batch_shape, *density.event_shape))
    value = 6 * torch.randn(shape, dtype=torch.float64, generator=generator)
    value[0], value[1], value[2] = math.pi, -math.pi, 0.0
    with torch.enable_grad():
        here = density.log_prob(value.requires_grad_())
        (slope,) = torch.autograd.grad(here.sum(), value)
    for turns in (1, -1, 7, -1000):
        moved = value.detach() + turns * 2 * math.pi
        scale = here.detach().abs().clamp(min=1) + slope.abs().sum(-1)
        # the number of turns times 2π is rounded relative to its size, as any float
        scale = scale * (1 + moved.abs().amax(-1))
        error = (density.log_prob(moved) - here.detach()).abs() / scale
        worst.see(error, lambda at, turns=turns: f"{turns} turns on, value {at[0]}, {worst.row(at[1])}")


def entropy(density: Distribution, worst: Worst) -> None:
    """Check that the entropy is -∫ p log p: by quadrature for one or two numbers and classes, else by draws.

    The error is in units of 1e-6 nats (relative above 1 nat) or, where draws are involved, of a statistical error that
    chance hardly exceeds.
    """
    found = torch.stack([_after(number, density.entropy) for number in range(2)]).double()
    noise = torch.zeros_like(found[0])
    if not torch.equal(*found):
        further = [_after(number, density.entropy) for number in range(2, 16)]
        found = torch.cat([found, torch.stack(further).double()])
        noise = 2 * found.std(0) / 4
    if density.event_shape == ():
        log_prob = density.log_prob(density.enumerate_support()).double()
        wanted = -(log_prob.exp() * log_prob.clamp(min=-1e4)).sum(0)
    elif density.event_shape in ((1,), (2,)):
        wanted = boxes(density).entropy()
    else:
        drawn = density.sample(torch.Size((DRAWS,)))
        surprise = _surprise(density, drawn)
        wanted, noise = surprise.mean(0), noise + 1.2 * surprise.std(0) / DRAWS**0.5
        # A draw is rounded, possibly by more than the width of a density of several numbers. A second rounding
        # shows the effect.
        size = drawn.abs().clamp(min=math.pi if isinstance(density.support, Circular) else 0.0)
        once_more = drawn + torch.finfo(drawn.dtype).eps * size * (torch.rand_like(drawn) - 0.5).sign()
        noise = noise + (_surprise(density, once_more) - surprise).abs().mean(0)
    error = (found.mean(0) - wanted).abs() / (noise + 1e-6 * wanted.abs().clamp(min=1))
    worst.see(
        error,
        lambda at: f"{worst.row(at[0])}: {found.mean(0)[at].item():.9g}, wanted {wanted[at].item():.9g}",
    )


def _surprise(density: Distribution, value: Tensor) -> Tensor:
    return torch.cat([-density.log_prob(part) for part in value.split(2000)]).double()


def _after(number: int, ask: Callable[[], Tensor]) -> Tensor:
    seed(number)
    return ask()


def mode_is_highest(density: Distribution, worst: Worst) -> None:
    """Check that neither a draw nor a node of the quadrature is more than `limit` nats above the mode."""
    seed(SEED)
    count = max(64, 36_000 // max(18, density.batch_shape.numel()))
    drawn = density.sample(torch.Size((count,)))
    highest = density.log_prob(drawn).amax(0)
    if density.event_shape in ((1,), (2,)) and density.batch_shape.numel() < 64:
        highest = torch.maximum(highest, boxes(density).log_prob.amax(0))
    above = highest - density.log_prob(density.mode)
    worst.see(above, lambda at: f"{worst.row(at[0])}: {above[at].item():.3g} nats above the mode")


def mode_of_mixture(density: Distribution, worst: Worst) -> None:
    """Check the mode of a mixture; the error is in units of the height that the search may miss.

    That height is 0.05 nats where `quadratic_bound` leads up from the modes of the components, else log 2 nats.
    """
    known = density.has_enumerate_support or quadratic_bound(density, density.mode) is not None
    inner = Worst()
    mode_is_highest(density, inner)
    worst.see(inner.error / (0.05 if known else math.log(2)), inner.case)


def marginals(density: Distribution, worst: Worst) -> None:
    """Check that marginal(density, i) is the joint density integrated over the other angles."""
    numbers = density.event_shape[0]
    points = 256 if numbers == 2 else 64
    sides = [side(density, number, points, points // 8) for number in range(numbers)]
    for index in range(numbers):
        some, one = side(density, index, 12, 12)[0], torch.ones(12, dtype=torch.float64)
        nodes = [some if number == index else sides[number][0] for number in range(numbers)]
        weights = [one if number == index else sides[number][1] for number in range(numbers)]
        axes = torch.meshgrid(*nodes, indexing="ij")
        weight = torch.stack(torch.meshgrid(*weights, indexing="ij")).prod(0)
        joint = density_at(density, torch.stack(axes, -1).flatten(0, -2))
        joint = joint.reshape(*axes[0].shape, *density.batch_shape)
        joint = joint * weight.reshape(*weight.shape, *(1,) * len(density.batch_shape))
        wanted = joint.sum([number for number in range(numbers) if number != index])
        found = density_at(marginal(density, index), some[:, None])
        worst.see(
            (found - wanted).abs() / wanted.clamp(min=1),
            lambda at, index=index: f"angle {index}, point {at[0]}, {worst.row(at[1])}",
        )


def median_is_best(density: Distribution, worst: Worst) -> None:
    """Check that half of the mass lies on each side of the median.

    The expected deviation from the median of an angle must also be the least. The error is in standard errors of a
    median of MEDIAN_DRAWS draws; where nothing is drawn, in 1e-6 of the mass.
    """
    chosen = _after(SEED, lambda: median(density, MEDIAN_DRAWS)).double()
    still = torch.equal(chosen, _after(SEED + 1, lambda: median(density, MEDIAN_DRAWS)).double())
    found = boxes(density)
    below = found.below(chosen[..., 0].unsqueeze(0))[0]
    if isinstance(density.support, Circular):
        # mass ahead of the median up to its antipode; both are counted from half a turn before the mode
        other = found.below(
            wrap(chosen[..., 0] + math.pi - found.way.mode[:, 0]).unsqueeze(0) + found.way.mode[:, 0]
        )
        below = (below - other[0]).remainder(1.0)
        deviation = angular_distance(chosen[..., 0], found.value[..., 0])
        mean = found.mean(deviation)
        spread = (found.mean(deviation.square()) - mean.square()).clamp(min=1e-30).sqrt()
        # every seventh node suffices, since the others lie between them
        best = torch.stack(
            [found.mean(angular_distance(node, found.value[..., 0])) for node in found.value[::7, :, 0]]
        )
        worst.see(
            (mean - best.amin(0)) / (2 * spread / MEDIAN_DRAWS**0.5),
            lambda at: f"{worst.row(at[0])}: {mean[at].item():.4g}, best {best.amin(0)[at].item():.4g} rad",
        )
    unit = 1e-6 if still else 0.5 / MEDIAN_DRAWS**0.5
    worst.see(
        (below - 0.5).abs() / unit,
        lambda at: f"{worst.row(at[0])}: {below[at].item():.6g} of the mass before it",
    )


def moments(density: Distribution, worst: Worst) -> None:
    """Check mean and variance, where the density has them, against the quadrature, in standard deviations.

    The quadrature adapts to the density alone, so that heavy tails leave an error in moments; only differences beyond
    that error count. Where the density states that no variance exists, that of the quadrature must be huge, and the
    mean need not exist either.
    """
    found = boxes(density)
    offset = found.value - found.way.mode  # keeps the digits of a narrow density far from 0
    mean = torch.stack([found.mean(part) for part in offset.unbind(-1)], -1)
    variance = torch.stack([found.mean(part) for part in (offset - mean).square().unbind(-1)], -1)
    numbers = range(offset.shape[-1])
    # uncertainty of the mean distance from the mode, and of its mean square
    first, second = (
        torch.stack(
            [
                found.doubt(lambda value, i=i, power=power: (value - found.way.mode)[..., i].abs() ** power)
                for i in numbers
            ],
            -1,
        )
        for power in (1, 2)
    )
    given = {}
    for name in ("mean", "variance"):
        try:
            given[name] = getattr(density, name).double()
        except (NotImplementedError, AttributeError):
            worst.count(False, f"no {name} is given")
    none = torch.zeros_like(variance, dtype=torch.bool)
    if "variance" in given:
        huge = variance + second > 1e6 * found.way.scale.square()
        # where the variance only just does not exist, it grows too slowly to be huge within the quadrature's reach
        none = ~given["variance"].isfinite() & (huge | (100 * second > variance))
        gap = ((given["variance"] - variance).abs() - 10 * second).clamp(min=0) / variance
        worst.see(gap.where(~none, 0.0), lambda at: f"variance, {worst.row(at[0])}")
    if "mean" in given:
        gap = ((given["mean"] - found.way.mode - mean).abs() - 10 * first).clamp(min=0) / variance.sqrt()
        worst.see(gap.where(~none, 0.0), lambda at: f"mean, {worst.row(at[0])}")


def masses(density: Distribution, worst: Worst) -> None:
    """Check cdf and arc, where they are known, against the quadrature at mode ± {0, 0.3, 1, 3, 30} widths."""
    found = boxes(density)
    offset = torch.tensor([-30, -3, -1, -0.3, 0, 0.3, 1, 3, 30], dtype=torch.float64)[:, None]
    value = found.way.mode[:, 0] + offset * found.way.scale[:, 0]
    if isinstance(density.support, Circular):
        value = value.clamp(found.way.mode[:, 0] - 3.1, found.way.mode[:, 0] + 3.1)
        given = arc_probability(
            density, found.border[:1].unsqueeze(-1).expand(len(offset), -1, 1), value.unsqueeze(-1)
        )
    else:
        given = cdf(density, value.unsqueeze(-1))
    if given is None:
        worst.count(False, "not known in closed form")
        return
    wanted = found.below(value)
    worst.see(
        (given - wanted).abs(), lambda at: f"mode + {offset[at[0]].item():g} widths, {worst.row(at[1])}"
    )


OF_ONE = (
    "integral",
    "samples follow log_prob",
    "entropy",
    "mode",
    "median",
    "mean and variance",
    "cdf",
)
"""Properties that are also checked for a mixture of two densities of one number or of classes."""
CHECKS = (
    Property("integral", 1e-6, integral, "scales"),
    Property("integral by draws", 6.0, integral_by_draws, "scales"),
    Property("samples follow log_prob", 5.0, samples_follow_log_prob, "scales"),
    Property("samples follow marginals", 5.0, samples_follow_marginals, "scales"),
    Property("draws are independent", 6.0, independent, "own"),
    Property("2π-periodic", 1e-13, periodic, "own"),
    Property("entropy", 5.0, entropy, "scales"),
    Property("mode", 0.05, mode_is_highest, "scales"),
    Property("mode", 0.5, mode_is_highest, "many"),
    Property("marginals", 1e-6, marginals, "own"),
    Property("median", 5.0, median_is_best, "scales"),
    Property("mean and variance", 1e-5, moments, "scales"),
    Property("cdf", 1e-6, masses, "scales"),
)
