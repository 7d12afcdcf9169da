import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import uniform, vonmises
from torch.distributions import Categorical, Distribution, VonMises

from framework.configuration.schema import build, resolve
from framework.distributions.circular import circular
from framework.distributions.protocol import marginal
from framework.errors import ConfigError, DataError
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.true_posterior.metric import TruePosterior, entropy_and_mode_mass

TARGET = Target("angle", ("azimuth",))
TURN = 2 * math.pi


class Modes(Distribution):
    """Density with von Mises components of equal weight in the first angle; other angles must not be evaluated."""

    arg_constraints = {}  # noqa: RUF012 - as torch has it
    support = circular

    def __init__(self, modes, concentration, angles=1):  # modes: (batch, K)
        self.modes = modes
        self.components = VonMises(modes, torch.full_like(modes, concentration), validate_args=False)
        super().__init__(modes.shape[:1], torch.Size((angles,)), validate_args=False)

    def log_prob(self, value):
        assert self.event_shape == (1,)
        component_log_prob = self.components.log_prob(value)  # (..., batch, K)
        return component_log_prob.logsumexp(-1) - math.log(self.modes.shape[-1])

    def sample(self, sample_shape=()):
        which = Categorical(logits=torch.zeros_like(self.modes)).sample(sample_shape)
        draws = self.components.sample(sample_shape)
        return draws.gather(-1, which.unsqueeze(-1))


@marginal.register
def _(density: Modes, index: int) -> Distribution:
    assert index < density.event_shape[0]
    return Modes(density.modes, density.components.concentration[0, 0].item())


def prediction(modes, concentration, azimuth, symmetry, dtype=torch.float64, **batch):
    density = Modes(torch.as_tensor(modes, dtype=dtype), concentration)
    target = torch.as_tensor(azimuth, dtype=dtype).unsqueeze(-1)
    return Prediction(density, {"target": target, "symmetry": torch.as_tensor(symmetry), **batch})


def compute_metric(*predictions, **config):
    metric = build("metric", resolve("metric", {"name": "true_posterior", **config}), target=TARGET)
    for item in predictions:
        metric.update(item)
    return {name: value.item() for name, value in metric.compute().items()}


def quadrature(modes, concentration, azimuth, symmetry):
    """Return entropy and mode masses by adaptive quadrature of SciPy's density, one sample at a time."""

    def density(angle):
        return vonmises.pdf(angle, concentration, loc=np.asarray(modes)).mean()

    def surprise(angle):
        return -density(angle) * math.log(max(density(angle), 1e-300))

    cuts = np.linspace(-math.pi, math.pi, 33)
    entropy = sum(quad(surprise, a, b)[0] for a, b in pairwise(cuts))
    half = math.pi / (2 * symmetry) if symmetry else 0
    centres = [azimuth + TURN * k / symmetry for k in range(symmetry)]
    return entropy, [quad(density, c - half, c + half, points=[c])[0] for c in centres]


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 2e-5), (torch.float64, 2e-5)])
@pytest.mark.parametrize("concentration", [0.01, 3.0, 200.0])
def test_results_agree_with_quadrature(dtype, tolerance, concentration):
    modes = np.array([[0.3, 2.0], [-3.1, 3.1], [1.0, 1.0 + math.pi], [0.5, -0.5]])
    azimuth, symmetry = np.array([0.4, 3.0, 1.1, -0.6]), [2, 3, 4, 0]
    metric = TruePosterior(TARGET)
    metric.update(prediction(modes, concentration, azimuth, symmetry, dtype))
    actual = metric.compute()
    samples = zip(modes, azimuth, symmetry, strict=True)
    rows = [quadrature(mode, concentration, true, count) for mode, true, count in samples]
    assert actual["azimuth_entropy"].item() == pytest.approx(np.mean([row[0] for row in rows]), abs=tolerance)
    assert actual["uniform_gap"].item() == pytest.approx(math.log(TURN) - rows[3][0], abs=tolerance)
    for (_, masses), count in zip(rows[:3], symmetry, strict=False):
        for k, mass in enumerate(masses):
            assert actual[f"mode_mass_{k}_of_{count}"].item() == pytest.approx(mass, abs=tolerance)
    least = min(min(row[1]) for row in rows[:3])
    assert actual["mode_mass_min"].item() == pytest.approx(least, abs=tolerance)


@pytest.mark.parametrize("azimuth_deg", [0, 1, 90, 179.99, 180, 359, -721])
@pytest.mark.parametrize("modes", [2, 3, 4, 36])
def test_the_true_posterior_has_all_modes_wherever_it_lies(azimuth_deg, modes):
    azimuth = math.radians(azimuth_deg)
    centres = [[azimuth + TURN * k / modes for k in range(modes)]]
    actual = compute_metric(prediction(centres, 5e4, [azimuth], [modes]), largest_symmetry=36, points=1440)
    assert actual["mode_mass_min"] == pytest.approx(1 / modes, rel=1e-6)
    assert actual["azimuth_entropy"] == pytest.approx(vonmises.entropy(5e4) + math.log(modes), abs=1e-5)


def test_a_missed_mode_lowers_the_smallest_mean_mass():
    azimuth = torch.zeros(10)
    centres = torch.zeros(10, 1)
    centres[:3] = math.pi  # for 3 of 10 samples, the only predicted mode is k = 1
    actual = compute_metric(prediction(centres, 1e3, azimuth, torch.full((10,), 2)))
    assert actual["mode_mass_0_of_2"] == pytest.approx(0.7, abs=1e-6)
    assert actual["mode_mass_min"] == pytest.approx(0.3, abs=1e-6)


def test_a_uniform_density_has_no_gap():
    actual = compute_metric(prediction([[1.0]], 1e-30, [2.0], [0]))
    assert actual["uniform_gap"] == pytest.approx(0, abs=1e-6)
    assert actual["azimuth_entropy"] == pytest.approx(uniform.entropy(0, TURN), abs=1e-6)


@pytest.mark.parametrize("concentration", [1e6, 1e7])
def test_a_density_between_the_grid_points_is_evaluated_from_draws(concentration):
    torch.manual_seed(0)
    azimuth = 0.4
    off = azimuth + 0.5 * TURN / 720  # halfway between two points of a coarse grid
    actual = compute_metric(
        prediction([[off, off + math.pi]] * 40, concentration, [azimuth] * 40, [2] * 40), points=720
    )
    # 40 × 1000 draws: standard error 0.0025 (mass) and 0.0035 nats (entropy); five times each
    assert actual["mode_mass_min"] == pytest.approx(0.5, abs=0.0125)
    exact = 0.5 * (1 + math.log(TURN / concentration)) + math.log(2)
    assert actual["azimuth_entropy"] == pytest.approx(exact, abs=0.0175)


@settings(deadline=None, max_examples=60)
@given(
    st.floats(-20, 20),
    st.floats(-20, 20),
    st.floats(0.001, 1e4),
    st.integers(0, 16),
    st.sampled_from([180, 720]),
)
def test_masses_are_probabilities_of_disjoint_windows(mode, azimuth, concentration, symmetry, points):
    density = Modes(torch.tensor([[mode]], dtype=torch.float64), concentration)
    entropy, mass = entropy_and_mode_mass(
        density, torch.tensor([azimuth], dtype=torch.float64), torch.tensor([symmetry]), 16, points, 100
    )
    assert entropy.isfinite().all()
    assert entropy.item() <= math.log(TURN) + 1e-9
    assert (mass >= 0).all()
    assert mass.sum() <= 1 + 1e-9
    assert (mass[0, max(symmetry, 1) :] == 0).all()


def test_only_the_azimuth_marginal_is_read():
    density = Modes(torch.zeros(3, 1), 4.0, angles=3)
    metric = TruePosterior(Target("angle", ("azimuth", "elevation", "tilt")))
    metric.update(Prediction(density, {"target": torch.zeros(3, 3), "symmetry": torch.tensor([0, 1, 2])}))
    assert metric.compute()["azimuth_entropy"].item() == pytest.approx(vonmises.entropy(4.0), abs=1e-5)


def test_no_samples_give_nan():
    empty = compute_metric(prediction(np.zeros((0, 2)), 1.0, np.zeros(0), np.zeros(0, dtype=np.int64)))
    assert empty.keys() == {"azimuth_entropy", "mode_mass_min", "uniform_gap"}
    assert all(np.isnan(value) for value in empty.values())
    unsymmetric = compute_metric(prediction([[0.0]], 1.0, [0.0], [1]))
    assert not np.isnan(unsymmetric["azimuth_entropy"])
    assert np.isnan(unsymmetric["mode_mass_min"])
    assert np.isnan(unsymmetric["uniform_gap"])


def test_data_without_symmetry_raise_an_error():
    density = Modes(torch.zeros(3, 1), 1.0)
    with pytest.raises(ConfigError, match="records no symmetry of its objects"):
        TruePosterior(TARGET).update(Prediction(density, {"target": torch.zeros(3, 1)}))


@pytest.mark.parametrize("symmetry", [-1, 17])
def test_a_symmetry_out_of_range_raises_an_error(symmetry):
    with pytest.raises(DataError, match=f"got the symmetry {symmetry}"):
        TruePosterior(TARGET).update(prediction([[0.0]], 1.0, [0.0], [symmetry]))


@pytest.mark.parametrize("target", [Target("angle", ("pan",)), Target("real", ("azimuth",))])
def test_targets_without_an_azimuth_raise_an_error(target):
    with pytest.raises(ConfigError, match="requires an angle named azimuth"):
        TruePosterior(target)
