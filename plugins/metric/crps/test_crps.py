import math

import numpy as np
import pytest
import torch
from scipy.stats import sem
from torch.distributions import Independent, MultivariateNormal, Normal, StudentT

from framework.configuration.schema import build, resolve
from framework.distributions.circular import angular_distance
from framework.distributions.density import Mixture
from framework.errors import ConfigError, UserError
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.metrics import Cardioid
from plugins.metric.crps.metric import CRPS
from plugins.metric.crps.score import MOST, crps

THREE = Target("angle", ("azimuth", "elevation", "tilt"))
REALS = Target("real", ("x", "y"))


def compute_metric(target, density, value, **config):
    metric = build("metric", resolve("metric", {"name": "crps", **config}), target=target)
    for part in torch.arange(len(value)).split(7):
        metric.update(Prediction(density(part), {"target": value[part]}))
    return metric, {name: number.item() for name, number in metric.compute().items()}


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 2e-6), (torch.float64, 1e-12)])
def test_reals_are_averaged_over_numbers_and_samples(dtype, tolerance):
    torch.manual_seed(0)
    mean, value = torch.randn(2, 40, 2, dtype=dtype)
    root = torch.tensor([[1.0, 0.0], [2.0, 0.5]], dtype=dtype)
    _, actual = compute_metric(
        REALS, lambda part: MultivariateNormal(mean[part], scale_tril=root, validate_args=False), value
    )
    scale = np.array([1.0, math.sqrt(4.25)])
    z = (value - mean).double().numpy() / scale
    bell, below = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi), np.vectorize(math.erf)(z / np.sqrt(2))
    scores = scale * (z * below + 2 * bell - 1 / np.sqrt(np.pi))  # Gneiting & Raftery 2007, below eq. 21
    wanted = {"crps": scores.mean(1), "crps_x": scores[:, 0], "crps_y": scores[:, 1]}
    assert set(actual) == {*wanted, *(f"{name}_sem" for name in wanted)}
    for name, numbers in wanted.items():
        assert actual[name] == pytest.approx(numbers.mean(), rel=tolerance)
        assert actual[f"{name}_sem"] == pytest.approx(sem(numbers), rel=10 * tolerance)


def test_angles_are_reported_in_degrees():
    torch.manual_seed(1)
    place, value = 5 * torch.randn(2, 30, 3, dtype=torch.float64)
    metric, actual = compute_metric(THREE, lambda part: Cardioid(place[part]), value)
    # the only moment of the cardioid is 1/2, in its direction
    scores = np.degrees(math.pi / 4 - 4 / math.pi * ((value - place).cos() / 2 - 1 / 8).numpy())
    assert actual["crps_deg"] == pytest.approx(scores.mean(), rel=1e-12)
    assert actual["crps_tilt_deg"] == pytest.approx(scores[:, 2].mean(), rel=1e-12)
    assert metric.columns == {"crps_deg": "CRPS °"} and metric.better == {"crps_deg": "lower"}
    assert CRPS.columns == {"crps": "CRPS"}


def test_the_score_of_a_point_mass_is_its_distance():
    head = build(
        "density_head", resolve("density_head", "von_mises"), target=Target("angle", ("a",))
    ).double()
    place, value = torch.linspace(-3, 3, 20, dtype=torch.float64)[:, None], torch.full((20, 1), 2.5).double()
    raw = torch.cat([1e25 * place.cos(), 1e25 * place.sin(), torch.zeros(20, 1)], -1)
    _, actual = compute_metric(Target("angle", ("a",)), lambda part: head(raw[part]), value, samples=32)
    assert actual["crps_deg"] == pytest.approx(
        angular_distance(place, value).mean().item() * 180 / math.pi, abs=1e-4
    )


def test_estimated_scores_report_their_error():
    value = torch.zeros(30, 1)

    def student(part):
        return Independent(StudentT(torch.full((len(part), 1), 5.0)), 1)

    target = Target("real", ("x",))
    many = []
    for seed in range(40):
        torch.manual_seed(seed)
        many.append(compute_metric(target, student, value, samples=64)[1])
    spread = np.std([actual["crps"] for actual in many], ddof=1)
    reported_error = np.mean([actual["crps_mc_error"] for actual in many])
    assert reported_error == pytest.approx(
        spread, rel=0.35
    )  # the standard deviation of 40 values is exact to 11 %
    normal = compute_metric(target, lambda part: Independent(Normal(value[part], value[part] + 1), 1), value)[
        1
    ]
    assert set(normal) == {"crps", "crps_sem"}


def test_nan_and_classes_raise_an_error():
    density = Independent(
        Normal(torch.tensor([[0.0], [math.nan]]), 1.0, validate_args=False), 1, validate_args=False
    )
    with pytest.raises(UserError, match="1 of 2 scores in this batch are NaN, the first in row 1"):
        CRPS(Target("real", ("x",))).update(Prediction(density, {"target": torch.zeros(2, 1)}))
    with pytest.raises(ConfigError, match="there is no distance between classes"):
        CRPS(Target("class", ("off", "on")))
    with pytest.raises(ConfigError, match=r"samples = 3"):
        resolve("metric", {"name": "crps", "samples": 3})


@pytest.mark.parametrize("count", [2, MOST, MOST + 1, 20000])
def test_many_components_are_estimated_without_all_pairs(count):
    """Check two normals, each repeated many times: beyond MOST components, the score is an estimate with an error."""
    place = torch.tensor([-1.0, 2.0], dtype=torch.float64).repeat(1, count // 2 + 1)[:, :count]
    weights = torch.zeros(1, count, dtype=torch.float64)
    density = Mixture(
        weights, Independent(Normal(place[..., None], torch.full((1, count, 1), 0.5).double()), 1)
    )
    torch.manual_seed(0)
    actual = crps(density, torch.tensor([[0.3]], dtype=torch.float64), 4000)
    share = (place[0] == -1).double().mean()
    few = torch.stack([share, 1 - share]).log()[None]
    pair = Mixture(few, Independent(Normal(place[:, :2, None], torch.full((1, 2, 1), 0.5).double()), 1))
    wanted = crps(pair, torch.tensor([[0.3]], dtype=torch.float64), 4000)
    assert (actual.error == 0) == (count <= MOST)
    assert (actual.mean - wanted.mean).abs() <= 5 * actual.error + 1e-12
