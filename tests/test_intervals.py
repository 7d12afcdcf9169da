"""Intervals of many shapes, locations and widths, in float32 and float64, compared with SciPy and with random draws."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from scipy import optimize, stats
from torch import Tensor
from torch.distributions import (
    Cauchy,
    Distribution,
    Gumbel,
    Independent,
    Laplace,
    MultivariateNormal,
    Normal,
    StudentT,
    constraints,
)

from framework.configuration.schema import build, resolve
from framework.distributions.affine import AffineDensity
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.circular import Circular, circular, wrap
from framework.distributions.density import Mixture
from framework.distributions.intervals import DRAWS, Interval, central_interval
from framework.distributions.tempering import temper
from framework.target import Target
from framework.testing.metrics import Cardioid

TYPES = (torch.float32, torch.float64)
MASSES = (0.5, 0.9, 0.999)
PLACES = (0.0, -3.0, 1e4)
WIDTHS = (1e-6, 1.0, 1e5)
HEAD = build("density_head", resolve("density_head", "von_mises"), target=Target("angle", ("a",)))
VonMises = type(HEAD(torch.zeros(1, 3)))

Ends = Callable[[float], tuple[float, float]]


def column(*numbers: float, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(numbers, dtype=dtype).unsqueeze(-1)


def depends_on_draws(interval: Interval) -> bool:
    return bool(((interval.low_error != 0) | (interval.high_error != 0)).any())


def quantiles(law: Callable[[float], float], mass: float, low: float, high: float) -> tuple[float, float]:
    """Return both ends of an interval, from a distribution function and SciPy's root finder."""
    tails = ((1 - mass) / 2, (1 + mass) / 2)
    found = [
        optimize.brentq(lambda x, tail=tail: law(x) - tail, low, high, xtol=1e-300, rtol=1e-14)
        for tail in tails
    ]
    return found[0], found[1]


def reals(dtype: torch.dtype) -> Iterator[tuple[str, Distribution, Ends]]:
    """Yield densities of one real number with the exact ends of their intervals."""
    for place in PLACES:
        for width in WIDTHS:
            loc, scale = column(place, dtype=dtype), column(width, dtype=dtype)
            at, by = loc.item(), scale.item()
            name = f"{place:g} ± {width:g}"
            laws = {
                "normal": (Normal(loc, scale), stats.norm(at, by)),
                "Laplace": (Laplace(loc, scale), stats.laplace(at, by)),
                "Cauchy": (Cauchy(loc, scale), stats.cauchy(at, by)),
                "Gumbel": (Gumbel(loc, scale), stats.gumbel_r(at, by)),
                "Student 3": (StudentT(torch.full_like(loc, 3), loc, scale), stats.t(3, at, by)),
                "Student 0.5": (StudentT(torch.full_like(loc, 0.5), loc, scale), stats.t(0.5, at, by)),
            }
            for kind, (base, exact) in laws.items():
                yield f"{kind} {name}", Independent(base, 1), exact.interval
            yield (
                f"one number of a joint normal {name}",
                MultivariateNormal(loc, scale_tril=scale.unsqueeze(-1)),
                stats.norm(at, by).interval,
            )
            three = loc.unsqueeze(-2) + scale.unsqueeze(-2) * column(-2.0, 0.0, 3.0, dtype=dtype)
            widths = scale.unsqueeze(-2) * column(1.0, 1e-3, 0.5, dtype=dtype)
            logits = torch.tensor([[0.3, -1.0, 0.0]], dtype=dtype)
            yield f"mixture of normals {name}", *mixed(logits, three, widths, stats.norm, Normal)
            yield (
                f"mixture of Students {name}",
                *mixed(
                    logits, three, widths, partial(stats.t, 4), partial(StudentT, torch.full_like(three, 4))
                ),
            )


def mixed(logits: Tensor, loc: Tensor, scale: Tensor, exact: Any, base: Any) -> tuple[Distribution, Ends]:
    """Return a mixture with the exact ends of its intervals."""
    weights = logits[0].double().softmax(-1).numpy()
    laws = [exact(at, by) for at, by in zip(loc.flatten().tolist(), scale.flatten().tolist(), strict=True)]

    def ends(mass: float) -> tuple[float, float]:
        each = [law.interval(mass) for law in laws]
        low, high = min(end[0] for end in each), max(end[1] for end in each)
        return quantiles(
            lambda x: sum(w * law.cdf(x) for w, law in zip(weights, laws, strict=True)), mass, low, high
        )

    return Mixture(logits, Independent(base(loc, scale), 1)), ends


def close(found: Tensor, wanted: tuple[float, float], note: str) -> None:
    """Require that an interval agrees to 1e-6 of its width, apart from rounding; the contract requires 0.1 %."""
    width = wanted[1] - wanted[0]
    np.testing.assert_allclose(
        found.numpy(), wanted, rtol=0, atol=1e-6 * width + 8e-15 * max(map(abs, wanted)), err_msg=note
    )


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("mass", MASSES)
def test_of_reals_are_scipys(dtype: torch.dtype, mass: float) -> None:
    for name, density, exact in reals(dtype):
        found = central_interval(density, mass)
        assert found.low.dtype == torch.float64 and not depends_on_draws(found), name
        close(torch.cat([found.low, found.high]).flatten(), exact(mass), name)


@pytest.mark.parametrize("dtype", TYPES)
def test_frames_numbers_and_batches_of_other_shapes(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    loc = torch.randn(4, 2, generator=generator).to(dtype)
    scale = torch.rand(4, 2, generator=generator).to(dtype) + 0.1
    pair = Independent(Normal(loc, scale), 1)
    plain = central_interval(pair, 0.9)
    want = stats.norm(loc.double().numpy(), scale.double().numpy()).interval(0.9)
    np.testing.assert_allclose(plain.low.numpy(), want[0], rtol=1e-12)
    np.testing.assert_allclose(plain.high.numpy(), want[1], rtol=1e-12)
    # a year and its unit: in float32 neighbours of 2e9 are 128 apart, and the width is kept
    at, by = torch.full_like(loc, 2e9), torch.full_like(loc, 1e-3)
    moved = central_interval(AffineDensity(pair, at, by), 0.9)
    widths = (want[1] - want[0]) * by.double().numpy()
    np.testing.assert_allclose((moved.high - moved.low).numpy(), widths, rtol=1e-3)
    for other in (Reshaped(Independent(Normal(loc[:, :1], scale[:, :1]), 1), (2, 2)),):
        assert torch.equal(central_interval(other, 0.9).low.flatten(), plain.low[:, 0])
    several = Stacked(
        [Independent(Normal(loc[:, :1], scale[:, :1]), 1), Independent(Laplace(loc[:, :1], scale[:, :1]), 1)]
    )
    ends = central_interval(several, 0.9)
    np.testing.assert_allclose(ends.low[:, 0, 0].numpy(), want[0][:, 0], rtol=1e-6)
    np.testing.assert_allclose(
        ends.high[:, 1, 0].numpy(),
        stats.laplace(loc[:, 0].double(), scale[:, 0].double()).ppf(0.95),
        rtol=1e-6,
    )


def two_halves(found: Interval, law: Callable[[float, float], float], mass: float, note: str) -> None:
    """Require that the middle of an arc halves the mass of the arc and the mass of the circle."""
    low, high = found.low.item(), found.high.item()
    assert -math.pi <= low < math.pi and low < high <= low + 2 * math.pi + 1e-12, note
    assert law(low, high) == pytest.approx(mass, rel=1e-6), note
    middles = optimize.brentq(lambda x: law(low, x) - mass / 2, low, high, xtol=1e-15)
    assert law(middles, middles + math.pi) == pytest.approx(0.5, abs=1e-5), note


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("mass", MASSES)
def test_of_angles_are_scipys_arcs(dtype: torch.dtype, mass: float) -> None:
    grid = [(mean, kappa) for mean in (0.0, 3.1, -2.0) for kappa in (0.0, 1e-2, 1.0, 30.0, 900.0, 1e6, 1e10)]
    loc, concentration = (column(*numbers, dtype=dtype) for numbers in zip(*grid, strict=True))
    found = central_interval(VonMises(loc, concentration), mass)
    assert not depends_on_draws(found)
    # SciPy reads concentrations above 50 as normal: there the next term of the expansion is small enough
    exact = [
        2 * stats.vonmises(kappa).ppf((1 + mass) / 2) if kappa else 2 * math.pi * mass for _, kappa in grid
    ]
    widths = found.high - found.low
    np.testing.assert_allclose(widths.flatten().numpy(), exact, rtol=1e-3)
    off = wrap((found.low + found.high) / 2 - loc.double()).abs()
    assert (off < 1e-6 * widths)[concentration > 0].all()
    kappas, means, logits = [0.5, 40.0, 2e4], [0.2, 2.9, -2.5], torch.tensor([[0.0, 0.4, -0.7]], dtype=dtype)
    mixture = Mixture(
        logits, VonMises(column(*means, dtype=dtype).unsqueeze(0), column(*kappas, dtype=dtype).unsqueeze(0))
    )
    weights = logits[0].double().softmax(-1).tolist()
    at = torch.tensor(means, dtype=dtype).tolist()

    def law(low: float, high: float) -> float:
        parts = (stats.vonmises(kappa, mean) for kappa, mean in zip(kappas, at, strict=True))
        return sum(w * (part.cdf(high) - part.cdf(low)) for w, part in zip(weights, parts, strict=True))

    two_halves(central_interval(mixture, mass), law, mass, "mixture")


@pytest.mark.parametrize("mass", MASSES)
def test_of_other_angles_follow_from_the_series(mass: float) -> None:
    """A density without arc_probability, and powers of one, use their Fourier series."""
    rho = column(-0.4, 0.0, 0.9)

    cardioid = Cardioid(rho)
    found = central_interval(cardioid, mass)
    assert not depends_on_draws(found)
    value = torch.linspace(-math.pi, math.pi, 20001, dtype=torch.float64)
    for item in range(3):
        dense = cardioid.log_prob(value.reshape(-1, 1, 1).expand(-1, 3, 1))[:, item].exp().numpy()
        inside = torch.remainder(value - found.low[item], 2 * math.pi) <= found.high[item] - found.low[item]
        share = np.trapezoid(np.where(inside.numpy(), dense, 0.0), value.numpy())
        assert share == pytest.approx(mass, abs=3e-4)
    power = central_interval(temper(VonMises(column(1.0), column(4.0)), torch.tensor(2.0)), mass)
    half = stats.vonmises(2.0).ppf((1 + mass) / 2)
    assert ((power.high - power.low).item() / 2) == pytest.approx(half, rel=1e-6)


class Sampled(Distribution):
    """Density of a real number or an angle that provides only samples and log_prob."""

    arg_constraints = {}  # noqa: RUF012

    def __init__(self, loc: Tensor, scale: float, turns: bool = False) -> None:
        self.loc, self.scale, self.turns = loc, scale, turns
        super().__init__(loc.shape[:-1], loc.shape[-1:], validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return circular if self.turns else constraints.independent(constraints.real, 1)

    @property
    def mode(self) -> Tensor:
        return self.loc

    def log_prob(self, value: Tensor) -> Tensor:
        away = wrap(value - self.loc) if self.turns else value - self.loc
        return Normal(0.0, self.scale).log_prob(away).sum(-1)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        noise = torch.randn((*sample_shape, *self.loc.shape), dtype=self.loc.dtype)
        return self.loc + self.scale * noise


@pytest.mark.parametrize("turns", [False, True])
def test_ends_from_draws_say_their_error(turns: bool) -> None:
    """The reported errors equal the actual errors of the ends over 150 items, also for an angle too narrow for a
    grid."""
    torch.manual_seed(0)
    loc, scale = torch.full((150, 1), 2.0, dtype=torch.float64), 1e-7 if turns else 3.0
    found = central_interval(Sampled(loc, scale, turns), 0.9)
    assert depends_on_draws(found)
    for end, error, place in ((found.low, found.low_error, 0.05), (found.high, found.high_error, 0.95)):
        residual = (end - (2.0 + scale * stats.norm.ppf(place))) / error
        assert abs(residual.mean().item()) < 0.35
        assert 0.75 < residual.std().item() < 1.3
        exact = scale * math.sqrt(0.05 * 0.95 / DRAWS) / stats.norm.pdf(stats.norm.ppf(place))
        assert error.mean().item() == pytest.approx(exact, rel=0.1)
    beyond = central_interval(Sampled(loc[:2], scale, turns), 0.9999)
    assert (beyond.low_error == math.inf).all()


def test_of_what_is_not_a_number_is_none() -> None:
    broken = column(0.0, math.nan)
    for density in (
        Independent(Normal(broken, torch.ones_like(broken), validate_args=False), 1, validate_args=False),
        Independent(Cauchy(broken, torch.ones_like(broken), validate_args=False), 1, validate_args=False),
        VonMises(broken, torch.ones_like(broken)),
    ):
        found = central_interval(density, 0.9)
        assert found.low[0].isfinite() and found.low[1].isnan() and found.high[1].isnan()


def test_a_part_of_the_circle_has_ends_like_a_line() -> None:
    """Density cos(x)/2 of the elevation of a uniform direction on the sphere."""

    class Elevation(Sampled):
        @property
        def support(self) -> constraints.Constraint:
            return Circular(((-math.pi / 2, math.pi / 2),))

        def log_prob(self, value: Tensor) -> Tensor:
            inside = value.abs() <= math.pi / 2
            return torch.where(inside, (value.cos().clamp(min=1e-12) / 2).log(), -math.inf).sum(-1)

        def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
            return (2 * torch.rand((*sample_shape, *self.loc.shape), dtype=self.loc.dtype) - 1).asin()

    torch.manual_seed(0)
    found = central_interval(Elevation(torch.zeros(3, 1, dtype=torch.float64), 1.0), 0.9)
    atol = 5 * found.high_error.max().item() if depends_on_draws(found) else 1e-3
    np.testing.assert_allclose(found.high.numpy(), math.asin(0.9), atol=atol)
    np.testing.assert_allclose(found.low.numpy(), -math.asin(0.9), atol=atol)
