import math

import mpmath
import numpy as np
import pytest
import torch
from scipy import integrate, special, stats
from torch.distributions import Categorical, Distribution, Independent, MultivariateNormal, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.circular import circular, wrap
from framework.distributions.density import Mixture
from framework.distributions.normals import IndependentNormals, JointNormal
from framework.distributions.protocol import estimate, marginal, median, tempered_density
from framework.distributions.tempering import CircularPower, temper
from framework.errors import UserError
from framework.target import Target
from framework.testing.metrics import Cardioid
from framework.testing.quadrature import cells
from plugins.density_head.latent.monte_carlo import SampledMixture

ANGLE, ANGLES = Target("angle", ("azimuth",)), Target("angle", ("azimuth", "elevation", "tilt"))
REALS, CLASSES = Target("real", ("x", "y", "z")), Target("class", ("a", "b", "c"))


def hot(value):
    return torch.tensor(value, dtype=torch.float64)


def head(name, target, **config):
    torch.manual_seed(0)
    return build("density_head", resolve("density_head", {"name": name, **config}), target=target).eval()


def density_of(name, target, batch=(4,), dtype=torch.float64, scale=1.0, **config):
    made = head(name, target, **config).to(dtype)
    torch.manual_seed(1)
    with torch.no_grad():
        return made(scale * torch.randn(*batch, made.size, dtype=dtype))


HEADS = [
    pytest.param("von_mises", ANGLE, {}, id="one von Mises"),
    pytest.param("von_mises", ANGLES, {}, id="three von Mises"),
    pytest.param("mixture", ANGLE, {}, id="mixture"),
    pytest.param("matrix_fisher", ANGLES, {}, id="matrix Fisher"),
    pytest.param("gaussian", REALS, {}, id="Gaussian"),
    pytest.param("gaussian", REALS, {"covariance": "full"}, id="full Gaussian"),
    pytest.param("categorical", CLASSES, {}, id="classes"),
    pytest.param("uniform_floor", ANGLE, {}, id="floor of an angle"),
    pytest.param("uniform_floor", CLASSES, {"component": "categorical"}, id="floor of classes"),
    pytest.param("scvae", ANGLE, {"samples": 40, "hidden": 8}, id="simplified CVAE"),
    pytest.param("scvae", ANGLE, {"samples": 40, "hidden": 8, "tolerance": 0.1}, id="with a tolerance"),
    pytest.param("cvae", ANGLE, {"samples": 40, "hidden": 8}, id="CVAE"),
]


@pytest.mark.parametrize("name, target, config", HEADS)
def test_every_heads_density_has_a_temperature(name, target, config):
    """Tempered densities: temperature 1 is the density itself; others keep shape and type, integrate to 1 and have
    gradients."""
    for dtype in (torch.float32, torch.float64):
        density = density_of(name, target, dtype=dtype, **config)
        assert temper(density, hot(1.0)) is density
        value = density.sample((3,))
        for temperature in (0.3, 7.0):
            warm = temper(density, hot(temperature))
            assert (warm.batch_shape, warm.event_shape) == (density.batch_shape, density.event_shape)
            found = warm.log_prob(value)
            assert found.shape == (3, 4) and found.isfinite().all()
            assert found.dtype == density.log_prob(value).dtype
            assert warm.sample((2,)).shape == (2, 4, *density.event_shape)
    if target.kind != "real" and name != "cvae":  # whose log_prob is a bound
        _, mass = cells(temper(density, hot(3.0)))
        total = mass.sum(tuple(range(len(mass.shape) - 1)))
        limit = 1e-6 if config.get("tolerance") is None else 0.05
        torch.testing.assert_close(total, torch.ones(4).double(), rtol=0, atol=limit)
    # derivatives in log T, first and second, against differences
    at = hot(0.4)

    def total_of(logarithm):
        return temper(density, logarithm.exp()).log_prob(value).double().sum()

    here = at.clone().requires_grad_()
    (slope,) = torch.autograd.grad(total_of(here), here, create_graph=True)
    (bend,) = torch.autograd.grad(slope, here)
    step = 1e-4
    with torch.no_grad():
        ahead, middle, behind = (total_of(at + sign * step) for sign in (1, 0, -1))
    if config.get("tolerance") is None:  # whose values come in rounds
        assert slope.item() == pytest.approx((ahead - behind).item() / (2 * step), rel=1e-5, abs=1e-5)
        curvature = (ahead - 2 * middle + behind).item() / step**2
        assert bend.item() == pytest.approx(curvature, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("temperature", [0.01, 0.5, 1.0, 20.0])
def test_classes_agree_with_fifty_digits(temperature):
    rows = [[0.0, 0.0, 0.0], [1e4, -1e4, 0.0], [-1e4, -1e4, -1e4 + 1], [3.0, -2.0, 1e-3], [0.5, 0.5, -1e4]]
    for dtype, limit in ((torch.float32, 1e-6), (torch.float64, 1e-13)):
        logits = torch.tensor(rows, dtype=dtype)
        found = temper(Categorical(logits=logits.log_softmax(-1), validate_args=False), hot(temperature))
        for row, one in zip(logits.double().tolist(), found.logits.double().tolist(), strict=True):
            with mpmath.workdps(50):
                heights = [(mpmath.mpf(number) - max(row)) / mpmath.mpf(temperature) for number in row]
                total = mpmath.log(mpmath.fsum(mpmath.e**height for height in heights))
                wanted = [float(height - total) for height in heights]
            # a log-density of -1e-9 is as good as 0: against 1 nat
            np.testing.assert_allclose(one, wanted, rtol=limit, atol=limit)


def test_classes_that_are_ruled_out_stay_so():
    logits = torch.tensor([[0.0, -math.inf, -math.inf], [-math.inf, 0.0, 0.0]])
    warm = hot(3.0).requires_grad_()
    found = temper(Categorical(logits=logits, validate_args=False), warm)
    wanted = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.5, 0.5]])
    torch.testing.assert_close(found.probs.detach(), wanted)
    (slope,) = torch.autograd.grad(found.log_prob(torch.tensor([0, 1])).sum(), warm)
    assert slope.item() == 0


@pytest.mark.parametrize("temperature", [0.05, 0.7, 20.0])
def test_normals_have_the_power_of_their_density(temperature):
    torch.manual_seed(2)
    place, root = torch.randn(3, 2).double(), torch.randn(3, 2, 2).double().tril() + 2 * torch.eye(2)
    spread = torch.rand(3, 2).double() + 0.1
    densities = {
        "many": MultivariateNormal(place, scale_tril=root, validate_args=False),
        "apart": Independent(Normal(place, spread, validate_args=False), 1, validate_args=False),
    }
    value = torch.randn(5, 3, 2).double()
    for density in densities.values():
        warm = temper(density, hot(temperature))
        # log p / T up to one constant an item
        gap = warm.log_prob(value) - density.log_prob(value) / temperature
        torch.testing.assert_close(gap, gap[:1].expand_as(gap), rtol=0, atol=1e-9)
    flat = temper(Normal(place, spread, validate_args=False), hot(temperature))
    wanted = stats.norm(place.numpy(), spread.numpy() * temperature**0.5).logpdf(value.numpy())
    np.testing.assert_allclose(flat.log_prob(value).numpy(), wanted, rtol=1e-12)


def test_the_power_of_von_mises_full_gaussians_and_rotations():
    for name, target, config in (
        ("von_mises", ANGLES, {}),
        ("gaussian", REALS, {"covariance": "full"}),
        ("gaussian", REALS, {}),
    ):
        density = density_of(name, target, **config)
        value = density.sample((6,))
        gap = temper(density, hot(2.5)).log_prob(value) - density.log_prob(value) / 2.5
        torch.testing.assert_close(gap, gap[:1].expand_as(gap), rtol=0, atol=1e-9)
    rotations = density_of("matrix_fisher", ANGLES)
    value = rotations.sample((6,))
    chart = value[..., 1].cos().log()
    of_rotation = rotations.log_prob(value) - chart
    gap = temper(rotations, hot(2.5)).log_prob(value) - chart - of_rotation / 2.5
    torch.testing.assert_close(gap, gap[:1].expand_as(gap), rtol=0, atol=1e-9)


def test_a_mixture_over_classes_is_tempered_as_a_whole():
    logits = torch.randn(5, 4, 3).double()
    mixture = Mixture(torch.randn(5, 4), Categorical(logits=logits, validate_args=False))
    probabilities = mixture.log_prob(mixture.enumerate_support()).exp().T.numpy()
    wanted = special.softmax(np.log(probabilities) / 1.7, -1)
    found = temper(mixture, hot(1.7))
    assert isinstance(found, Categorical)
    np.testing.assert_allclose(found.probs.numpy(), wanted, rtol=1e-12)


def test_a_mixture_over_numbers_keeps_its_weights():
    components = Independent(
        Normal(torch.randn(5, 3, 1).double(), torch.rand(5, 3, 1).double() + 0.2, validate_args=False), 1
    )
    weights = torch.randn(5, 3).double()
    warm = temper(Mixture(weights, components), hot(4.0))
    for row in range(5):
        scale = 2 * components.base_dist.scale[row, :, 0].numpy()
        place, share = components.base_dist.loc[row, :, 0].numpy(), special.softmax(weights[row].numpy())
        wanted = math.log((share * stats.norm(place, scale).pdf(0.3)).sum())
        found = warm.log_prob(torch.full((5, 1), 0.3, dtype=torch.float64))[row].item()
        assert found == pytest.approx(wanted, rel=1e-12)


def test_a_sampled_mixture_stays_an_estimate():
    density = density_of("scvae", ANGLE, samples=40, hidden=8)
    warm = temper(density, hot(2.0))
    assert isinstance(warm, SampledMixture) and warm.replicates == density.replicates
    found = estimate(warm, warm.sample())
    assert (found.standard_error > 0).all() and (found.samples == 40).all()
    latent = density_of("scvae", ANGLE, samples=40, hidden=8, tolerance=0.05)
    mixture = latent.mixture  # asked for before: the tempered one has its own
    warm = temper(latent, hot(2.0))
    assert warm.mixture is not mixture and warm.points is latent.points
    wanted = tempered_density(mixture, hot(2.0)).log_prob(warm.mode)
    torch.testing.assert_close(warm.mixture.log_prob(warm.mode), wanted)


def test_the_bound_of_a_cvae_is_that_of_its_tempered_components():
    """Weight by weight: log p(φ|z)^(1/T) + log p(z) - log q(z), of points that are the untempered density's."""
    density = density_of("cvae", ANGLE, batch=(3,), samples=40, hidden=8)
    value = torch.tensor([[0.2], [1.0], [-2.0]], dtype=torch.float64)
    networks, noise = density.latent, density.points(torch.arange(3), 0, density.effort.first).flatten(0, 1)
    posterior = networks.posterior(value)
    z = posterior.at(noise)
    component = networks.component(networks.decode(z))
    cooled = type(component)(component.location, component.concentration / 3)
    weights = cooled.log_prob(value) + networks.prior.log_prob(z) - posterior.log_prob_at(noise)
    wanted = torch.logsumexp(weights, 0) - math.log(len(noise))
    torch.testing.assert_close(temper(density, hot(3.0)).log_prob(value), wanted)


def test_stacked_and_reshaped_are_tempered_inside():
    first, second = Cardioid(torch.randn(4, 1).double()), Cardioid(torch.randn(4, 1).double())
    value = torch.randn(4, 1).double()
    stacked = temper(Stacked([first, second]), hot(3.0)).log_prob(value.unsqueeze(1))
    torch.testing.assert_close(stacked[:, 1], temper(second, hot(3.0)).log_prob(value))
    folded = temper(Reshaped(first, (2, 2)), hot(3.0)).log_prob(value.reshape(2, 2, 1))
    torch.testing.assert_close(folded.reshape(4), temper(first, hot(3.0)).log_prob(value))


@pytest.mark.parametrize("temperature", [0.05, 0.4, 2.0, 20.0])
def test_any_density_of_one_angle_is_normalised_on_a_grid(temperature):
    """Compare with adaptive quadrature; powers below 1 have a cusp at the zero of the cardioid."""
    place = torch.tensor([[0.0], [2.9], [-40.0]]).double()
    warm = temper(Cardioid(place), hot(temperature))
    assert isinstance(warm, CircularPower) and warm.support is circular
    power = 1 / temperature

    def height(angle):
        return (1 + math.cos(angle)) ** power

    total = 2 * integrate.quad(height, 0, math.pi, epsabs=0, epsrel=1e-11, limit=500)[0]
    angle = torch.tensor([[0.5], [-1.0], [2.0]]).double()
    wanted = [math.log(height(a - m) / total) for a, m in zip(angle[:, 0], place[:, 0], strict=True)]
    limit = {20.0: 1e-4, 2.0: 1e-5}.get(temperature, 1e-6)  # the cusp
    np.testing.assert_allclose(warm.log_prob(angle).numpy(), wanted, atol=limit)

    def surprise(angle):
        return -height(angle) / total * math.log(height(angle) / total)

    entropy = 2 * integrate.quad(surprise, 0, math.pi - 1e-9, limit=500)[0]
    np.testing.assert_allclose(warm.entropy().numpy(), entropy, atol=limit)
    assert torch.equal(warm.mode, place)
    torch.manual_seed(3)
    drawn = wrap(warm.sample((20_000,)) - place)[..., 0].numpy()
    axis = np.linspace(-math.pi, math.pi, 20_001)
    cumulative = integrate.cumulative_trapezoid((1 + np.cos(axis)) ** power / total, axis, initial=0)
    for row in range(3):
        assert stats.kstest(drawn[:, row], lambda x: np.interp(x, axis, cumulative)).pvalue > 1e-3


class OneAngle(Distribution):
    """A stranger's density of one angle, of which nothing is registered: Σ_k w_k of von Mises or cusped components."""

    arg_constraints = {}  # noqa: RUF012 - as torch has it
    support = circular

    def __init__(self, place, concentration, weights, cusp, dtype):
        self.place, self.concentration = torch.tensor(place).double(), torch.tensor(concentration).double()
        self.log_weights = torch.tensor(weights).double().log_softmax(-1)
        self.cusp, self.dtype = cusp, dtype
        super().__init__(torch.Size((2,)), torch.Size((1,)), validate_args=False)

    def log_prob(self, value):
        apart = wrap(value.double() - self.place)  # (*sample, 2, K)
        if self.cusp:  # exp(-κ d) on the circle
            scale = torch.log(self.concentration / 2) - torch.log1p(-(-math.pi * self.concentration).exp())
            parts = scale - self.concentration * apart.abs()
        else:
            norm = torch.special.i0e(self.concentration).log() + math.log(2 * math.pi)
            parts = -2 * self.concentration * (apart / 2).sin().square() - norm
        return torch.logsumexp(self.log_weights + parts, -1).to(self.dtype)

    @property
    def mode(self):
        height = self.concentration.log() * (1.0 if self.cusp else 0.5)
        highest = (self.log_weights + height).argmax()
        return self.place[highest].expand(2, 1).to(self.dtype)

    def sample(self, sample_shape=()):
        return self.mode.expand(*sample_shape, 2, 1).clone()


def quadrature(density, temperature):
    """The distribution function of p^(1/T) and its entropy, float64 NumPy, on nodes about each peak."""
    steps = np.concatenate([[0.0], np.logspace(-11, math.log10(math.pi), 60_001)])
    steps = np.concatenate([-steps[:0:-1], steps])
    nodes = [wrap(torch.tensor(float(place) + steps)) for place in density.place]
    nodes = torch.cat([*nodes, torch.tensor([-math.pi, math.pi]).double()]).unique()
    exact = OneAngle([0.0], [1.0], [0.0], density.cusp, torch.float64)
    exact.__dict__.update(density.__dict__ | {"dtype": torch.float64})
    log_power = exact.log_prob(nodes.reshape(-1, 1, 1).expand(-1, 2, 1))[:, 0].numpy() / temperature
    nodes, top = nodes.numpy(), log_power.max()
    height = np.exp(log_power - top)
    total = integrate.trapezoid(height, nodes)
    surprise = np.where(height > 0, height * (log_power - top), 0.0)
    entropy = math.log(total) - integrate.trapezoid(surprise, nodes) / total
    return nodes, integrate.cumulative_trapezoid(height / total, nodes, initial=0), entropy


POWERS = {
    **{f"concentration {kappa:g}": ([0.3], [kappa], [0.0], False) for kappa in (1e-3, 1.0, 30.0, 3e2, 1e3)},
    **{f"concentration {kappa:g}": ([-3.1], [kappa], [0.0], False) for kappa in (9e3, 8e4, 1e6, 1e8, 1e12)},
    "a low and a high peak": ([0.3, 2.5], [1e4, 1e4], [0.0, -4.0], False),
    "sharp beside broad": ([-2.0, 1.0], [9e4, 2.0], [0.0, 1.0], False),
    "sharp between the grid's angles": ([0.3, 2.0014], [1e4, 1e6], [2.5, 0.0], False),
    "five": ([-3.0, -1.5, 0.0, 1.0, 2.2], [1e3, 1e4, 10.0, 1e5, 50.0], [0.0] * 5, False),
    "a cusp": ([0.3], [5.0], [0.0], True),
    "cusps": ([0.3, -2.0], [5.0, 40.0], [0.0, 0.0], True),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", POWERS)
@pytest.mark.parametrize("temperature", [0.4, 3.0])
def test_draws_of_a_power_are_those_of_its_density(kind, dtype, temperature, monkeypatch):
    """Draws at equally spaced probabilities are the quantiles; compare their spread and entropy with quadrature."""
    density = OneAngle(*POWERS[kind], dtype)
    if dtype == torch.float32 and density.concentration.max() > 1e6:
        pytest.skip("float32 shows no angle to a tenth of its standard deviation")
    power = CircularPower(density, hot(temperature))
    count = 20_000
    shares = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    monkeypatch.setattr(torch, "rand", lambda *shape, **_: shares.unsqueeze(-1).expand(shape))
    drawn = power.sample((count,))[..., 0]
    assert drawn.dtype == dtype
    nodes, cdf, entropy = quadrature(density, temperature)
    found = np.sort(drawn[:, 1].double().numpy())
    # the draws begin at the mode: in order of the angle they are turned by one constant
    gap = (np.interp(found, nodes, cdf) - shares.numpy() + 0.5) % 1
    assert np.ptp(gap) < (1e-3 if len(density.place) > 1 or dtype == torch.float32 else 1e-5)
    wanted = np.interp(shares.numpy(), cdf, nodes)
    for place in density.place.tolist():
        near = [wrap(torch.as_tensor(each).double() - place).numpy() for each in (found, wanted)]
        near = [each[np.abs(each) < 0.3] for each in near]
        if len(near[1]) > 400:
            assert len(near[0]) == pytest.approx(len(near[1]), abs=10)
            assert near[0].var() == pytest.approx(
                near[1].var(), rel=2e-3 if len(density.place) == 1 else 0.02
            )
    torch.testing.assert_close(power.entropy()[0].item(), entropy, rtol=0, atol=3e-4)
    at = -power.log_prob(drawn.unsqueeze(-1))[:, 1].double().mean().item()
    assert at == pytest.approx(entropy, abs=2e-3)


class Narrow(Cardioid):
    """Density proportional to (1 + cos)^10000000."""

    def log_prob(self, value):
        return 1e7 * super().log_prob(value)


def test_a_power_too_narrow_for_any_grid_gets_a_sentence():
    density = Narrow(torch.tensor([[0.3]]).double())
    assert temper(density, hot(50.0)).log_prob(density.mode).isfinite().all()
    with pytest.raises(UserError, match="too narrow for a grid of 32768 angles"):
        temper(density, hot(1e-3))


def test_an_empty_batch_of_densities_is_tempered():
    for density in (Cardioid(torch.zeros(0, 1)), Categorical(logits=torch.zeros(0, 3), validate_args=False)):
        warm = temper(density, hot(2.0))
        assert warm.log_prob(density.sample()).shape == (0,)
        assert warm.sample((3,)).shape == (3, 0, *density.event_shape)


def test_what_has_no_power_and_bad_temperatures_get_a_sentence():
    with pytest.raises(UserError, match=r"The temperature of Cardioid over \(3,\) numbers cannot be changed"):
        temper(Cardioid(torch.zeros(2, 3)), hot(2.0))
    for bad in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="expected a finite number above 0"):
            temper(Cardioid(torch.zeros(2, 1)), hot(bad))


def test_of_classes_every_mixture_is_tempered_as_a_whole_and_none_changes_its_likeliest():
    shares = torch.tensor([[[0.99, 0.005, 0.005], [0.2, 0.41, 0.39], [0.2, 0.41, 0.39]]], dtype=torch.float64)
    components = Categorical(logits=shares.log(), validate_args=False)
    weights = torch.zeros(1, 3, dtype=torch.float64)
    wanted = special.softmax(np.log(shares.mean(1).numpy()) / 0.2, -1)
    for density in (Mixture(weights, components), SampledMixture(weights, components, 3)):
        found = temper(density, hot(0.2))
        assert found.mode.item() == density.mode.item() == 0
        np.testing.assert_allclose(found.probs.numpy(), wanted, rtol=1e-12)
        assert (estimate(found, found.mode).standard_error > 0) == isinstance(density, SampledMixture)


@pytest.mark.parametrize(
    "kelvin", [0.2, *(pytest.param(kelvin, marks=pytest.mark.slow) for kelvin in (1.0, 3.0))]
)
@pytest.mark.parametrize("name", ["scvae", "cvae"])
@pytest.mark.parametrize("more", [{}, {"tolerance": 0.1}], ids=["samples", "tolerance"])
def test_of_classes_latent_densities_keep_their_likeliest(name, kelvin, more):
    density = density_of(name, CLASSES, samples=40, hidden=8, scale=3.0, component="categorical", **more)
    found = temper(density, hot(kelvin))
    log_prob = torch.stack([found.log_prob(label) for label in found.enumerate_support()])
    if kelvin != 1:  # else it is the density itself, whose bounds of few samples do not sum to 1
        nothing = torch.zeros(4, dtype=torch.float64)
        torch.testing.assert_close(log_prob.logsumexp(0), nothing, rtol=0, atol=1e-9)
    own = torch.stack([density.log_prob(label) for label in density.enumerate_support()])
    assert (log_prob.argmax(0) == own.argmax(0)).all()
    kelvin = hot(kelvin).requires_grad_()
    temper(density, kelvin).log_prob(density.enumerate_support()[0]).sum().backward()
    assert kelvin.grad.isfinite()


@pytest.mark.parametrize("batch", [(3,), (0,), (2, 0), (2, 3)], ids=str)
@pytest.mark.parametrize("joint", [False, True], ids=["independent", "joint"])
def test_normals_stay_normals_whatever_is_asked_of_them(joint, batch):
    """The median equals the mean exactly, and no protocol function fails for an empty batch."""
    torch.manual_seed(0)
    mean = 1000 * torch.randn(*batch, 2).double()
    scale = torch.rand(*batch, 2).double() + 0.5
    root = torch.diag_embed(scale) + torch.tensor([[0.0, 0.0], [0.7, 0.0]]).double()
    density = JointNormal(mean, root) if joint else IndependentNormals(mean, scale)
    whole = root @ root.mT if joint else torch.diag_embed(scale.square())
    for made, middle, spread in (
        (density, mean, whole),
        (temper(density, hot(2.5)), mean, 2.5 * whole),
        (marginal(density, 1), mean[..., 1:], whole[..., 1:, 1:]),
        (marginal(temper(density, hot(2.5)), 0), mean[..., :1], 2.5 * whole[..., :1, :1]),
        (temper(marginal(density, 0), hot(0.5)), mean[..., :1], 0.5 * whole[..., :1, :1]),
    ):
        assert torch.equal(median(made, 100), middle)
        value = middle + 0.3
        found = made.log_prob(value)
        assert found.shape == torch.Size(batch)
        for index in np.ndindex(*batch):
            wanted = stats.multivariate_normal(middle[index].numpy(), spread[index].numpy()).logpdf(
                value[index]
            )
            assert found[index].item() == pytest.approx(wanted, rel=1e-10)
