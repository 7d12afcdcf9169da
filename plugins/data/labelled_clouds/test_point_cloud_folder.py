import math
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import DataError

NAME = "point_cloud_folder"
FORMATS = ("off", "ply", "stl", "obj", "npy", "npz", "xyz")
PLY = "ply\nformat ascii 1.0\nelement vertex {}\n{}end_header\n"


def cloud_file(file, points=30, red=None):
    """Write a random cloud as text, with all colours equal to `red` if it is given, and return the file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    table = np.random.default_rng(points).normal(size=(points, 3))
    names = "x y z"
    if red is not None:
        table, names = np.column_stack([table, np.full((points, 3), red)]), "x y z red green blue"
    np.savetxt(file, table, header=names, comments="")
    return file


def write_every_format(folder, name, height):
    """Write a triangle at this height in every format: as a mesh, or as its corners if the format has no meshes."""
    corners = np.array([[0, 0, height], [2, 0, height], [0, 2, height]])
    text = "\n".join(" ".join(map(str, corner)) for corner in corners)
    facet = "".join(f"vertex {line}\n" for line in text.split("\n"))
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    faces = "element face 1\nproperty list uchar int vertex_index\n"
    content = {
        "off": f"OFF3 1 0\n{text}\n3 0 1 2\n",
        "ply": PLY.format(3, properties + faces) + text + "\n3 0 1 2\n",
        "stl": f"solid t\nfacet normal 0 0 1\nouter loop\n{facet}endloop\nendfacet\nendsolid t\n",
        "obj": "v " + text.replace("\n", "\nv ") + "\nf 1 2 3\n",
        "xyz": text,
    }
    folder.mkdir(parents=True, exist_ok=True)
    for suffix, file_text in content.items():
        (folder / f"{name}.{suffix}").write_text(file_text)
    np.save(folder / f"{name}.npy", corners)
    np.savez(folder / f"{name}.npz", points=corners)


def test_every_format_is_read_and_clouds_keep_their_sizes(prepare_data, tmp_path):
    for number, name in enumerate(("low", "high")):
        for height in (0, 10):
            write_every_format(tmp_path / name, f"t{height}", 100.0 * number + height)
    (tmp_path / "low" / "t0.mtl").write_text("a companion")
    (tmp_path / "low" / ".hidden").write_text("")
    dataset = prepare_data(root=tmp_path, validation=0.2, test=0.2)
    assert dataset.target.names == ("high", "low")
    assert dataset.input_shape == (2048, 3)
    assert dataset.columns == ("x", "y", "z")
    assert not dataset.varies
    assert dataset.fingerprint()["ignored"] == "1"
    assert dataset.remarks[0] == "left out: 1 file of other kinds"
    sizes = []
    for split in dataset.splits():
        batch = split.__getitems__(range(len(split)))
        is_point = ~batch["input"].isnan().all(-1)
        assert set(is_point.sum(1).tolist()) <= {3, 2048}
        for cloud, mask, label in zip(batch["input"], is_point, batch["target"], strict=True):
            assert (cloud[mask][:, 2] >= 100).all() == (label == 0)
            assert (cloud[mask][:, :2] >= 0).all()
            assert (cloud[mask][:, :2].sum(1) <= 2 + 1e-5).all()
        sizes.append(len(split))
    assert sizes == [16, 6, 6]  # of 28 files


def test_folders_determine_the_splits(prepare_data, tmp_path):
    for split, count in (("train", 3), ("validation", 2), ("test", 1)):
        for name in "ab":
            for number in range(count):
                cloud_file(tmp_path / split / name / f"{split}{number}.xyz", points=10 * count + number)
    dataset = prepare_data(root=tmp_path)
    assert [len(split) for split in dataset.splits()] == [6, 4, 2]
    assert dataset.input_shape == (32, 3)
    batch = dataset.splits().train.__getitems__(range(6))
    assert (~batch["input"].isnan().all(-1)).sum(1).tolist() == [30, 31, 32] * 2
    assert batch["target"].tolist() == [0, 0, 0, 1, 1, 1]


@pytest.mark.parametrize("layout", ["{split}/{name}", "{name}/{split}"])
def test_the_validation_split_is_random_without_a_folder_for_it(prepare_data, tmp_path, layout):
    for split, count in (("train", 5), ("test", 2)):
        for name in "ab":
            for number in range(count):
                cloud_file(tmp_path / layout.format(split=split, name=name) / f"{number}.xyz", 5 + number)
    dataset = prepare_data(root=tmp_path, validation=0.2)
    assert [len(split) for split in dataset.splits()] == [8, 2, 4]
    assert sorted(dataset.splits().validation.fields.fields["target"].tolist()) == [0, 1]
    other = prepare_data(root=tmp_path, validation=0.2, data_seed=1)
    assert dataset.fingerprint()["sha256"] != other.fingerprint()["sha256"]


def test_without_a_validation_share_the_training_split_is_used(prepare_data, tmp_path):
    for split in ("train", "test"):
        for name in "ab":
            cloud_file(tmp_path / name / split / "cloud.xyz")
    with pytest.raises(
        DataError,
        match=r"validation split is empty .* At least one sample of each class is used for training",
    ):
        prepare_data(root=tmp_path)
    dataset = prepare_data(root=tmp_path, validation=0)
    assert [len(split) for split in dataset.splits()] == [2, 2, 2]


def test_larger_clouds_are_subsampled(prepare_data, tmp_path):
    for name in "ab":
        for points in (5, 50, 60):
            cloud_file(tmp_path / name / f"{points}.xyz", points)
    dataset = prepare_data(root=tmp_path, points=20, validation=0.3, test=0.3)
    assert dataset.input_shape == (20, 3)
    batches = [split.__getitems__(range(len(split))) for split in dataset.splits()]
    sizes = [size for batch in batches for size in (~batch["input"].isnan().all(-1)).sum(1).tolist()]
    assert sorted(sizes) == [5, 5, 20, 20, 20, 20]


def test_the_columns_are_the_configured_ones(prepare_data, tmp_path):
    for name, red in (("a", 0.25), ("b", 0.75)):
        for number in range(3):
            cloud_file(tmp_path / name / f"{number}.xyz", 10, red)
    config = {"validation": 0.3, "test": 0.3}
    assert prepare_data(root=tmp_path, **config).input_shape == (10, 3)
    dataset = prepare_data(root=tmp_path, columns=["x", "red"], **config)
    assert dataset.columns == ("x", "y", "z", "red")
    batch = dataset.splits().train.__getitems__([0, 1])
    assert (batch["input"][..., 3] == 0.25 + 0.5 * batch["target"][:, None]).all()
    assert dataset.read([tmp_path / "a" / "1.xyz"])[0]["input"].shape == (10, 4)
    with pytest.raises(DataError, match=r"(?s)6 of 6 samples.*no column 'rad'\. Did you mean 'red'"):
        prepare_data(root=tmp_path, columns=["rad"], **config)


def test_a_clouds_mean_is_subtracted_before_it_is_rounded(prepare_data, tmp_path):
    for name in "ab":
        for number in range(3):
            file = cloud_file(tmp_path / name / f"{number}.xyz", 40 + number)
            np.savetxt(file, np.loadtxt(file, skiprows=1) + np.array([4e8, 5e8, 0]))
    with pytest.raises(DataError, match=r"data\.centred=true"):
        prepare_data(root=tmp_path)
    dataset = prepare_data(root=tmp_path, centred=True, validation=0.3, test=0.3)
    cloud = dataset.splits().test[0]["input"]
    assert cloud.mean(0).abs().max() < 1e-6
    assert 0.5 < cloud.std() < 1.5


def test_unreadable_files_are_refused_or_skipped_and_counted(prepare_data, tmp_path):
    for name in "ab":
        for number in range(4):
            cloud_file(tmp_path / name / f"{number}.xyz")
    (tmp_path / "b" / "4.xyz").write_text("1 2 3\n4 5 nan\n")
    (tmp_path / "a" / "4.ply").write_text("no ply")
    with pytest.raises(
        DataError, match=r"(?s)2 of 10 samples cannot.*4\.ply.*first is point 1.*data\.unreadable=skip"
    ):
        prepare_data(root=tmp_path)
    assert prepare_data(root=tmp_path, unreadable="skip", validation=0.25, test=0.25).skipped == 2


def test_own_files_are_read_without_prepare(data, tmp_path):
    write_every_format(tmp_path, "t", 1.0)
    files = [tmp_path / f"t.{suffix}" for suffix in FORMATS]
    clouds = data().read(files)
    assert [clouds[number]["input"].shape[0] for number in range(7)] == [2048, 2048, 2048, 2048, 3, 3, 3]
    batch = clouds.__getitems__(range(7))
    assert batch["input"].shape == (7, 2048, 3)
    assert batch["index"].tolist() == list(range(7))
    with pytest.raises(DataError, match=r"t\.gltf"):
        data().read([tmp_path / "t.gltf"])


def test_other_layouts_are_refused(prepare_data, tmp_path):
    with pytest.raises(DataError, match="holds no folder, but folders of at least 2 classes"):
        prepare_data(root=tmp_path)
    cloud_file(tmp_path / "a" / "1.xyz")
    with pytest.raises(DataError, match="holds only the class a, but"):
        prepare_data(root=tmp_path)
    (tmp_path / "b").mkdir()
    with pytest.raises(DataError, match=r"b is empty, but a file that can be read is required"):
        prepare_data(root=tmp_path)
    (tmp_path / "b" / "notes.txt").write_text("")
    with pytest.raises(DataError, match=r"b holds no file that can be read, but notes\.txt"):
        prepare_data(root=tmp_path)
    cloud_file(tmp_path / "b" / "deep" / "1.xyz")
    with pytest.raises(DataError, match=r"b holds further folders \(deep\)"):
        prepare_data(root=tmp_path)
    for split in ("train", "test"):
        cloud_file(tmp_path / "c" / split / "1.xyz")
    with pytest.raises(DataError, match="a has no folders train and test, but others have"):
        prepare_data(root=tmp_path)


@pytest.mark.parametrize(
    "names, message",
    [
        (
            ("Train", "Test"),
            "The folders Test, Train have the names of splits, but hold no folders of classes",
        ),
        (("training", "val", "eval"), "The folders eval, training, val have the names of splits"),
        (
            ("caf\u00e9", "cafe\u0301"),
            r"The classes 'cafe\\u0301' and 'caf\\xe9' look the same \('caf\u00e9'\)",
        ),
    ],
)
def test_folders_that_are_no_different_classes_are_refused(prepare_data, tmp_path, names, message):
    for name in names:
        cloud_file(tmp_path / name / "1.xyz")
    with pytest.raises(DataError, match=message):
        prepare_data(root=tmp_path)


@pytest.mark.parametrize(
    "folder, message",
    [
        ("val", "holds a folder val beside .* Rename the folder val to validation"),
        ("Test", "holds a folder Test beside .* Rename the folder Test to test"),
        ("mine", "only validation may be missing. Set data.root"),
        (None, "holds no folder test"),
    ],
)
def test_incomplete_splits_are_refused(prepare_data, tmp_path, folder, message):
    for split in filter(None, ("train", folder, "test" if folder else None)):
        for name in "ab":
            cloud_file(tmp_path / split / name / "1.xyz")
    with pytest.raises(DataError, match=message):
        prepare_data(root=tmp_path)


def test_a_class_without_a_training_sample_is_refused(prepare_data, tmp_path):
    for split, names in (("train", "ab"), ("validation", "ab"), ("test", "abc")):
        for name in names:
            cloud_file(tmp_path / split / name / "1.xyz")
    with pytest.raises(DataError, match="The class c has no training sample"):
        prepare_data(root=tmp_path)


def test_too_large_shares_and_a_missing_root_are_refused(data, prepare_data, tmp_path):
    with pytest.raises(DataError, match=r"data\.validation \+ data\.test = 1\.2"):
        prepare_data(root=tmp_path, validation=0.6, test=0.6)
    with pytest.raises(DataError, match=r"data\.root is not set"):
        data().prepare()


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
@pytest.mark.parametrize("name", ["point_cloud_folder", "modelnet40"])
def test_the_real_shapes(prepare_data, tmp_path, name):
    with zipfile.ZipFile(
        Path(os.environ["REAL_DATA_ROOT"]) / "clouds" / "geometric_shapes_off.zip"
    ) as archive:
        archive.extractall(tmp_path)
    if (
        name == "modelnet40"
    ):  # the validation split is part of the training split, which has one mesh of each class
        config = {"name": name, "root": str(tmp_path / "raw"), "points": 256}
        with pytest.raises(DataError, match="validation split is empty"):
            build("data", resolve("data", config)).prepare()
        return
    shapes = prepare_data(root=tmp_path / "raw", validation=0, points=256)
    assert len(shapes.target.names) == 40
    batch = shapes.splits().test.__getitems__(range(40))
    assert sorted(batch["target"].tolist()) == list(range(40))
    assert batch["input"].shape == (40, 256, 3)
    assert batch["input"].isfinite().all()
    # the test mesh of a class is the same as or similar to its training mesh, so that their bounding boxes agree
    train = shapes.splits().train.__getitems__(range(40))
    train_box, test_box = (
        torch.stack([split["input"].amin(1), split["input"].amax(1)]) for split in (train, batch)
    )
    extent = (train_box[1] - train_box[0]).amax(1)
    assert ((train_box - test_box).abs().amax((0, 2)) < 0.2 * extent).double().mean() > 0.9
    assert math.isfinite(float(extent.sum()))


def test_remarks_name_the_columns_that_are_not_read(prepare_data, tmp_path):
    for number, name in enumerate(("low", "high")):
        (tmp_path / name).mkdir()
        for sample in range(8):
            rows = "\n".join(f"{number} {row} {sample} 0.5 7" for row in range(5))
            (tmp_path / name / f"{sample}.xyz").write_text(f"x y z red heat\n{rows}\n")
    remark = "left out: the columns red, heat of 0.xyz; list them in data.columns to read them"
    assert prepare_data(root=tmp_path, validation=0.2, test=0.2).remarks == (remark,)
    assert not prepare_data(root=tmp_path, validation=0.2, test=0.2, columns=["red", "heat"]).remarks
