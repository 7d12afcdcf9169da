import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.distributions import Distribution

from framework.configuration.schema import build, resolve
from framework.distributions.circular import Circular
from framework.errors import ConfigError, DataError
from framework.geometry import quaternions
from framework.geometry.symmetry import GROUPS
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.metrics import Cardioid

TARGET = Target("angle", ("azimuth", "elevation", "tilt"))
CHART = ((-math.pi, math.pi), (-math.pi / 2, math.pi / 2), (-math.pi, math.pi))


class Uniform(Distribution):
    """The uniform density of rotations, over the chart or half of it on each side of the poles of the torus."""

    def __init__(self, count, ranges):
        self.ranges = ranges
        super().__init__(torch.Size((count,)), torch.Size((3,)), validate_args=False)

    @property
    def support(self):
        return Circular(self.ranges)

    def log_prob(self, value):
        volume = 8 * math.pi**2 if self.ranges else 16 * math.pi**2
        return torch.log(torch.cos(value[..., 1]).abs() / volume)

    def sample(self, sample_shape=()):
        turn = torch.randn(*sample_shape, *self.batch_shape, 4, dtype=torch.float64)
        return quaternions.to_viewpoint(turn / turn.norm(dim=-1, keepdim=True))


class Point(Uniform):
    """Draws of one rotation for each item."""

    def __init__(self, angles):
        super().__init__(len(angles), CHART)
        self.angles = angles

    def sample(self, sample_shape=()):
        return self.angles.expand(*sample_shape, *self.angles.shape)


def turns(count):
    turn = torch.randn(count, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(count))
    return turn / turn.norm(dim=-1, keepdim=True)


def result(density, truth, group, **fields):
    metric = build("metric", resolve("metric", {"name": "symmetric_rotation", "draws": 300}), target=TARGET)
    target = quaternions.to_viewpoint(turns(len(truth)))
    groups = torch.full((len(truth),), GROUPS.index(group))
    metric.update(
        Prediction(density, {"target": target, "true_rotation": truth, "symmetry_group": groups, **fields})
    )
    return {name: float(value) for name, value in metric.compute().items()}


@pytest.mark.parametrize("ranges", [CHART, None])
def test_the_uniform_density_has_minus_log_pi_squared(ranges):
    torch.manual_seed(0)
    optimum = torch.full((50,), 1.5, dtype=torch.float64)
    values = result(Uniform(50, ranges), turns(50), "none", true_log_density=optimum)
    assert values["rotation_log_likelihood"] == pytest.approx(-math.log(math.pi**2), abs=1e-12)
    assert values["optimum_gap"] == pytest.approx(1.5, abs=1e-12)
    # E ω for uniform rotations is π/2 + 2/π
    assert values["spread_deg"] == pytest.approx(math.degrees(math.pi / 2 + 2 / math.pi), abs=1)


@pytest.mark.parametrize(("group", "symbol"), [("tetrahedral", "T"), ("octahedral", "O"), ("none", "C1")])
def test_spread_is_scipys_angle_to_the_nearest_equivalent_rotation(group, symbol):
    truth, drawn = turns(30), turns(31)[:30]
    first, second = (Rotation.from_quat(turn[:, [1, 2, 3, 0]].numpy()) for turn in (truth, drawn))
    nearest = (first.inv() * second).reduce(right=None, left=Rotation.create_group(symbol)).magnitude()
    values = result(Point(quaternions.to_viewpoint(drawn)), truth, group)
    assert values["spread_deg"] == pytest.approx(math.degrees(nearest.mean()), abs=1e-5)
    assert math.isnan(values["optimum"])


def test_equivalent_rotations_have_no_spread():
    truth = turns(20)
    around = quaternions.about(3, torch.linspace(0, 6, 20).double())
    values = result(Point(quaternions.to_viewpoint(quaternions.product(truth, around))), truth, "conical")
    assert values["spread_deg"] < 1e-5


def test_other_targets_and_batches_without_symmetry_are_refused():
    with pytest.raises(ConfigError, match="three angles azimuth, elevation, tilt"):
        build("metric", resolve("metric", "symmetric_rotation"), target=Target("angle", ("azimuth",)))
    metric = build("metric", resolve("metric", "symmetric_rotation"), target=TARGET)
    with pytest.raises(ConfigError, match="'symmetry_group'"):
        metric.update(Prediction(Cardioid(torch.zeros(2, 3)), {"target": torch.zeros(2, 3)}))
    fields = {"true_rotation": turns(2), "symmetry_group": torch.tensor([0, 6])}
    with pytest.raises(DataError, match="from 0 to 6"):
        metric.update(Prediction(Cardioid(torch.zeros(2, 3)), {"target": torch.zeros(2, 3), **fields}))
