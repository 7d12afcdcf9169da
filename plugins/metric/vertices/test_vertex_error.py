import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import sem
from torch.distributions import MultivariateNormal

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.vertices.metric import VertexError
from plugins.metric.vertices.rows import mesh


def make_prediction(point, target, scale):
    eye = torch.eye(point.shape[1], dtype=point.dtype)
    density = MultivariateNormal(point, scale_tril=eye, validate_args=False)
    return Prediction(density, {"target": target, "scale": scale})


def compute_metric(*batches, vertices):
    metric = build("metric", resolve("metric", "vertex_error"), target=mesh(vertices))
    for batch in batches:
        metric.update(make_prediction(*batch))
    return {name: value.item() for name, value in metric.compute().items()}


def loop(point, target, scale):
    """Return the distances one vertex at a time, centimetres."""
    return np.array(
        [
            [100 * s * math.dist(p[3 * v : 3 * v + 3], t[3 * v : 3 * v + 3]) for v in range(len(p) // 3)]
            for p, t, s in zip(point.tolist(), target.tolist(), scale.tolist(), strict=True)
        ]
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_agree_with_a_loop(dtype):
    generator = torch.Generator().manual_seed(0)
    point, target = (torch.randn(30, 120, generator=generator).to(dtype) for _ in range(2))
    scale = (0.5 + torch.rand(30, generator=generator)).to(dtype)
    actual = compute_metric(
        (point[:7], target[:7], scale[:7]), (point[7:], target[7:], scale[7:]), vertices=40
    )
    wanted = loop(point, target, scale)
    assert actual["vertex_error_cm"] == pytest.approx(wanted.mean(), rel=1e-12)
    assert actual["vertex_error_cm_sem"] == pytest.approx(sem(wanted.mean(1)), rel=1e-9)
    assert actual["vertex_error_median_cm"] == pytest.approx(np.median(wanted), rel=0.01)
    assert actual["vertex_error_95_cm"] == pytest.approx(np.quantile(wanted, 0.95), rel=0.01)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(2e-4, 9e3), min_size=1, max_size=30), st.sampled_from([0.5, 0.95]))
def test_a_quantile_is_one_of_the_distances(distances, share):
    distance = torch.tensor(distances, dtype=torch.float64)
    point = torch.zeros(len(distances), 3, dtype=torch.float64)
    point[:, 2] = distance / 100
    actual = compute_metric((point, torch.zeros_like(point), torch.ones(len(point))), vertices=1)
    wanted = np.quantile(distances, share, method="inverted_cdf")
    key = "vertex_error_median_cm" if share == 0.5 else "vertex_error_95_cm"
    assert actual[key] == pytest.approx(wanted, rel=0.01)


def test_a_millimetre_is_a_tenth_of_a_centimetre_whatever_the_scale():
    target = torch.zeros(1, 3, dtype=torch.float64)
    for scale in (1e-3, 1.0, 250.0):
        point = torch.tensor([[0.0, 0.001 / scale, 0.0]], dtype=torch.float64)
        actual = compute_metric((point, target, torch.tensor([scale])), vertices=1)
        assert actual["vertex_error_cm"] == pytest.approx(0.1, rel=1e-6)


def test_no_samples_give_nan_and_a_perfect_prediction_gives_0():
    nothing = (torch.zeros(0, 6), torch.zeros(0, 6), torch.ones(0))
    assert all(math.isnan(value) for value in compute_metric(nothing, vertices=2).values())
    point = torch.randn(3, 6)
    actual = compute_metric((point, point, torch.ones(3)), vertices=2)
    assert set(actual.values()) == {0.0}


def test_targets_and_data_that_are_no_meshes_raise_an_error():
    with pytest.raises(ConfigError, match="describes targets of kind 'real'"):
        VertexError(Target("angle", ("azimuth",)))
    with pytest.raises(ConfigError, match="the target has 4 numbers"):
        VertexError(Target("real", ("a", "b", "c", "d")))
    prediction = make_prediction(torch.zeros(2, 3), torch.zeros(2, 3), torch.ones(2))
    del prediction.batch["scale"]
    with pytest.raises(DataError, match="requires the batch field 'scale'"):
        VertexError(mesh(1)).update(prediction)
