import copy

import numpy as np
import pytest
import torch
from scipy import stats

from plugins.encoder.normal_scores.encoder import KNOTS, NormalScores


def fitted(inputs):
    encoder = NormalScores(tuple(inputs.shape[1:]))
    encoder.fit_inputs(inputs.split(64))
    return encoder


def test_the_scores_of_training_values_are_those_of_their_mean_ranks():
    torch.manual_seed(0)
    inputs = torch.stack([torch.randn(100).exp(), torch.randint(5, (100,)).float(), torch.ones(100)], 1)
    features = fitted(inputs)(inputs).numpy()
    np.testing.assert_array_equal(features[:, :3], inputs)
    for column in (0, 1):
        ranks = stats.rankdata(inputs[:, column].numpy())
        expected = stats.zscore(stats.norm.ppf((ranks - 0.5) / 100))
        np.testing.assert_allclose(features[:, 3 + column], expected, atol=2e-6)
    np.testing.assert_array_equal(features[:, 5], 0)


def test_many_values_are_interpolated_and_extremes_are_bounded():
    torch.manual_seed(0)
    inputs = torch.randn(20_000, 1, dtype=torch.float64).sinh()
    encoder = fitted(inputs)
    scores = encoder(inputs)[:, 1]
    expected = stats.zscore(stats.norm.ppf((stats.rankdata(inputs[:, 0].numpy()) - 0.5) / 20_000))
    assert np.abs(scores.numpy() - expected).max() < 0.05
    assert encoder(torch.tensor([[-1e30], [1e30]], dtype=torch.float64))[:, 1].abs().max() < 4.2
    assert (encoder(inputs.sort(0).values)[:, 1].diff() >= 0).all()


def test_the_form_for_export_computes_the_same(monkeypatch):
    torch.manual_seed(0)
    inputs = torch.stack([torch.randn(500).exp(), torch.randint(3, (500,)).float()], 1)
    encoder = fitted(inputs)
    new = torch.cat([inputs, 3 * torch.randn(50, 2)])
    expected = encoder(new)
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    torch.testing.assert_close(encoder(new), expected, rtol=1e-4, atol=1e-4)


def test_the_fitted_state_is_stored():
    encoder = fitted(torch.randn(300, 2))
    other = NormalScores((2,))
    assert other.values.shape == (2, KNOTS)
    other.load_state_dict(copy.deepcopy(encoder.state_dict()))
    inputs = torch.randn(9, 2)
    assert torch.equal(other(inputs), encoder(inputs))


@pytest.mark.parametrize("count", [1, 2, KNOTS, KNOTS + 1])
def test_any_number_of_values_gives_finite_scores(count):
    inputs = torch.arange(count, dtype=torch.float32)[:, None]
    assert fitted(inputs)(torch.linspace(-5, 2 * count, 50)[:, None]).isfinite().all()
