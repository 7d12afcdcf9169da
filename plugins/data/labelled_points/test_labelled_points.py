"""Tests of reading labelled scans: classes, splits, formats and refusals."""

import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.datasets.fields import fetch
from framework.errors import DataError
from plugins.data.labelled_points.rows import folder, folders_of_splits, scan, write_scan


def prepare(root, **config):
    data = build("data", resolve("data", {"name": "labelled_points", "root": str(root), **config}))
    data.prepare()
    return data


@pytest.fixture
def scans(tmp_path):
    """Return a folder of five scans in folders of splits."""
    folders_of_splits(tmp_path)
    return tmp_path


def save(file, points, **arrays):
    np.savez(file, points=points, **arrays)


def test_labels_are_classes_and_the_test_has_every_point_in_its_order(scans):
    data = prepare(scans, points=7)
    train, validation, test = data.splits()
    assert data.target.names == ("2", "6")
    assert [len(train), len(validation), len(test)] == [14, 7, 120]
    batch = fetch(test, range(120))
    expected = np.concatenate([scan(seed)[1] for seed in (3, 4)])
    np.testing.assert_array_equal(np.array([2, 6])[batch["target"]], expected)
    np.testing.assert_array_equal(batch["scan"], np.repeat([0, 1], 60))


def test_training_features_are_standardised_and_the_code_is_the_same_within_a_scan(scans):
    data = prepare(scans, neighbours=3, basis_points=6)
    batch = fetch(data.splits().train, range(len(data.splits().train)))
    inputs = batch["input"]
    np.testing.assert_allclose(inputs[:, :-6].mean(0), 0, atol=1e-5)
    np.testing.assert_allclose(inputs[:, :-6].std(0, correction=0), 1, atol=1e-5)
    for number in (0, 1):
        code = inputs[batch["scan"] == number, -6:]
        assert torch.equal(code, code[:1].expand_as(code))


def test_files_of_a_trained_model_get_the_features_of_the_test(scans, tmp_path):
    data = prepare(scans, surrounding_points=2)
    elsewhere = build("data", resolve("data", {"name": "labelled_points", "surrounding_points": 2}))
    elsewhere.load_state_dict(data.state_dict())
    files = sorted((scans / "test").iterdir())
    assert torch.equal(
        fetch(elsewhere.read(files), range(120))["input"], fetch(data.splits().test, range(120))["input"]
    )
    with pytest.raises(DataError, match=r"must hold around, 3×3 finite numbers.*data.surrounding_points"):
        build("data", resolve("data", {"name": "labelled_points", "surrounding_points": 3})).load_state_dict(
            data.state_dict()
        )


def for_model(trained, root, **config):
    data = build("data", resolve("data", {"name": "labelled_points", "root": str(root), **config}))
    data.load_state_dict(trained.state_dict())
    return data


def test_a_trained_model_is_tested_on_scans_with_some_of_its_classes(scans, tmp_path):
    trained = prepare(scans)
    other = tmp_path / "other"
    other.mkdir()
    points, labels = scan(9)
    save(other / "wall.npz", points[labels == 6], label=labels[labels == 6])
    data = for_model(trained, other, test=1)
    data.prepare()
    assert [len(part) for part in data.splits()] == [0, 0, 20]
    assert data.target == trained.target
    assert set(fetch(data.splits().test, range(20))["target"].tolist()) == {1}  # label 6 is the second class
    (other / "test").mkdir()
    (other / "wall.npz").rename(other / "test" / "wall.npz")
    stated = for_model(trained, other)  # a folder of test scans suffices
    stated.prepare()
    assert stated.fingerprint()["test"] == "20 points of 1 scans"
    save(other / "test" / "tree.npz", points, label=np.full(60, 8))
    with pytest.raises(DataError, match=r"tree.npz: a point has the label 8, .* knows the labels 2 \(2\), 6"):
        for_model(trained, other).prepare()


def test_a_model_of_an_older_version_needs_training_scans(scans, tmp_path):
    state = {
        name: part
        for name, part in prepare(scans).state_dict().items()
        if name in ("around", "whole", "location", "scale")
    }
    other = tmp_path / "other"
    other.mkdir()
    write_scan(other / "further.ply", 9)
    data = build("data", resolve("data", {"name": "labelled_points", "root": str(other), "test": 1}))
    data.load_state_dict(state)
    with pytest.raises(DataError, match="an older version stored the model without its classes"):
        data.prepare()
    with pytest.raises(DataError, match="must hold one label for each class"):
        data.load_state_dict({**prepare(scans).state_dict(), "labels": [2]})


def test_points_without_a_class_are_only_neighbours(scans):
    points, labels = scan(7)
    labels[:10] = -1
    save(scans / "test" / "more.npz", points, label=labels)
    with pytest.raises(DataError, match=r"more.npz: a point has the label -1, .* are 2, 6\."):
        prepare(scans)
    save(scans / "train" / "more.npz", points, label=np.full(60, -1))  # a scan without any sample
    data = prepare(scans, unlabelled=[-1])
    assert len(data.splits().test) == 120 + 50
    assert data.remarks == ("left out, except as neighbours: 70 points without a class",)


def test_without_folders_of_splits_whole_scans_are_drawn(tmp_path):
    folder(tmp_path)
    splits = prepare(tmp_path, test=0.3, validation=0.01).splits()
    assert [int(part.scan.max()) + 1 for part in splits] == [6, 1, 3]  # at least one for validation
    (tmp_path / "notes.txt").write_text("", encoding="utf-8")
    data = prepare(tmp_path, validation=0.0)
    assert torch.equal(data.splits().train.local, data.splits().validation.local)
    assert data.remarks == ("left out: 1 file of other kinds",)


def test_names_of_classes_belong_to_the_labels_from_0(tmp_path):
    for number in range(3):
        points, labels = scan(number)
        save(tmp_path / f"{number}.npz", points, kind=np.where(labels == 6, 1, 0))
    assert prepare(tmp_path, label="kind", classes=["ground", "wall"]).target.names == ("ground", "wall")
    with pytest.raises(DataError, match=r"The class roof \(label 2\) has no point in the training scans"):
        prepare(tmp_path, label="kind", classes=["ground", "wall", "roof"])
    with pytest.raises(
        DataError, match=r"a point has the label 1, but the labels that data\.classes names are 0"
    ):
        prepare(tmp_path, label="kind", classes=["ground"])
    with pytest.raises(DataError, match="The training scans hold only the label 0, but at least two classes"):
        prepare(tmp_path, label="kind", unlabelled=[1])
    with pytest.raises(DataError, match=r"no column 'kinds'.*kind.*Set data.label to one of them"):
        prepare(tmp_path, label="kinds")


@pytest.mark.parametrize(
    "points, label, words",
    [
        (scan(1)[0], scan(1)[1][:-1], "no column 'label' with one label for each of its 60 points"),
        (scan(1)[0], scan(1)[1] + 0.5, r"point 0 \(from 0\) has label = \d\.5; expected an integer"),
        (scan(1)[0], np.full(60, np.nan), "has label = nan; expected an integer"),
        (np.full((60, 3), np.nan), scan(1)[1], "bad.npz"),
        (np.empty((0, 3)), np.empty(0), "has no vertices"),
        (scan(1)[0][:3], scan(1)[1][:3], "3 points, but data.neighbours = 16"),
    ],
)
def test_a_bad_scan_is_refused_with_a_sentence(scans, points, label, words):
    save(scans / "train" / "bad.npz", points, label=label)
    with pytest.raises(DataError, match=words):
        prepare(scans)


@pytest.mark.parametrize("reach", [0.05, 40.0])
def test_a_reach_in_another_unit_is_refused(scans, reach):
    words = rf"data.reach = {reach:g} does not fit the scans, whose points are 0\.\d+ apart and which extend over 1\d"
    with pytest.raises(DataError, match=words):
        prepare(scans, reach=reach)
    prepare(scans, reach=reach, surrounding_points=0)


def test_a_folder_without_enough_scans_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"data.root is not set.*<root>/<scan>"):
        build("data", resolve("data", "labelled_points")).prepare()
    write_scan(tmp_path / "one.ply", 0)
    write_scan(tmp_path / "two.ply", 1)
    with pytest.raises(DataError, match="holds 2 scans, but at least 3 are needed"):
        prepare(tmp_path)
    assert len(prepare(tmp_path, validation=0.0).splits().test) == 60
    (tmp_path / "train").mkdir()
    with pytest.raises(DataError, match="holds a folder train, but no folder test"):
        prepare(tmp_path)
    (tmp_path / "test").mkdir()
    with pytest.raises(DataError, match="holds no scan"):
        prepare(tmp_path)
    data = build("data", resolve("data", "labelled_points"))
    with pytest.raises(DataError, match="expected a scan whose name ends in"):
        data.read([tmp_path / "points.laz"])
