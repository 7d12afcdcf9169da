"""Tests of the scores against scikit-learn and SciPy, of what the wrapper refuses, and of what keeps its score."""

import math

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from sklearn.covariance import EmpiricalCovariance, LedoitWolf, ShrunkCovariance
from sklearn.neighbors import NearestNeighbors
from torch import nn

from framework.configuration.schema import build, resolve
from framework.distributions.affine import AffineDensity
from framework.distributions.protocol import value_set
from framework.distributions.unchanged import ScoredDensity, outlier_score
from framework.errors import ConfigError, UserError
from framework.model import FrozenFrontEnd, Model
from framework.prediction import Prediction, table_columns
from framework.target import Target
from framework.uncertainty import reading_training
from plugins.uncertainty.feature_score.statistics import (
    choose_samples,
    energy,
    fit_clusters,
    mahalanobis,
    merge_clusters,
    neighbour_distance,
    to_unit_length,
)

CLASSES, REAL = Target("class", ("a", "b", "c")), Target("real", ("x",))


def model(target=CLASSES, head="categorical", length=4, encoders=()):
    torch.manual_seed(0)
    built = [build("encoder", resolve("encoder", part), input_shape=(length,)) for part in encoders]
    return Model(built, build("density_head", resolve("density_head", head), target=target), (length,))


def wrapper_around(target=CLASSES, dtype=torch.float64, inner=None, **config):
    part = resolve("uncertainty", {"name": "feature_score", **config})
    make = (lambda: model(target)) if inner is None else inner
    return build("uncertainty", part, model=make, target=target).eval().to(dtype)


def labelled(count=90, dtype=torch.float64, far=0.0):
    generator = torch.Generator().manual_seed(1)
    label = torch.arange(count) % 3
    mixing = torch.randn(4, 4, generator=generator, dtype=torch.float64)
    inputs = torch.randn(count, 4, generator=generator, dtype=torch.float64) @ mixing + far
    return (inputs + 3 * label.unsqueeze(1)).to(dtype), label


def as_batches(inputs, label, size=32):
    return [
        {"input": part, "target": labels}
        for part, labels in zip(inputs.split(size), label.split(size), strict=True)
    ]


def score_of(wrapper, inputs):
    with torch.no_grad():
        return outlier_score(wrapper(inputs))


def reference(estimator, inputs, label, new):
    """Return the smallest distance from a class mean by an estimator of scikit-learn."""
    inputs, label, new = inputs.double().numpy(), label.numpy(), new.double().numpy()
    means = np.stack([inputs[label == number].mean(0) for number in np.unique(label)])
    estimator.fit(inputs - means[np.unique(label, return_inverse=True)[1]])
    return np.min([estimator.mahalanobis(new - mean) for mean in means], 0)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-9)])
@pytest.mark.parametrize(
    "shrinkage, estimator",
    [
        (0.0, EmpiricalCovariance(assume_centered=True)),
        (0.3, ShrunkCovariance(assume_centered=True, shrinkage=0.3)),
        (None, LedoitWolf(assume_centered=True)),
    ],
    ids=["empirical", "shrunk", "ledoit-wolf"],
)
@pytest.mark.parametrize("far", [0.0, 1e4])
def test_mahalanobis_distances_equal_scikit_learns(dtype, tolerance, shrinkage, estimator, far):
    inputs, label = labelled(dtype=dtype, far=far)
    wrapper = wrapper_around(dtype=dtype, shrinkage=shrinkage)
    wrapper.calibrate(as_batches(inputs, label))
    new = 2 * inputs.flip(1)
    expected = reference(estimator, inputs, label, new)
    np.testing.assert_allclose(score_of(wrapper, new), expected, rtol=tolerance)
    if shrinkage is None:
        assert f"shrinkage of the covariance {estimator.shrinkage_:.3g}." in wrapper.remark


def test_the_relative_distance_subtracts_that_of_one_normal_density():
    inputs, label = labelled()
    new = inputs.flip(1)
    wrapper = wrapper_around(method="relative_mahalanobis", shrinkage=0.0)
    wrapper.calibrate(as_batches(inputs, label))
    classes = reference(EmpiricalCovariance(assume_centered=True), inputs, label, new)
    everything = EmpiricalCovariance().fit(inputs.numpy()).mahalanobis(new.numpy())
    np.testing.assert_allclose(score_of(wrapper, new), classes - everything, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shrinkage", [None, 1e-6, 0.5])
def test_the_relative_distance_differs_from_0_along_the_class_means_only(shrinkage):
    """Check that Σ⁻¹ - Σ_all⁻¹ has no negative eigenvalue, and K - 1 positive ones for K classes."""
    inputs, label = labelled(count=60)
    scales = torch.logspace(0, -4, 16, dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    wide = torch.cat([inputs, torch.randn(60, 16, generator=generator, dtype=torch.float64) * scales], 1)
    clusters = fit_clusters(lambda: iter([(wide, label)]), 4, shrinkage)  # one class has no samples
    merged = merge_clusters(clusters)
    np.testing.assert_allclose(merged.means[0], wide.mean(0), rtol=1e-12)
    inverse, inverse_of_all = (part.whitening.T @ part.whitening for part in (clusters, merged))
    values = torch.linalg.eigvalsh(inverse - inverse_of_all) / torch.linalg.eigvalsh(inverse)[-1]
    assert values[0] > -1e-9
    assert (values > 1e-9).sum() == 2


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("normalise", [None, True, False])
def test_neighbour_distances_equal_scikit_learns(dtype, tolerance, normalise):
    inputs, label = labelled(dtype=dtype)
    wrapper = wrapper_around(dtype=dtype, method="knn", neighbours=7, normalise=normalise)
    wrapper.calibrate(as_batches(inputs, label))
    bank, new = inputs.double().numpy(), 2 * inputs.flip(1).double().numpy()
    if normalise is not False:
        bank, new = (part / np.linalg.norm(part, axis=1, keepdims=True) for part in (bank, new))
    expected = NearestNeighbors(n_neighbors=7).fit(bank).kneighbors(new)[0][:, -1]
    np.testing.assert_allclose(
        score_of(wrapper, 2 * inputs.flip(1)), expected, rtol=tolerance, atol=tolerance
    )


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (torch.float64, 1e-13)])
def test_energy_equals_scipys_logsumexp_also_of_large_logits(dtype, tolerance):
    logits = torch.tensor([[0.0, 0, 0], [1e4, -1e4, 3], [-900, -900.5, -1e3], [1e30, 0, 0]], dtype=dtype)
    np.testing.assert_allclose(energy(logits), -logsumexp(logits.double().numpy(), axis=1), rtol=1e-14)
    inputs, label = labelled(dtype=dtype)
    wrapper = wrapper_around(dtype=dtype, method="energy")
    before = score_of(wrapper, inputs)
    wrapper.calibrate(as_batches(inputs, label))
    raw = wrapper.model.raw(inputs).detach().double().numpy()
    np.testing.assert_allclose(score_of(wrapper, inputs), -logsumexp(raw, axis=1), rtol=tolerance)
    assert torch.equal(before, score_of(wrapper, inputs))


@pytest.mark.parametrize("method", ["mahalanobis", "relative_mahalanobis", "knn", "energy"])
def test_scores_before_calibration_are_reported_once(method, caplog):
    inputs, label = labelled()
    wrapper = wrapper_around(method=method)
    for _ in range(2):
        score_of(wrapper, inputs)
    warned = [record.message for record in caplog.records if "was not calibrated" in record.message]
    assert len(warned) == (method != "energy")
    caplog.clear()
    calibrated, loaded = wrapper_around(method=method), wrapper_around(method=method)
    calibrated.calibrate(as_batches(inputs, label))
    loaded.load_state_dict(calibrated.state_dict())
    assert score_of(loaded, inputs).abs().sum() > 0
    score_of(calibrated, inputs)
    assert not caplog.records


def test_statistics_come_from_the_training_split_in_any_batches():
    inputs, label = labelled()
    others = labelled(count=20, far=5.0)
    for method in ("mahalanobis", "relative_mahalanobis", "knn"):
        expected = None
        for size in (7, 90):
            wrapper = wrapper_around(method=method)
            with reading_training(wrapper, as_batches(inputs, label, size)):
                wrapper.calibrate(as_batches(*others))
            scores = score_of(wrapper, inputs)
            expected = scores if expected is None else expected
            torch.testing.assert_close(scores, expected, rtol=1e-9, atol=1e-9)
        alone = wrapper_around(method=method)
        alone.calibrate(as_batches(inputs, label))
        torch.testing.assert_close(score_of(alone, inputs), expected, rtol=1e-9, atol=1e-9)


def test_stored_samples_are_a_random_choice_in_their_order():
    inputs, label = labelled(count=300)
    chosen = choose_samples(lambda: iter(zip(inputs.split(40), label.split(40), strict=True)), 60)
    rows = [int((inputs == row).all(1).nonzero()) for row in chosen]
    assert len(rows) == 60 and rows == sorted(set(rows)) and rows[-1] > 200 > 100 > rows[0]
    assert torch.equal(chosen, choose_samples(lambda: iter([(inputs, label)]), 60))
    assert torch.equal(inputs, choose_samples(lambda: iter([(inputs, label)]), 300))


def test_with_fewer_samples_than_neighbours_the_farthest_counts():
    inputs, label = labelled(count=9)
    wrapper = wrapper_around(method="knn", normalise=False)
    wrapper.calibrate(as_batches(inputs, label))
    torch.testing.assert_close(score_of(wrapper, inputs), torch.cdist(inputs, inputs).amax(1))
    assert wrapper.remark == (
        "feature_score: the store holds 9 training samples, fewer than the 50 neighbours that are set."
    )


def test_constant_and_dependent_features_have_finite_distances():
    label = torch.arange(30) % 2
    constant = torch.ones(30, 3, dtype=torch.float64)
    clusters = fit_clusters(lambda: iter([(constant, label)]), 3, None)
    distance = mahalanobis(constant + 2, *clusters[:3])
    torch.testing.assert_close(distance, torch.full((30,), 12.0, dtype=torch.float64))
    line = torch.randn(30, 1, dtype=torch.float64).expand(30, 3)
    for shrinkage in (0.0, None):
        clusters = fit_clusters(lambda: iter([(line, label)]), 3, shrinkage)
        assert mahalanobis(line + torch.tensor([1.0, 0, 0]), *clusters[:3]).isfinite().all()
    assert clusters.counts.tolist() == [15, 15, 0]
    assert to_unit_length(torch.zeros(1, 3)).tolist() == [[0.0, 0.0, 0.0]]
    single = constant[:1]
    assert neighbour_distance(single, single, 1).tolist() == [0.0]


def test_far_inputs_have_high_scores_and_the_density_is_that_of_the_model():
    inputs, label = labelled()
    far = 40 * torch.nn.functional.normalize(inputs.flip(1) - 30)
    for config in (
        {},
        {"method": "relative_mahalanobis"},
        {"method": "knn", "neighbours": 5, "normalise": False},
    ):
        wrapper = wrapper_around(**config)
        assert not score_of(wrapper, inputs).any()
        wrapper.calibrate(as_batches(inputs, label))
        assert score_of(wrapper, far).min() > score_of(wrapper, inputs).max()
        torch.testing.assert_close(
            wrapper(inputs).log_prob(label), wrapper.model(inputs).log_prob(label), rtol=0, atol=0
        )


def test_the_features_are_those_in_front_of_the_final_layer():
    mlp = {"name": "mlp", "widths": [5]}
    inputs, label = labelled()
    for wrapped in (None, "temperature"):

        def inner(wrapped=wrapped):
            make = lambda: model(encoders=[mlp]).double()  # noqa: E731
            if wrapped is None:
                return make()
            return build("uncertainty", resolve("uncertainty", wrapped), model=make, target=CLASSES)

        wrapper = wrapper_around(inner=inner, shrinkage=0.5)
        wrapper.calibrate(as_batches(inputs, label))
        network = next(module for module in wrapper.modules() if isinstance(module, Model))
        features = network.encoders(inputs).detach()
        expected = reference(ShrunkCovariance(assume_centered=True, shrinkage=0.5), features, label, features)
        np.testing.assert_allclose(score_of(wrapper, inputs), expected, rtol=1e-8)
    front = FrozenFrontEnd([nn.Flatten()], wrapper)  # type: ignore[list-item]
    assert torch.equal(outlier_score(front(inputs)), score_of(wrapper, inputs))


def test_unchanged_densities_keep_the_score_and_others_drop_it():
    inputs, label = labelled()
    scored = lambda: wrapper_around(inner=lambda: model().double())  # noqa: E731

    def around(name):
        outer = build("uncertainty", resolve("uncertainty", name), model=scored, target=CLASSES).eval()
        outer.calibrate(as_batches(inputs, label))
        return outer(inputs)

    with torch.no_grad():
        sets = around("conformal")
        assert outlier_score(sets).any() and value_set(sets) is sets
        assert outlier_score(around("temperature")) is None
        inside = build("uncertainty", resolve("uncertainty", "conformal"), model=model, target=CLASSES).eval()
        assert value_set(ScoredDensity(inside(inputs.float()), torch.zeros(90))) is not None
    real = model(REAL, "gaussian").double()(inputs)
    score = torch.arange(90.0)
    affine = AffineDensity(ScoredDensity(real, score), torch.zeros(90, 1), torch.ones(90, 1))
    assert torch.equal(outlier_score(affine), score) and outlier_score(real) is None
    columns = table_columns(REAL, Prediction(affine, {}))
    assert torch.equal(columns["outlier_score"], score)
    assert "outlier_score" not in table_columns(REAL, Prediction(real, {}))


@pytest.mark.parametrize(
    "config, target, message",
    [
        ({"neighbours": 3}, CLASSES, "neighbours = 3 has no effect on method=mahalanobis"),
        ({"method": "knn", "shrinkage": 0.1}, CLASSES, "shrinkage = 0.1 has no effect on method=knn"),
        (
            {"method": "energy", "normalise": False},
            CLASSES,
            "normalise = False has no effect on method=energy",
        ),
        ({"method": "energy"}, REAL, "with method=energy"),
        ({"method": "relative_mahalanobis"}, REAL, "with method=relative_mahalanobis"),
        ({"method": "knn", "references": 10}, CLASSES, "only 10 training samples are stored"),
        ({"method": "knn", "references": 10**8}, CLASSES, "Lower references"),
    ],
)
def test_settings_that_do_not_fit_are_refused(config, target, message):
    with pytest.raises(ConfigError, match=message):
        wrapper_around(
            target, inner=lambda: model(target, "gaussian" if target is REAL else "categorical"), **config
        )


def test_models_that_do_not_fit_are_refused():
    def members():
        part = resolve("uncertainty", {"name": "ensemble", "members": 2})
        return build("uncertainty", part, model=model, target=CLASSES)

    with pytest.raises(ConfigError, match="reads the features of one model, but Ensemble"):
        wrapper_around(inner=members)
    with pytest.raises(ConfigError, match="no such layer"):
        wrapper_around(inner=lambda: model(head="extra_trees"))
    with pytest.raises(ConfigError, match=r"allows at most 2,048\. Set method to knn"):
        wrapper_around(inner=lambda: model(length=3000))
    two = Target("class", ("a", "b"))
    inputs, label = labelled()
    with pytest.raises(ConfigError, match="needs one logit for each class"):
        wrapper_around(two, inner=lambda: model(two, "bernoulli"), method="energy").calibrate(
            as_batches(inputs, label % 2)
        )
    with pytest.raises(UserError, match="feature_score is calibrated on the validation split"):
        wrapper_around().calibrate([])


def test_a_metric_ranks_outliers_by_the_score():
    inputs, label = labelled()
    wrapper = wrapper_around()
    wrapper.calibrate(as_batches(inputs, label))
    part = resolve("metric", {"name": "out_of_distribution", "score": "outlier_score"})
    metric = build("metric", part)
    with torch.no_grad():
        metric.update(Prediction(wrapper(inputs), {}))
        metric.update(Prediction(wrapper(inputs - 100), {}, split="outliers"))
        assert metric.compute()["auroc"] == 1
        with pytest.raises(ConfigError, match=r"Choose a wrapper .* uncertainty=\[feature_score\]"):
            metric.update(Prediction(wrapper.model(inputs), {}))
    assert math.isfinite(metric.compute()["ood_entropy"])
