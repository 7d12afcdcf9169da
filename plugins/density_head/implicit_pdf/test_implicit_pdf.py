import math

import pytest
import torch
from scipy import stats

from framework.configuration.schema import build, resolve
from framework.distributions.protocol import marginal
from framework.errors import ConfigError
from framework.geometry import quaternions
from framework.geometry.rotation_grid import centres
from framework.geometry.symmetry import draw_members, draw_noise, log_blurred, noise_concentration
from framework.heads.viewpoints import VOLUME
from framework.target import Target
from plugins.density_head.implicit_pdf.density import CellDensity
from plugins.density_head.implicit_pdf.rows import COARSE, TARGET


def make(**settings):
    config = resolve("density_head", {"name": "implicit_pdf", **COARSE, **settings})
    return build("density_head", config, target=TARGET)


def random_density(batch=(), cells=576, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return CellDensity(torch.log_softmax(3 * torch.randn(*batch, cells, generator=generator).double(), -1))


def random_viewpoints(count):
    turn = torch.randn(count, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return quaternions.to_viewpoint(turn / turn.norm(dim=-1, keepdim=True))


def test_the_density_integrates_to_one_over_uniform_rotations():
    density = random_density()
    angles = random_viewpoints(400_000)
    of_rotation = (density.log_prob(angles) - angles[:, 1].cos().log() + math.log(VOLUME)).exp()
    assert abs(of_rotation.mean() - 1) < 5 * of_rotation.std() / 400_000**0.5


@pytest.mark.parametrize("index", [0, 1, 2])
def test_the_density_of_one_angle_is_that_of_draws(index):
    torch.manual_seed(0)
    density = random_density()
    alone = marginal(density, index)
    draws = density.sample((20_000,))[:, index]
    assert stats.ks_2samp(alone.sample((20_000,))[:, 0].numpy(), draws.numpy()).pvalue > 1e-3
    low, high = (-math.pi / 2, math.pi / 2) if index == 1 else (-math.pi, math.pi)
    middle = low + (torch.arange(360).double() + 0.5) * (high - low) / 360
    log_prob = alone.log_prob(middle[:, None])
    mass = log_prob.exp() * (high - low) / 360
    assert mass.sum().item() == pytest.approx(1, abs=1e-12)
    assert alone.entropy().item() == pytest.approx(-(mass * log_prob.clamp(min=-99)).sum().item(), abs=1e-9)
    assert alone.log_prob(alone.mode).item() == log_prob.max().item()


def test_the_entropy_of_the_uniform_density_is_that_of_the_chart():
    density = CellDensity(torch.full((576,), -math.log(576), dtype=torch.float64))
    # -E log(cos e / 8π²) with E log cos e = log 2 - 1
    assert density.entropy().item() == pytest.approx(math.log(VOLUME) - math.log(2) + 1, abs=1e-4)


def test_draws_lie_in_the_likely_cell_and_an_impossible_cell_has_no_density():
    log_weights = torch.full((72,), -math.inf, dtype=torch.float64)
    log_weights[5] = 0
    density = CellDensity(log_weights)
    torch.manual_seed(0)
    draws = density.sample((1000,))
    assert density.log_prob(draws).isfinite().all()
    assert density.log_prob(draws * torch.tensor([1, -1, 1])).max() == -math.inf  # in the other hemisphere
    assert density.entropy().isfinite()


@pytest.mark.slow
@pytest.mark.parametrize("group", ["none", "tetrahedral", "cylindrical"])
def test_the_network_learns_a_known_density(group):
    steps, batch, tested = 300, 16, 4000
    torch.manual_seed(0)
    head = make(hidden=64, layers=2, frequencies=3, training_cells=576, cells=36864)
    concentration = noise_concentration(math.radians(20))
    optimizer = torch.optim.Adam(head.parameters(), 1e-2)
    raw, identity = torch.zeros(batch, 64), torch.tensor([[1.0, 0, 0, 0]]).double()
    count = steps * batch + tested
    label = quaternions.product(draw_members(count, group), draw_noise(count, concentration))
    angles = quaternions.to_viewpoint(label)
    for step, target in enumerate(angles[:-tested].float().split(batch)):
        for part in optimizer.param_groups:
            part["lr"] = 1e-2 * (1 - step / steps)
        optimizer.zero_grad()
        head.loss(raw, target).mean().backward()
        optimizer.step()
    label, angles = label[-tested:], angles[-tested:]
    exact = log_blurred(identity, label, group, concentration) + angles[:, 1].cos().log() - math.log(VOLUME)
    with torch.no_grad():
        log_prob = head.eval()(raw[0]).log_prob(angles.float()).double()
    gap = exact - log_prob
    assert -5 * gap.std() / tested**0.5 < gap.mean() < 0.1


def test_more_cells_lose_less():
    # constant cells of width h lose about h²/(24 σ²) nats for each axis
    concentration = noise_concentration(math.radians(20))
    torch.manual_seed(0)
    label = draw_noise(20_000, concentration)
    identity, angles = torch.tensor([[1.0, 0, 0, 0]]).double(), quaternions.to_viewpoint(label)
    losses = []
    for cells in (4608, 36864):
        at_centres = log_blurred(identity, quaternions.of_viewpoint(centres(cells)), "none", concentration)
        density = CellDensity(torch.log_softmax(at_centres, -1))
        exact = (
            log_blurred(identity, label, "none", concentration) + angles[:, 1].cos().log() - math.log(VOLUME)
        )
        losses.append((exact - density.log_prob(angles)).mean().item())
    expected = 3 * math.radians(15) ** 2 / (24 * math.radians(20) ** 2)
    assert losses[0] == pytest.approx(expected, rel=0.5)
    assert losses[0] / losses[1] == pytest.approx(4, rel=0.3)


@pytest.mark.parametrize("names", [("azimuth",), ("tilt", "azimuth", "elevation")])
def test_other_angles_are_refused(names):
    config = resolve("density_head", {"name": "implicit_pdf"})
    with pytest.raises(ConfigError, match=r"implicit_pdf.*azimuth, elevation, tilt"):
        build("density_head", config, target=Target("angle", names))


def test_another_number_of_cells_is_refused():
    with pytest.raises(ConfigError, match="cells"):
        make(cells=1000)
