import math

import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.data import Splits
from framework.errors import ConfigError, DataError
from framework.geometry import quaternions
from framework.geometry.rotation import viewpoint_rotation
from framework.geometry.symmetry import GROUPS, draw_members, log_blurred, nearest_distance
from plugins.data.symmetric_solids.generator import draw_images, random_rotations
from plugins.data.symmetric_solids.solids import SOLIDS, solid

SMALL = {"train": 400, "validation": 3, "test": 40, "image_size": 16, "renderer": "rasterizer"}
RENDERER = build("renderer", resolve("renderer", {"name": "rasterizer", "supersampling": 3, "cull": True}))


def prepared(**changes):
    data = build("data", resolve("data", {"name": "symmetric_solids", **SMALL, **changes}))
    data.prepare()
    return data


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_and_face_outwards(name):
    vertices, normals, faces, _ = solid(name)
    corners = vertices[faces]
    volumes = np.linalg.det(corners) / 6
    assert volumes.sum() > 0.2
    assert (volumes > -1e-12).all()  # the solids are convex around the origin
    directed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.abs(directed.sum(0)).max() < 1e-12
    flat = np.linalg.norm(directed, axis=1) > 1e-9
    cosine = (directed[:, None] * normals[faces]).sum(-1)[flat] / np.linalg.norm(directed[flat], axis=1)[
        :, None
    ]
    assert cosine.min() > 0.99
    assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-12
    assert np.linalg.norm(vertices, axis=1).max() <= 1 + 1e-12


@pytest.mark.parametrize("name", SOLIDS)
def test_a_solid_looks_the_same_after_the_rotations_of_its_group_and_after_no_others(name):
    turns = random_rotations(6, generator())
    group = solid(name).group
    equivalent = quaternions.product(turns, draw_members(6, group, generator(1)))
    other = random_rotations(6, generator(2))
    apart = nearest_distance(turns, other, group) > math.radians(10)
    first, same, different = (
        draw_images(name, part, 32, RENDERER).float() for part in (turns, equivalent, other)
    )
    assert (first - same).abs().flatten(1).mean(1).max() < 0.7  # bytes: corners are rounded to 1/256 pixel
    assert (first - different).abs().flatten(1).mean(1)[apart].min() > 2.5


def test_labels_have_the_density_that_the_batch_states():
    data = prepared(solids=list(SOLIDS))
    test = data.splits().test.fields
    labels = quaternions.of_matrix(viewpoint_rotation(test["target"].double()))
    for group, name in enumerate(SOLIDS):
        rows = test["group"] == group
        assert (test["symmetry_group"][rows] == GROUPS.index(solid(name).group)).all()
        expected = log_blurred(
            test["true_rotation"][rows], labels[rows], solid(name).group, data.concentration
        )
        torch.testing.assert_close(test["true_log_density"][rows], expected, rtol=1e-4, atol=1e-4)
        distance = nearest_distance(test["true_rotation"][rows], labels[rows], solid(name).group)
        assert math.radians(8) < distance.mean() < math.radians(20)


def test_augmentation_draws_new_labels_of_the_same_images():
    data = prepared()
    batch = data.splits().train.fields
    torch.manual_seed(0)
    new = data.augment(dict(batch))
    assert torch.equal(new["input"], batch["input"])
    assert (new["target"] != batch["target"]).any(-1).float().mean() > 0.99
    # both mean log-densities estimate the same negative entropy
    difference = (new["true_log_density"] - batch["true_log_density"]).double()
    assert difference.mean().abs() < 5 * difference.std() / len(difference) ** 0.5


def test_exact_labels_are_equivalent_to_the_true_rotation():
    data = prepared(label_noise_deg=0.0)
    test = data.splits().test.fields
    assert "true_log_density" not in test
    labels = quaternions.of_matrix(viewpoint_rotation(test["target"].double()))
    for index in test["symmetry_group"].unique().tolist():
        rows = test["symmetry_group"] == index
        assert nearest_distance(test["true_rotation"][rows], labels[rows], GROUPS[index]).max() < 1e-5


def test_images_of_a_solid_do_not_depend_on_the_other_solids():
    alone, among = prepared(solids=["cone"]), prepared(solids=["cube", "cone"])
    for split in Splits._fields:
        table, both = (getattr(data.splits(), split).fields for data in (alone, among))
        for name in ("input", "target"):
            assert torch.equal(table[name], both[name][both["group"] == 1])


def test_a_damaged_cache_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path))
    prepared(solids=["cone"])
    (file,) = tmp_path.rglob("test_images.npy")
    file.write_bytes(b"garbage")
    with pytest.raises(
        DataError, match=r"test_images\.npy: cannot be read as an array of generated data.*Delete the folder"
    ):
        prepared(solids=["cone"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"solids": ["cub"]}, "no known solid.*cube"),
        ({"solids": ["cube", "cube"]}, "twice"),
        ({"label_noise_deg": 0.01}, "below 0.1"),
        ({"solids": []}, "solids"),
    ],
)
def test_wrong_settings_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        prepared(**changes)
