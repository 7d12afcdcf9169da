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


def test_objects_are_cut_out_and_padded(prepared, root):
    held = objects()
    found = prepared(root=root)
    assert found.target.names == CLASSES
    assert found.input_shape == (int(np.diff(held["offset"]).max()), 3)
    assert (found.columns, found.varies) == (("x", "y", "z"), False)
    seen = []
    for split in found.splits():
        batch = split.__getitems__(range(len(split)))
        for cloud, label, number in zip(batch["input"], batch["target"], batch["object"] - 100, strict=True):
            wanted = held["points"][held["offset"][number] : held["offset"][number + 1]]
            np.testing.assert_array_equal(cloud[: len(wanted)], wanted)
            assert cloud[len(wanted) :].isnan().all()
            assert label == held["label"][number]
        seen += batch["object"].tolist()
    assert sorted(seen) == list(range(100, 133))  # each once


def test_every_object_is_tested_once_over_the_folds(prepared, root):
    tested = []
    for fold in range(5):
        found = prepared(root=root, fold=fold, validation_share=0.2)
        batch = found.splits().test.__getitems__(range(len(found.splits().test)))
        tested += batch["object"].tolist()
        counts = torch.bincount(batch["target"], minlength=3)
        assert set(counts.tolist()) <= {2, 3}
        assert torch.bincount(found.splits().validation.fields.fields["target"]).tolist() in (
            [2, 2, 2],
            [2, 1, 2],
            [1, 2, 2],
        )
    assert sorted(tested) == list(range(100, 133))
    assert (
        prepared(root=root).fingerprint()["sha256"]
        != prepared(root=root, data_seed=1).fingerprint()["sha256"]
    )


def test_larger_objects_are_subsampled_whatever_the_fold(prepared, root):
    clouds, whole = {}, np.diff(objects()["offset"])
    for fold in (0, 1):
        found = prepared(root=root, points=10, fold=fold)
        assert found.input_shape == (10, 3)
        for split in found.splits():
            for number in range(len(split)):
                sample = split[number]
                cloud = clouds.setdefault(int(sample["object"]), sample["input"])
                assert torch.equal(cloud, sample["input"])
                assert len(cloud) == min(10, whole[int(sample["object"]) - 100])


def without(name):
    return lambda held: {key: value for key, value in held.items() if key != name}


def changed(name, change):
    def apply(held):
        held = {**held, name: held[name].copy()}
        change(held[name])
        return held

    return apply


@pytest.mark.parametrize(
    "change, message",
    [
        (without("label"), "holds points, offset, object_id, classes, but no label"),
        (
            changed("label", lambda label: label.__setitem__(3, 9)),
            "object 3 has label 9, but there are 3 classes",
        ),
        (changed("offset", lambda offset: offset.__setitem__(3, offset[4])), "do not cut"),
        (changed("offset", lambda offset: offset.__setitem__(-1, 5)), "do not cut"),
        (
            changed("points", lambda points: points.__setitem__((7, 1), np.nan)),
            "object 0 .* first its point 7",
        ),
        (lambda held: {**held, "points": held["points"][:, :2]}, r"points float32 \(\d+, 2\)"),
        (lambda held: {**held, "label": held["label"][:-1]}, "32 labels, 33 identities and 34 offsets"),
    ],
)
def test_another_archive_is_refused(prepared, tmp_path, change, message):
    held = objects()
    first = held["offset"][1]
    assert first > 7  # so that point 7 is the first object's
    np.savez(tmp_path / "objects.npz", **change(held))
    with pytest.raises(DataError, match=message):
        prepared(root=tmp_path / "objects.npz")


def test_other_archives_are_refused(data, prepared, tmp_path):
    with pytest.raises(DataError, match=r"data\.root is not set: .* github\.com/ATRM-Raphael/geo5017_A2"):
        data().prepare()
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(DataError, match="it is a single array"):
        prepared(root=tmp_path / "one.npy")


def test_a_class_of_few_objects_keeps_its_training_samples(prepared, tmp_path):
    np.savez(tmp_path / "objects.npz", **objects((30, 5)))
    found = prepared(root=tmp_path / "objects.npz", fold=2)
    assert torch.bincount(found.splits().train.fields.fields["target"], minlength=2).min() >= 1


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_the_real_objects_can_be_told_apart_by_distances_to_fixed_points(prepared):
    random = np.random.default_rng(0)
    basis = random.normal(size=(128, 3))
    basis *= random.random((128, 1)) ** (1 / 3) / np.linalg.norm(basis, axis=1, keepdims=True)

    def encoded(split):
        rows = []
        for number in range(len(split)):
            points = split[number]["input"].double().numpy()
            points = points - points.mean(0)
            points /= np.linalg.norm(points, axis=1).max()
            rows.append(cKDTree(points).query(basis)[0])
        return np.array(rows), split.fields.fields["target"].numpy()

    found = prepared(root=Path(os.environ["REAL_DATA_ROOT"]) / "clouds" / "dales500.npz", points=2000)
    assert found.target.names == ("building", "car", "fence", "pole", "tree")
    assert [len(split) for split in found.splits()] == [339, 60, 100]
    model = make_pipeline(StandardScaler(), LogisticRegression(max_iter=2000)).fit(
        *encoded(found.splits().train)
    )
    assert model.score(*encoded(found.splits().test)) > 0.9
