"""Tests of the moons, of their exact posterior against independent quadrature, and of the outliers."""

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.special import logsumexp
from sklearn.datasets import make_moons

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from plugins.data.moons.generator import CENTRE, draw, log_density, log_posterior, posterior, scale
from plugins.data.moons.points import SIDE

DEFAULT = 0.37


def prepare_data(name: str = "moons", **config: Any) -> Any:
    data = build("data", resolve("data", {"name": name, **config}))
    data.prepare()
    return data


def plane(step: float, reach: float = 6.0) -> np.ndarray:
    """Return grid points of [-reach, reach]².

    A sum over them is the trapezium rule, which converges faster than any power of `step` for smooth densities.
    """
    line = np.arange(-reach, reach + step / 2, step)
    return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)


def by_scipy(point: np.ndarray, noise: float) -> np.ndarray:
    """Return the density of each class: the normal density about a point of the arc, averaged over the arc."""
    x, y = point * scale(noise) + CENTRE
    arcs = (lambda t: (math.cos(t), math.sin(t)), lambda t: (1 - math.cos(t), 0.5 - math.sin(t)))
    densities = []
    for arc in arcs:

        def normal(angle: float, arc: Any = arc) -> float:
            square = (x - arc(angle)[0]) ** 2 + (y - arc(angle)[1]) ** 2
            return math.exp(-square / (2 * noise**2)) / (2 * math.pi * noise**2)

        grid = np.linspace(0, math.pi, 41)
        parts = (quad(normal, a, b, epsabs=0, epsrel=1e-12)[0] for a, b in pairwise(grid))
        densities.append(sum(parts) / math.pi * scale(noise).prod())
    return np.array(densities)


def by_mpmath(point: np.ndarray, noise: float) -> list[mpmath.mpf]:
    """Return the logarithms of both classes' densities, from a 60-digit quadrature."""
    with mpmath.workdps(60):
        spread = mpmath.mpf(noise)
        sides = (mpmath.sqrt(0.75 + spread**2), mpmath.sqrt(0.5625 - 1 / mpmath.pi + spread**2))
        x, y = (mpmath.mpf(float(value)) * side for value, side in zip(point, sides, strict=True))
        log_densities = []
        for sign in (1, -1):
            across, up = sign * x + 0.5, sign * y + 0.25
            direction = mpmath.atan2(up, across)
            nearest = direction if up >= 0 else (mpmath.mpf(0) if across > 0 else +mpmath.pi)

            def exponent(t: Any, across: Any = across, up: Any = up) -> Any:
                return ((across - mpmath.cos(t)) ** 2 + (up - mpmath.sin(t)) ** 2) / (2 * spread**2)

            best = exponent(nearest)
            width = spread / mpmath.sqrt(max(mpmath.hypot(across, up), spread**2))
            cuts = {min(max(nearest + k * width, 0), mpmath.pi) for k in range(-24, 25, 4)}
            cuts = sorted(cuts | {mpmath.mpf(0), +mpmath.pi})
            total = mpmath.quad(lambda t, best=best, exponent=exponent: mpmath.exp(best - exponent(t)), cuts)
            norm = 2 * mpmath.pi**2 * spread**2 / (sides[0] * sides[1])
            log_densities.append(mpmath.log(total / norm) - best)
        return log_densities


@pytest.mark.parametrize("noise", [0.05, DEFAULT, 1.0])
def test_densities_and_posterior_agree_with_quadrature_over_the_arc(noise: float) -> None:
    # for small noise only points near the arcs, so that exp does not underflow
    points = np.random.default_rng(0).uniform(-4, 4, (12, 2)) * min(1, 3 * noise)
    expected = np.array([by_scipy(point, noise) for point in points])
    np.testing.assert_allclose(np.exp(log_density(points, noise)), expected, rtol=1e-10)
    np.testing.assert_allclose(
        posterior(points, noise), expected / expected.sum(-1, keepdims=True), rtol=1e-9, atol=1e-300
    )


@pytest.mark.parametrize(
    ("noise", "reach"), [(0.01, 1e20), (DEFAULT, 4.0), pytest.param(DEFAULT, 1e3, marks=pytest.mark.slow)]
)
def test_logs_keep_their_digits_far_away(noise: float, reach: float) -> None:
    points = reach * np.array([[-1.0, 1.0], [0.7, -0.9], [0.3, 0.8], [-0.02, -1.0]])
    for point, density, odds in zip(
        points, log_density(points, noise), log_posterior(points, noise), strict=True
    ):
        expected = by_mpmath(point, noise)
        np.testing.assert_allclose(density, [float(value) for value in expected], rtol=1e-12)
        with mpmath.workdps(60):
            gap = expected[1] - expected[0]
            logs = [float(-mpmath.log1p(mpmath.exp(difference))) for difference in (gap, -gap)]
        np.testing.assert_allclose(odds, logs, rtol=1e-10, atol=1e-300)


def test_extreme_points_are_finite_and_the_arcs_own_centres_too() -> None:
    most = float(np.finfo(np.float32).max)
    far = most * np.array([[1, 1], [-1, 1], [1, -1], [-1, -1], [0, 1], [1, 0], [0, -1]])
    centres = np.array([-CENTRE, CENTRE, 0 * CENTRE]) / scale(DEFAULT)
    points = np.concatenate([far, centres, np.zeros((0, 2))])
    for noise in (0.01, DEFAULT, 1.0):
        assert np.isfinite(log_density(points, noise)).all()
        logs = log_posterior(points, noise)
        assert np.isfinite(logs).all()
        np.testing.assert_allclose(logsumexp(logs, axis=-1), 0, atol=1e-15)
    assert log_posterior(points[:0], DEFAULT).shape == (0, 2)
    assert posterior(np.zeros(2), DEFAULT) == pytest.approx([0.5, 0.5], abs=1e-15)


def test_the_law_has_mass_one_mean_zero_and_deviation_one() -> None:
    for noise in (0.2, DEFAULT):
        points = plane(0.05)
        mass = np.exp(log_density(points, noise)) * 0.05**2
        np.testing.assert_allclose(mass.sum(0), 1, rtol=1e-12)
        both = mass.mean(1)[:, None]
        np.testing.assert_allclose((both * points).sum(0), 0, atol=1e-12)
        np.testing.assert_allclose((both * points**2).sum(0), 1, rtol=1e-10)
    outside = np.abs(points).max(-1) > 4
    assert 3e-7 < both[outside].sum() < 4e-7  # at the README's noise, the last one


def test_the_classes_mirror_each_other() -> None:
    points = np.random.default_rng(1).uniform(-4, 4, (50, 2))
    np.testing.assert_allclose(log_posterior(points, 0.3), log_posterior(-points, 0.3)[:, ::-1], rtol=1e-13)


def scores(noise: float, step: float = 0.05) -> tuple[float, float, float]:
    """Return accuracy, negative log-likelihood (nats) and Brier score (thesis eq. 2.26) of the exact posterior."""
    points = plane(step)
    logs = log_posterior(points, noise)
    both = np.exp(logs)
    mass = np.exp(log_density(points, noise)).mean(-1) * step**2
    entropy = -np.where(both > 0, both * logs, 0).sum(-1)
    return (
        float((mass * both.max(-1)).sum()),
        float((mass * entropy).sum()),
        float((mass * both.prod(-1)).sum()),
    )


def test_the_best_possible_scores_are_those_of_the_readme() -> None:
    accuracy, likelihood, brier = scores(DEFAULT)
    assert accuracy == pytest.approx(0.8772, abs=5e-5)
    assert likelihood == pytest.approx(0.2903, abs=5e-5)
    assert brier == pytest.approx(0.0891, abs=5e-5)


def test_draws_follow_the_density() -> None:
    """Check the exact posterior's scores on draws, and on those of another generator, against quadrature."""
    size = 40_000
    _, expected, _ = scores(DEFAULT)
    points, label = draw(size, DEFAULT, 5, 0)
    other, other_label = make_moons(size, noise=DEFAULT, random_state=0)
    scaled = (other - CENTRE) / scale(DEFAULT)
    for sample, labels in ((points, label), (scaled, other_label)):
        loss = -log_posterior(sample, DEFAULT)[np.arange(size), labels]
        assert loss.mean() == pytest.approx(expected, abs=4 * loss.std() / size**0.5)
        np.testing.assert_allclose(sample.mean(0), 0, atol=4 / size**0.5)
        np.testing.assert_allclose(sample.std(0), 1, atol=4 / size**0.5)
    joint = [
        log_density(sample, DEFAULT)[np.arange(size), y]
        for sample, y in ((points, label), (scaled, other_label))
    ]
    spread = math.hypot(*(part.std() / size**0.5 for part in joint))
    assert abs(joint[0].mean() - joint[1].mean()) < 4 * spread


def test_the_splits_are_independent_and_depend_on_the_data_seed_alone() -> None:
    data, other, larger = (
        prepare_data(**config) for config in ({}, {"data_seed": 1}, {"train": 800, "test": 10})
    )
    tables = {name: split.fields for name, split in data.splits()._asdict().items()}
    assert [len(table["index"]) for table in tables.values()] == [500, 500, 5000]
    firsts = {tuple(table["input"][0].tolist()) for table in tables.values()}
    assert len(firsts) == 3
    assert data.fingerprint()["sha256"] != other.fingerprint()["sha256"]
    assert torch.equal(larger.splits().train.fields["input"][:500], tables["train"]["input"])
    assert torch.equal(larger.splits().validation.fields["input"], tables["validation"]["input"])
    given_class = tables["train"]["target"].double()
    assert torch.equal(tables["train"]["target"], tables["validation"]["target"])
    # in both splits the classes alternate, which alone makes them correlated; so the class means are subtracted
    residuals = [
        (tables[name]["input"].double() - class_means(tables[name], given_class)).numpy()
        for name in ("train", "validation")
    ]
    correlation = np.corrcoef(residuals[0].T, residuals[1].T)[:2, 2:]
    assert np.abs(correlation).max() < 4 / 500**0.5


def class_means(table: dict[str, torch.Tensor], label: torch.Tensor) -> torch.Tensor:
    """Return, for each point, the mean of the points of its class, (size, 2)."""
    points = table["input"].double()
    means = torch.stack([points[label == number].mean(0) for number in (0, 1)])
    return means[label.long()]


def test_a_batch_holds_labels_and_the_posterior_of_its_points() -> None:
    data = prepare_data(test=101, noise=0.2)
    batch = data.splits().test.__getitems__([0, 3, 100])
    assert data.target.kind == "class"
    assert data.target.names == ("upper", "lower")
    assert batch["input"].dtype == batch["posterior"].dtype == torch.float32
    assert batch["target"].tolist() == [0, 1, 0]
    expected = posterior(batch["input"].double().numpy(), 0.2)
    np.testing.assert_allclose(batch["posterior"], expected, rtol=1e-6)


def test_outliers_lie_far_from_both_moons() -> None:
    data = prepare_data("moons_outliers")
    points = np.concatenate([split.fields["input"].double().numpy() for split in data.splits()])
    assert len(points) == 500 + 500 + 1000
    corner = np.where(points[:, :1] < 0, 1, -1) * np.array([-3.2, 3.2])
    distance = np.linalg.norm(points - corner, axis=-1)
    assert distance.max() < 0.6 + 1e-6
    assert np.mean(distance < 0.6 / 2**0.5) == pytest.approx(0.5, abs=4 * 0.5 / 2000**0.5)  # half of the area
    assert np.mean(points[:, 0] < 0) == 0.5
    around = np.linspace(0, 2 * math.pi, 721)
    edge = np.array([-3.2, 3.2]) + 0.6 * np.stack([np.cos(around), np.sin(around)], -1)
    assert np.abs(edge).max() < 4
    # as the README says: the density is below 2e-7 (0.12 at its peak), the discs lie at least 5 standard deviations of
    # the noise from an arc, and the exact posterior is certain
    both = np.exp(logsumexp(log_density(edge, DEFAULT), axis=-1)) / 2
    assert 1e-7 < both.max() < 2e-7
    assert np.exp(logsumexp(log_density(plane(0.05), DEFAULT), axis=-1)).max() / 2 == pytest.approx(
        0.12, abs=5e-4
    )
    angle = np.linspace(0, math.pi, 721)
    arc = np.stack([np.cos(angle), np.sin(angle)], -1)
    gap = np.linalg.norm((edge * scale(DEFAULT) + CENTRE)[:, None] - arc, axis=-1).min() / DEFAULT
    assert 5 < gap < 5.1
    assert 1 - posterior(edge, DEFAULT)[:, 0].min() < 4e-6


def test_outliers_have_the_shapes_of_moons_and_independent_splits() -> None:
    moons, outliers = prepare_data(), prepare_data("moons_outliers", radius=0.0, corner=10.0, test=3)
    assert (outliers.target, outliers.input_shape) == (moons.target, moons.input_shape)
    test = outliers.splits().test.fields
    assert test["input"].tolist() == [[-10, 10], [10, -10], [-10, 10]]
    assert test["target"].tolist() == [0, 1, 0]
    firsts = {
        tuple(split.fields["input"][0].tolist())
        for seed in (0, 1)
        for split in prepare_data("moons_outliers", data_seed=seed).splits()
    }
    assert len(firsts) == 6


@pytest.mark.parametrize("name", ["moons", "moons_outliers"])
def test_a_users_points_are_read_without_prepare(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("y,label,x\n2,upper,1\n-4e3,lower,0.5\n")
    (tmp_path / "b.csv").write_text("x,y\n7,8\n")
    data = build("data", resolve("data", {"name": name}))
    read = data.read([tmp_path / "a.csv", tmp_path / "b.csv"])
    assert read.fields["input"].tolist() == [[1, 2], [0.5, -4000], [7, 8]]
    assert read.fields["input"].dtype == torch.float32
    (tmp_path / "a.csv").write_text("x,y\n1,2\n1,two\n")
    with pytest.raises(DataError, match=r"a\.csv line 3, column 'y': 'two' is not a finite number"):
        data.read([tmp_path / "a.csv"])
    (tmp_path / "a.csv").write_text("x,z\n1,2\n")
    with pytest.raises(DataError, match=r"names the column 'y', which .*a\.csv does not have"):
        data.read([tmp_path / "a.csv"])
    (tmp_path / "a.csv").write_text("x,y\n1,1e39\n")
    with pytest.raises(
        DataError, match=r"a\.csv line 2: The point \(1, 1e\+39\) lies beyond single precision"
    ):
        data.read([tmp_path / "a.csv"])


@pytest.mark.parametrize("name", ["moons", "moons_outliers"])
def test_a_picture_marks_the_point_in_the_cloud(name: str) -> None:
    data = prepare_data(name)
    for point, row, column in (([0.0, 0.0], 47, 48), ([-4.0, 4.0], 0, 0), ([1e9, -1e9], 95, 95)):
        image = data.preview(torch.tensor(point))
        assert image.shape == (SIDE, SIDE, 3)
        black = np.argwhere((image == 0).all(-1))
        assert [row, column] in black.tolist()
        assert np.abs(black - [row, column]).max() == 4
        assert len(np.unique(image.reshape(-1, 3), axis=0)) == 4  # white, two classes, the cross


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("moons", "noise", 0.0),
        ("moons", "noise", math.nan),
        ("moons", "train", 0),
        ("moons", "data_seed", -1),
        ("moons_outliers", "radius", -0.1),
        ("moons_outliers", "corner", math.inf),
        ("moons_outliers", "noise", 0.3),
    ],
)
def test_a_config_out_of_range_is_refused(name: str, key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"data\.{key}"):
        resolve("data", {"name": name, key: value})
