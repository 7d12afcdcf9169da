"""Tests of labelled images: what is read and refused, turning, and corruptions."""

import gzip
import io
import math
import os
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from kornia.geometry.transform import rotate
from PIL import Image
from scipy.ndimage import center_of_mass, gaussian_filter

from framework.configuration.schema import build, resolve
from framework.data import Batch, Data
from framework.datasets.fields import fetch
from framework.errors import ConfigError, DataError, UserError
from framework.testing.data_samples import prepared
from plugins.data.image_folder.corruption import CORRUPT, STRENGTHS
from plugins.data.image_folder.data import find_centres, keep_disc, turn
from plugins.data.image_folder.idx import read_idx
from plugins.data.image_folder.rows import write_folders, write_idx, write_table

SPLITS = ("train", "validation", "test")
SMALL = {"image_size": 8, "jitter": 0.0}


def fields_of(data: Data, split: str) -> Batch:
    """Return all samples of a split."""
    dataset = getattr(data.splits(), split)
    return fetch(dataset, range(len(dataset)))


def write_image(file: Path, red: int) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((6, 9, 3), (red, 50, 200), np.uint8)).save(file)


def test_folders_by_class_are_split_with_equal_shares(tmp_path: Path) -> None:
    for number in range(40):
        write_image(tmp_path / ("a", "b")[number >= 20] / f"{number:02d}.png", number)
    (tmp_path / "a" / "notes.txt").write_text("text", encoding="utf-8")
    data = prepared("image_folder", root=str(tmp_path), validation=0.2, test=0.3, **SMALL)
    assert (data.target.kind, data.target.names) == ("class", ("a", "b"))
    assert data.remarks == ("left out: 1 file of other kinds",)
    seen = []
    for split, count in zip(SPLITS, (10, 4, 6), strict=True):
        table = fields_of(data, split)
        assert Counter(table["target"].tolist()) == {0: count, 1: count}
        for red, label in zip(table["input"][:, 0, 0, 0].tolist(), table["target"].tolist(), strict=True):
            assert label == (red >= 20)
        seen += table["input"][:, 0, 0, 0].tolist()
    assert sorted(seen) == list(range(40))


def test_folders_of_splits_are_kept(tmp_path: Path) -> None:
    for number in range(24):
        write_image(
            tmp_path / ("train", "test")[number % 3 == 0] / ("a", "b")[number % 2] / f"{number}.png", number
        )
    data = prepared("image_folder", root=str(tmp_path), validation=0.25, **SMALL)
    reds = {split: fields_of(data, split)["input"][:, 0, 0, 0] for split in SPLITS}
    assert set(reds["test"].tolist()) == set(range(0, 24, 3))
    assert len(reds["validation"]) == 4


def test_a_table_states_labels_and_splits(tmp_path: Path) -> None:
    data = prepared("image_folder", **write_table(tmp_path), **SMALL)
    for number, split in enumerate(SPLITS):
        expected = [int(index % 2 == 0) for index in range(40) if index % 3 == number]
        assert fields_of(data, split)["target"].tolist() == expected  # cat, dog


def test_idx_files_of_train_and_test(tmp_path: Path) -> None:
    settings = write_idx(tmp_path, 60, 8)
    for part in ("images-idx3-ubyte.gz", "labels-idx1-ubyte"):
        (tmp_path / f"t10k-{part}").write_bytes((tmp_path / f"train-{part}").read_bytes())
    data = prepared("image_folder", **settings, **SMALL, grayscale=True)
    raw = gzip.decompress((tmp_path / "t10k-images-idx3-ubyte.gz").read_bytes())[16:]
    test = fields_of(data, "test")
    assert test["input"].numpy().tobytes() == raw
    assert test["target"].tolist() == [number % 3 for number in range(60)]
    assert len(fields_of(data, "validation")["target"]) == 9


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda root: (root / "train-labels-idx1-ubyte").unlink(), "but neither train-labels-idx1-ubyte nor"),
        (lambda root: write_labels(root, 12), "holds 40 images of 9 × 9 pixels, and .* 12 labels"),
        (lambda root: (root / "train-labels-idx1-ubyte").write_bytes(bytes(8)), "the header is 00000000"),
        (
            lambda root: (root / "train-labels-idx1-ubyte").write_bytes(bytes([0, 0, 8, 1, 9, 9, 9, 9])),
            "states",
        ),
    ],
)
def test_idx_files_that_do_not_fit_are_refused(
    tmp_path: Path, spoil: Callable[[Path], object], message: str
) -> None:
    settings = write_idx(tmp_path)
    spoil(tmp_path)
    with pytest.raises(DataError, match=message):
        prepared("image_folder", **settings, **SMALL)


def write_labels(root: Path, count: int) -> None:
    content = bytes([0, 0, 8, 1]) + count.to_bytes(4, "big") + bytes(count)
    (root / "train-labels-idx1-ubyte").write_bytes(content)


def test_a_packed_idx_file_cannot_fill_the_memory(tmp_path: Path) -> None:
    size = 2**31
    packed = io.BytesIO()
    with gzip.GzipFile(fileobj=packed, mode="wb", compresslevel=9) as stream:
        stream.write(bytes([0, 0, 8, 1]) + size.to_bytes(4, "big"))
        for _ in range(1024):
            stream.write(bytes(2**20))
    (tmp_path / "labels").write_bytes(packed.getvalue())
    with pytest.raises(DataError, match="decompress to more than"):
        read_idx(tmp_path / "labels", 1)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"classes": ["cat", "dgo"]}, "data.classes names 'dgo'.* Did you mean 'dog'"),
        ({"classes": ["cat"]}, "images of 1 classes, but at least 2"),
        ({"validation": 0.5, "test": 0.5}, "must be less than 1"),
        ({"csv": "none.csv"}, "none.csv: no such file; expected a table with the columns `file` and `label`"),
        ({"strength": 2}, "data.strength = 2 has no effect without a corruption"),
        ({"root": None}, "data.root is not set. Set data.root to a folder with the layout"),
    ],
)
def test_mistakes_in_settings_are_named(tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        prepared("image_folder", **{**write_folders(tmp_path), **SMALL, **settings})


def test_a_table_beside_folders_that_are_no_classes_is_named(tmp_path: Path) -> None:
    write_image(tmp_path / "all" / "0.png", 0)
    (tmp_path / "labels.csv").write_text("file,label\nall/0.png,cat", encoding="utf-8")
    with pytest.raises(
        DataError, match=r"only the class all, .* is a table of labels, set data.csv=labels.csv"
    ):
        prepared("image_folder", root=str(tmp_path), **SMALL)


@pytest.mark.parametrize(
    "table, message",
    [
        ("file,class\n000.png,cat", "has no column `label`"),
        ("file,label\n000.png,cat\n001.png,", "line 3: The column `label` is "),
        ("file,label\n000.png,cat\n./000.png,dog", "line 3: './000.png' is already listed in line 2"),
        ("file,label,split\n000.png,cat,tset", "'tset' is not a split"),
    ],
)
def test_mistakes_in_a_table_are_named(tmp_path: Path, table: str, message: str) -> None:
    settings = write_table(tmp_path)
    (tmp_path / "labels.csv").write_text(table, encoding="utf-8")
    with pytest.raises(DataError, match=re.escape(message)):
        prepared("image_folder", **settings, **SMALL)


def test_a_policy_without_its_package_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plugins.data.image_folder.policy.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs the package kornia.*\[augment\]"):
        build("data", resolve("data", {"name": "image_folder", "root": str(tmp_path), "policy": "trivial"}))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_turning_agrees_with_kornia_and_quarter_turns(dtype: torch.dtype) -> None:
    image = (255 * torch.rand(6, 3, 31, 31, generator=torch.Generator().manual_seed(0))).to(dtype)
    degrees = torch.tensor([0.0, 90.0, 180.0, -90.0, 33.0, -127.0])
    turned = turn(image, degrees.deg2rad()).float()
    peer = rotate(image.float(), degrees, padding_mode="border", align_corners=False)
    peer = keep_disc(peer.round() if dtype == torch.uint8 else peer)
    assert (turned - peer).abs().max() <= (1 if dtype == torch.uint8 else 0.02)  # rounding of a half
    for index, times in ((0, 0), (1, 1), (2, 2), (3, -1)):
        exact = keep_disc(torch.rot90(image[index], times, (1, 2)))
        torch.testing.assert_close(turned[index], exact.float(), atol=0.02, rtol=0)


def test_turned_images_have_the_angle_of_their_target(tmp_path: Path) -> None:
    """The brighter half of an image points to the right when the image is upright."""
    picture = np.tile(np.linspace(0, 255, 33).astype(np.uint8), (33, 1))
    for number in range(30):
        (tmp_path / "a").mkdir(exist_ok=True)
        Image.fromarray(picture).save(tmp_path / "a" / f"{number}.png")
    data = prepared("turned_images", root=str(tmp_path), image_size=33, grayscale=True)
    assert data.groups == ("a",)
    batch = fields_of(data, "train")
    varied = data.augment(batch)
    assert not torch.equal(varied["target"], batch["target"])
    offset = torch.arange(33.0) - 16
    for table in (fields_of(data, "test"), batch, varied):
        pixels = table["input"][:, 0].float()
        pixels = pixels * (255 if table["input"].is_floating_point() and pixels.max() <= 1 else 1)
        angle = torch.atan2(-(pixels * offset[:, None]).sum((1, 2)), (pixels * offset).sum((1, 2)))
        error = torch.remainder(angle - table["target"][:, 0] + math.pi, 2 * math.pi) - math.pi
        assert error.abs().max() < 0.01
    again = prepared("turned_images", root=str(tmp_path), image_size=33, grayscale=True)
    assert torch.equal(fields_of(again, "test")["input"], fields_of(data, "test")["input"])


@pytest.mark.parametrize("background", [0, 200])
def test_a_centre_of_mass_is_turned_into_the_middle(background: int) -> None:
    """An L off the middle looks like the L turned about the middle, and SciPy finds its centre of mass there."""
    upright = torch.full((1, 1, 41, 41), float(background))
    upright[..., 12:22, 20:23] = 100
    upright[..., 20:22, 23:29] = 100
    centres = find_centres(upright, "mass")
    assert centres is not None
    mass = (upright[0, 0] - background).abs().numpy()
    expected = (np.array(center_of_mass(mass))[::-1] - 20) / 20.5  # (x, y), in units of half a side
    np.testing.assert_allclose(centres[0], expected, atol=1e-5)
    for angle in (0.0, 0.7, 3.0):
        turned = turn(upright - background, torch.tensor([angle]), centres)[0, 0].abs()
        np.testing.assert_allclose(center_of_mass(turned.numpy()), (20, 20), atol=0.05)
    blank = torch.full((2, 3, 9, 9), 7, dtype=torch.uint8)
    assert torch.equal(find_centres(blank, "mass"), torch.zeros(2, 2))


def test_an_image_that_is_predicted_is_centred_like_turned_images(tmp_path: Path) -> None:
    picture = np.zeros((33, 33), np.uint8)
    picture[4:16, 6:12] = 255
    (tmp_path / "a").mkdir()
    for number in range(30):
        Image.fromarray(picture).save(tmp_path / "a" / f"{number}.png")
    data = prepared("turned_images", root=str(tmp_path), image_size=33, grayscale=True, centre="mass")
    test = fields_of(data, "test")
    read = fetch(data.read([tmp_path / "a" / "0.png"]), [0])["input"]
    assert torch.equal(read, data.inputs(torch.from_numpy(picture)[None, None]))
    for table in (test["input"], data.augment(fields_of(data, "train"))["input"], read):
        for pixels in table[:, 0].numpy():
            np.testing.assert_allclose(center_of_mass(pixels), (16, 16), atol=0.05)


def test_corruptions_have_the_strength_that_they_state() -> None:
    image = torch.randint(90, 160, (3, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    values = image.double()
    for strength in range(5):
        noisy, blurred, flat, packed = (
            CORRUPT[kind](image, STRENGTHS[kind][strength], 3).double()
            for kind in ("noise", "blur", "contrast", "jpeg")
        )
        if strength < 2:  # a wider noise is cut off at black and white
            deviation = (noisy - values).std() / 255
            assert deviation == pytest.approx(STRENGTHS["noise"][strength], rel=0.03)
        sigma = 64 * STRENGTHS["blur"][strength]
        peer = np.stack([gaussian_filter(plane, sigma, mode="reflect") for plane in values.numpy()])
        assert np.abs(blurred.numpy() - peer).max() <= 1
        assert flat.std() / values.std() == pytest.approx(STRENGTHS["contrast"][strength], rel=0.1)
        assert (flat.mean((1, 2)) - values.mean((1, 2))).abs().max() < 0.5
        assert 1 < (packed - values).abs().mean() < 30


def test_only_test_images_are_corrupted_and_always_alike(tmp_path: Path) -> None:
    settings = write_folders(tmp_path)
    clean = prepared("image_folder", **settings, **SMALL)
    noisy = prepared("image_folder", **settings, **SMALL, corruption="noise", strength=1)
    for split in SPLITS:
        same = torch.equal(fields_of(clean, split)["input"], fields_of(noisy, split)["input"])
        assert same == (split != "test")
    whole = fields_of(noisy, "test")["input"]
    assert torch.equal(noisy.splits().test[2]["input"], whole[2])


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT names no folder of real data")
def test_digits_are_read_upright() -> None:
    root = Path(os.environ["REAL_DATA_ROOT"]) / "digits"
    data = prepared("image_folder", root=str(root), image_size=28, grayscale=True)
    assert data.target.names == tuple("0123456789")
    table = fields_of(data, "train")
    assert len(table["target"]) == 7000
    ones = table["input"][table["target"] == 1].float().mean((0, 1))
    assert ones[4:24, 12:17].mean() > 5 * ones[12:17, 4:9].mean()  # a vertical stroke
