"""Figure of the predicted probabilities of a classifier of two inputs."""

import math

import numpy as np
import pytest
import torch

from framework.reports.landscape_picture import POINTS, Plane, draw_landscapes, half_width, probabilities
from framework.target import Target
from tests.test_tradeoff import predictor


@pytest.mark.parametrize("names, head", [(("a", "b"), "bernoulli"), (("a", "b", "c"), "categorical")])
def test_a_landscape_holds_the_probabilities_at_its_points(names, head, tmp_path):
    model = predictor(head=head, target=Target("class", names))
    found = probabilities(model, 3.0)
    assert found.shape == (POINTS, POINTS)
    axis = np.linspace(-3, 3, POINTS)
    point = torch.tensor(
        [[axis[10], axis[50]]], dtype=torch.float32
    )  # the 11th from the left, the 51st from below
    with torch.no_grad():
        shares = model(point).probs[0].double().numpy()
    wanted = shares[1] if len(names) == 2 else -(shares * np.log(shares)).sum() / math.log(3)
    assert found[50, 10] == pytest.approx(wanted, abs=1e-5)
    points, labels = np.random.default_rng(0).normal(size=(9, 2)), np.arange(9) % len(names)
    plane = Plane(points, labels, points[:0], names, half_width(points, points[:0]))
    figure = draw_landscapes({"one": found, "two": found}, plane, title="t", synthetic=True)
    figure.savefig(tmp_path / "x.png")
    assert figure.get_suptitle() == "t (synthetic data)"
