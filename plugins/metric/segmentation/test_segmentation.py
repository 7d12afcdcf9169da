"""Tests of the metric against scikit-learn and an explicit jackknife."""

import math

import numpy as np
import pytest
import torch
from sklearn.metrics import accuracy_score, jaccard_score
from torch.distributions import Categorical

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.segmentation.metric import Segmentation

NAMES = ("ground", "car", "tree")


def compute(guess, label, scan, parts=1, names=NAMES):
    metric = build("metric", resolve("metric", "segmentation"), target=Target("class", names))
    for index in np.array_split(np.arange(len(label)), parts):
        logits = torch.nn.functional.one_hot(torch.as_tensor(guess[index]), len(names)).double()
        batch = {"target": torch.as_tensor(label[index]), "scan": torch.as_tensor(scan[index])}
        metric.update(Prediction(Categorical(logits=logits, validate_args=False), batch))
    return {name: value.item() for name, value in metric.compute().items()}


@pytest.mark.parametrize("parts", [1, 7])
def test_numbers_equal_sklearns_and_errors_those_of_the_jackknife_over_scans(parts):
    random = np.random.default_rng(0)
    scan = random.integers(0, 5, 200) * 3  # numbers with gaps, in any order
    label = random.integers(0, 3, 200)
    guess = np.where(random.random(200) < 0.2 + 0.1 * (scan / 3), label, random.integers(0, 3, 200))
    actual = compute(guess, label, scan, parts)

    def scores(rows):
        overlap = jaccard_score(label[rows], guess[rows], average=None)
        return np.array([accuracy_score(label[rows], guess[rows]), overlap.mean(), *overlap])

    whole = scores(np.ones(200, bool))
    left_out = np.stack([scores(scan != number) for number in np.unique(scan)])
    error = np.sqrt(4 / 5 * np.square(left_out - left_out.mean(0)).sum(0))
    keys = ("point_accuracy", "mean_iou", *(f"iou_{name}" for name in NAMES))
    np.testing.assert_allclose([actual[key] for key in keys], whole, atol=1e-14)
    np.testing.assert_allclose([actual[f"{key}_sem"] for key in keys], error, atol=1e-14)


def test_repeating_every_point_changes_no_standard_error():
    """Points of one scan are not independent: a hundred copies of each point say nothing new."""
    random = np.random.default_rng(1)
    label, guess, scan = random.integers(0, 3, 60), random.integers(0, 3, 60), np.arange(60) % 6
    once = compute(guess, label, scan)
    often = compute(*(np.tile(values, 100) for values in (guess, label, scan)))
    assert often == pytest.approx(once, abs=1e-12)


def test_an_absent_class_is_left_out_and_one_scan_has_no_standard_error():
    actual = compute(np.array([0, 1, 1, 0]), np.array([0, 1, 0, 0]), np.zeros(4, int))
    assert actual["point_accuracy"] == 0.75
    assert actual["mean_iou"] == pytest.approx((2 / 3 + 1 / 2) / 2)
    assert math.isnan(actual["iou_tree"])
    assert all(math.isnan(value) for key, value in actual.items() if key.endswith("_sem"))


@pytest.mark.parametrize("predicted_elsewhere", [False, True])
def test_a_class_of_one_scan_has_no_standard_error(predicted_elsewhere):
    """All other scans say nothing of such a class, so that the jackknife would give it an error near 0."""
    label, scan = np.array([0, 1, 2, 2, 0, 1, 0, 1]), np.array([0, 0, 0, 0, 1, 1, 2, 2])
    guess = np.array([0, 1, 2, 0, 0, 0, 1, 2 if predicted_elsewhere else 1])
    actual = compute(guess, label, scan)
    assert math.isfinite(actual["iou_tree"])
    assert math.isnan(actual["iou_tree_sem"]) is not predicted_elsewhere
    assert all(actual[f"{key}_sem"] > 0 for key in ("point_accuracy", "mean_iou", "iou_ground", "iou_car"))


def test_samples_without_scans_and_wrong_labels_are_refused():
    density = Categorical(logits=torch.zeros(2, 3), validate_args=False)
    metric = Segmentation(Target("class", NAMES))
    with pytest.raises(ConfigError, match="reads the field 'scan' of the batches"):
        metric.update(Prediction(density, {"target": torch.zeros(2).long()}))
    with pytest.raises(DataError, match="row 1 is 3, but class indices go from 0 to 2"):
        batch = {"target": torch.tensor([0, 3]), "scan": torch.zeros(2).long()}
        metric.update(Prediction(density, batch))
    with pytest.raises(ConfigError, match="metric segmentation describes targets of kind 'class'"):
        Segmentation(Target("real", ("x",)))
