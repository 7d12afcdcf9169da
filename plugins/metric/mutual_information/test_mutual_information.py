"""Tests of the two parts of the entropy against sums over classes and quadrature."""

import numpy as np
import pytest
import torch
from scipy import integrate, special, stats
from torch.distributions import Categorical, Independent, Normal

from framework.calibration.equal_mixture import equal_mixture
from framework.configuration.schema import build, resolve
from framework.distributions.batch_shapes import Stacked
from framework.distributions.density import Mixture
from framework.distributions.model_mixtures import expected_entropy
from framework.distributions.tempering import temper
from framework.prediction import Prediction


def compute_metric(*densities):
    metric = build("metric", resolve("metric", "mutual_information"))
    for density in densities:
        metric.update(Prediction(density, {}))
    return {name: value.item() for name, value in metric.compute().items()}


def over_models(components):
    like = torch.nn.Linear(1, 1).double()
    return equal_mixture(components, like, torch.device("cpu"))


def test_entropies_of_class_mixtures_equal_sums_in_numpy():
    logits = 2 * torch.randn(7, 5, 3, dtype=torch.float64)
    probability = torch.softmax(logits, -1).numpy()
    expected = special.entr(probability).sum(-1).mean(1)
    total = special.entr(probability.mean(1)).sum(-1)
    parts = (Categorical(logits=part, validate_args=False) for part in logits.split([4, 3]))
    results = compute_metric(*map(over_models, parts))
    assert results["expected_entropy"] == pytest.approx(expected.mean(), rel=1e-12)
    assert results["mutual_information"] == pytest.approx((total - expected).mean(), rel=1e-10)
    assert results["total_entropy"] == pytest.approx(total.mean(), rel=1e-12)
    assert results["mutual_information_sem"] == pytest.approx(stats.sem(total - expected), rel=1e-8)


def test_entropies_of_normal_mixtures_equal_quadrature():
    place, scale = (
        torch.tensor([[[-1.0], [0.5], [3.0]]]).double(),
        torch.tensor([[[0.4], [1.0], [0.7]]]).double(),
    )
    results = compute_metric(over_models(Independent(Normal(place, scale, validate_args=False), 1)))
    normals = [stats.norm(float(m), float(s)) for m, s in zip(place.flatten(), scale.flatten(), strict=True)]

    def integrand(value):
        return special.entr(np.mean([normal.pdf(value) for normal in normals]))

    total = integrate.quad(integrand, -8, 12, limit=400)[0]
    expected = np.mean([normal.entropy() for normal in normals])
    assert results["expected_entropy"] == pytest.approx(expected, rel=1e-10)
    assert results["mutual_information"] == pytest.approx(total - expected, abs=1e-6)


def test_only_models_have_mutual_information_and_not_components_of_a_head():
    logits = torch.randn(4, 3, 5, dtype=torch.float64)
    components = Categorical(logits=logits, validate_args=False)
    head = Mixture(torch.randn(4, 3).double(), components)  # as the density head `mixture` returns it
    assert compute_metric(head)["mutual_information"] == 0
    nested = over_models(Stacked([head, head]))
    assert compute_metric(nested)["mutual_information"] == pytest.approx(0, abs=1e-12)
    deep = over_models(Stacked([over_models(components), over_models(components)]))
    torch.testing.assert_close(expected_entropy(deep), components.entropy().mean(1))
    normals = over_models(
        Independent(Normal(logits[..., :1], logits[..., 1:2].exp(), validate_args=False), 1)
    )
    tempered = temper(normals, torch.tensor(2.0).double())
    assert (tempered.entropy() - expected_entropy(tempered) > 1e-3).any()


def test_members_that_disagree_without_doubt_have_mutual_information_only():
    logits = torch.tensor([[[100.0, -100.0], [-100.0, 100.0]]]).double()
    results = compute_metric(over_models(Categorical(logits=logits, validate_args=False)))
    assert results["expected_entropy"] == pytest.approx(0, abs=1e-12)
    assert results["mutual_information"] == pytest.approx(np.log(2))
