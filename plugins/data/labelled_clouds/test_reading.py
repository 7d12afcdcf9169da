"""Tests of clouds from files: sampling, the cache, padding, shares of classes, and configurations."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.configuration.schema import resolve
from framework.datasets.shares import assign_folds, choose_held_out
from framework.errors import ConfigError, DataError
from framework.geometry import meshes
from framework.geometry.mesh_files import NORMALS
from plugins.data.labelled_clouds import reading
from plugins.data.labelled_clouds.labelled_clouds import require_samples
from plugins.data.labelled_clouds.reading import (
    Clouds,
    Packed,
    Reading,
    load_files,
    load_unlabelled,
    read_cloud,
)

SQUARE = b"OFF\n4 1 0\n0 0 2\n1 0 2\n1 1 2\n0 1 2\n4 0 1 2 3\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder for files, whose subfolder `cache` is the cache."""
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "cache"))
    return tmp_path


def test_a_surface_is_sampled_and_a_cloud_stays_unchanged(folder):
    (folder / "square.off").write_bytes(SQUARE)
    points = read_cloud(folder / "square.off", Reading(points=None, columns=NORMALS))
    assert points.shape == (2048, 6)
    assert points.dtype == np.float32
    np.testing.assert_array_equal(points[:, 2:], np.tile([2, 0, 0, 1], (2048, 1)))
    own = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    np.save(folder / "own.npy", own)
    np.testing.assert_array_equal(read_cloud(folder / "own.npy", Reading(None)), own)
    fewer = read_cloud(folder / "own.npy", Reading(20))
    rows = [np.flatnonzero((own == point).all(1)).item() for point in fewer]
    assert len(rows) == 20
    assert rows == sorted(set(rows))
    with pytest.raises(DataError, match="the mesh has no faces"):
        read_cloud(folder / "own.npy", Reading(20, surface=True))
    with pytest.raises(DataError, match="no column 'normal_x'"):
        read_cloud(folder / "own.npy", Reading(20, NORMALS))


def test_attributes_are_linear_on_a_face(folder):
    # red = x / 4 and green = y / 4 at the corners, and therefore on the whole face
    text = "v 0 0 1 0 0 .5\nv 4 0 1 1 0 .5\nv 1 3 1 .25 .75 .5\nf 1 2 3\n"
    (folder / "face.obj").write_text(text)
    points = read_cloud(folder / "face.obj", Reading(500, ("green", "normal_z", "red", "blue")))
    np.testing.assert_allclose(points[:, 3], points[:, 1] / 4, atol=1e-6)
    np.testing.assert_array_equal(points[:, 4], 1)
    np.testing.assert_allclose(points[:, 5], points[:, 0] / 4, atol=1e-6)
    np.testing.assert_allclose(points[:, 6], 0.5, atol=1e-6)


def test_coordinates_of_a_map_are_refused_or_centred(folder):
    metres = np.random.default_rng(1).uniform(0, 5, (100, 3))
    np.save(folder / "tree.npy", metres + np.array([4e8, 5e8, 0]))
    with pytest.raises(DataError, match=r"up to 5e\+08 in size and differ by .*data\.centred=true"):
        read_cloud(folder / "tree.npy", Reading(None))
    centred = read_cloud(folder / "tree.npy", Reading(None, centred=True))
    np.testing.assert_allclose(centred, metres - metres.mean(0), atol=1e-6)
    np.save(folder / "same.npy", np.full((4, 3), 1e9))  # equal points have no shape that rounding could blur
    assert (read_cloud(folder / "same.npy", Reading(None)) == np.float32(1e9)).all()
    np.save(folder / "huge.npy", np.eye(3) * 1e39)
    with pytest.raises(DataError, match=r"up to 1e\+39"):
        read_cloud(folder / "huge.npy", Reading(None))


def test_clouds_are_read_again_only_if_settings_or_files_change(folder, monkeypatch):
    files = [folder / f"{name}.off" for name in "abc"]
    for file in files:
        file.write_bytes(SQUARE)
    files[1].write_bytes(b"OFF\n1 0 0\n0 0 x\n")
    first = load_files(files, folder, Reading(10), "place")
    assert first.good == (0, 2)
    assert "b.off" in str(first.faults[0])
    assert first.packed.points.shape == (20, 3)
    assert first.packed.offset.tolist() == [0, 10, 20]

    calls = []
    original = reading.read_cloud
    monkeypatch.setattr(
        reading, "read_cloud", lambda *arguments: calls.append(arguments) or original(*arguments)
    )
    again = load_files(files, folder, Reading(10), "place")
    assert not calls
    assert torch.equal(again.packed.points, first.packed.points)
    assert again.good == first.good
    assert [str(fault) for fault in again.faults] == [str(fault) for fault in first.faults]

    load_files(files, folder, Reading(10, seed=1), "place")
    assert len(calls) == 3
    files[1].write_bytes(SQUARE)
    assert load_files(files, folder, Reading(10), "place").good == (0, 1, 2)
    assert len(calls) == 6
    for cache_file in (folder / "cache" / "place").iterdir():
        cache_file.write_bytes(
            cache_file.read_bytes()[:100]
        )  # damaged: the files are read again without an error
    assert torch.equal(
        load_files(files, folder, Reading(10), "place").packed.points[:10], first.packed.points[:10]
    )
    assert len(calls) == 9
    assert not list((folder / "cache" / "place").glob(".*"))  # no incomplete files are left


def test_points_depend_on_the_name_and_not_on_the_order(folder):
    for name in "ab":
        (folder / f"{name}.off").write_bytes(SQUARE)
    points = load_files([folder / "a.off", folder / "b.off"], folder, Reading(5), "place").packed.points
    reversed_points = load_files(
        [folder / "b.off", folder / "a.off"], folder, Reading(5), "place"
    ).packed.points
    assert torch.equal(points[:5], reversed_points[5:])
    assert not torch.equal(points[:5], points[5:])


def pack_clouds(*sizes):
    """Return clouds of these sizes."""
    table = torch.arange(float(3 * sum(sizes))).reshape(-1, 3)
    return Packed(table, torch.tensor([0, *np.cumsum(sizes).tolist()]))


def test_a_batch_is_padded_to_its_own_largest_cloud():
    clouds = Clouds(pack_clouds(2, 5, 1, 3), np.array([3, 0, 2]), target=torch.tensor([7, 8, 9]))
    assert len(clouds) == 3
    assert clouds.packed.largest() == 5
    batch = clouds.__getitems__([2, 0])
    assert batch["input"].shape == (2, 3, 3)
    assert batch["target"].tolist() == [9, 7]
    assert batch["index"].tolist() == [2, 0]
    assert torch.equal(batch["input"][1], clouds.packed.points[8:11])
    assert torch.equal(batch["input"][0, :1], clouds.packed.points[7:8])
    assert batch["input"][0, 1:].isnan().all()
    assert torch.equal(clouds[1]["input"], clouds.packed.points[:2])


def test_own_files_are_all_read_or_the_message_names_all_bad_ones(folder):
    np.save(folder / "own.npy", np.eye(3))
    (folder / "square.off").write_bytes(SQUARE)
    clouds = load_unlabelled([folder / "own.npy", folder / "square.off"], Reading(4))
    assert clouds.__getitems__([0, 1])["input"].shape == (2, 4, 3)
    assert set(clouds[0]) == {"input", "index"}
    (folder / "bad.xyz").write_text("1 2\n")
    with pytest.raises(DataError, match=r"(?s)2 of 3 samples cannot be read:.*bad\.xyz.*none\.ply"):
        load_unlabelled([folder / "bad.xyz", folder / "own.npy", folder / "none.ply"], Reading(4))
    with pytest.raises(DataError, match="No file was given"):
        load_unlabelled([], Reading(4))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(0, 12), min_size=1, max_size=8), st.floats(0.01, 0.99), st.integers(0, 99))
def test_a_share_is_held_out_of_every_class(counts, share, seed):
    labels = np.random.default_rng(seed).permutation(np.repeat(np.arange(len(counts)), counts))
    held_out = choose_held_out(labels, share, np.random.default_rng(seed))
    numbers = np.bincount(labels[held_out], minlength=len(counts))
    for number, count in zip(numbers, counts, strict=True):
        assert number <= max(count - 1, 0)  # one is left for training
        assert math.floor(share * count) - 1 <= number <= math.ceil(share * count)
    total = round(share * len(labels))
    assert held_out.sum() <= max(total, sum(math.floor(share * count) for count in counts))
    available = sum(min(math.ceil(share * count), max(count - 1, 0)) for count in counts)
    assert held_out.sum() >= min(total, available) - len(counts) * (share > 0.5)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 30), min_size=1, max_size=6), st.integers(2, 6), st.integers(0, 99))
def test_folds_have_equal_shares_of_every_class(counts, count, seed):
    labels = np.random.default_rng(seed).permutation(np.repeat(np.arange(len(counts)), counts))
    if not len(labels):
        return
    fold = assign_folds(labels, count, np.random.default_rng(seed))
    for label in (*range(len(counts)), None):
        table = np.bincount(fold if label is None else fold[labels == label], minlength=count)
        assert table.max() - table.min() <= 1


def test_an_empty_split_is_refused():
    with pytest.raises(DataError, match=r"folder: The validation split is empty \(train 3, validation 0\)"):
        require_samples({"train": 3, "validation": 0}, "folder")


def test_the_cloud_of_a_mesh_is_the_sample_of_its_surface(folder):
    (folder / "square.off").write_bytes(SQUARE)
    mesh = meshes.read(folder / "square.off")
    expected = meshes.sample(mesh, 7, meshes.stream(3, "square.off")).points.astype(np.float32)
    np.testing.assert_array_equal(read_cloud(folder / "square.off", Reading(7, seed=3)), expected)


@pytest.mark.parametrize(
    "name, key, value",
    [
        *[
            ("modelnet40", "points", 0),
            ("modelnet40", "rotations", 0),
            ("modelnet40", "validation_share", 1.0),
        ],
        *[
            ("modelnet40", "unreadable", "no"),
            ("dales", "fold", 5),
            ("dales", "fold", -1),
            ("dales", "points", 0),
        ],
        *[("dales", "validation_share", 0.0), ("point_cloud_folder", "points", 0)],
        *[("point_cloud_folder", "validation", 1.0), ("point_cloud_folder", "test", 0.0)],
        ("point_cloud_folder", "data_seed", -1),
    ],
)
def test_a_config_out_of_range_is_refused(name, key, value):
    with pytest.raises(ConfigError, match=r"data\."):
        resolve("data", {"name": name, key: value})
