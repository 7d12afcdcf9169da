import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import sem
from sklearn.metrics import accuracy_score
from torch.distributions import Categorical, Independent, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.errors import ConfigError, DataError, UserError
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.accuracy.metric import Accuracy


def classes(count):
    return Target("class", tuple(f"class {k}" for k in range(count)))


def prediction(logits, label):
    return Prediction(Categorical(logits=logits, validate_args=False), {"target": torch.as_tensor(label)})


def compute_metric(logits, label):
    metric = build("metric", resolve("metric", "accuracy"), target=classes(logits.shape[-1]))
    metric.update(prediction(logits, label))
    return {name: value.item() for name, value in metric.compute().items()}


@settings(deadline=None, max_examples=80)
@given(st.data(), st.integers(2, 10), st.integers(1, 25), st.sampled_from([torch.float32, torch.float64]))
def test_accuracy_equals_sklearns_with_ties_for_the_first_class(data, count, samples, dtype):
    logit = st.sampled_from([0.0, 1.0, -2.0, 1e4, -1e4])  # few values, so that ties are frequent
    row = st.lists(logit, min_size=count, max_size=count)
    logits = np.array(data.draw(st.lists(row, min_size=samples, max_size=samples)))
    label = data.draw(st.lists(st.integers(0, count - 1), min_size=samples, max_size=samples))
    actual = compute_metric(torch.tensor(logits, dtype=dtype), label)
    predicted = logits.argmax(-1)  # NumPy returns the first of equal values
    assert actual["accuracy"] == pytest.approx(accuracy_score(label, predicted), abs=1e-15)
    if samples > 1:
        wanted = sem((predicted == np.array(label)).astype(float))
        assert actual["accuracy_sem"] == pytest.approx(wanted, abs=1e-14)
    else:
        assert math.isnan(actual["accuracy_sem"])


def test_the_prediction_of_a_mixture_has_the_largest_averaged_probability():
    # the components prefer different classes, but both give a third class 0.45
    probabilities = torch.tensor([[[0.5, 0.05, 0.45], [0.05, 0.5, 0.45]]])
    density = Mixture(torch.zeros(1, 2), Categorical(logits=probabilities.log()))
    metric = Accuracy(classes(3))
    metric.update(Prediction(density, {"target": torch.tensor([2])}))
    assert metric.compute()["accuracy"] == 1


def test_one_class_batches_and_probabilities_of_zero_and_one():
    certain = torch.tensor([[0.0, -torch.inf]]).expand(8, 2)
    assert compute_metric(certain, [0] * 8) == {"accuracy": 1.0, "accuracy_sem": 0.0}
    assert compute_metric(certain, [1] * 8) == {"accuracy": 0.0, "accuracy_sem": 0.0}


def test_nan_wrong_labels_and_wrong_densities_raise_a_clear_message():
    with pytest.raises(UserError, match="1 of 2 predicted distributions over classes"):
        compute_metric(torch.tensor([[0.0, 1.0], [0.0, torch.nan]]), [0, 1])
    with pytest.raises(DataError, match="row 1 is 2, but class indices go from 0 to 1"):
        compute_metric(torch.zeros(2, 2), [0, 2])
    with pytest.raises(UserError, match="is not a density over classes"):
        real = Independent(Normal(torch.zeros(3, 1), 1.0), 1)
        Accuracy(classes(2)).update(Prediction(real, {"target": torch.zeros(3, dtype=torch.int64)}))
    with pytest.raises(ConfigError, match="metric accuracy describes targets of kind 'class'"):
        Accuracy(Target("angle", ("azimuth",)))
