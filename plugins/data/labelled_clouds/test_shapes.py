"""Tests of the generated set."""

import hashlib
import json

import numpy as np
import pytest

from framework.geometry.meshes import read
from plugins.data.labelled_clouds.shapes import generator
from plugins.data.labelled_clouds.shapes.generator import CLASSES, Models, as_off, generate_models, model


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Return a generated root of 3 + 2 models of each class, in a cache of the module's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FRAMEWORK_CACHE", str(tmp_path_factory.mktemp("cache")))
        return generate_models(Models(train_models=3, test_models=2))


def test_the_seed_determines_every_byte(root):
    again = generate_models(Models(train_models=3, test_models=2))
    assert again != root

    def content(folder):
        return {file.relative_to(folder): file.read_bytes() for file in sorted(folder.rglob("*.off"))}

    assert content(again) == content(root)
    more = content(generate_models(Models(train_models=4, test_models=2)))
    first = {name: text for name, text in content(root).items() if name.parts[1] == "train"}
    assert {
        name: more[name] for name in first
    } == first  # a larger set begins with the models of a smaller set
    assert content(generate_models(Models(train_models=4, test_models=2, generator_seed=1))) != content(root)
    assert json.loads((again / "synthetic.json").read_text())["seed"] == 0


def test_the_bytes_are_those_of_this_version():
    """Check the bytes: changes of shapes or of the writer must increase `generator.VERSION`, or old caches are read."""
    digest = hashlib.sha256()
    for category in CLASSES:
        digest.update(as_off(model(category, "train", 0, 0)).encode())
    assert (generator.VERSION, digest.hexdigest()[:12]) == (2, "c910d65c24ef")


FACES = (10, 8000)
# plausible range of the longest edge of the upright box around a stretched model, metres
EDGE_M = {
    "airplane": (1.0, 9.0), "bathtub": (0.8, 5.0), "bed": (1.0, 6.0), "bench": (0.4, 6.0),
    "bookshelf": (0.4, 5.0), "bottle": (0.2, 2.0), "bowl": (0.2, 1.6), "car": (1.6, 13.0),
    "chair": (0.4, 3.0), "cone": (0.2, 2.5), "cup": (0.1, 1.2), "curtain": (0.6, 6.0),
    "desk": (0.4, 5.0), "door": (1.0, 7.0), "dresser": (0.4, 5.0), "flower_pot": (0.1, 2.2),
    "glass_box": (0.25, 6.0), "guitar": (0.4, 3.0), "keyboard": (0.1, 1.5), "lamp": (0.3, 5.5),
    "laptop": (0.12, 1.5), "mantel": (0.6, 6.5), "monitor": (0.2, 3.5), "night_stand": (0.25, 2.2),
    "person": (0.8, 4.5), "piano": (0.8, 8.5), "plant": (0.15, 5.0), "radio": (0.1, 1.6),
    "range_hood": (0.3, 4.0), "sink": (0.2, 4.0), "sofa": (0.6, 7.0), "stairs": (0.6, 12.0),
    "stool": (0.2, 2.2), "table": (0.4, 6.0), "tent": (0.8, 9.0), "toilet": (0.3, 2.2),
    "tv_stand": (0.4, 6.0), "vase": (0.15, 2.5), "wardrobe": (0.7, 6.0), "xbox": (0.12, 1.6),
}  # fmt: skip


def test_the_classes_are_those_of_modelnet40(root):
    """Check that the root holds exactly Princeton's 40 classes, in their order, with the same number of models each."""
    assert list(CLASSES) == sorted(CLASSES) == list(EDGE_M)
    assert sorted(path.name for path in root.iterdir() if path.is_dir()) == list(CLASSES)
    for split, count in (("train", 3), ("test", 2)):
        assert {len(list((root / name / split).iterdir())) for name in CLASSES} == {count}


@pytest.mark.parametrize("category", CLASSES)
def test_every_model_is_a_closed_surface_of_sensible_size(root, category):
    files = sorted((root / category).rglob("*.off"))
    assert [file.name for file in files] == [f"{category}_{number:04d}.off" for number in (4, 5, 1, 2, 3)]
    for file in files:
        mesh = read(file)
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        assert EDGE_M[category][0] < (high - low).max() < EDGE_M[category][1]
        assert (high - low).min() > 0.01 * (high - low).max()
        assert FACES[0] <= len(mesh.faces) < FACES[1]
        # a closed surface with outward normals: ∮ n dA = 0, and the volume ∮ x · n dA / 3 is positive
        corners = mesh.vertices[mesh.faces]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        np.testing.assert_allclose(area.sum(0), 0, atol=1e-4 * np.abs(area).sum())
        assert (corners.mean(1) * area).sum() / 3 > 0
        wide, deep, tall = high - low
        box_area = 2 * (wide * deep + deep * tall + tall * wide)  # of the box around the model
        assert 0.05 * box_area < np.linalg.norm(area, axis=1).sum() < 12 * box_area
        assert_edges_meet(mesh.vertices, mesh.faces)


@pytest.mark.parametrize("category", CLASSES)
def test_no_triangle_has_area_zero(category):
    for number in range(3):
        solid = model(category, "test", number, 3)
        corners = np.round(solid.vertices, 5)[solid.faces]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        assert np.linalg.norm(area, axis=1).min() > 0


def assert_edges_meet(vertices, faces):
    """Assert that the faces pass every edge equally often in both directions.

    Then there is no hole, and no face is inside out.
    """
    corners = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)[faces]
    start, end = corners.reshape(-1), np.roll(corners, -1, axis=1).reshape(-1)
    count = len(vertices)
    np.testing.assert_array_equal(np.sort(start * count + end), np.sort(end * count + start))


def test_the_models_of_a_class_differ(root):
    for category in CLASSES:
        texts = {as_off(model(category, "train", number, 0)) for number in range(4)}
        assert len(texts) == 4
