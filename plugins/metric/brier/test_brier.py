import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special
from scipy.stats import sem
from sklearn.metrics import brier_score_loss
from torch.distributions import Categorical

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.errors import ConfigError, DataError, UserError
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.brier.metric import Brier


def classes(count):
    return Target("class", tuple(f"class {k}" for k in range(count)))


def compute_metric(logits, label, parts=1):
    metric = build("metric", resolve("metric", "brier"), target=classes(logits.shape[-1]))
    label = torch.as_tensor(label)
    for index in torch.arange(len(label)).chunk(parts):
        density = Categorical(logits=logits[index], validate_args=False)
        metric.update(Prediction(density, {"target": label[index]}))
    return {name: value.item() for name, value in metric.compute().items()}


@settings(deadline=None, max_examples=80)
@given(st.data(), st.integers(2, 10), st.integers(1, 25), st.sampled_from([torch.float32, torch.float64]))
def test_score_equals_sklearns_and_standard_error_scipys(data, count, samples, dtype):
    # logits are shifted to a maximum of 0 before conversion to float32, as in density heads
    logit = st.sampled_from([0.0, 1.0, -1e4, -800.0]) | st.floats(-30, 0)
    row = st.lists(logit, min_size=count, max_size=count)
    logits = np.array(data.draw(st.lists(row, min_size=samples, max_size=samples)))
    label = data.draw(st.lists(st.integers(0, count - 1), min_size=samples, max_size=samples))
    actual = compute_metric(torch.tensor(logits, dtype=dtype), label, parts=data.draw(st.integers(1, 3)))
    probability = special.softmax(logits.astype(str(dtype).removeprefix("torch.")).astype(float), -1)
    tolerance = 1e-6 if dtype == torch.float32 else 1e-12
    if count == 2:  # eq. 2.26 uses only the positive class
        wanted = brier_score_loss(label, probability[:, 1], labels=[0, 1], pos_label=1)
    else:
        wanted = brier_score_loss(label, probability, labels=range(count), scale_by_half=False)
    assert actual["brier"] == pytest.approx(wanted, abs=tolerance)
    error = np.square(probability - np.eye(count)[label])
    scores = error[:, 1] if count == 2 else error.sum(-1)
    if samples > 1:  # the root turns rounding errors of 1e-16 into 1e-8
        assert actual["brier_sem"] == pytest.approx(sem(scores), abs=max(tolerance, 2e-8))
    else:
        assert math.isnan(actual["brier_sem"])


@pytest.mark.parametrize("size", [1e4, 1e30])
@pytest.mark.parametrize("count", [2, 3])
def test_certain_predictions_give_the_lowest_or_highest_score(size, count):
    logits = torch.zeros(5, count)
    logits[:, 1] = size
    most = 1.0 if count == 2 else 2.0
    assert compute_metric(logits, [1] * 5) == {"brier": 0.0, "brier_sem": 0.0}
    assert compute_metric(logits, [0] * 5) == {"brier": most, "brier_sem": 0.0}


def test_a_mixture_is_evaluated_with_averaged_probabilities():
    # two certain members that disagree give a probability of one half
    logits = torch.tensor([[[1e4, 0.0], [0.0, 1e4]]])
    metric = Brier(classes(2))
    metric.update(
        Prediction(Mixture(torch.zeros(1, 2), Categorical(logits=logits)), {"target": torch.tensor([0])})
    )
    assert metric.compute()["brier"].item() == pytest.approx(0.25, abs=1e-7)


def test_nan_wrong_labels_and_wrong_targets_raise_a_clear_message():
    with pytest.raises(UserError, match="2 of 2 predicted distributions over classes"):
        compute_metric(torch.full((2, 2), torch.nan), [0, 1])
    with pytest.raises(DataError, match="row 0 is 3, but class indices go from 0 to 2"):
        compute_metric(torch.zeros(1, 3), [3])
    with pytest.raises(ConfigError, match="metric brier describes targets of kind 'class'"):
        Brier(Target("real", ("x",)))
