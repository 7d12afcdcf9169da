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

NAME = "dales"
CLASSES = ("building", "car", "tree")


def arrays(counts=(11, 10, 12), seed=0):
    """Objects of 2 to 40 points; a point's z is its object's number, x its label."""
    random = np.random.default_rng(seed)
    label = random.permutation(np.repeat(np.arange(len(counts)), counts)).astype(np.uint8)
    sizes = random.integers(2, 41, len(label))
    points = random.normal(size=(sizes.sum(), 3)).astype(np.float32)
    points[:, 2] = np.repeat(np.arange(len(label)), sizes)
    points[:, 0] = np.repeat(label, sizes)
    offset = np.concatenate([[0], np.cumsum(sizes)])
    names = np.array(CLASSES[: len(counts)])
    return {
        "points": points,
        "offset": offset,
        "label": label,
        "object_id": np.arange(len(label)) + 100,
        "classes": names,
    }


@pytest.fixture
def root(tmp_path):
    np.savez(tmp_path / "objects.npz", **arrays())
    return tmp_path / "objects.npz"


def test_objects_are_cut_out_and_padded(prepared, root):
    held = arrays()
    found = prepared(root=root)
    assert found.target.names == CLASSES
    assert found.input_shape == (int(np.diff(held["offset"]).max()), 3)
    assert (found.columns, found.synthetic, found.skipped, found.varies) == (("x", "y", "z"), False, 0, False)
    seen = []
    for split in found.splits():
        batch = split.__getitems__(range(len(split)))
        for cloud, label, number in zip(batch["input"], batch["target"], batch["object"] - 100, strict=True):
            wanted = held["points"][held["offset"][number] : held["offset"][number + 1]]
            np.testing.assert_array_equal(cloud[: len(wanted)], wanted)
            assert cloud[len(wanted) :].isnan().all()
            assert label == held["label"][number]
        assert batch["index"].tolist() == list(range(len(split)))
        seen += batch["object"].tolist()
    assert sorted(seen) == list(range(100, 133))  # each once
    assert found.picture(found.splits().test[0]["input"]).shape == (160, 160, 3)


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
    assert prepared(root=root).fingerprint() == prepared(root=root).fingerprint()
    assert (
        prepared(root=root).fingerprint()["sha256"]
        != prepared(root=root, data_seed=1).fingerprint()["sha256"]
    )


def test_larger_objects_are_subsampled_whatever_the_fold(prepared, root):
    clouds, whole = {}, np.diff(arrays()["offset"])
    for fold in (0, 1):
        found = prepared(root=root, points=10, fold=fold)
        assert found.input_shape == (10, 3)
        for split in found.splits():
            for number in range(len(split)):
                sample = split[number]
                cloud = clouds.setdefault(int(sample["object"]), sample["input"])
                assert torch.equal(cloud, sample["input"])
                assert len(cloud) == min(10, whole[int(sample["object"]) - 100])


def test_own_files_need_no_archive(data, tmp_path):
    np.save(tmp_path / "tree.npy", np.random.default_rng(0).normal(size=(50, 3)))
    found = data(points=20).read([tmp_path / "tree.npy"])
    assert found[0]["input"].shape == (20, 3)


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
    held = arrays()
    first = held["offset"][1]
    assert first > 7  # so that point 7 is the first object's
    np.savez(tmp_path / "objects.npz", **change(held))
    with pytest.raises(DataError, match=message):
        prepared(root=tmp_path / "objects.npz")


def test_missing_and_damaged_archives_are_refused(data, prepared, tmp_path):
    with pytest.raises(DataError, match=r"data\.root is not set: .* github\.com/ATRM-Raphael/geo5017_A2"):
        data().prepare()
    with pytest.raises(DataError, match="no such file"):
        prepared(root=tmp_path / "objects.npz")
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(DataError, match="it is a single array"):
        prepared(root=tmp_path / "one.npy")
    np.savez(tmp_path / "objects.npz", **arrays())
    (tmp_path / "objects.npz").write_bytes((tmp_path / "objects.npz").read_bytes()[:2000])
    with pytest.raises(DataError, match="cannot be read as a NumPy archive"):
        prepared(root=tmp_path / "objects.npz")


def test_a_class_of_few_objects_keeps_its_training_samples(prepared, tmp_path):
    np.savez(tmp_path / "objects.npz", **arrays((30, 5)))
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
