"""Modes of mixtures, compared with the highest density by brute force."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from framework.distributions.affine import AffineDensity
from framework.distributions.batch_shapes import Stacked
from framework.distributions.density import Mixture
from framework.distributions.highest import highest
from framework.distributions.many_components import FEWEST, likeliest_modes
from framework.distributions.tempering import CircularPower
from plugins.density_head.gaussian.density import Gaussian
from plugins.density_head.projected_normal.density import ProjectedNormal
from plugins.density_head.von_mises.density import VonMises

ITEMS = 40
KINDS = ("angles", "reals", "torch's normals", "correlated reals")


def mixture(kind: str, numbers: int, components: int, seed: int, dtype: torch.dtype) -> Mixture:
    """Return mixtures whose components are far apart to equal, broad to narrow, and of unequal weights."""
    generator = torch.Generator().manual_seed(seed)

    def drawn(*shape: int) -> Tensor:
        return torch.randn(ITEMS, *shape, dtype=torch.float64, generator=generator)

    center = 2 * drawn(1, 1).abs() * drawn(components, numbers)
    log_scale = 1.2 * drawn(components, numbers) - 1
    weights = drawn(components).to(dtype)
    center, scale = center.to(dtype), log_scale.exp().to(dtype)
    if kind == "angles":
        return Mixture(weights, VonMises(center, scale.square().reciprocal()))
    if kind == "reals":
        return Mixture(weights, Gaussian(center, scale))
    if kind == "torch's normals":
        return Mixture(
            weights, Independent(Normal(center, scale, validate_args=False), 1, validate_args=False)
        )
    coefficients = drawn(components, numbers, numbers).tril(-1).to(dtype)
    return Mixture(weights, Gaussian(center, scale, coefficients))


def everywhere(density: Distribution, kind: str) -> Tensor:
    """Return the largest log-density on a grid and near the components, (items,)."""
    ends, points = (math.pi, 3001) if kind == "angles" else (12.0, 6001)
    numbers = density.event_shape[0]
    axis = torch.linspace(-ends, ends, points if numbers == 1 else 101, dtype=torch.float64)
    grid = torch.cartesian_prod(*[axis] * numbers).reshape(-1, 1, numbers).expand(-1, ITEMS, numbers)
    with torch.no_grad():
        return density.log_prob(grid).amax(0)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    st.sampled_from(KINDS),
    st.sampled_from([1, 2, 4]),
    st.integers(1, 6),
    st.integers(0, 2**31),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_the_mode_is_no_lower_than_any_component_s_nor_than_what_is_near(
    kind: str, numbers: int, components: int, seed: int, dtype: torch.dtype
) -> None:
    density = mixture(kind, numbers, components, seed, dtype)
    mode = density.mode
    assert mode.shape == (ITEMS, numbers) and mode.dtype == dtype
    height = density.log_prob(mode)
    modes = density.components.mode.movedim(1, 0)
    assert (height >= density.log_prob(modes)).all()
    if components == 1:
        assert torch.equal(mode, modes[0])
        return
    # correlated numbers are climbed in small steps: they promise no more than not to be lower
    if kind != "correlated reals" or numbers == 1:
        wide = mixture(kind, numbers, components, seed, torch.float64)
        directions = torch.randn(
            64, 1, numbers, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
        )
        limit = 1e-5 if numbers == 1 else 2e-3  # nats; the steps that it takes are counted
        for size in (1e-4, 1e-2, 0.1):
            near = wide.log_prob(mode.double() + size * directions)
            assert (near - wide.log_prob(mode.double()) < limit).all()


@pytest.mark.parametrize("numbers", [1, 2])
@pytest.mark.parametrize("kind", KINDS[:2])
def test_hardly_any_density_is_higher_elsewhere(kind: str, numbers: int) -> None:
    """Compare the modes of mixtures of five with a grid; the best mode of a component is often 1e-3 nats too low."""
    missed = before = 0
    seeds = range(10 if numbers == 1 else 3)
    for seed in seeds:
        density = mixture(kind, numbers, 5, seed, torch.float64)
        highest = everywhere(density, kind)
        missed += int((highest - density.log_prob(density.mode) > 1e-6).sum())
        modes = density.components.mode.movedim(1, 0)
        before += int((highest - density.log_prob(modes).amax(0) > 1e-3).sum())
    assert missed <= (0 if numbers == 1 else 1)
    assert before >= len(seeds)


def nested(structure: str, seed: int) -> Distribution:
    """Return mixtures of densities that have several peaks themselves, (ITEMS,)."""
    generator = torch.Generator().manual_seed(seed)
    center = math.pi * torch.randn(3, ITEMS, 5, 1, dtype=torch.float64, generator=generator)
    width = (0.4 * torch.randn(3, ITEMS, 5, 1, dtype=torch.float64, generator=generator) - 0.5).exp()
    real, equal = structure == "moved", torch.zeros(ITEMS, 5)
    flat = [
        Mixture(equal, Gaussian(one, each) if real else VonMises(one, each**-2))
        for one, each in zip(center, width, strict=True)
    ]
    if structure == "three mixtures":
        return Mixture(torch.zeros(ITEMS, 3), Stacked(flat))
    if structure == "three tempered":
        tempered = [CircularPower(one, torch.tensor(0.7, dtype=torch.float64)) for one in flat]
        return Mixture(torch.zeros(ITEMS, 3), Stacked(tempered))
    if structure == "moved":
        place, scale = torch.randn(
            2, ITEMS, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
        )
        moved = [AffineDensity(one, shift * place, scale.exp()) for shift, one in enumerate(flat)]
        return Mixture(torch.zeros(ITEMS, 3), Stacked(moved))
    inner = Mixture(torch.zeros(ITEMS, 2), Stacked(flat[:2]))
    return Mixture(torch.zeros(ITEMS, 2), Stacked([inner, flat[2]]))


@pytest.mark.parametrize("structure", ["three mixtures", "three tempered", "moved", "mixtures of mixtures"])
def test_humps_of_nested_mixtures_are_highest_together(structure: str) -> None:
    """The second peak of a component can be the highest of the mixture, so the modes of the components do not
    suffice."""
    missed = before = 0
    for seed in range(5):
        density = nested(structure, seed)
        assert isinstance(density, Mixture)
        top = everywhere(density, "reals" if structure == "moved" else "angles")
        missed += int((top - density.log_prob(density.mode) > 1e-3).sum())
        modes = density.components.mode.movedim(1, 0)
        before += int((top - density.log_prob(highest(density, modes)) > 1e-3).sum())
    assert missed <= 1  # of 200: three places are climbed from
    assert before > 3 * missed


@pytest.mark.parametrize("kind", KINDS[:3])
@pytest.mark.parametrize("widths", [(1.0, 1.0), (1e-3, 1e-3), (1e-5, 1e5)])
def test_the_mode_of_very_many_components_is_as_high_as_their_modes(
    kind: str, widths: tuple[float, float]
) -> None:
    """The density at the modes of so many components is interpolated, whether their widths are equal or not."""
    generator = torch.Generator().manual_seed(5)
    weights, place, part = torch.rand(3, 2, FEWEST, dtype=torch.float64, generator=generator)
    low, high = (math.log(width) for width in widths)
    center, scale = (6 * place - 3)[..., None], (low + (high - low) * part).exp()[..., None]
    if kind == "angles":
        components: Distribution = VonMises(center, scale.square().reciprocal())
    elif kind == "reals":
        components = Gaussian(center, scale)
    else:
        components = Independent(Normal(center, scale, validate_args=False), 1, validate_args=False)
    density = Mixture(weights, components)
    modes = components.mode.movedim(1, 0)
    kept = likeliest_modes(components, density.log_weights, modes)
    assert kept is not None and len(kept) < len(modes)
    best = density.log_prob(modes).amax(0)
    assert (density.log_prob(kept).amax(0) >= best - 1e-4).all()
    assert (density.log_prob(density.mode) >= best - 1e-4).all()


def test_two_overlapping_components_have_their_mode_between_them() -> None:
    """Components at ±0.9 standard deviations have one peak at 0, and at ±2 two peaks; also across ±π on the circle."""
    apart = torch.tensor([[[-0.9], [0.9]], [[-2.0], [2.0]]], dtype=torch.float64)
    density = Mixture(torch.zeros(2, 2), Gaussian(apart, torch.ones_like(apart)))
    assert density.mode[0].abs() < 1e-5
    root = torch.tensor(1.0)
    for _ in range(200):  # m = 2 tanh 2m, the fixed point
        root = 2 * torch.tanh(2 * root)
    torch.testing.assert_close(density.mode[1].abs(), root.double().reshape(1), atol=1e-6, rtol=0)
    seam = torch.tensor([[[math.pi - 0.09], [-math.pi + 0.09]]], dtype=torch.float64)
    angle = Mixture(torch.zeros(1, 2), VonMises(seam, torch.full_like(seam, 100.0))).mode
    torch.testing.assert_close(angle.abs(), torch.full_like(angle, math.pi), atol=1e-6, rtol=0)


def test_crossing_ridges_are_highest_where_they_cross() -> None:
    """One component is narrow in the first number and one in the second, so that the peak is near neither mode."""
    center = torch.tensor([[[0.0, 1.0], [1.0, 0.0]]], dtype=torch.float64)
    scale = torch.tensor([[[0.01, 2.0], [2.0, 0.01]]], dtype=torch.float64)
    mode = Mixture(torch.zeros(1, 2), Gaussian(center, scale)).mode
    torch.testing.assert_close(mode, torch.zeros_like(mode), atol=1e-3, rtol=0)


def test_members_that_agree_keep_their_mode_to_the_last_bit() -> None:
    one = VonMises(torch.tensor([[0.3, -3.0]]), torch.tensor([[1e4, 0.0]]))
    assert torch.equal(Mixture(torch.zeros(1, 3), Stacked([one] * 3)).mode, one.mode)


class Silent(Distribution):
    """Normal densities with the scale √½ around `places`, (1, component, number), that know no quadratic bound."""

    arg_constraints = {}  # noqa: RUF012  # pyright: ignore[reportAssignmentType]
    support = Normal.support

    def __init__(self, places: Tensor) -> None:
        self.places = places
        super().__init__(places.shape[:-1], places.shape[-1:], validate_args=False)

    @property
    def mode(self) -> Tensor:
        return self.places

    def log_prob(self, value: Tensor) -> Tensor:
        return -(value - self.places).square().sum(-1)


def test_several_numbers_without_a_slope_keep_the_best_component_s_mode() -> None:
    places = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [1.2, 0.0]]])
    assert torch.equal(Mixture(torch.zeros(1, 3), Silent(places)).mode, torch.tensor([[1.0, 0.0]]))


@pytest.mark.parametrize("places", [(0.0, 0.0), (0.5, -0.5), (3.0, -3.0), (1e6, 1e6 + 1), (0.0, 1.0, 1.2)])
def test_one_number_without_a_slope_is_highest_between_components(places: tuple[float, ...]) -> None:
    """The mode equals that of the same mixture of densities that know their slope."""
    center = torch.tensor(places, dtype=torch.float64).reshape(1, -1, 1)
    weights = torch.arange(len(places), dtype=torch.float64).div(10).reshape(1, -1)
    known = Mixture(weights, Gaussian(center, torch.full_like(center, 0.5**0.5)))
    mode = Mixture(weights, Silent(center)).mode
    torch.testing.assert_close(mode, known.mode, atol=1e-6, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("structure", ["projected normal", "with a narrow peak", "across ±π"])
def test_a_mixture_of_skewed_angles_has_its_mode_between_components(
    structure: str, dtype: torch.dtype
) -> None:
    """Two peaks 15° beside 0 have one maximum together, at 0, where no component has its mode."""
    angles = math.radians(15) * torch.tensor([1.0, -1.0], dtype=torch.float64)
    angles = angles + math.pi if structure == "across ±π" else angles
    mean = 2 * torch.stack([angles.cos(), angles.sin()], -1)[None, :, None].to(dtype)
    density = Mixture(torch.zeros(1, 2, dtype=dtype), ProjectedNormal(mean, torch.zeros_like(mean)))
    if structure == "with a narrow peak":
        peak = VonMises(torch.full((1, 1), 0.5, dtype=dtype), torch.full((1, 1), 1e3, dtype=dtype))
        density = Mixture(torch.tensor([[0.5, -1.5]], dtype=dtype), Stacked([density, peak]))
    axis = torch.linspace(-math.pi, math.pi, 20_001, dtype=torch.float64).to(dtype)
    highest_on_grid = density.log_prob(axis[:, None, None]).amax(0)
    assert (density.log_prob(density.mode) >= highest_on_grid - 1e-6).all()


def test_members_without_a_slope_that_agree_keep_their_mode() -> None:
    mean = torch.tensor([[[1.0, 2.0]], [[-30.0, 0.1]]])
    member = ProjectedNormal(mean, 0.1 * mean)
    assert torch.equal(Mixture(torch.zeros(2, 3), Stacked([member] * 3)).mode, member.mode)
