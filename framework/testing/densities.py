"""What every density must satisfy, whatever made it; each function reports the worst case it saw."""

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import angular_distance, grid
from framework.distributions.protocol import marginal, median
from framework.testing.finding import SEED, Finding, Worst, examined
from framework.testing.heads import HeadSubject
from framework.testing.quadrature import cells, counted, density_at, side

DRAWS = 20_000
Check = Callable[[Distribution, Worst], None]


def examine_densities(subject: HeadSubject) -> Iterator[Finding]:
    """Every property of the row's densities, on three of them, in float64."""
    head = subject.make().double()
    head.requires_grad_(False)
    raw = subject.row.scale * subject.raws(3).double()
    for name, (limit, check) in CHECKS.items():
        if name in subject.row.leave_out or not applies(name, subject):
            continue

        def look(worst: Worst, check: Check = check) -> None:
            with torch.no_grad():
                check(head(raw), worst)

        yield examined(name, subject.row.limits.get(name, limit), look)


def applies(name: str, subject: HeadSubject) -> bool:
    """Whether a property can be asked of the row's target."""
    target = subject.row.target
    numbers = 1 if target.kind == "class" else len(target.names)
    wanted = {
        "integral": numbers <= 3,
        "samples follow log_prob": numbers <= 3,
        "2π-periodic": target.kind == "angle",
        "median": target.kind == "angle" and numbers == 1,
        "marginals": target.kind == "angle" and numbers in (2, 3),
    }
    return wanted.get(name, True)


def integral(density: Distribution, worst: Worst) -> None:
    """The density integrates to 1."""
    _, mass = cells(density)
    numbers = max(1, len(density.event_shape) and density.event_shape[0])
    total = mass.sum(tuple(range(numbers)))
    worst.see((total - 1).abs(), lambda at: f"batch row {at}: {total[at].item():.9g}")


def samples_follow_log_prob(density: Distribution, worst: Worst) -> None:
    """Pearson's χ² of samples over cells, in its standard deviations; cells expecting below five draws are one."""
    torch.manual_seed(SEED)
    borders, mass = cells(density)
    count = counted(density, borders, density.sample(torch.Size((DRAWS,))))
    batch = density.batch_shape
    expected, count = DRAWS * mass.reshape(-1, *batch), count.reshape(-1, *batch)
    rare = expected < 5
    score = ((count - expected).square() / expected).where(~rare, 0).sum(0)
    rest, rest_count = expected.where(rare, 0).sum(0), count.where(rare, 0).sum(0)
    score = score + (rest_count - rest).square() / rest.clamp(min=5)
    freedom = (~rare).sum(0).clamp(min=1)
    worst.see(
        (score - freedom) / (2 * freedom).sqrt(), lambda at: f"batch row {at}, {freedom[at].item()} cells"
    )


def periodic(density: Distribution, worst: Worst) -> None:
    """log_prob the same up to a thousand turns on; relative to its slope, since 2π has no exact float."""
    generator = torch.Generator().manual_seed(SEED)
    shape = torch.Size((8, *density.batch_shape, *density.event_shape))
    value = 6 * torch.randn(shape, dtype=torch.float64, generator=generator)
    with torch.enable_grad():
        here = density.log_prob(value.requires_grad_())
        (slope,) = torch.autograd.grad(here.sum(), value)
    for turns in (1, -1, 7, -1000):
        moved = value.detach() + turns * 2 * math.pi
        scale = here.detach().abs().clamp(min=1) + slope.abs().sum(-1)
        # a rounded turn is off by the same share as any other float
        scale = scale * (1 + moved.abs().amax(-1))
        error = (density.log_prob(moved) - here.detach()).abs() / scale
        worst.see(error, lambda at, turns=turns: f"{turns} turns on, value and batch row {at}")


def entropy(density: Distribution, worst: Worst) -> None:
    """entropy() is the mean of -log_prob over samples; in standard errors of such a mean over 1000."""
    torch.manual_seed(SEED)
    drawn = density.sample(torch.Size((DRAWS,)))
    surprise = torch.cat([-density.log_prob(part) for part in drawn.split(2000)])
    noise = surprise.std(0) / 1000**0.5
    found = density.entropy()
    # a density that is constant has no noise: rounding is allowed instead
    error = (found - surprise.mean(0)).abs() / (noise + 1e-6)
    worst.see(
        error,
        lambda at: f"batch row {at}: {found[at].item():.6g}, by samples {surprise.mean(0)[at].item():.6g}",
    )


def mode_is_highest(density: Distribution, worst: Worst) -> None:
    """No sample is more than `limit` nats above the mode."""
    torch.manual_seed(SEED)
    drawn = density.sample(torch.Size((2000,)))
    torch.manual_seed(SEED)
    above = density.log_prob(drawn).amax(0) - density.log_prob(density.mode)
    worst.see(above, lambda at: f"batch row {at}: {above[at].item():.3g} nats above the mode")


def marginals(density: Distribution, worst: Worst) -> None:
    """marginal(density, i) is the joint density integrated over the other angles."""
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
            lambda at, index=index: f"angle {index}, point and row {at}",
        )


def median_is_best(density: Distribution, worst: Worst) -> None:
    """No angle of a grid has a smaller expected deviation than median(density); radians."""
    torch.manual_seed(SEED)
    axis = grid(2048, dtype=torch.float64)
    shape = (len(axis), *(1,) * len(density.batch_shape))
    mass = density.log_prob(axis.reshape(*shape, 1).expand(-1, *density.batch_shape, 1)).exp()
    mass = mass / mass.sum(0)
    chosen = (angular_distance(median(density, 2000)[..., 0], axis.reshape(shape)) * mass).sum(0)
    best = torch.stack([_deviation(angle, axis, shape, mass) for angle in axis[::8]]).amin(0)
    worst.see(
        chosen - best, lambda at: f"batch row {at}: {chosen[at].item():.4g}, best {best[at].item():.4g} rad"
    )


def _deviation(angle: Tensor, axis: Tensor, shape: tuple[int, ...], mass: Tensor) -> Tensor:
    return (angular_distance(angle, axis).reshape(shape) * mass).sum(0)


CHECKS: dict[str, tuple[float, Check]] = {
    "integral": (1e-6, integral),
    "samples follow log_prob": (5.0, samples_follow_log_prob),
    "2π-periodic": (1e-13, periodic),
    "entropy": (5.0, entropy),
    "mode": (0.05, mode_is_highest),
    "marginals": (1e-6, marginals),
    "median": (1e-3, median_is_best),
}
