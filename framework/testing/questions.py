"""Checks of the optional functions of framework.distributions.protocol against log_prob and against draws."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.circular import Circular, wrap
from framework.distributions.density import Mixture
from framework.distributions.protocol import (
    arc_probability,
    cdf,
    estimate,
    images,
    mahalanobis,
    marginal,
    marginal_cdfs,
    median,
    mode_candidates,
    normals,
    peak_widths,
    pick,
    quadratic_bound,
    recentre,
    tempered_density,
    value_set,
)
from framework.errors import UserError
from framework.testing.finding import SEED, Worst, seed

MANY = 4000
"""Number of draws that a result is compared with."""
TEMPERATURES = (0.6, 1.7)
SUSPICIOUS = 6.0
"""Number of standard errors that a deviation by chance does not exceed."""
APART = 2.7
"""Largest Kolmogorov-Smirnov statistic that is ascribed to chance.

The statistic is √(n/2) times the largest difference between the empirical distribution functions of two samples of n
draws. Chance exceeds this value once in 10⁶ comparisons.
"""


def some_values(density: Distribution, count: int = 6) -> Tensor:
    """Return `count` draws and the mode, (count + 1, *batch, *event)."""
    seed(SEED + 3)
    drawn = density.sample(torch.Size((count,)))
    return torch.cat([drawn, density.mode.unsqueeze(0).to(drawn)])


def seeded_log_prob(density: Distribution, value: Tensor, number: int = SEED) -> Tensor:
    """Return log_prob of a value, after random numbers were seeded with `number`."""
    seed(number)
    return density.log_prob(value)


def estimated(density: Distribution, worst: Worst) -> None:
    """Check that estimate(density, value) agrees with log_prob within the standard error that it states.

    Where nothing is drawn, the standard error must be 0 or unknown. Where log_prob draws random numbers, the standard
    error must be at least a fifth of the spread of log_prob over seeds.
    """
    value = some_values(density)
    wanted = seeded_log_prob(density, value)
    seed(SEED)
    found = estimate(density, value)
    for name, field in found._asdict().items():
        worst.same(f"shape of {name}", tuple(field.shape), tuple(wanted.shape))
    worst.same("type of samples", found.samples.dtype, torch.int64)
    worst.same("type of unresolved", found.unresolved.dtype, torch.bool)
    others = torch.stack([seeded_log_prob(density, value, number) for number in range(2)])
    drawn = not torch.equal(*others)
    error = found.standard_error.double()
    known = error.nan_to_num(nan=0.0, posinf=1e30)
    worst.count(error < 0, "a standard error below 0")
    if drawn:
        several = torch.stack([seeded_log_prob(density, value, number) for number in range(2, 14)]).double()
        spread = several.std(0)
        worst.count(
            (error < spread / 5) & (spread > 1e-6 * wanted.abs().clamp(min=1)) & spread.isfinite(),
            "log_prob draws and its standard error is less than a fifth of its spread over seeds",
        )
    else:
        # a density that drew once, when it was made, says so by its number of samples
        worst.count((known > 0) & (found.samples == 0), "a standard error where nothing is drawn")
    size = wanted.double().abs().clamp(min=1)
    room = 1e-6 * size + (SUSPICIOUS * known if drawn else 0.0)
    apart = (found.log_mean.double() - wanted.double()).abs()
    apart = torch.where(found.log_mean == wanted, 0.0, apart)  # -∞ equals -∞
    worst.see(apart / room, lambda at: f"log_mean is not log_prob: off by {apart[at].item():.3g} nats")
    bias = (found.debiased - found.log_mean).double() - known.square() / 2
    bias = torch.where(wanted.isfinite() & (error < 1e15), bias, 0.0)
    worst.see(bias.abs() / (1e-5 * size + known.square() * 1e-3), "debiased is not log_mean + error²/2")


def powers(density: Distribution, worst: Worst) -> None:
    """Check that tempered(density, T), where known, is proportional to p^(1/T), with the same shapes and dtype."""
    while isinstance(density, Mixture):  # a mixture tempers each of its components by itself
        density = density.components
    value = some_values(density)
    log_prob = density.log_prob(value).double()
    for temperature in TEMPERATURES:
        try:
            power = tempered_density(density, torch.tensor(temperature, dtype=torch.float64))
        except UserError:
            worst.count(False, "no power is known")
            return
        what = f"T = {temperature:g}"
        worst.same(f"batch_shape, {what}", tuple(power.batch_shape), tuple(density.batch_shape))
        worst.same(f"event_shape, {what}", tuple(power.event_shape), tuple(density.event_shape))
        found = power.log_prob(value)
        worst.same(f"type of log_prob, {what}", found.dtype, density.log_prob(value).dtype)
        rest = found.double() - log_prob / temperature
        apart = (rest - rest[-1]).abs() / (1e-6 * (log_prob / temperature).abs().clamp(min=1))
        apart = torch.where(log_prob.isfinite(), apart, 0.0)
        worst.see(apart, f"log q - log p / T is not the same everywhere, {what}")
        place = power.mode
        above = power.log_prob(density.mode.to(place)) - power.log_prob(place)
        worst.see(above.abs() / 0.05, f"the mode is not that of the density, {what}")


def powers_of(density: Distribution, worst: Worst, check: Callable[[Distribution, Worst], None]) -> None:
    """Apply a check to the density tempered with each of TEMPERATURES."""
    for temperature in TEMPERATURES:
        try:
            power = tempered_density(density, torch.tensor(temperature, dtype=torch.float64))
        except UserError:
            worst.count(False, "no power is known")
            return
        check(power, worst)


def picks(density: Distribution, worst: Worst) -> None:
    """Check that pick(density, index) draws from the item that the index names; batch_shape is (rows, 2)."""
    rows, count = density.batch_shape
    index = (torch.arange(MANY).unsqueeze(-1) + torch.arange(rows)) % count
    drawn = pick(density, index).sample()
    worst.same("shape of the draws", tuple(drawn.shape), (MANY, rows, *density.event_shape))
    alone = density.sample(torch.Size((MANY // count,)))
    for row in range(rows):
        for item in range(count):
            mine = drawn[index[:, row] == item, row]
            two_samples(density, mine, alone[:, row, item], worst, f"item {item} of row {row}")


def two_samples(density: Distribution, first: Tensor, second: Tensor, worst: Worst, what: str) -> None:
    """Compare draws (draw, *event) with as many draws of the same density; the error is in units of APART."""
    count = len(first)
    if density.has_enumerate_support and density.event_shape == ():
        labels = torch.arange(int(max(first.max(), second.max())) + 1)
        shares = [(one.unsqueeze(-1) == labels).double().mean(0).cumsum(-1) for one in (first, second)]
        apart = (shares[0] - shares[1]).abs()
    else:
        both = torch.cat([first, second]).double().flatten(1)
        if isinstance(density.support, Circular):
            both = wrap(both - both[:1])
        mine = torch.cat([torch.ones(count), -torch.ones(len(second))]).double() / count
        order = both.argsort(dim=0, stable=True)
        value, sign = both.gather(0, order), mine[order]
        # equal values form one step of the distribution function
        last = torch.cat([value[1:] != value[:-1], torch.ones_like(value[:1], dtype=torch.bool)])
        apart = sign.cumsum(0).abs().where(last, 0.0)
    worst.see((count / 2) ** 0.5 * apart / APART, f"draws of {what} are not the density's")


def slopes(density: Distribution, worst: Worst) -> None:
    """Check that slope(density, value) has the value and gradient of log_prob and is a lower bound elsewhere."""
    value = some_values(density).requires_grad_()
    with torch.enable_grad():
        log_prob = density.log_prob(value)
        (gradient,) = torch.autograd.grad(log_prob.sum(), value)
    value = value.detach()
    found = quadratic_bound(density, value)
    if found is None:
        worst.count(False, "not known")
        return
    size = log_prob.detach().abs().clamp(min=1)
    worst.see((found.log_prob - log_prob).abs() / (1e-6 * size), "its log_prob is another")
    steep = gradient.abs().amax(-1, keepdim=True).clamp(min=1)
    worst.see((found.pull - gradient).abs() / (1e-6 * steep), "its pull is not the gradient of log_prob")
    stiffness, angles = found.stiffness, isinstance(density.support, Circular)
    worst.count(~((stiffness > 0) | (angles & (stiffness == stiffness))), "a stiffness not above 0")
    generator = torch.Generator().manual_seed(SEED)
    for length in (0.01, 0.3, 1.0, 4.0, 30.0):
        unit = torch.randn(value.shape, dtype=value.dtype, generator=generator)
        step = length * unit * stiffness.abs().clamp(min=1e-12).rsqrt().clamp(max=1e6)
        if angles:
            bound = found.pull * step.sin() - stiffness * (1 - step.cos())
        else:
            bound = found.pull * step - stiffness * step.square() / 2
        wanted = found.log_prob + bound.sum(-1)
        below = wanted - density.log_prob(value + step)
        room = 1e-6 * (size + wanted.abs() + bound.abs().sum(-1))
        worst.see(below / room, f"not a bound from below {length:g} widths away")


def moved_places(density: Distribution, worst: Worst) -> None:
    """Check that about(density, index, place) at d is log_prob at place + d, for densities of one number."""
    rows = density.batch_shape[0]
    index = torch.arange(2 * rows + 1) % rows
    width = known_widths(density)
    place = density.mode.double()[index] + 0.3 * width[index].unsqueeze(-1)
    moved = recentre(density, (index,), place)
    offset = torch.tensor([-3.0, -0.5, 0.0, 0.2, 2.0], dtype=torch.float64)[:, None] * width[index]
    found = moved.log_prob(offset.unsqueeze(-1)).double()
    value = (place + offset.unsqueeze(-1)).to(density.mode.dtype)  # (5, item, 1)
    wanted = torch.stack(
        [density.log_prob(value[:, item : item + 1].expand(-1, rows, 1))[:, row] for item, row in enumerate(index)],
        1,
    ).double()  # fmt: skip
    apart = torch.where(found == wanted, 0.0, (found - wanted).abs())
    worst.see(apart / (1e-6 * wanted.abs().clamp(min=1)), "log_prob there is not that at place + offset")


def known_widths(density: Distribution) -> Tensor:
    """Return the standard deviation, (rows,), of a normal as high as the density at its mode; for angles at most 1."""
    width = (-density.log_prob(density.mode).double()).exp() / math.sqrt(2 * math.pi)
    return width.clamp(max=1.0) if isinstance(density.support, Circular) else width


def normal_forms(density: Distribution, worst: Worst) -> None:
    """Check that `normals` gives log p and that `mahalanobis` is -2 log p plus a constant, where they are known."""
    worst.count(False, "not known")
    value = some_values(density)
    log_prob = density.log_prob(value).double()
    size = log_prob.abs().clamp(min=1)
    if density.event_shape == (1,) and (known := normals(density)) is not None:
        standard = (value.double() - known.mean) / known.scale
        parts = known.log_weights - standard.square() / 2 - known.scale.log() - math.log(2 * math.pi) / 2
        worst.see((parts.logsumexp(-1) - log_prob).abs() / (1e-6 * size), "normals: another log-density")
    distance = mahalanobis(density, value)
    if distance is not None:
        rest = log_prob + distance / 2
        worst.see((rest - rest[-1]).abs() / (1e-6 * size), "mahalanobis: log p + m/2 is not a constant")
        worst.count(distance < 0, "mahalanobis: a distance below 0")


def candidates(density: Distribution, worst: Worst) -> None:
    """Check that `mode_candidates` and `peak_widths` are finite and of the documented shapes, and all widths above 0."""
    places = mode_candidates(density)
    shape = (*density.batch_shape, *density.event_shape)
    worst.same("shape of a peak", tuple(places.shape[1:]), shape)
    worst.finite("mode_candidates", places)
    if density.event_shape == (1,):
        widths = peak_widths(density)
        worst.same("shape of the scales", tuple(widths.shape), tuple(places.shape[:-1]))
        worst.count(~(widths > 0) | widths.isnan(), "a scale not above 0")


def shares_below(density: Distribution, worst: Worst) -> None:
    """Check that each_cdf is the share of draws below a value, for each number; in standard errors of MANY draws."""
    value = some_values(density)
    found = marginal_cdfs(density, value)
    if found is None:
        worst.count(False, "not known")
        return
    worst.same("shape", tuple(found.shape), tuple(value.shape))
    drawn = density.sample(torch.Size((MANY,)))
    share = torch.stack([(drawn <= one).double().mean(0) for one in value])
    noise = (found * (1 - found) / MANY).clamp(min=0).sqrt() + 1 / MANY
    worst.see((share - found).abs() / noise / SUSPICIOUS, "not the share of draws below")


def moments_of_draws(density: Distribution, worst: Worst) -> None:
    """Check mean and variance of each number of many reals against those of draws, in standard errors."""
    drawn = density.sample(torch.Size((MANY,))).double()
    middle = drawn.mean(0)
    apart = (drawn - middle).square()
    try:
        mean, variance = density.mean.double(), density.variance.double()
    except (NotImplementedError, AttributeError):
        worst.count(False, "none is given")
        return
    tiny = 1e-9 * (middle.abs() + apart.mean(0).sqrt()) + 1e-300
    spread = torch.maximum(
        apart.mean(0), variance.nan_to_num(posinf=0.0)
    )  # a rare value may not be among the draws
    noise = (spread / MANY).sqrt() + 1e-6 * spread.sqrt() + tiny
    worst.see((mean - middle).abs() / noise / SUSPICIOUS, "mean")
    noise = apart.std(0) / MANY**0.5 + 2 * noise.square() + 1e-6 * variance.abs() + 1 / MANY * apart.amax(0)
    gap = (variance - apart.mean(0)).abs() / noise / SUSPICIOUS
    # where a number has two values and one is rare, the draws may show only the other
    several = (drawn.sort(0).values.diff(dim=0) > 0).sum(0) > 1
    worst.see(gap.where(variance.isfinite() & several, 0.0), "variance")


def medians_of_draws(density: Distribution, worst: Worst) -> None:
    """Check that half of the draws lie on each side of the median of each number, in standard errors.

    For angles the two sides are the half turns before and after the median.
    """
    seed(SEED)
    chosen = median(density, MANY // 2)
    drawn = density.sample(torch.Size((MANY,)))
    offset = drawn - chosen
    offset = wrap(offset) if isinstance(density.support, Circular) else offset
    # the median is itself estimated from draws, which adds to the error of the shares
    noise = 0.5 * (3 / MANY) ** 0.5
    above, below = (offset > 0).double().mean(0), (offset < 0).double().mean(0)
    # where a number has few values, more than half of the draws may equal the median
    gap = (torch.maximum(above, below) - 0.5).clamp(min=0)
    worst.see(gap / noise / SUSPICIOUS, "more than half of the draws on one side")


def marginals_of_draws(density: Distribution, worst: Worst) -> None:
    """Check that draws of marginal(density, number) are distributed as that number is in draws of the density."""
    drawn = density.sample(torch.Size((MANY // 2,)))
    for number in range(density.event_shape[0]):
        try:
            one = marginal(density, number)
        except UserError:
            worst.count(isinstance(density.support, Circular), "no marginal is given")
            return
        alone = one.sample(torch.Size((MANY // 2,)))
        for row in range(density.batch_shape[0]):
            two_samples(
                one, alone[:, row], drawn[:, row, number : number + 1], worst, f"number {number}, row {row}"
            )


def mixed(components: Distribution) -> Mixture:
    """Return the mixture of two components with weights 0.7 and 0.3; batch_shape of `components` is (rows, 2)."""
    like = components.log_prob(components.mode)
    weights = like.new_tensor([0.7, 0.3], dtype=torch.float64).log().expand(components.batch_shape)
    return Mixture(weights.to(like.dtype), components)


def every_question(
    density: Distribution, index: Tensor, temperature: Tensor
) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield every function of the protocol by name, as a call on the densities; a density may refuse some.

    Args:
        density: Densities, batch_shape (rows,).
        index: Numbers of rows, (draw, 1).
        temperature: Temperature above 0, a tensor without dimensions.
    """
    few = torch.Size((5,))
    value = density.sample(few)

    def answer(made: Distribution) -> None:
        made.log_prob(made.sample(few))

    yield "sample", lambda: density.sample(few)
    yield "log_prob", lambda: density.log_prob(value)
    yield "mode", lambda: density.mode
    yield "entropy", lambda: density.entropy()
    yield "mean", lambda: density.mean
    yield "variance", lambda: density.variance
    yield "estimate", lambda: estimate(density, value)
    yield "cdf", lambda: cdf(density, value)
    yield "marginal_cdfs", lambda: marginal_cdfs(density, value)
    yield "arc_probability", lambda: arc_probability(density, value - 0.1, value + 0.1)
    yield "marginal", lambda: answer(marginal(density, 0))
    yield "median", lambda: median(density, 50)
    if density.event_shape == (1,):
        rows = index[:, 0]
        yield (
            "recentre",
            lambda: recentre(density, (rows,), value[0].double()[rows]).log_prob(value[:, :1].double()),
        )
    yield "tempered_density", lambda: answer(tempered_density(density, temperature))
    yield "normals", lambda: normals(density)
    yield "mahalanobis", lambda: mahalanobis(density, value)
    yield "mode_candidates", lambda: mode_candidates(density)
    yield "peak_widths", lambda: peak_widths(density)
    yield "quadratic_bound", lambda: quadratic_bound(density, value)
    yield "images", lambda: images(density, {"color"})
    yield "value_set", lambda: _of_set(density, value)
    yield "expand", lambda: answer(density.expand(torch.Size((2, *density.batch_shape))))
    yield "enumerate_support", lambda: density.enumerate_support()


def _of_set(density: Distribution, value: Tensor) -> None:
    sets = value_set(density)
    if sets is not None:
        _ = sets.contains(value), sets.size(), sets.empty(), sets.parts()
