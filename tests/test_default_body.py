import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from framework.bodies import default_body
from framework.bodies.body import BodyModel
from framework.bodies.default_body import Traits, interpolation
from framework.errors import DataError


@pytest.fixture(scope="module")
def found():
    return default_body.load_default_body()


def test_it_moves_as_the_packages_own_model_does(found):
    _, traits = found
    assert 0 < traits.largest_error < 2e-6  # metres, float32 against float64; measured when it was extracted


def test_it_stands_upright_faces_the_front_and_has_two_sides(found):
    body, traits = found
    model = BodyModel(body)
    vertices = model(torch.zeros(1, 1), torch.zeros(1, len(body.parents), 3))[0]
    assert body.template.shape == (13_718, 3)
    assert traits.labels == ("gender", "age", "muscle", "weight", "height", "proportions")
    place = dict(zip(body.names, model.joints.numpy(), strict=True))
    assert place["head"][1] > place["spine01"][1] > place["foot.L"][1]  # y up
    assert place["wrist.L"][0] > 0 > place["wrist.R"][0]  # x to its left
    assert place["eye.L"][2] > place["head"][2]  # z to the front
    assert vertices.isfinite().all()
    # the surface is nearly closed: its volume is positive if faces are counter-clockwise seen from outside
    corners = vertices[model.faces]
    volume = torch.linalg.det(corners).sum() / 6
    assert 0.01 < volume < 0.2


def test_it_has_places_in_a_texture_with_seams(found):
    body, _ = found
    assert body.uv.shape == (21_334, 2) and body.uv_faces.shape == body.faces.shape
    assert body.uv.min() > 0 and body.uv.max() < 1
    pairs = np.unique(np.stack([body.faces.ravel(), body.uv_faces.ravel()]), axis=1)
    # each texture coordinate belongs to one vertex, and few vertices lie on a seam
    assert len(np.unique(pairs[1])) == pairs.shape[1]
    assert 1.02 < pairs.shape[1] / len(body.template) < 1.2
    # hands lie apart from the face in the texture: with v upwards, hands and feet are low
    face, hands = (
        body.uv[pairs[1][body.weights[pairs[0]][:, joints].sum(1) > 0.9]] for joints in _joints(body)
    )
    assert face[:, 0].mean() > 0.6 and np.abs(face[:, 1] - 0.5).mean() < 0.3
    assert hands[:, 1].max() < 0.35
    for wrong in ({"uv": body.uv[:50]}, {"uv": body.uv * np.nan}, {"uv_faces": body.uv_faces[:9]}):
        with pytest.raises(DataError, match=r"expected finite uv .* uv_faces of shape \(27420, 3\)"):
            replace(body, **wrong)


def _joints(body):
    """Return the joints of the head, and those of the fingers."""
    return [
        [number for number, name in enumerate(body.names) if name.startswith(words)]
        for words in (("head", "eye"), ("finger",))
    ]


def test_traits_do_what_they_are_called(found):
    body, traits = found
    model = BodyModel(body)

    def height(**values):
        row = torch.tensor([[values.get(label, 2 / 3 if label == "age" else 0.5) for label in traits.labels]])
        vertices = model(traits.coefficients(row), torch.zeros(1, len(body.parents), 3))[0]
        return (vertices[:, 1].max() - vertices[:, 1].min()).item()

    assert 1.75 < height() < 1.9
    assert height(age=0.0) < height(age=1 / 3) < height()
    assert height(gender=1.0) < height(gender=0.0)
    assert height(height=0.4) < height(height=0.6)


def test_it_comes_from_the_cache_the_second_time(found, monkeypatch):
    monkeypatch.setattr(default_body, "_write", lambda folder: pytest.fail("extracted twice"))
    again = default_body.load_default_body()
    for name in ("template", "weights", "shapes", "joint_shapes", "uv", "uv_faces"):
        assert np.array_equal(getattr(again[0], name), getattr(found[0], name))


def test_without_the_package_it_says_how_to_get_it(monkeypatch):
    def missing(name):
        raise default_body.PackageNotFoundError(name)

    monkeypatch.setattr(default_body, "version", missing)
    with pytest.raises(DataError, match=r"pip install -e '\.\[body\]'"):
        default_body.load_default_body()


def made():
    """Return traits "age" with three anchors, "size" with two, "side" without anchors, and "hidden" without a label."""
    columns = ("age", "age", "age", "side", "side", "size", "size", "hidden", "hidden")
    random = np.random.default_rng(0)
    return Traits(
        labels=("size", "age"),
        anchors={
            "age": np.array([-0.5, 0.25, 1.0]),
            "size": np.array([0.0, 1.0]),
            "hidden": np.array([0.0, 1.0]),
        },
        traits=columns,
        products=random.random((12, len(columns))) < 0.3,
        projection=random.normal(size=(12, 4)),
    )


@pytest.mark.parametrize("size, age", [*itertools.product((0.0, 0.3, 1.0), (0.0, 0.25, 0.8, 1.0))])
def test_coefficients_are_those_of_a_loop(size, age):
    traits = made()
    weights = [*hat(age, (-0.5, 0.25, 1.0)), 0.5, 0.5, *hat(size, (0.0, 1.0)), 0.5, 0.5]
    blends = []
    for chosen in traits.products:
        product = 1.0
        for weight, one in zip(weights, chosen, strict=True):
            product *= weight if one else 1.0
        blends.append(product)
    found = traits.coefficients(torch.tensor([[size, age]], dtype=torch.float64))
    np.testing.assert_allclose(found.numpy()[0], np.array(blends) @ traits.projection, atol=1e-15)


def hat(value, anchors):
    """Return NumPy's linear interpolation of the indicator of each anchor."""
    return [float(np.interp(value, anchors, np.eye(len(anchors))[i])) for i in range(len(anchors))]


def test_interpolation_stays_within_its_anchors():
    anchors = torch.tensor([-0.5, 0.25, 1.0], dtype=torch.float64)
    values = torch.tensor([-3.0, -0.5, 0.25, 0.7, 1.0, 9.0], dtype=torch.float64)
    found = interpolation(values, anchors)
    np.testing.assert_allclose(found, [hat(value, anchors.tolist()) for value in values.tolist()], atol=1e-15)


@pytest.mark.parametrize("values", [[[0.5, 1.1]], [[-0.1, 0.5]], [[0.5]], [[float("nan"), 0.5]]])
def test_traits_out_of_range_are_refused(values):
    with pytest.raises(ValueError, match="expected a number in 0…1 for each of size, age"):
        made().coefficients(torch.tensor(values))
