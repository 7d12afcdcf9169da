import math

import pytest
import torch
from scipy import stats

from framework.geometry import quaternions
from framework.geometry.rotation import geodesic_distance, viewpoint_rotation
from framework.geometry.rotation_grid import (
    cell_of,
    centres,
    distant_rotations,
    level_of,
    mean_log_cosine,
    points_in,
)


def random_viewpoints(count):
    turn = torch.randn(count, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return quaternions.to_viewpoint(turn / turn.norm(dim=-1, keepdim=True))


@pytest.mark.parametrize("cells", [72, 576, 4608, 36864])
def test_a_point_of_a_cell_lies_in_this_cell(cells):
    assert torch.equal(cell_of(centres(cells), cells), torch.arange(cells))
    place = 0.001 + 0.998 * torch.rand(3, 20_000, generator=torch.Generator().manual_seed(1)).double()
    index = torch.randint(cells, (20_000,), generator=torch.Generator().manual_seed(2))
    assert torch.equal(cell_of(points_in(index, *place, cells), cells), index)


@pytest.mark.parametrize("cells", [72, 576, 4608])
def test_cells_have_equal_volumes(cells):
    count = torch.bincount(cell_of(random_viewpoints(400_000), cells), minlength=cells)
    assert stats.chisquare(count.numpy()).pvalue > 1e-3


def test_points_that_are_uniform_in_the_cells_are_uniform_rotations():
    generator = torch.Generator().manual_seed(3)
    index = torch.randint(72, (100_000,), generator=generator)
    angles = points_in(index, *torch.rand(3, 100_000, generator=generator).double(), 72)
    for number, low in ((0, -math.pi), (2, -math.pi)):
        assert stats.kstest(angles[:, number].numpy(), "uniform", (low, -2 * low)).pvalue > 1e-3
    assert stats.kstest(angles[:, 1].sin().numpy(), "uniform", (-1, 2)).pvalue > 1e-3


@pytest.mark.parametrize("cells, most_deg", [(72, 62), (576, 31), (4608, 17), (36864, 9)])
def test_every_rotation_is_near_the_centre_of_its_cell(cells, most_deg):
    angles = random_viewpoints(50_000)
    near_pole = angles.clone()
    near_pole[:, 1] = angles[:, 1].sign() * (math.pi / 2 - 1e-3 * angles[:, 1].abs())
    for viewpoint in (angles, near_pole):
        centre = centres(cells)[cell_of(viewpoint, cells)]
        distance = geodesic_distance(viewpoint_rotation(viewpoint), viewpoint_rotation(centre))
        assert distance.max() < math.radians(most_deg)


def test_mean_log_cosine_is_that_of_the_sphere():
    # ∫ log cos e cos e de / 2 = log 2 - 1
    assert mean_log_cosine(576).mean().item() == pytest.approx(math.log(2) - 1, abs=1e-4)
    place = torch.rand(3, 40_000, generator=torch.Generator().manual_seed(4)).double()
    for cell in (0, 100, 300):
        inside = points_in(torch.full((40_000,), cell), *place, 576)[:, 1].cos().log()
        assert abs(inside.mean() - mean_log_cosine(576)[cell]) < 5 * inside.std() / 200


def test_other_numbers_of_cells_are_refused():
    with pytest.raises(ValueError, match="72, 576, 4608"):
        level_of(100)


@pytest.mark.parametrize("count", [2, 4, 24, 72, 200])
def test_rounding_does_not_choose_the_distant_rotations(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    expected = distant_rotations(count)
    exact = quaternions.of_viewpoint
    noise = torch.Generator().manual_seed(0)

    def rounded(angles: torch.Tensor) -> torch.Tensor:
        turns = exact(angles)
        return turns * (1 + 1e-14 * torch.randn(turns.shape, generator=noise, dtype=turns.dtype))

    monkeypatch.setattr(quaternions, "of_viewpoint", rounded)
    torch.testing.assert_close(distant_rotations(count), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("count, least_deg", [(2, 179), (4, 179), (24, 87), (72, 50), (500, 25)])
def test_distant_rotations_are_far_from_one_another(count, least_deg):
    turns = distant_rotations(count)
    torch.testing.assert_close(turns.norm(dim=-1), torch.ones(count, dtype=torch.float64))
    first, second = torch.combinations(torch.arange(count)).unbind(-1)
    matrices = quaternions.matrix_less_identity(turns) + torch.eye(3, dtype=torch.float64)
    distance = geodesic_distance(matrices[first], matrices[second])
    assert math.degrees(distance.min()) > least_deg


def test_more_distant_rotations_than_the_finest_grid_spreads_are_refused():
    with pytest.raises(ValueError, match="Got 200000 rotations, but at most 147456 can be spread"):
        distant_rotations(200_000)
