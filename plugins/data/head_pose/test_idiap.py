"""Tests of the IDIAP label file, an HDF5 file: what is read, refused and written."""

import math
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from framework.testing.data_samples import fields_of
from plugins.data.head_pose.idiap import PEOPLE, random_pose
from plugins.data.head_pose.idiap_labels import LABELS, Label, read_labels, write_labels
from plugins.data.head_pose.roots import (
    idiap_row,
    prepare_data,
    publish_idiap,
    save_idiap,
    write_idiap,
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_idiap(tmp_path / "IHDPHeadPose")


def test_structs_may_lie_in_a_row(root: Path) -> None:
    column = fields_of(prepare_data("idiap", root), "train")
    publish_idiap(root, column=False)
    row = fields_of(prepare_data("idiap", root), "train")
    assert torch.equal(row["input"], column["input"])
    assert torch.equal(row["target"], column["target"])


def test_angles_are_chosen_and_ordered(root: Path) -> None:
    data = prepare_data("idiap", root, angles=["roll", "pan", "roll"])
    assert data.target.names == ("roll", "pan")
    expected = torch.tensor([[idiap_row(number)[3], idiap_row(number)[1]] for number in range(20)])
    torch.testing.assert_close(fields_of(data, "train")["target"], expected)


def test_struct_of_one_element(root: Path) -> None:
    publish_idiap(root, train=[7])
    (label,) = read_labels(root / LABELS, "radians")["train"]
    assert label == Label("head_7.png", idiap_row(7)[1:])


def test_labels_in_the_wrong_unit_are_refused(root: Path) -> None:
    in_degrees = {
        f"or_label_{split}": [
            (name, *(math.degrees(angle) for angle in angles)) for name, *angles in map(idiap_row, numbers)
        ]
        for split, numbers in (("train", range(20)), ("test", range(20, 31)))
    }
    radians = fields_of(prepare_data("idiap", root), "train")["target"]
    with pytest.raises(DataError, match=r"looks like radians, but degrees .* Set data\.angles_in=radians"):
        prepare_data("idiap", root, angles_in="degrees")
    save_idiap(root / LABELS, **in_degrees)
    with pytest.raises(DataError, match=r"look like degrees, but radians .* Set data\.angles_in=degrees"):
        prepare_data("idiap", root)
    torch.testing.assert_close(
        fields_of(prepare_data("idiap", root, angles_in="degrees"), "train")["target"], radians
    )


def test_unit_of_generated_labels_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"data\.angles_in=degrees is the unit .* data\.root is not set"):
        build("data", resolve("data", {"name": "idiap", "angles_in": "degrees"}))


def test_label_file_that_is_cut_short_or_lacks_something_is_named(root: Path) -> None:
    whole = (root / LABELS).read_bytes()
    for length in range(0, len(whole) - 1, 4999):
        (root / LABELS).write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"or_label_full\.mat: cannot be read"):
            prepare_data("idiap", root)
    for missing in ("or_label_test", "or_label_train/roll"):
        (root / LABELS).write_bytes(whole)
        with h5py.File(root / LABELS, "r+") as content:
            del content[missing]
        with pytest.raises(DataError, match=missing.split("/")[-1]):
            prepare_data("idiap", root)
    (root / LABELS).write_bytes(whole)
    with h5py.File(root / LABELS, "r+") as content:
        shorter = content["or_label_train/tilt"][:19]
        del content["or_label_train/tilt"]
        content["or_label_train/tilt"] = shorter
    with pytest.raises(
        DataError, match=r"fields of the struct or_label_train have different lengths: .*'tilt': 19"
    ):
        prepare_data("idiap", root)


@pytest.mark.parametrize("angle", [math.nan, math.inf])
def test_angle_that_is_not_finite_is_never_skipped(root: Path, angle: float) -> None:
    publish_idiap(root, or_label_train=[idiap_row(0), ("head_1.png", 0.5, angle, 0.25)])
    with pytest.raises(DataError, match=rf"1 images have an angle .*\n.*head_1\.png: 0\.5, {angle}, 0\.25"):
        prepare_data("idiap", root, skip_unreadable=True)
    # without tilt among the angles, that label is good
    assert len(fields_of(prepare_data("idiap", root, angles=["pan"]), "train")["input"]) == 2


def test_labels_are_written_in_the_layout_of_matlab(tmp_path: Path) -> None:
    labels = {
        "train": [Label("a_1.jpg", (1.0, -2.0, 3.0)), Label("b.jpg", (0.5, 0.25, 0.125))],
        "test": [Label("c.jpg", (0.0, 0.0, 0.0)), Label("d.jpg", (0.0, 0.0, 1.0))],
    }
    write_labels(tmp_path / LABELS, labels)
    assert read_labels(tmp_path / LABELS, "radians") == labels
    assert (tmp_path / LABELS).read_bytes().startswith(b"MATLAB 7.3 MAT-file")
    with h5py.File(tmp_path / LABELS) as content:
        field = content["or_label_train/name"]
        assert field.shape == (2, 1)
        cell = content[field[1, 0]]
        assert (cell.dtype, cell.shape) == (np.uint16, (5, 1))


def test_labels_of_the_generated_set_are_the_random_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path))
    data = prepare_data("idiap", None, images=60)
    poses = []
    for number in range(38):
        random = np.random.default_rng([0, 0, number])
        random.integers(PEOPLE)
        poses.append(random_pose(random))
    np.testing.assert_allclose(fields_of(data, "train")["target"].rad2deg(), poses, atol=1e-4)


@pytest.mark.parametrize("kind", ["struct elsewhere", "field elsewhere", "struct behind a link"])
def test_a_link_is_refused_and_never_opened(kind: str, root: Path) -> None:
    """HDF5 opens the file to which a link leads, and opening a pipe would wait for ever."""
    os.mkfifo(root / "pipe")
    with h5py.File(root / LABELS, "r+") as content:
        elsewhere = h5py.ExternalLink("pipe", "/a")
        if kind == "field elsewhere":
            del content["or_label_test"]["pan"]
            content["or_label_test"]["pan"] = elsewhere
        else:
            del content["or_label_train"]
            content["or_label_train"] = elsewhere if kind == "struct elsewhere" else h5py.SoftLink("/other/a")
            content["other"] = elsewhere
    with pytest.raises(DataError, match=r"is a link to another place or file"):
        read_labels(root / LABELS, "radians")


@pytest.mark.parametrize("name", ["../a.png", "/home/a.png", "a/../../b.png"])
def test_an_image_outside_of_the_folder_is_refused(name: str, tmp_path: Path) -> None:
    label = Label(name, (0.0, 0.0, 0.0))
    write_labels(tmp_path / LABELS, {"train": [label], "test": [Label("b.png", (0.0, 0.0, 0.0))]})
    with pytest.raises(DataError, match=r"lies outside of the folder of the data"):
        read_labels(tmp_path / LABELS, "radians")
