"""Entropies of densities of one number and of mixtures, compared with a 50-digit reference and brute force."""

import logging
import math
import random

import mpmath
import pytest
import torch
from torch import Tensor
from torch.distributions import Cauchy, Distribution, Independent, MultivariateNormal, Normal, StudentT

from framework.configuration.schema import build, resolve
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.density import Mixture, circular_entropy
from framework.distributions.panels import COARSE, FINE, NODES
from framework.distributions.protocol import marginal
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.density_head.uniform_floor.density import Floored
from plugins.density_head.von_mises.density import VonMises

VIEWPOINT = Target("angle", ("azimuth", "elevation", "tilt"))


def mixture_of(
    logits: list[float], means: list[float], spreads: list[float], kind: type = VonMises
) -> Mixture:
    """Return one item of von Mises densities with these κ, or of normal densities with these σ."""
    mean, spread = (torch.tensor(column, dtype=torch.float64)[None, :, None] for column in (means, spreads))
    parts = VonMises(mean, spread) if kind is VonMises else Independent(Normal(mean, spread), 1)
    return Mixture(torch.tensor([logits], dtype=torch.float64), parts)


def log_peak(kappa: mpmath.mpf) -> mpmath.mpf:
    """Return the largest log-density of a von Mises density, κ - log(2π I0(κ))."""
    if kappa < 1e6:
        return kappa - mpmath.log(2 * mpmath.pi * mpmath.besseli(0, kappa))
    series = 1 + 1 / (8 * kappa) + 9 / (128 * kappa**2) + 225 / (3072 * kappa**3) + 11025 / (98304 * kappa**4)
    return mpmath.log(kappa / (2 * mpmath.pi)) / 2 - mpmath.log(series)


def exact(density: Mixture) -> float:
    """Return -∫ f log f with 50 digits, by Gauss-Legendre quadrature between the centres and multiples of each
    scale."""
    weights, means = density.log_weights[0].exp().tolist(), []
    circular = isinstance(density.components, VonMises)
    parts = density.components if circular else density.components.base_dist
    with mpmath.workdps(50):
        means = [mpmath.mpf(mean) for mean in (parts.location if circular else parts.loc).flatten().tolist()]
        spread = [
            mpmath.mpf(s) for s in (parts.concentration if circular else parts.scale).flatten().tolist()
        ]
        if circular:
            scale, tops = [1 / mpmath.sqrt(s + 1) for s in spread], [log_peak(s) for s in spread]
        else:
            scale, tops = spread, [-mpmath.log(2 * mpmath.pi * s**2) / 2 for s in spread]
        total = mpmath.fsum(weights)

        def fall(x: mpmath.mpf, mean: mpmath.mpf, s: mpmath.mpf) -> mpmath.mpf:
            return 2 * s * mpmath.sin((x - mean) / 2) ** 2 if circular else ((x - mean) / s) ** 2 / 2

        def surprise(x: mpmath.mpf) -> mpmath.mpf:
            terms = zip(weights, means, spread, tops, strict=True)
            f = sum(w / total * mpmath.exp(top - fall(x, mean, s)) for w, mean, s, top in terms if w > 0)
            return -f * mpmath.log(f) if f > 0 else mpmath.mpf(0)

        steps = (0, 1, 2, 3, 4.5, 6, 8, 11, 16)
        cuts = {
            m + side * t * s for m, s in zip(means, scale, strict=True) for t in steps for side in (-1, 1)
        }
        if circular:
            cuts = {cut for cut in cuts if abs(cut) < mpmath.pi} | {-mpmath.pi, mpmath.pi}
        return float(mpmath.quad(surprise, sorted(cuts), method="gauss-legendre", maxdegree=4))


def drawn(seed: int, kind: type, count: int) -> tuple[list[float], list[float], list[float]]:
    """Return mixtures with weights down to 0 and components far apart, close to each other, and at the same place."""
    chance = random.Random(seed)
    low, high = (-3, 30) if kind is VonMises else (-30, 30)
    spreads = [10 ** chance.uniform(low, high) for _ in range(count)]
    if seed % 4 == 0:
        spreads = [spreads[0] * 10 ** chance.uniform(-0.5, 0.5) for _ in range(count)]
    width = 1 / math.sqrt(1 + spreads[0]) if kind is VonMises else spreads[0]
    means = [chance.uniform(-3, 3) for _ in range(count)]
    if seed % 3 == 0:
        means = [means[0] + 3 * width * chance.gauss(0, 1) for _ in range(count)]
    elif seed % 7 == 1:
        means = [means[0]] * count
    logits = [chance.gauss(0, 10 if seed % 5 == 0 else 1) for _ in range(count)]
    if seed % 6 == 5:
        logits[0] = -math.inf
    return logits, means, spreads


@pytest.mark.parametrize("kind", [VonMises, Normal])
@pytest.mark.parametrize("seed", range(12))
def test_of_mixtures_of_any_width_against_50_digits(kind: type, seed: int) -> None:
    density = mixture_of(*drawn(seed, kind, 2 + seed % 3), kind)
    wanted = exact(density)
    assert density.entropy().item() == pytest.approx(wanted, abs=1e-9)
    shapes = (
        Reshaped(density, (1, 1)),
        Mixture(torch.zeros(1, 2).double(), Stacked([density, density])),
        Floored(density, 1e-30) if kind is VonMises else density,
    )
    for same in shapes:
        assert circular_entropy(same).item() == pytest.approx(wanted, abs=1e-9)


def test_of_single_precision_is_right_to_its_rounding() -> None:
    for seed in range(4):
        logits, means, spreads = drawn(seed, VonMises, 3)
        wide = mixture_of(logits, means, spreads)
        parts = VonMises(wide.components.location.float(), wide.components.concentration.float())
        found = Mixture(wide.log_weights.float(), parts)
        same = Mixture(
            found.log_weights.double(), VonMises(parts.location.double(), parts.concentration.double())
        )
        assert found.entropy().dtype == torch.float32
        assert found.entropy().item() == pytest.approx(same.entropy().item(), rel=2e-7, abs=1e-6)


@pytest.mark.parametrize("count", [1, 2, 7, 50])
def test_far_apart_it_is_that_of_the_parts_and_their_weights(count: int) -> None:
    """Return Σ w_k (H_k - log w_k), the entropy of components that do not overlap."""
    mean = torch.linspace(-3, 3, count, dtype=torch.float64).expand(7, count).unsqueeze(-1)
    kappa = torch.logspace(6, 30, 7, dtype=torch.float64)[:, None, None].expand(7, count, 1)
    log_weights = torch.linspace(-20, 0, count, dtype=torch.float64).log_softmax(-1).expand(7, count)
    density = Mixture(log_weights, VonMises(mean, kappa))
    wanted = (log_weights.exp() * (density.components.entropy() - log_weights)).sum(-1)
    torch.testing.assert_close(density.entropy(), wanted, rtol=0, atol=1e-11)


def test_its_gradient_is_that_of_differences() -> None:
    logits, means, spreads = (
        torch.tensor([row], dtype=torch.float64) for row in ([0.3, -0.4], [0.5, 2.0], [30.0, 3.0])
    )

    def entropy(logits: Tensor, means: Tensor, spreads: Tensor) -> Tensor:
        return Mixture(logits, VonMises(means.unsqueeze(-1), spreads.unsqueeze(-1))).entropy()

    inputs = [column.requires_grad_() for column in (logits, means, spreads)]
    assert torch.autograd.gradcheck(entropy, inputs, eps=1e-5, atol=1e-7)


class Strange(Distribution):
    """Third-party density around another density, which provides only torch's own methods and no protocol functions."""

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]

    def __init__(self, inside: Distribution) -> None:
        self.inside = inside
        super().__init__(inside.batch_shape, inside.event_shape, validate_args=False)

    support = property(lambda self: self.inside.support)
    mode = property(lambda self: self.inside.mode)

    def log_prob(self, value: Tensor) -> Tensor:
        return self.inside.log_prob(value)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        return self.inside.sample(sample_shape)


def test_of_a_stranger_it_is_right_or_drawn_and_said(caplog: pytest.LogCaptureFixture) -> None:
    """The entropy needs only log_prob and mode: to 1e-9 for smooth densities, and by draws if a peak is far from the
    mode."""
    smooth = [
        mixture_of([0.0, 0.5], [0.4, 1.5], [20.0, 7.0]),
        mixture_of([0.0, 0.5], [0.4, 1.5], [1.0, 3.0], Normal),
    ]
    for density in smooth:
        found = Mixture(torch.zeros(1, 2).double(), Stacked([Strange(density), Strange(density)])).entropy()
        assert found.item() == pytest.approx(exact(density), abs=1e-9)
    strength = torch.tensor([0.1, 0.999, 1.0], dtype=torch.float64)
    cardioid = Cardioid(torch.tensor([[0.3], [-1.0], [3.0]], dtype=torch.float64), strength)
    torch.testing.assert_close(circular_entropy(cardioid), cardioid.entropy(), rtol=0, atol=1e-9)
    heavy = StudentT(torch.tensor([[3.0]]).double(), 2.0, 1e3)
    heavy = Independent(heavy, 1)
    assert circular_entropy(heavy).item() == pytest.approx(heavy.entropy().item(), abs=1e-6)
    assert not caplog.records
    torch.manual_seed(0)
    hidden = Strange(mixture_of([0.0, 0.5], [0.4, 1.5], [1e-7, 1e-8], Normal))
    with caplog.at_level(logging.WARNING):
        assert circular_entropy(hidden).item() == pytest.approx(exact(hidden.inside), abs=0.15)
        far = Independent(Cauchy(torch.zeros(1, 1).double(), 1.0), 1)
        assert circular_entropy(far).item() == pytest.approx(math.log(4 * math.pi), abs=0.3)
    assert len(caplog.records) == 2 and "1 of 1 densities" in caplog.text


def test_nothing_and_not_a_number() -> None:
    empty = Mixture(torch.zeros(0, 2), VonMises(torch.zeros(0, 2, 1), torch.ones(0, 2, 1)))
    assert empty.entropy().shape == (0,)
    single = mixture_of([0.0, 1.0], [0.0, 2.0], [3.0, 4.0])
    alone = Mixture(
        single.log_weights[0], VonMises(single.components.location[0], single.components.concentration[0])
    )
    assert alone.entropy().shape == () and alone.entropy() == single.entropy()[0]
    broken = mixture_of([0.0, 0.0], [1.0, math.nan], [3.0, 4.0])
    assert broken.entropy().isnan().all()


def test_of_several_angles_only_overlap_is_left_to_chance() -> None:
    """Separate components are exact to the last digits, overlapping ones to the error of the draws."""
    torch.manual_seed(1)
    mean = torch.tensor([[[0.0, 1.0, 2.0], [2.0, -1.0, 0.0]]], dtype=torch.float64)
    for kappa in (1e6, 1e14, 1e30):
        density = Mixture(torch.tensor([[0.0, 1.0]]).double(), VonMises(mean, torch.full_like(mean, kappa)))
        wanted = (density.log_weights.exp() * (density.components.entropy() - density.log_weights)).sum(-1)
        torch.testing.assert_close(density.entropy(), wanted, rtol=0, atol=1e-12)
    loc = torch.tensor([[[0.0, 0.0], [1.5, 0.5]]], dtype=torch.float64)
    scale = torch.eye(2).double()
    density = Mixture(torch.zeros(1, 2).double(), MultivariateNormal(loc, scale_tril=scale))
    axis = torch.linspace(-9, 10, 800, dtype=torch.float64)
    log_prob = density.log_prob(torch.cartesian_prod(axis, axis).unsqueeze(1))
    wanted = -(log_prob.exp() * log_prob).sum().item() * (19 / 799) ** 2
    assert density.entropy().item() == pytest.approx(wanted, abs=0.04)


def test_the_nodes_are_kronrod_s() -> None:
    """The Kronrod rule is exact for polynomials of degree 22, and Gauss's rule for degree 13 (Piessens et al. 1983)."""
    for degree in range(24):
        wanted = 2 / (degree + 1) if degree % 2 == 0 else 0.0
        assert (FINE @ NODES**degree).item() == pytest.approx(wanted, abs=1e-15)
        if degree < 14:
            assert (COARSE @ NODES**degree).item() == pytest.approx(wanted, abs=1e-15)


def test_on_a_part_of_the_circle_with_a_logarithm_at_its_ends() -> None:
    """Elevations of uniform rotations have the density cos(e)/2 and the entropy log 2 - E log cos e = 1."""
    head = build("density_head", resolve("density_head", "matrix_fisher"), target=VIEWPOINT)
    joint = head(torch.zeros(2, 9, dtype=torch.float64))
    elevation = marginal(joint, 1)
    both = Mixture(torch.zeros(2, 2).double(), Stacked([elevation, elevation]))
    for density in (elevation, both):
        assert density.entropy().tolist() == pytest.approx([1.0, 1.0], abs=1e-9)


@pytest.mark.parametrize(
    "kind", [pytest.param(VonMises, id="angle", marks=pytest.mark.slow), pytest.param(Normal, id="real")]
)
def test_of_more_peaks_than_can_be_compared_draws_tell_it(
    kind: type, caplog: pytest.LogCaptureFixture
) -> None:
    """The entropy needs no array of all pairs of components, which would take 5 GB for 25,000 components."""
    count = 25_000
    spread = 4.0 if kind is VonMises else 0.5
    whole = mixture_of([0.0] * count, [-1.0, 1.5] * (count // 2), [spread] * count, kind)
    pair = mixture_of([0.0, 0.0], [-1.0, 1.5], [spread] * 2, kind)
    torch.manual_seed(0)
    with caplog.at_level(logging.WARNING):
        found = whole.entropy()
    assert "means over 1024 draws" in caplog.text
    torch.testing.assert_close(found, pair.entropy(), rtol=0, atol=0.1)


@pytest.mark.parametrize("kind", [VonMises, Normal], ids=["angle", "real"])
def test_drawn_entropies_have_the_gradient_of_the_entropy(kind: type) -> None:
    """Compare the gradients for two peaks and for many copies of them; -log_prob at fixed draws would have a mean
    gradient of 0."""
    gradients = []
    for count in (2, 6000):
        spread = torch.tensor(4.0 if kind is VonMises else 0.5, dtype=torch.float64, requires_grad=True)
        mean = torch.tensor([-1.0, 1.5], dtype=torch.float64).repeat(count // 2)[None, :, None]
        width = spread.expand(mean.shape)
        parts = VonMises(mean, width) if kind is VonMises else Independent(Normal(mean, width), 1)
        torch.manual_seed(0)
        Mixture(torch.zeros(1, count, dtype=torch.float64), parts).entropy().sum().backward()
        gradients.append(spread.grad.item())
    exact, drawn = gradients
    assert drawn == pytest.approx(exact, rel=0.15)
