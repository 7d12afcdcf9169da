"""Tests of a user's folder and table: what is read and refused."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from framework.configuration import schema
from framework.datasets.fields import Fields
from framework.datasets.file_columns import SPLITS, split_of
from framework.errors import ConfigError, DataError
from framework.testing.data_samples import fields_of, prepared
from plugins.data.images_with_angles.data import ImagesWithAngles


def write_folder(root: Path, table: str | None = None, images: int = 40) -> Path:
    """Write images and their table into a folder, and return it.

    The red value of an image is its number; its pan is 10° × number and its tilt is -1° × number.
    """
    lines = ["file,pan,tilt,note"]
    for number in range(images):
        name = f"{number:03d}.png"
        Image.fromarray(np.full((6, 9, 3), (number, 50, 200), np.uint8)).save(root / name)
        lines.append(f"{name},{10 * number},{-number},text")
    (root / "angles.csv").write_text(table if table is not None else "\n".join(lines), encoding="utf-8")
    return root


def prepare_data(root: Path, **config: Any) -> ImagesWithAngles:
    return prepared("images_with_angles", **{"root": str(root), "image_size": 8, **config})


def test_a_folder_gives_images_angles_and_splits(tmp_path: Path) -> None:
    data = prepare_data(write_folder(tmp_path))
    assert data.target.kind == "angle"
    assert data.target.names == ("pan", "tilt")  # the column `note` holds no numbers
    assert data.input_shape == (3, 8, 8)
    assert data.groups == (tmp_path.name,)
    all_numbers = []
    for split in SPLITS:
        table = fields_of(data, split)
        numbers = table["input"][:, 0, 0, 0].tolist()
        assert torch.all(table["input"][:, 2] == 200)
        for number, target in zip(numbers, table["target"].tolist(), strict=True):
            assert math.cos(target[0] - math.radians(10 * number)) == pytest.approx(1)
            assert target[1] == pytest.approx(-math.radians(number))
            assert split_of(f"{number:03d}.png") == split
        all_numbers += numbers
    assert sorted(all_numbers) == list(range(40))


def test_columns_splits_and_grey(tmp_path: Path) -> None:
    table = "file , split,yaw,roll\n000.png,train,370,5\n001.png,test,-190,6\n002.png,validation,0,7\n\n"
    data = prepare_data(
        write_folder(tmp_path, table, 3), angle_columns=["roll", "yaw", "roll"], grayscale=True
    )
    assert data.target.names == ("roll", "yaw")
    assert data.input_shape == (1, 8, 8)
    for split, roll, yaw in (("train", 5, 10), ("test", 6, 170), ("validation", 7, 0)):
        expected = torch.tensor([[math.radians(roll), math.radians(yaw)]])
        torch.testing.assert_close(fields_of(data, split)["target"], expected)


def test_split_by_name_is_70_15_15_and_never_moves() -> None:
    counts = Counter(split_of(f"image_{number}.jpg") for number in range(20000))
    for split, share in (("train", 0.70), ("validation", 0.15), ("test", 0.15)):
        assert counts[split] / 20000 == pytest.approx(share, abs=0.01)
    assert [split_of(name) for name in ("a.png", "b.png", "c.png", "d.png", "e.png", "f.png")] == [
        "train", "train", "train", "train", "train", "train",
    ]  # fmt: skip


LINES = [f"{number:03d}.png,{10 * number},{number}" for number in range(30)]


def table_with(line: str, header: str = "file,pan,tilt", index: int = 3) -> str:
    """Return a table with one more line after the first `index` lines of samples."""
    return "\n".join([header, *LINES[:index], line, *LINES[index:]])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("", r"is empty or begins with a blank line, but the first line must name the columns"),
        ("files,pan\n000.png,3", r"has no column `file`\. Did you mean 'files'\?"),
        ("file,pan\n000.png,3;4", r"no column of numbers .* 'pan': words"),
        ("file,pan", r"no row below its first line, but one row per sample is expected"),
        ("file,pan,pan\n000.png,3,4", r"the column 'pan' is named twice"),
        ("file,note\n000.png,hello", r"has no column of numbers besides `file` and `split`"),
        (table_with("777.png,abc,4"), r"line 5, column 'pan': 'abc' is not a finite number"),
        (table_with("777.png,,4"), r"line 5, column 'pan': The cell is empty, but a finite number"),
        (table_with("777.png,1_0,4"), r"line 5, column 'pan': '1_0' is not a finite number"),
        (table_with("777.png,3,nan"), r"line 5, column 'tilt': 'nan' is not a finite number"),
        (table_with("777.png,-inf,3"), r"line 5, column 'pan': '-inf' is not a finite number"),
        (table_with("777.png,3"), r"line 5: the line has 2 cells, but the first line names 3"),
        (table_with("777.png,3,4,5"), r"line 5: the line has 4 cells, but the first line names 3"),
        (table_with("  ,3,4"), r"line 5: The column `file` is empty\. Write the name of an image"),
        (table_with("001.png,3,4"), r"line 5: '001\.png' is already listed in line 3"),
        (table_with("../001.png,3,4"), r"line 5: '\.\./001\.png' lies outside of the folder of the data"),
        (table_with("a/../../001.png,3,4"), r"line 5: .* lies outside of the folder of the data"),
        (table_with("C:/Users/me/001.png,3,4"), r"line 5: .* is an absolute path"),
        (table_with("C:\\Users\\me\\001.png,3,4"), r"line 5: .* is an absolute path"),
        (
            table_with("/home/001.png,3,4"),
            r"line 5: '/home/001\.png' is an absolute path, .* set data\.root to a folder",
        ),
        (table_with("./001.png,3,4"), r"line 5: '\./001\.png' is already listed in line 3"),
        (table_with("a/..//001.png,3,4"), r"line 5: 'a/\.\.//001\.png' is already listed in line 3"),
        ('file,pan\n"000.png,3', r"cannot be read .* Save it as UTF-8 text"),
        (
            "file,pan,split\n000.png,3,trian",
            r"line 2, column `split`: 'trian' is not a split.* Did you mean 'train'\?",
        ),
        (
            "file,pan,split\n000.png,3,train",
            r"The validation split is empty \(1 images in all, 0 unreadable\)",
        ),
    ],
)
def test_wrong_tables_are_refused(tmp_path: Path, table: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        prepare_data(write_folder(tmp_path, table, 30))


def test_messages_about_missing_names_suggest_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"labels\.csv: no such file; expected a table .* data\.csv"):
        prepare_data(write_folder(tmp_path), csv="labels.csv")
    with pytest.raises(
        DataError, match=r"names the column 'pam', which .* does not have\. Did you mean 'pan'\?"
    ):
        prepare_data(tmp_path, angle_columns=["pam"])
    with pytest.raises(DataError, match=r"column 'note': 'text' is not a finite number"):
        prepare_data(tmp_path, angle_columns=["note"])
    with pytest.raises(DataError, match="angle_columns is empty"):
        prepare_data(tmp_path, angle_columns=[])
    with pytest.raises(
        DataError,
        match=r"data\.mirror names 'pam', which is not an angle of the table\. Did you mean 'pan'\?",
    ):
        prepare_data(tmp_path, mirror=["pam"])
    (tmp_path / "angles.csv").write_bytes("file,pan\nä.png,3".encode("latin-1"))
    with pytest.raises(DataError, match=r"angles\.csv: line 2 .* not UTF-8\. Save .* data\.encoding="):
        prepare_data(tmp_path)


def test_table_written_by_a_spreadsheet(tmp_path: Path) -> None:
    """Check that a byte-order mark, carriage returns, quotes and blank lines are accepted."""
    text = "file,pan\r\n" + "".join(f'"{n:03d}.png", {10 * n}.5\r\n,\r\n' for n in range(40))
    write_folder(tmp_path)
    (tmp_path / "angles.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    data = prepare_data(tmp_path)
    assert sum(len(fields_of(data, split)["index"]) for split in SPLITS) == 40


def radians_table(values: Sequence[float]) -> str:
    return "file,pan\n" + "\n".join(f"{index:03d}.png,{value}" for index, value in enumerate(values))


def test_radians_are_noticed(tmp_path: Path) -> None:
    values = np.linspace(-3.1, 3.1, 40).round(4).tolist()
    message = r"looks like radians, but degrees are expected\. Set data\.angles_in=radians"
    with pytest.raises(DataError, match=rf"{message}.* list the columns of angles in data\.angle_columns"):
        prepare_data(write_folder(tmp_path, radians_table(values)))
    with pytest.raises(DataError, match=rf"{message}.* if the angles are in degrees\.$"):
        prepare_data(tmp_path, angle_columns=["pan"])
    for unit, factor in (("radians", 1.0), ("degrees", math.pi / 180)):
        data = prepare_data(tmp_path, angles_in=unit)
        targets = torch.cat([fields_of(data, split)["target"] for split in SPLITS])
        expected = torch.tensor(values) * factor
        torch.testing.assert_close(targets.flatten().sort().values, expected.sort().values)


@pytest.mark.parametrize(
    "values", [[0.0] * 40, [*[1.0] * 39, 6.3], [1.0] * 20], ids=["all zero", "one beyond 2π", "few rows"]
)
def test_small_degrees_that_are_not_surely_radians_are_read(tmp_path: Path, values: list[float]) -> None:
    rows = [f"{index:03d}.png,{value},{SPLITS[index % 3]}" for index, value in enumerate(values)]
    data = prepare_data(write_folder(tmp_path, "file,pan,split\n" + "\n".join(rows)))
    targets = torch.cat([fields_of(data, split)["target"] for split in SPLITS]).flatten()
    torch.testing.assert_close(targets.sort().values, torch.tensor(values).deg2rad().sort().values)


def test_augment_changes_the_sign_of_the_named_angles_only(tmp_path: Path) -> None:
    batch = {
        "input": torch.randint(0, 256, (64, 3, 8, 8), dtype=torch.uint8),
        "target": torch.rand(64, 2) + 0.1,
    }
    data = prepare_data(write_folder(tmp_path), mirror=["tilt"], jitter=0.0)
    varied = data.augment(batch)
    flipped = (255 * varied["input"] - batch["input"].flip(-1)).abs().amax((1, 2, 3)) < 0.01
    assert 15 < int(flipped.sum()) < 50
    expected = torch.where(flipped[:, None], batch["target"] * torch.tensor([1.0, -1.0]), batch["target"])
    assert torch.equal(varied["target"], expected)
    assert prepare_data(tmp_path, jitter=0.0).augment(batch) is batch
    unmirrored = prepare_data(tmp_path).augment(batch)
    assert torch.equal(unmirrored["target"], batch["target"])


def test_read_gives_inputs_as_the_splits_hold_them(tmp_path: Path) -> None:
    data = prepare_data(write_folder(tmp_path), grayscale=True)
    names = [name for name in ("000.png", "001.png", "002.png", "003.png") if split_of(name) == "train"]
    read = data.read([tmp_path / name for name in names])
    assert isinstance(read, Fields)
    assert torch.equal(read.fields["input"], fields_of(data, "train")["input"][: len(names)])


@pytest.mark.parametrize(
    ("key", "value"), [("angles_in", "gradians"), ("image_size", 2), ("jitter", math.nan), ("rot", "x")]
)
def test_a_config_out_of_range_is_refused(key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"data\.{key}"):
        schema.resolve("data", {"name": "images_with_angles", key: value})


@given(st.text(max_size=60))
@settings(deadline=None, max_examples=60)
def test_any_text_for_a_table_is_refused_with_a_sentence(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    root = tmp_path_factory.mktemp("any")
    (root / "angles.csv").write_text("file,pan\n" + text, encoding="utf-8", errors="replace", newline="")
    with pytest.raises(DataError):
        prepare_data(root)
