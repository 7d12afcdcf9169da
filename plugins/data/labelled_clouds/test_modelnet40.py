"""Tests of the reader of ModelNet40's layout, of the generated set, and of rotated copies."""

import math

import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import DataError
from framework.geometry.meshes import READERS, read, sample, stream
from framework.geometry.solids import box
from plugins.data.labelled_clouds.shapes.generator import CLASSES, as_off

NAME = "modelnet40"
SIZES = {"train_models": 4, "test_models": 2}


def write_cubes(folder, *names):
    """Write unit cubes as `<folder>/<name>`, with the broken header of some official files."""
    text = as_off(box(1.0, 1.0, 1.0)).replace("OFF\n", "OFF", 1)
    for name in names:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)


def write_official(folder):
    """Write three classes of cubes in the layout of ModelNet40, and return the folder."""
    for category in ("cube", "crate", "box"):
        write_cubes(folder, *(f"{category}/train/{category}_{number:04d}.off" for number in range(5)))
        write_cubes(folder, *(f"{category}/test/{category}_{number:04d}.off" for number in range(5, 7)))
    return folder


def test_splits_labels_and_attributes(prepare_data, tmp_path):
    root = write_official(tmp_path / "ModelNet40")
    clouds = prepare_data(root=root, points=64, validation_share=0.2)
    assert clouds.target.kind == "class"
    assert clouds.target.names == ("box", "crate", "cube")
    assert clouds.input_shape == (64, 3)
    assert clouds.columns == ("x", "y", "z")
    assert not clouds.varies
    sizes = {}
    for name, split in clouds.splits()._asdict().items():
        batch = split.__getitems__(range(len(split)))
        sizes[name] = torch.bincount(batch["target"]).tolist()
        assert batch["input"].shape == (len(split), 64, 3)
        surface = (batch["input"] - torch.tensor([0, 0, 0.5])).abs().amax(-1)
        torch.testing.assert_close(surface, torch.full_like(surface, 0.5))
    assert sizes == {"train": [4, 4, 4], "validation": [1, 1, 1], "test": [2, 2, 2]}
    fingerprint = clouds.fingerprint()
    assert (fingerprint["train"], fingerprint["version"]) == ("12", "ModelNet40")


def test_the_points_of_a_file_do_not_depend_on_other_files(data, prepare_data, tmp_path):
    root = write_official(tmp_path / "ModelNet40")
    file = root / "cube" / "test" / "cube_0006.off"
    expected = sample(read(file), 64, stream(7, "cube_0006.off")).points.astype(np.float32)
    for config in ({}, {"classes": ["cube", "box"]}):
        clouds = prepare_data(root=root, points=64, data_seed=7, **config)
        last = clouds.splits().test[len(clouds.splits().test) - 1]
        np.testing.assert_array_equal(last["input"], expected)
    unlabelled = data(points=64, data_seed=7).read([file])  # without prepare
    np.testing.assert_array_equal(unlabelled[0]["input"], expected)


def test_the_second_run_reads_no_mesh(prepare_data, tmp_path, monkeypatch):
    root = write_official(tmp_path / "ModelNet40")
    first = prepare_data(root=root, points=32)
    monkeypatch.setitem(READERS, ".off", None)
    again = prepare_data(root=root, points=32)
    assert torch.equal(
        first.splits().train.__getitems__([3, 1])["input"], again.splits().train.__getitems__([3, 1])["input"]
    )


def test_normals_are_those_of_the_faces(prepare_data, tmp_path):
    clouds = prepare_data(root=write_official(tmp_path / "ModelNet40"), points=50, normals=True)
    assert clouds.columns == ("x", "y", "z", "normal_x", "normal_y", "normal_z")
    assert clouds.input_shape == (50, 6)
    inputs = clouds.splits().train.__getitems__(range(len(clouds.splits().train)))["input"]
    # the outward normal of a cube is along the coordinate that is furthest from the middle of the cube
    local = inputs[..., :3] - torch.tensor([0, 0, 0.5])
    axis = local.abs().argmax(-1, keepdim=True)
    outwards = torch.zeros_like(local).scatter(-1, axis, local.gather(-1, axis).sign())
    torch.testing.assert_close(inputs[..., 3:], outwards, atol=1e-6, rtol=0)


def test_the_whole_training_split_can_be_used_for_training(prepare_data, tmp_path):
    """Check that nothing is held out, as in the thesis, and that validation uses unrotated training clouds."""
    config = {"root": write_official(tmp_path / "ModelNet40"), "points": 40}
    whole, held_out = prepare_data(**config, validation_share=0, rotations=2), prepare_data(**config)
    train, validation, test = whole.splits()
    assert len(validation) == len(held_out.splits().train) + len(held_out.splits().validation)
    assert len(train) == 2 * len(validation)
    first = [split.__getitems__(range(len(validation))) for split in (train, validation)]
    assert torch.equal(first[0]["input"], first[1]["input"])
    assert len(test) == len(held_out.splits().test)


def test_rotations_repeat_the_training_split_about_the_up_axis(prepare_data, tmp_path):
    config = {"root": write_official(tmp_path / "ModelNet40"), "points": 40, "normals": True}
    plain, rotated = prepare_data(**config), prepare_data(**config, rotations=3)
    count = len(plain.splits().train)
    assert len(rotated.splits().train) == 3 * count
    assert len(rotated.splits().test) == len(plain.splits().test)
    unrotated = plain.splits().train.__getitems__(range(count))
    copies = rotated.splits().train.__getitems__(range(3 * count))
    torch.testing.assert_close(copies["input"][:count], unrotated["input"], atol=0, rtol=0)
    assert copies["index"].tolist() == list(range(3 * count))
    assert copies["target"].tolist() == 3 * unrotated["target"].tolist()
    for copy in (1, 2):
        clouds = copies["input"][copy * count : (copy + 1) * count]
        # x and y as a complex number are multiplied by exp(2πi copy / 3); columns 0 and 1 are points, 3 and 4 normals
        for first in (0, 3):
            before = torch.complex(
                unrotated["input"][..., first].double(), unrotated["input"][..., first + 1].double()
            )
            after = torch.complex(clouds[..., first].double(), clouds[..., first + 1].double())
            factor = complex(math.cos(2 * math.pi * copy / 3), math.sin(2 * math.pi * copy / 3))
            torch.testing.assert_close(after, before * factor, atol=1e-6, rtol=0)
        torch.testing.assert_close(clouds[..., [2, 5]], unrotated["input"][..., [2, 5]], atol=0, rtol=0)
    single = rotated.splits().train[count + 2]
    assert torch.equal(single["input"], copies["input"][count + 2])
    with pytest.raises(IndexError):
        rotated.splits().train[3 * count]


def test_other_layouts_and_classes_are_refused(prepare_data, tmp_path):
    root = write_official(tmp_path / "ModelNet40")
    with pytest.raises(DataError, match="the folder ModelNet40 has no folders train and test"):
        prepare_data(root=tmp_path)
    with pytest.raises(DataError, match=r"names 'crat', which .* Did you mean 'crate'"):
        prepare_data(root=root, classes=["crat", "box"])
    with pytest.raises(DataError, match=r"at least two classes are required\. Choose from box, crate, cube"):
        prepare_data(root=root, classes=["box"])
    for file in (root / "crate" / "test").iterdir():
        file.unlink()
    with pytest.raises(DataError, match=r"crate/test is empty, but a \.off file is required"):
        prepare_data(root=root)


def test_without_a_root_every_class_is_generated(prepare_data):
    clouds = prepare_data(points=128, **SIZES)
    assert len(clouds.target.names) == len(CLASSES) == 40
    assert clouds.fingerprint()["root"] == "synthetic, seed 0"
    assert torch.bincount(clouds.splits().test.fields.fields["target"]).tolist() == [2] * len(CLASSES)


def test_a_trained_model_is_tested_on_new_files_of_some_of_its_classes(prepare_data, tmp_path):
    settings = {"points": 64, "validation_share": 0.2, "classes": ["box", "crate", "cube"]}
    trained = prepare_data(root=write_official(tmp_path / "ModelNet40"), **settings)
    assert any(
        "6 of the 6 test files have the content" in x for x in trained.remarks
    )  # all are the same cube
    other = tmp_path / "new"
    (other / "cube" / "test").mkdir(parents=True)
    (other / "cube" / "test" / "long.off").write_text(as_off(box(1.0, 2.0, 5.0)))
    with pytest.raises(DataError, match="the folder cube has no folders train and test"):
        prepare_data(root=other, **settings)
    data = build("data", resolve("data", {"name": "modelnet40", "root": str(other), **settings}))
    data.load_state_dict(trained.state_dict())
    data.prepare()
    assert data.target == trained.target and data.remarks == ()
    assert [len(part) for part in data.splits()] == [0, 0, 1]
    assert int(data.splits().test[0]["target"]) == 2
