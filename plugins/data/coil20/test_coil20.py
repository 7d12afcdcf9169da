import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.io import savemat

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from plugins.data.coil20.manifold import FINE, look_alikes, spline_weights
from plugins.data.coil20.rows import as_matlab, turntable


def data(root, **config):
    return build("data", resolve("data", {"name": "coil20", "root": str(root), **config}))


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return as_matlab(tmp_path_factory.mktemp("coil"), turntable())


def test_views_angles_and_splits(root):
    coil = data(root)
    coil.prepare()
    views = torch.from_numpy(turntable())
    sizes = []
    occurrences = torch.zeros(20, 72, dtype=torch.int64)
    for split, residues in zip(coil.splits(), ({0}, {2}, {1, 3}), strict=True):
        sizes.append(len(split))
        batch = split.__getitems__(range(len(split)))
        view = (batch["target"][:, 0].double() / math.radians(5)).round().long() % 72
        assert {int(number) % 4 for number in view} == residues
        assert torch.equal(batch["input"][:, 0], views[batch["object"], view])
        assert (batch["target"].abs() <= math.pi).all()
        occurrences[batch["object"], view] += 1
    assert sizes == [360, 360, 720]
    assert (occurrences == 1).all()  # every view of every object is in one split


def test_the_processed_images_are_read_like_the_matlab_file(root, tmp_path):
    for number, views in enumerate(turntable(), start=1):
        for view, pixels in enumerate(views):
            Image.fromarray(pixels).save(tmp_path / f"obj{number}__{view}.png")
    from_matlab, from_images = data(root), data(tmp_path)
    from_matlab.prepare()
    from_images.prepare()
    assert torch.equal(from_matlab.splits().train.fields["input"], from_images.splits().train.fields["input"])
    (tmp_path / "obj7__3.png").unlink()
    with pytest.raises(DataError, match=r"obj7__3\.png is missing"):
        data(tmp_path).prepare()


def test_objects_that_repeat_after_half_a_turn_are_found(tmp_path):
    views = turntable()
    views[[2, 9]] = turntable(symmetric=True)[[2, 9]]
    coil = data(as_matlab(tmp_path, views))
    coil.prepare()
    batch = coil.splits().test.fields
    assert set(batch["object"][batch["group"] == 1].tolist()) == {2, 9}
    assert coil.groups == ("unique", "look-alikes")
    assert coil.fingerprint()["look_alikes"] == "3 10"


def test_the_spline_passes_through_its_views_and_closes():
    weights = spline_weights(18).double()
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    turn = (np.arange(FINE) + 0.5) / FINE * 2 * np.pi
    # 18 views sample harmonics up to the third finely enough for the spline to reproduce them
    for harmonic in (0, 1, 2, 3):
        interpolated = weights.numpy() @ np.cos(harmonic * np.arange(18) * 2 * np.pi / 18)
        np.testing.assert_allclose(interpolated, np.cos(harmonic * turn), atol=6e-3)


def test_interpolated_views_show_the_object_at_their_angle(root):
    coil = data(root, jitter=0.0)
    coil.prepare()
    batch = coil.splits().train.__getitems__(range(360))
    torch.manual_seed(0)
    augmented = coil.augment(batch)
    shift = torch.remainder(augmented["target"] - batch["target"] + math.pi, 2 * math.pi) - math.pi
    assert shift.abs().max() <= math.radians(10) + 1e-5
    assert shift.std() > math.radians(5)
    # angle of the blob's centre of mass, minus the angle of the object's first view
    pixels = augmented["input"][:, 0].double()
    position = torch.arange(32.0).double() - 16
    row, column = (pixels.sum(2) * position).sum(1), (pixels.sum(1) * position).sum(1)
    azimuth = torch.atan2(column, row) - batch["object"]
    error = torch.remainder(azimuth - augmented["target"][:, 0] + math.pi, 2 * math.pi) - math.pi
    assert error.abs().max() < math.radians(3)
    assert (augmented["target"].abs() <= math.pi).all()


def test_without_interpolation_and_jitter_a_batch_stays_as_it_is(root):
    coil = data(root, jitter=0.0, interpolate=False)
    coil.prepare()
    batch = coil.splits().train.__getitems__([5, 7])
    assert coil.augment(batch) is batch


def test_views_are_resized(root):
    coil = data(root, image_size=48)
    coil.prepare()
    assert coil.splits().train[0]["input"].shape == coil.input_shape == (1, 48, 48)


@pytest.mark.parametrize("every, training", [(15, 24), (60, 6)])
def test_the_step_of_training_views_sets_the_sizes_of_the_splits(root, every, training):
    coil = data(root, every=every)
    coil.prepare()
    assert [*map(len, coil.splits())] == [20 * training, 20 * training, 20 * (72 - 2 * training)]


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_eight_of_the_real_objects_are_look_alikes():
    coil = data(Path(os.environ["REAL_DATA_ROOT"]) / "orientation")
    coil.prepare()
    assert coil.fingerprint()["look_alikes"] == "3 5 6 8 9 11 14 19"


def test_an_object_whose_views_are_all_equal_is_no_look_alike():
    assert not look_alikes(torch.ones(1, 18, 1, 4, 4)).any()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"X": np.zeros((1440, 1024))}, "X has the type float64"),
        ({"X": np.zeros((1439, 1024), np.uint8)}, r"\(1439, 1024\)"),
        (
            {"Y": np.ones((1440, 1))},
            "Y holds 1 different numbers, .* expected the numbers 1 to 20 of the objects",
        ),
    ],
)
def test_another_matlab_file_is_refused(tmp_path, change, message):
    if "Y" in change:
        change = {"Y": change["Y"].astype(np.int64)}
    with pytest.raises(DataError, match=message):
        data(as_matlab(tmp_path, turntable(), **change)).prepare()


def test_other_folders_and_files_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"holds neither COIL20\.mat nor obj1__0\.png"):
        data(tmp_path).prepare()
    savemat(tmp_path / "COIL20.mat", {"fea": np.zeros(3)})
    with pytest.raises(DataError, match="The file holds fea"):
        data(tmp_path / "COIL20.mat").prepare()
    with pytest.raises(DataError, match=r"data\.root is not set: COIL-20 is published for research"):
        build("data", resolve("data", {"name": "coil20"})).prepare()


@pytest.mark.parametrize("config", [{"every": 25}, {"image_size": 4}, {"jitter": 1.0}])
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"data\."):
        resolve("data", {"name": "coil20", **config})
