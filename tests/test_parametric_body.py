import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from framework.bodies.parametric import parametric_body
from framework.testing.bodies import DOLL, random_parameters


@pytest.fixture(scope="module")
def body_model():
    return parametric_body(DOLL["body"])


def test_place_turns_the_body_about_its_root_and_moves_it(body_model):
    nominal = body_model(torch.zeros(len(body_model.names))).double().numpy()
    place = torch.zeros(len(body_model.names), dtype=torch.float64)
    place[:6] = torch.tensor([0.3, -1.2, 0.7, 0.1, -0.2, 0.3])
    root = body_model.joints[body_model.parents.index(-1)].numpy()
    wanted = Rotation.from_rotvec(place[:3].numpy()).apply(nominal - root) + root + place[3:6].numpy()
    np.testing.assert_allclose(body_model(place).numpy(), wanted, atol=2e-6)
    np.testing.assert_allclose(nominal, body_model.template.T.numpy(), atol=1e-6)


def test_movements_bend_what_they_name(body_model):
    """Check that the forearm moves forwards, the knee back and the arm up, and that left mirrors right."""

    def moved(name):
        given = torch.zeros(len(body_model.names), dtype=torch.float64)
        given[body_model.names.index(name)] = 0.2
        return (body_model(given) - body_model(given * 0)).double()

    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    for name, axis, sign in (
        ("elbow", 2, 1),
        ("knee", 2, -1),
        ("raise", 1, 1),
        ("hip", 2, 1),
        ("forward", 2, 1),
    ):
        left, right = moved(f"left_{name}"), moved(f"right_{name}")
        far = left.norm(dim=1).argmax()
        assert sign * left[far, axis] > 0.02, name
        assert (left.sum(0) * mirror - right.sum(0)).abs().max() < 0.02, name


def test_slopes_are_those_of_the_vertices(body_model):
    at, chosen, step = random_parameters(body_model), torch.arange(0, len(body_model.colors), 7), 1e-3
    slopes = body_model.derivatives(at, chosen)
    for column in range(len(at)):
        aside = torch.zeros_like(at)
        aside[column] = step
        wanted = (body_model(at + aside) - body_model(at - aside))[chosen] / (2 * step)
        torch.testing.assert_close(
            slopes[:, :, column], wanted, atol=1e-3, rtol=1e-3, msg=body_model.names[column]
        )
