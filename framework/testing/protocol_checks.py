"""Checks of the optional functions of framework.distributions.protocol: comparison with log_prob and with draws.

Each check records its errors in `worst` (`framework.testing.finding.Worst`), which keeps the largest one.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions import protocol
from framework.distributions.circular import Circular, wrap
from framework.distributions.density import Mixture
from framework.errors import UserError
from framework.testing.finding import SEED, Worst, seed

MANY = 4000
"""Number of draws with which the result of a function is compared."""
TEMPERATURES = (0.6, 1.7)
"""Temperatures of the powers that are checked."""
STANDARD_ERRORS = 6.0
"""Largest deviation that is ascribed to chance, in standard errors."""
LARGEST_STATISTIC = 2.7
"""Largest Kolmogorov-Smirnov statistic that is ascribed to chance.

The statistic is √(n/2) times the largest difference between the empirical distribution functions of two samples of n
draws. Chance exceeds this value once in 10⁶ comparisons.
"""


def draws_and_mode(density: Distribution) -> Tensor:
    """Return six draws and the mode, (7, *batch, *event)."""
    seed(SEED + 3)
    draws = density.sample(torch.Size((6,)))
    return torch.cat([draws, density.mode.unsqueeze(0).to(draws)])


def seeded_log_prob(density: Distribution, value: Tensor, number: int = SEED) -> Tensor:
    """Return log_prob of a value, with random numbers seeded with `number`."""
    seed(number)
    return density.log_prob(value)


def check_estimate(density: Distribution, worst: Worst) -> None:
    """Check that `estimate` agrees with log_prob within the standard error that it states.

    If log_prob draws no random numbers, the standard error must be 0 or unknown. If it does, the standard error must be
    at least a fifth of the standard deviation of log_prob over seeds.
    """
    value = draws_and_mode(density)
    expected = seeded_log_prob(density, value)
    seed(SEED)
    stated = protocol.estimate(density, value)
    for name, field in stated._asdict().items():
        worst.same(f"shape of {name}", tuple(field.shape), tuple(expected.shape))
    worst.same("dtype of samples", stated.samples.dtype, torch.int64)
    worst.same("dtype of unresolved", stated.unresolved.dtype, torch.bool)
    repeats = torch.stack([seeded_log_prob(density, value, number) for number in range(2)])
    is_random = not torch.equal(*repeats)
    error = stated.standard_error.double()
    known = error.nan_to_num(nan=0.0, posinf=1e30)
    worst.count(error < 0, "standard errors below 0")
    if is_random:
        several = torch.stack([seeded_log_prob(density, value, number) for number in range(2, 14)]).double()
        spread = several.std(0)
        worst.count(
            (error < spread / 5) & (spread > 1e-6 * expected.abs().clamp(min=1)) & spread.isfinite(),
            "standard errors below a fifth of the standard deviation of log_prob over seeds",
        )
    else:
        # a density that drew random numbers once, at construction, states how many in `samples`
        worst.count(
            (known > 0) & (stated.samples == 0),
            "standard errors above 0 although log_prob draws no random numbers",
        )
    size = expected.double().abs().clamp(min=1)
    room = 1e-6 * size + (STANDARD_ERRORS * known if is_random else 0.0)
    gap = (stated.log_mean.double() - expected.double()).abs()
    gap = torch.where(stated.log_mean == expected, 0.0, gap)  # -∞ equals -∞
    worst.record(gap / room, lambda at: f"log_mean differs from log_prob by {gap[at].item():.3g} nats")
    bias = (stated.debiased - stated.log_mean).double() - known.square() / 2
    bias = torch.where(expected.isfinite() & (error < 1e15), bias, 0.0)
    worst.record(
        bias.abs() / (1e-5 * size + known.square() * 1e-3),
        "debiased differs from log_mean + standard_error² / 2",
    )


def check_powers(density: Distribution, worst: Worst) -> None:
    """Check that `tempered_density`, where known, is proportional to p^(1/T), with the same shapes and dtype."""
    # the power of a mixture is the mixture of the powers of its components
    while isinstance(density, Mixture):
        density = density.components
    value = draws_and_mode(density)
    log_prob = density.log_prob(value).double()
    for temperature, power in powers_of(density, worst):
        label = f"T = {temperature:g}"
        worst.same(f"batch_shape, {label}", tuple(power.batch_shape), tuple(density.batch_shape))
        worst.same(f"event_shape, {label}", tuple(power.event_shape), tuple(density.event_shape))
        power_log_prob = power.log_prob(value)
        worst.same(f"dtype of log_prob, {label}", power_log_prob.dtype, density.log_prob(value).dtype)
        rest = power_log_prob.double() - log_prob / temperature
        gap = (rest - rest[-1]).abs() / (1e-6 * (log_prob / temperature).abs().clamp(min=1))
        gap = torch.where(log_prob.isfinite(), gap, 0.0)
        worst.record(gap, f"log q - log p / T is not constant, {label}")
        mode = power.mode
        above = power.log_prob(density.mode.to(mode)) - power.log_prob(mode)
        worst.record(above.abs() / 0.05, f"the mode differs from that of the density, {label}")


def powers_of(density: Distribution, worst: Worst) -> Iterator[tuple[float, Distribution]]:
    """Yield each of TEMPERATURES at which the density can be tempered, with the tempered density."""
    for temperature in TEMPERATURES:
        try:
            power = protocol.tempered_density(density, torch.tensor(temperature, dtype=torch.float64))
        except UserError:
            worst.count(False, "the density has no powers")
            return
        yield temperature, power


def apply_to_powers(
    density: Distribution, worst: Worst, check: Callable[[Distribution, Worst], None]
) -> None:
    """Apply a check to the power of a density at each of TEMPERATURES."""
    for _, power in powers_of(density, worst):
        check(power, worst)


def check_pick(density: Distribution, worst: Worst) -> None:
    """Check that draws of `pick(density, index)` are draws of the item at `index`; batch_shape is (rows, 2)."""
    rows, count = density.batch_shape
    index = (torch.arange(MANY).unsqueeze(-1) + torch.arange(rows)) % count
    draws = protocol.pick(density, index).sample()
    worst.same("shape of the draws", tuple(draws.shape), (MANY, rows, *density.event_shape))
    alone = density.sample(torch.Size((MANY // count,)))
    for row in range(rows):
        for item in range(count):
            picked = draws[index[:, row] == item, row]
            compare_draws(density, picked, alone[:, row, item], worst, f"item {item} of row {row}")


def compare_draws(density: Distribution, first: Tensor, second: Tensor, worst: Worst, label: str) -> None:
    """Check by the Kolmogorov-Smirnov statistic that two samples have the same distribution, number by number.

    The error is in units of LARGEST_STATISTIC.

    Args:
        density: Density whose support tells whether the draws are classes, angles or real numbers.
        first: Draws of one sample, (draw, *event).
        second: As many draws of the other sample.
        worst: Recorder of the largest error.
        label: Name of the draws, for the finding.
    """
    count = len(first)
    if density.has_enumerate_support and density.event_shape == ():
        labels = torch.arange(int(max(first.max(), second.max())) + 1)
        shares = [(sample.unsqueeze(-1) == labels).double().mean(0).cumsum(-1) for sample in (first, second)]
        gap = (shares[0] - shares[1]).abs()
    else:
        both = torch.cat([first, second]).double().flatten(1)
        if isinstance(density.support, Circular):
            both = wrap(both - both[:1])
        signs = torch.cat([torch.ones(count), -torch.ones(len(second))]).double() / count
        order = both.argsort(dim=0, stable=True)
        value, sign = both.gather(0, order), signs[order]
        # equal values form one step of the distribution function
        last = torch.cat([value[1:] != value[:-1], torch.ones_like(value[:1], dtype=torch.bool)])
        gap = sign.cumsum(0).abs().where(last, 0.0)
    worst.record((count / 2) ** 0.5 * gap / LARGEST_STATISTIC, f"draws of {label} do not follow the density")


def check_quadratic_bound(density: Distribution, worst: Worst) -> None:
    """Check that `quadratic_bound` has the value and gradient of log_prob at a point and is a lower bound elsewhere."""
    value = draws_and_mode(density)
    bound_at_value = protocol.quadratic_bound(density, value)
    if bound_at_value is None:
        worst.count(False, "quadratic_bound is not known")
        return
    with torch.enable_grad():
        log_prob = density.log_prob(value.requires_grad_())
        (gradient,) = torch.autograd.grad(log_prob.sum(), value)
    value = value.detach()
    size = log_prob.detach().abs().clamp(min=1)
    worst.record(
        (bound_at_value.log_prob - log_prob).abs() / (1e-6 * size),
        "log_prob differs from that of the density",
    )
    steep = gradient.abs().amax(-1, keepdim=True).clamp(min=1)
    worst.record(
        (bound_at_value.pull - gradient).abs() / (1e-6 * steep), "pull differs from the gradient of log_prob"
    )
    stiffness, angles = bound_at_value.stiffness, isinstance(density.support, Circular)
    worst.count(~((stiffness > 0) | (angles & (stiffness == stiffness))), "stiffness not above 0")
    generator = torch.Generator().manual_seed(SEED)
    for length in (0.01, 0.3, 1.0, 4.0, 30.0):
        unit = torch.randn(value.shape, dtype=value.dtype, generator=generator)
        step = length * unit * stiffness.abs().clamp(min=1e-12).rsqrt().clamp(max=1e6)
        if angles:
            bound = bound_at_value.pull * step.sin() - stiffness * (1 - step.cos())
        else:
            bound = bound_at_value.pull * step - stiffness * step.square() / 2
        expected = bound_at_value.log_prob + bound.sum(-1)
        below = expected - density.log_prob(value + step)
        room = 1e-6 * (size + expected.abs() + bound.abs().sum(-1))
        worst.record(below / room, f"bound above log_prob at a distance of {length:g} widths")


def check_recentre(density: Distribution, worst: Worst) -> None:
    """Check `recentre` to o, for densities of one number: log_prob at d must be the original log_prob at o + d."""
    rows = density.batch_shape[0]
    index = torch.arange(2 * rows + 1) % rows
    width = known_widths(density)
    place = density.mode.double()[index] + 0.3 * width[index].unsqueeze(-1)
    moved = protocol.recentre(density, (index,), place)
    offset = torch.tensor([-3.0, -0.5, 0.0, 0.2, 2.0], dtype=torch.float64)[:, None] * width[index]
    actual = moved.log_prob(offset.unsqueeze(-1)).double()
    value = (place + offset.unsqueeze(-1)).to(density.mode.dtype)  # (5, item, 1)
    expected = torch.stack(
        [density.log_prob(value[:, item : item + 1].expand(-1, rows, 1))[:, row] for item, row in enumerate(index)],
        1,
    ).double()  # fmt: skip
    gap = torch.where(actual == expected, 0.0, (actual - expected).abs())
    worst.record(
        gap / (1e-6 * expected.abs().clamp(min=1)),
        "log_prob at the offset differs from that at place + offset",
    )


def known_widths(density: Distribution) -> Tensor:
    """Return the standard deviation, (rows,), of a normal density with the same maximum; for angles, at most 1."""
    width = (-density.log_prob(density.mode).double()).exp() / math.sqrt(2 * math.pi)
    return width.clamp(max=1.0) if isinstance(density.support, Circular) else width


def check_normals(density: Distribution, worst: Worst) -> None:
    """Check `protocol.normals` and `protocol.mahalanobis` against log_prob.

    The log-density of the mixture that `normals` returns must equal log_prob, and the distance that `mahalanobis`
    returns must be -2 log_prob plus a constant. A function that returns None for this density is not checked.
    """
    worst.count(False, "neither normals nor mahalanobis is known")
    value = draws_and_mode(density)
    log_prob = density.log_prob(value).double()
    size = log_prob.abs().clamp(min=1)
    if density.event_shape == (1,) and (known := protocol.normals(density)) is not None:
        standard = (value.double() - known.mean) / known.scale
        parts = known.log_weights - standard.square() / 2 - known.scale.log() - math.log(2 * math.pi) / 2
        worst.record(
            (parts.logsumexp(-1) - log_prob).abs() / (1e-6 * size),
            "normals: the log-density differs from log_prob",
        )
    distance = protocol.mahalanobis(density, value)
    if distance is not None:
        rest = log_prob + distance / 2
        worst.record((rest - rest[-1]).abs() / (1e-6 * size), "mahalanobis: log p + m/2 is not constant")
        worst.count(distance < 0, "mahalanobis: distances below 0")


def check_mode_candidates(density: Distribution, worst: Worst) -> None:
    """Check that `mode_candidates` and `peak_widths` are finite, have the documented shapes, and widths above 0."""
    places = protocol.mode_candidates(density)
    shape = (*density.batch_shape, *density.event_shape)
    worst.same("shape of a mode candidate", tuple(places.shape[1:]), shape)
    worst.finite("mode_candidates", places)
    if density.event_shape == (1,):
        widths = protocol.peak_widths(density)
        worst.same("shape of the peak widths", tuple(widths.shape), tuple(places.shape[:-1]))
        worst.count(~(widths > 0) | widths.isnan(), "a peak width not above 0")


def check_marginal_cdfs(density: Distribution, worst: Worst) -> None:
    """Check that `marginal_cdfs` gives, for each number, the share of its draws below a value.

    The error is in units of STANDARD_ERRORS standard errors.
    """
    value = draws_and_mode(density)
    stated = protocol.marginal_cdfs(density, value)
    if stated is None:
        worst.count(False, "marginal_cdfs is not known")
        return
    worst.same("shape of marginal_cdfs", tuple(stated.shape), tuple(value.shape))
    draws = density.sample(torch.Size((MANY,)))
    share = torch.stack([(draws <= single_value).double().mean(0) for single_value in value])
    noise = (stated * (1 - stated) / MANY).clamp(min=0).sqrt() + 1 / MANY
    worst.record(
        (share - stated).abs() / noise / STANDARD_ERRORS, "differs from the share of draws below the value"
    )


def check_moments(density: Distribution, worst: Worst) -> None:
    """Compare mean and variance of densities over many real numbers with those of draws, number by number.

    The error is in units of STANDARD_ERRORS standard errors.
    """
    draws = density.sample(torch.Size((MANY,))).double()
    middle = draws.mean(0)
    squares = (draws - middle).square()
    try:
        mean, variance = density.mean.double(), density.variance.double()
    except (NotImplementedError, AttributeError):
        worst.count(False, "the density has no mean and variance")
        return
    tiny = 1e-9 * (middle.abs() + squares.mean(0).sqrt()) + 1e-300
    spread = torch.maximum(
        squares.mean(0), variance.nan_to_num(posinf=0.0)
    )  # rare values may be missing among the draws
    noise = (spread / MANY).sqrt() + 1e-6 * spread.sqrt() + tiny
    worst.record((mean - middle).abs() / noise / STANDARD_ERRORS, "mean")
    noise = (
        squares.std(0) / MANY**0.5 + 2 * noise.square() + 1e-6 * variance.abs() + 1 / MANY * squares.amax(0)
    )
    gap = (variance - squares.mean(0)).abs() / noise / STANDARD_ERRORS
    # if a number has two values and one is rare, all draws may have the other
    several = (draws.sort(0).values.diff(dim=0) > 0).sum(0) > 1
    worst.record(gap.where(variance.isfinite() & several, 0.0), "variance")


def check_medians(density: Distribution, worst: Worst) -> None:
    """Check that half of the draws lie on each side of the median of each number.

    For angles the two sides are the half turns before and after the median. The error is in units of STANDARD_ERRORS
    standard errors.
    """
    seed(SEED)
    chosen = protocol.median(density, MANY // 2)
    draws = density.sample(torch.Size((MANY,)))
    offset = draws - chosen
    offset = wrap(offset) if isinstance(density.support, Circular) else offset
    # the median may be estimated from draws too, which adds to the error of the shares
    noise = 0.5 * (3 / MANY) ** 0.5
    above, below = (offset > 0).double().mean(0), (offset < 0).double().mean(0)
    # if a number has few values, more than half of the draws may equal the median
    gap = (torch.maximum(above, below) - 0.5).clamp(min=0)
    worst.record(gap / noise / STANDARD_ERRORS, "more than half of the draws on one side of the median")


def check_marginals(density: Distribution, worst: Worst) -> None:
    """Check that draws of `marginal(density, number)` have the distribution of that number in draws of the density."""
    draws = density.sample(torch.Size((MANY // 2,)))
    for number in range(density.event_shape[0]):
        try:
            marginal_density = protocol.marginal(density, number)
        except UserError:
            worst.count(isinstance(density.support, Circular), "the density has no marginals")
            return
        alone = marginal_density.sample(torch.Size((MANY // 2,)))
        for row in range(density.batch_shape[0]):
            compare_draws(
                marginal_density,
                alone[:, row],
                draws[:, row, number : number + 1],
                worst,
                f"number {number}, row {row}",
            )


def mix_pairs(components: Distribution) -> Mixture:
    """Return the mixture of two components with weights 0.7 and 0.3; batch_shape of `components` is (rows, 2)."""
    like = components.log_prob(components.mode)
    weights = like.new_tensor([0.7, 0.3], dtype=torch.float64).log().expand(components.batch_shape)
    return Mixture(weights.to(like.dtype), components)


def protocol_calls(
    density: Distribution, index: Tensor, temperature: Tensor
) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield name and call of every function of a density and of the protocol; a density may refuse some calls.

    Args:
        density: Densities, batch_shape (rows,).
        index: Indices of rows, (draw, 1).
        temperature: Temperature above 0, a tensor without dimensions.
    """
    few = torch.Size((5,))
    value = density.sample(few)

    def evaluate(other: Distribution) -> None:
        other.log_prob(other.sample(few))

    yield "sample", lambda: density.sample(few)
    yield "log_prob", lambda: density.log_prob(value)
    yield "mode", lambda: density.mode
    yield "entropy", lambda: density.entropy()
    yield "mean", lambda: density.mean
    yield "variance", lambda: density.variance
    yield "estimate", lambda: protocol.estimate(density, value)
    yield "cdf", lambda: protocol.cdf(density, value)
    yield "marginal_cdfs", lambda: protocol.marginal_cdfs(density, value)
    yield "arc_probability", lambda: protocol.arc_probability(density, value - 0.1, value + 0.1)
    if isinstance(density.support, Circular) and density.event_shape == (1,):
        yield "trigonometric_moments", lambda: protocol.trigonometric_moments(density, 5)
    yield "marginal", lambda: evaluate(protocol.marginal(density, 0))
    yield "median", lambda: protocol.median(density, 50)
    if density.event_shape == (1,):
        rows = index[:, 0]
        yield (
            "recentre",
            lambda: protocol.recentre(density, (rows,), value[0].double()[rows]).log_prob(
                value[:, :1].double()
            ),
        )
    yield "tempered_density", lambda: evaluate(protocol.tempered_density(density, temperature))
    yield "normals", lambda: protocol.normals(density)
    yield "mahalanobis", lambda: protocol.mahalanobis(density, value)
    yield "mode_candidates", lambda: protocol.mode_candidates(density)
    yield "peak_widths", lambda: protocol.peak_widths(density)
    yield "quadratic_bound", lambda: protocol.quadratic_bound(density, value)
    yield "images", lambda: protocol.images(density, {"color"})
    yield "value_set", lambda: _evaluate_set(density, value)
    yield "expand", lambda: evaluate(density.expand(torch.Size((2, *density.batch_shape))))
    yield "enumerate_support", lambda: density.enumerate_support()


def _evaluate_set(density: Distribution, value: Tensor) -> None:
    sets = protocol.value_set(density)
    if sets is not None:
        _ = sets.contains(value), sets.size(), sets.empty(), sets.parts()
