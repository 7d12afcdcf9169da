import os
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from framework.errors import DataError
from plugins.data.labelled_clouds.rows import CLASSES, archive, objects

NAME = "dales"


@pytest.fixture
def root(tmp_path):
    return Path(archive(tmp_path)["root"])


def test_objects_are_cut_out_and_padded(prepare_data, root):
    arrays = objects()
    dataset = prepare_data(root=root)
    assert dataset.target.names == CLASSES
    assert dataset.input_shape == (int(np.diff(arrays["offset"]).max()), 3)
    assert (dataset.columns, dataset.varies) == (("x", "y", "z"), False)
    numbers = []
    for split in dataset.splits():
        batch = split.__getitems__(range(len(split)))
        for cloud, label, number in zip(batch["input"], batch["target"], batch["object"] - 100, strict=True):
            expected = arrays["points"][arrays["offset"][number] : arrays["offset"][number + 1]]
            np.testing.assert_array_equal(cloud[: len(expected)], expected)
            assert cloud[len(expected) :].isnan().all()
            assert label == arrays["label"][number]
        numbers += batch["object"].tolist()
    assert sorted(numbers) == list(range(100, 133))  # each object is in one split


def test_every_object_is_in_the_test_split_of_one_fold(prepare_data, root):
    numbers = []
    for fold in range(5):
        splits = prepare_data(root=root, fold=fold, validation_share=0.2).splits()
        batch = splits.test.__getitems__(range(len(splits.test)))
        numbers += batch["object"].tolist()
        counts = torch.bincount(batch["target"], minlength=3)
        assert set(counts.tolist()) <= {2, 3}
        assert torch.bincount(splits.validation.fields.fields["target"]).tolist() in (
            [2, 2, 2],
            [2, 1, 2],
            [1, 2, 2],
        )
    assert sorted(numbers) == list(range(100, 133))
    assert (
        prepare_data(root=root).fingerprint()["sha256"]
        != prepare_data(root=root, data_seed=1).fingerprint()["sha256"]
    )


def test_the_points_of_larger_objects_do_not_depend_on_the_fold(prepare_data, root):
    clouds, sizes = {}, np.diff(objects()["offset"])
    for fold in (0, 1):
        dataset = prepare_data(root=root, points=10, fold=fold)
        assert dataset.input_shape == (10, 3)
        for split in dataset.splits():
            for number in range(len(split)):
                sample = split[number]
                cloud = clouds.setdefault(int(sample["object"]), sample["input"])
                assert torch.equal(cloud, sample["input"])
                assert len(cloud) == min(10, sizes[int(sample["object"]) - 100])


def without(name):
    """Return a function that leaves out an array of an archive."""
    return lambda arrays: {key: value for key, value in arrays.items() if key != name}


def with_change(name, change):
    """Return a function that changes a copy of an array of an archive by calling `change` with the copy."""

    def apply(arrays):
        arrays = {**arrays, name: arrays[name].copy()}
        change(arrays[name])
        return arrays

    return apply


@pytest.mark.parametrize(
    "change, message",
    [
        (without("label"), "holds points, offset, object_id, classes, but no label"),
        (
            with_change("label", lambda label: label.__setitem__(3, 9)),
            "Object 3 has label 9, but there are only 3 classes",
        ),
        (
            with_change("offset", lambda offset: offset.__setitem__(3, offset[4])),
            "expected offsets that ascend",
        ),
        (with_change("offset", lambda offset: offset.__setitem__(-1, 5)), "expected offsets that ascend"),
        (
            with_change("points", lambda points: points.__setitem__((7, 1), np.nan)),
            "Point 7 of object 0 has a coordinate",
        ),
        (lambda arrays: {**arrays, "points": arrays["points"][:, :2]}, r"points float32 \(\d+, 2\)"),
        (
            lambda arrays: {**arrays, "label": arrays["label"][:-1]},
            "have 34, 32 and 33 numbers",
        ),
    ],
)
def test_another_archive_is_refused(prepare_data, tmp_path, change, message):
    arrays = objects()
    assert arrays["offset"][1] > 7  # so that point 7 belongs to object 0
    np.savez(tmp_path / "objects.npz", **change(arrays))
    with pytest.raises(DataError, match=message):
        prepare_data(root=tmp_path / "objects.npz")


def test_other_archives_are_refused(data, prepare_data, tmp_path):
    with pytest.raises(DataError, match=r"data\.root is not set\. .* github\.com/ATRM-Raphael/geo5017_A2"):
        data().prepare()
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(DataError, match="the file is a single array"):
        prepare_data(root=tmp_path / "array.npy")
    with pytest.raises(
        DataError, match=r"nowhere\.npz: no such file; expected a \.npz archive .*Correct data\.root"
    ):
        prepare_data(root=tmp_path / "nowhere.npz")


def test_a_class_of_few_objects_keeps_its_training_samples(prepare_data, tmp_path):
    np.savez(tmp_path / "objects.npz", **objects((30, 5)))
    dataset = prepare_data(root=tmp_path / "objects.npz", fold=2)
    assert torch.bincount(dataset.splits().train.fields.fields["target"], minlength=2).min() >= 1


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_distances_to_fixed_points_distinguish_the_real_objects(prepare_data):
    random = np.random.default_rng(0)
    basis = random.normal(size=(128, 3))
    basis *= random.random((128, 1)) ** (1 / 3) / np.linalg.norm(basis, axis=1, keepdims=True)

    def encode(split):
        """Return the distances of each cloud to the basis points, and the classes."""
        rows = []
        for number in range(len(split)):
            points = split[number]["input"].double().numpy()
            points = points - points.mean(0)
            points /= np.linalg.norm(points, axis=1).max()
            rows.append(cKDTree(points).query(basis)[0])
        return np.array(rows), split.fields.fields["target"].numpy()

    dataset = prepare_data(root=Path(os.environ["REAL_DATA_ROOT"]) / "clouds" / "dales500.npz", points=2000)
    assert dataset.target.names == ("building", "car", "fence", "pole", "tree")
    train, validation, test = dataset.splits()
    assert (len(train), len(validation), len(test)) == (339, 60, 100)
    model = make_pipeline(StandardScaler(), LogisticRegression(max_iter=2000)).fit(*encode(train))
    assert model.score(*encode(test)) > 0.9
