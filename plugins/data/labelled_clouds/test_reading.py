"""Tests of clouds from files: sampling, the cache, padding, shares of classes, and configurations."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.configuration.schema import resolve
from framework.errors import ConfigError, DataError
from framework.geometry import meshes
from framework.geometry.mesh_files import NORMALS
from plugins.data.labelled_clouds import reading
from plugins.data.labelled_clouds.labelled_clouds import require_samples
from plugins.data.labelled_clouds.reading import Clouds, Packed, Reading, cloud, load, unlabelled
from plugins.data.labelled_clouds.shares import folds, spared

SQUARE = b"OFF\n4 1 0\n0 0 2\n1 0 2\n1 1 2\n0 1 2\n4 0 1 2 3\n"


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "cache"))
    return tmp_path


def test_a_surface_is_sampled_and_a_cloud_kept(here):
    (here / "square.off").write_bytes(SQUARE)
    points = cloud(here / "square.off", Reading(points=None, columns=NORMALS))
    assert points.shape == (2048, 6)
    assert points.dtype == np.float32
    np.testing.assert_array_equal(points[:, 2:], np.tile([2, 0, 0, 1], (2048, 1)))
    own = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    np.save(here / "own.npy", own)
    np.testing.assert_array_equal(cloud(here / "own.npy", Reading(None)), own)
    fewer = cloud(here / "own.npy", Reading(20))
    place = [np.flatnonzero((own == point).all(1)).item() for point in fewer]
    assert len(place) == 20
    assert place == sorted(set(place))
    with pytest.raises(DataError, match="it has no faces"):
        cloud(here / "own.npy", Reading(20, surface=True))
    with pytest.raises(DataError, match="no column 'normal_x'"):
        cloud(here / "own.npy", Reading(20, NORMALS))


def test_attributes_are_linear_on_a_face(here):
    # red = x / 4, green = y / 4 at the corners, so everywhere
    text = "v 0 0 1 0 0 .5\nv 4 0 1 1 0 .5\nv 1 3 1 .25 .75 .5\nf 1 2 3\n"
    (here / "face.obj").write_text(text)
    points = cloud(here / "face.obj", Reading(500, ("green", "normal_z", "red", "blue")))
    np.testing.assert_allclose(points[:, 3], points[:, 1] / 4, atol=1e-6)
    np.testing.assert_array_equal(points[:, 4], 1)
    np.testing.assert_allclose(points[:, 5], points[:, 0] / 4, atol=1e-6)
    np.testing.assert_allclose(points[:, 6], 0.5, atol=1e-6)


def test_coordinates_of_a_map_are_refused_or_centred(here):
    metres = np.random.default_rng(1).uniform(0, 5, (100, 3))
    np.save(here / "tree.npy", metres + np.array([4e8, 5e8, 0]))
    with pytest.raises(DataError, match=r"reach 5e\+08 and differ by .*data\.centred=true"):
        cloud(here / "tree.npy", Reading(None))
    found = cloud(here / "tree.npy", Reading(None, centred=True))
    np.testing.assert_allclose(found, metres - metres.mean(0), atol=1e-6)
    np.save(here / "same.npy", np.full((4, 3), 1e9))  # nothing to blur
    assert (cloud(here / "same.npy", Reading(None)) == np.float32(1e9)).all()
    np.save(here / "huge.npy", np.eye(3) * 1e39)
    with pytest.raises(DataError, match=r"reach 1e\+39"):
        cloud(here / "huge.npy", Reading(None))


def test_clouds_are_read_once_and_anew_when_something_changes(here, monkeypatch):
    files = [here / f"{name}.off" for name in "abc"]
    for file in files:
        file.write_bytes(SQUARE)
    files[1].write_bytes(b"OFF\n1 0 0\n0 0 x\n")
    first = load(files, here, Reading(10), "place")
    assert first.good == (0, 2)
    assert "b.off" in str(first.faults[0])
    assert first.packed.points.shape == (20, 3)
    assert first.packed.offset.tolist() == [0, 10, 20]

    calls = []
    real = reading.cloud
    monkeypatch.setattr(reading, "cloud", lambda *given: calls.append(given) or real(*given))
    again = load(files, here, Reading(10), "place")
    assert not calls
    assert torch.equal(again.packed.points, first.packed.points)
    assert again.good == first.good
    assert [str(fault) for fault in again.faults] == [str(fault) for fault in first.faults]

    load(files, here, Reading(10, seed=1), "place")
    assert len(calls) == 3
    files[1].write_bytes(SQUARE)
    assert load(files, here, Reading(10), "place").good == (0, 1, 2)
    assert len(calls) == 6
    for kept in (here / "cache" / "place").iterdir():
        kept.write_bytes(kept.read_bytes()[:100])  # damaged: read anew, not refused
    assert torch.equal(load(files, here, Reading(10), "place").packed.points[:10], first.packed.points[:10])
    assert len(calls) == 9
    assert not list((here / "cache" / "place").glob(".*"))  # no halves are left


def test_points_depend_on_the_name_and_not_on_the_order(here):
    for name in "ab":
        (here / f"{name}.off").write_bytes(SQUARE)
    one = load([here / "a.off", here / "b.off"], here, Reading(5), "place").packed.points
    other = load([here / "b.off", here / "a.off"], here, Reading(5), "place").packed.points
    assert torch.equal(one[:5], other[5:])
    assert not torch.equal(one[:5], one[5:])


def packed(*sizes):
    table = torch.arange(float(3 * sum(sizes))).reshape(-1, 3)
    return Packed(table, torch.tensor([0, *np.cumsum(sizes).tolist()]))


def test_a_batch_is_padded_to_its_own_largest_cloud():
    clouds = Clouds(packed(2, 5, 1, 3), np.array([3, 0, 2]), target=torch.tensor([7, 8, 9]))
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


def test_own_files_are_all_read_or_all_complained_of(here):
    np.save(here / "own.npy", np.eye(3))
    (here / "square.off").write_bytes(SQUARE)
    found = unlabelled([here / "own.npy", here / "square.off"], Reading(4))
    assert found.__getitems__([0, 1])["input"].shape == (2, 4, 3)
    assert set(found[0]) == {"input", "index"}
    (here / "bad.xyz").write_text("1 2\n")
    with pytest.raises(DataError, match=r"(?s)2 of 3 samples cannot be read:.*bad\.xyz.*none\.ply"):
        unlabelled([here / "bad.xyz", here / "own.npy", here / "none.ply"], Reading(4))
    with pytest.raises(DataError, match="No file was given"):
        unlabelled([], Reading(4))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(0, 12), min_size=1, max_size=8), st.floats(0.01, 0.99), st.integers(0, 99))
def test_a_share_is_held_out_of_every_class(counts, share, seed):
    labels = np.random.default_rng(seed).permutation(np.repeat(np.arange(len(counts)), counts))
    held = spared(labels, share, np.random.default_rng(seed))
    given_up = np.bincount(labels[held], minlength=len(counts))
    for number, count in zip(given_up, counts, strict=True):
        assert number <= max(count - 1, 0)  # one is left for training
        assert math.floor(share * count) - 1 <= number <= math.ceil(share * count)
    assert held.sum() <= max(round(share * len(labels)), sum(math.floor(share * count) for count in counts))
    spare = sum(min(math.ceil(share * count), max(count - 1, 0)) for count in counts)
    assert held.sum() >= min(round(share * len(labels)), spare) - len(counts) * (share > 0.5)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 30), min_size=1, max_size=6), st.integers(2, 6), st.integers(0, 99))
def test_folds_have_every_class_alike(counts, count, seed):
    labels = np.random.default_rng(seed).permutation(np.repeat(np.arange(len(counts)), counts))
    if not len(labels):
        return
    fold = folds(labels, count, np.random.default_rng(seed))
    for label in (*range(len(counts)), None):
        table = np.bincount(fold if label is None else fold[labels == label], minlength=count)
        assert table.max() - table.min() <= 1


def test_an_empty_split_is_refused():
    with pytest.raises(DataError, match=r"there: the validation split is empty \(train 3, validation 0\)"):
        require_samples({"train": 3, "validation": 0}, "there")


def test_what_is_kept_of_a_file_is_what_the_reader_and_sampler_say(here):
    (here / "square.off").write_bytes(SQUARE)
    mesh = meshes.read(here / "square.off")
    wanted = meshes.sample(mesh, 7, meshes.stream(3, "square.off")).points.astype(np.float32)
    np.testing.assert_array_equal(cloud(here / "square.off", Reading(7, seed=3)), wanted)


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
