"""The folder of IDIAP crops and its HDF5 label file: what is read, what is refused, and what is drawn."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from PIL import Image
from sklearn.kernel_ridge import KernelRidge

from framework.configuration import schema
from framework.datasets.fields import Fields
from framework.errors import ConfigError, DataError
from framework.storage import generated
from plugins.data.head_pose.idiap import generator
from plugins.data.head_pose.idiap.data import Idiap
from plugins.data.head_pose.idiap.labels import LABELS, Label, read_labels, write_labels

SPLITS = ("train", "validation", "test")
Rows = Sequence[tuple[str, float, float, float]]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def save(file: Path, *, column: bool = True, **structs: Rows) -> None:
    """A file as MATLAB 7.3 writes struct arrays: cells in #refs#, and fields of references to them.

    Text is UTF-16 code units down a column; a row of structs gives columns of references, a column a row.
    """
    with h5py.File(file, "w", userblock_size=512) as content:
        cells = content.create_group("#refs#")
        for name, rows in structs.items():
            struct = content.create_group(name)
            for index, field in enumerate(("name", "pan", "tilt", "roll")):
                values = [
                    np.array([[ord(letter)] for letter in row[0]], dtype=np.uint16)
                    if field == "name"
                    else np.array([[row[index]]], dtype=np.float64)
                    for row in rows
                ]
                if len(values) == 1:  # a struct alone holds its values itself
                    struct.create_dataset(field, data=values[0])
                    continue
                references = np.empty((len(values), 1), dtype=h5py.ref_dtype)
                for place, value in enumerate(values):
                    references[place, 0] = cells.create_dataset(f"{name}{field}{place}", data=value).ref
                struct.create_dataset(field, data=references if column else references.T)
    with file.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def row(number: int) -> tuple[str, float, float, float]:
    return f"head_{number}.png", 0.1 * number - 1.5, 0.02 * number, -0.05 * number


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Twenty images to train with and eleven to test with, whose red is their number times eight."""
    place = tmp_path / "IHDPHeadPose"
    for split, numbers in (("train", range(20)), ("test", range(20, 31))):
        (place / split).mkdir(parents=True)
        for number in numbers:
            Image.new("RGB", (75, 75), (8 * number, 100, 200)).save(place / split / f"head_{number}.png")
    published(place)
    return place


def published(root: Path, **more: Any) -> None:
    train, test = [row(n) for n in range(20)], [row(n) for n in range(20, 31)]
    save(root / LABELS, **{"or_label_train": train, "or_label_test": test, **more})


def prepared(root: Path | None, **config: Any) -> Idiap:
    config = {"name": "idiap", "root": root and str(root), **config}
    data = schema.build("data", schema.resolve("data", config))
    data.prepare()
    return data


def table(data: Idiap, split: str) -> Mapping[str, torch.Tensor]:
    dataset = {"train": data.train, "validation": data.validation, "test": data.test}[split]()
    assert isinstance(dataset, Fields)
    return dataset.fields


def numbers_in(fields: Mapping[str, torch.Tensor]) -> list[int]:
    return (fields["input"][:, 0, 0, 0] // 8).tolist()


# ---- the published layout --------------------------------------------------------------------------------


@pytest.mark.parametrize("column", [True, False])
def test_images_labels_and_splits(root: Path, column: bool) -> None:
    published(root, column=column)
    data = prepared(root)
    assert numbers_in(table(data, "train")) == list(range(20))
    np.random.seed(13)  # noqa: NPY002  (the thesis authors' code seeds the global generator)
    order = (20 + np.random.choice(11, 11, replace=False)).tolist()  # noqa: NPY002
    assert numbers_in(table(data, "validation")) == order[:5]
    assert numbers_in(table(data, "test")) == order[5:]
    for split in SPLITS:
        fields = table(data, split)
        expected = torch.tensor([row(number)[1:] for number in numbers_in(fields)])
        torch.testing.assert_close(fields["target"], expected)
    assert data.target.names == ("pan", "tilt", "roll")
    assert data.input_shape == (3, 75, 75)
    assert data.groups == ("idiap",)
    assert not data.synthetic
    assert data.skipped == 0
    assert data.fingerprint()["version"] == "IHDPHeadPose"
    assert prepared(root).fingerprint() == data.fingerprint()


def test_angles_are_chosen_and_ordered(root: Path) -> None:
    data = prepared(root, angles=["roll", "pan", "roll"])
    assert data.target.names == ("roll", "pan")
    expected = torch.tensor([[row(number)[3], row(number)[1]] for number in range(20)])
    torch.testing.assert_close(table(data, "train")["target"], expected)
    with pytest.raises(ConfigError, match=r"data\.angles"):
        prepared(root, angles=["yaw"])


def test_struct_of_one_element(root: Path) -> None:
    published(root, or_label_train=[row(7)])
    (label,) = read_labels(root / LABELS, "radians")["train"]
    assert label == Label("head_7.png", row(7)[1:])


def test_degrees_and_radians_are_told_apart(root: Path) -> None:
    turned = {
        f"or_label_{split}": [
            (name, *(math.degrees(angle) for angle in angles)) for name, *angles in map(row, numbers)
        ]
        for split, numbers in (("train", range(20)), ("test", range(20, 31)))
    }
    radians = table(prepared(root), "train")["target"]
    with pytest.raises(DataError, match=r"looks like radians; wanted degrees\. Set data\.angles_in=radians"):
        prepared(root, angles_in="degrees")
    save(root / LABELS, **turned)
    with pytest.raises(DataError, match=r"look like degrees; wanted radians\. Set data\.angles_in=degrees"):
        prepared(root)
    torch.testing.assert_close(table(prepared(root, angles_in="degrees"), "train")["target"], radians)


@pytest.mark.parametrize("content", [b"", b"no HDF5 at all" * 99, b"MATLAB 5.0 MAT-file".ljust(600)])
def test_label_file_that_cannot_be_read(root: Path, content: bytes) -> None:
    (root / LABELS).write_bytes(content)
    with pytest.raises(
        DataError, match=r"or_label_full\.mat: cannot be read as the MATLAB 7\.3 \(HDF5\) file"
    ):
        prepared(root)


def test_label_file_that_is_cut_short_or_lacks_something_is_named(root: Path) -> None:
    whole = (root / LABELS).read_bytes()
    for length in range(0, len(whole) - 1, 4999):
        (root / LABELS).write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"or_label_full\.mat: cannot be read"):
            prepared(root)
    for missing in ("or_label_test", "or_label_train/roll"):
        (root / LABELS).write_bytes(whole)
        with h5py.File(root / LABELS, "r+") as content:
            del content[missing]
        with pytest.raises(DataError, match=missing.split("/")[-1]):
            prepared(root)
    (root / LABELS).write_bytes(whole)
    with h5py.File(root / LABELS, "r+") as content:
        shorter = content["or_label_train/tilt"][:19]
        del content["or_label_train/tilt"]
        content["or_label_train/tilt"] = shorter
    with pytest.raises(DataError, match=r"fields of different lengths: .*'tilt': 19"):
        prepared(root)


def test_wrong_layouts_say_what_is_missing(root: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"data\.root = .*nowhere: no such folder; wanted the unpacked IHDP"):
        prepared(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"no train/, no test/, no or_label_full\.mat\. Did you mean .*IHDP"):
        prepared(tmp_path)
    (root / LABELS).unlink()
    with pytest.raises(DataError, match=r"no or_label_full\.mat\. Unpack the whole archive there"):
        prepared(root)


def test_unreadable_images_are_named_or_skipped(root: Path) -> None:
    (root / "train" / "head_3.png").unlink()
    (root / "test" / "head_21.png").write_bytes(b"\x89PNG")
    with pytest.raises(DataError) as caught:
        prepared(root)
    message = str(caught.value)
    assert message.startswith("2 of 31 samples cannot be read")
    for part in ("head_3.png: no such file", "head_21.png: cannot be read", "data.skip_unreadable=true"):
        assert part in message
    data = prepared(root, skip_unreadable=True)
    assert data.skipped == 2
    assert numbers_in(table(data, "train")) == [0, 1, 2, *range(4, 20)]


@pytest.mark.parametrize("angle", [math.nan, math.inf])
def test_angle_that_is_not_finite_is_never_skipped(root: Path, angle: float) -> None:
    published(root, or_label_train=[row(0), ("head_1.png", 0.5, angle, 0.25)])
    with pytest.raises(DataError, match=rf"1 images have an angle .*\n.*head_1\.png: 0\.5, {angle}, 0\.25"):
        prepared(root, skip_unreadable=True)
    assert len(table(prepared(root, angles=["pan"]), "train")["input"]) == 2  # nobody asks for that tilt


def test_empty_split(root: Path) -> None:
    published(root, or_label_test=[row(20)])
    with pytest.raises(DataError, match=r"The validation split is empty \(21 images in all, 0 unreadable\)"):
        prepared(root)
    published(root, or_label_train=[])
    with pytest.raises(DataError, match=r"The train split is empty"):
        prepared(root)


@pytest.mark.parametrize(
    ("key", "value"),
    [("image_size", 4), ("test_blur", math.nan), ("images", 3), ("mirror", True), ("angles_in", "turns")],
)
def test_config_out_of_range(key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"data\.{key}"):
        schema.resolve("data", {"name": "idiap", key: value})


# ---- the rest of the contract ----------------------------------------------------------------------------


def test_augment_changes_no_label(root: Path) -> None:
    data = prepared(root)
    batch = dict(table(data, "train"))
    torch.manual_seed(0)
    varied = data.augment(batch)
    assert torch.equal(varied["target"], batch["target"])
    assert not torch.equal(255 * varied["input"], batch["input"].float())
    assert prepared(root, jitter=0.0).augment(batch) is batch


def test_test_blur_changes_the_test_split_only(root: Path) -> None:
    for split in ("train", "test"):
        for file in (root / split).iterdir():
            pixels = np.random.default_rng(0).integers(0, 256, (75, 75, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(file)
    sharp, smooth = prepared(root), prepared(root, test_blur=2.0)
    for split in ("train", "validation"):
        assert torch.equal(table(sharp, split)["input"], table(smooth, split)["input"])
    changes = [table(data, "test")["input"].float().diff(dim=3).abs().mean() for data in (smooth, sharp)]
    assert changes[0] < 0.2 * changes[1]
    assert (sharp.fingerprint()["test_blur"], smooth.fingerprint()["test_blur"]) == ("0.0", "2.0")


def test_read_takes_a_users_own_files(root: Path) -> None:
    data = Idiap()
    samples = data.read([root / "train" / "head_9.png"])
    assert isinstance(samples, Fields)
    assert samples.fields.keys() == {"input", "index"}
    assert data.picture(samples[0]["input"]).shape == (75, 75, 3)


# ---- the synthetic set -----------------------------------------------------------------------------------


def files_of(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_labels_are_written_as_matlab_lays_them_out(tmp_path: Path) -> None:
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


def test_generation_is_the_same_to_the_byte_whatever_the_threads(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    contents = []
    for painters in (1, 3):
        monkeypatch.setattr(generated, "PAINTERS", painters)
        monkeypatch.setenv("FRAMEWORK_CACHE", str(cache / str(painters)))
        contents.append(files_of(generator.generate(40, 5)))
    first, second = contents
    assert len(first) == 40 + 2
    assert first == second
    other = files_of(generator.generate(40, 6))
    assert not any(content == other.get(name) for name, content in first.items())
    mark = json.loads(first["synthetic.json"])
    assert (mark["seed"], mark["images"]) == (5, 40)


def test_generated_set_is_read_as_it_was_drawn() -> None:
    data = prepared(None, images=60, angles_in="degrees")  # which says how a user's own file is to be read
    assert data.synthetic
    assert data.fingerprint()["root"] == "synthetic, seed 0"
    assert [len(table(data, split)["input"]) for split in SPLITS] == [38, 11, 11]
    drawn = []
    for number in range(38):
        random = np.random.default_rng([0, 0, number])
        random.integers(generator.PEOPLE)
        drawn.append(generator.pose(random))
    np.testing.assert_allclose(table(data, "train")["target"].rad2deg(), drawn, atol=1e-4)


def test_generated_data_that_are_damaged_are_to_be_deleted(cache: Path) -> None:
    prepared(None, images=20)
    next(cache.rglob("*.jpg")).write_bytes(b"")
    with pytest.raises(DataError, match=rf"Delete {cache}/idiap: the data are generated anew"):
        prepared(None, images=20)


def test_pictures_agree_with_their_labels() -> None:
    """A kernel regression of sin(pan) on coarse grey pictures: on mirror images its sign is turned."""
    data = prepared(None, images=600, image_size=16)

    def columns(split: str, *, mirrored: bool) -> tuple[np.ndarray, np.ndarray]:
        fields = table(data, split)
        grey = fields["input"].flip(-1) if mirrored else fields["input"]
        grey = grey.float().mean(1).flatten(1)
        grey = (grey - grey.mean(1, keepdim=True)) / (grey.std(1, keepdim=True) + 1)
        return grey.numpy(), fields["target"][:, 0].sin().numpy()

    regression = KernelRidge(kernel="rbf", gamma=2e-3, alpha=0.3).fit(*columns("train", mirrored=False))
    for mirrored, sign in ((False, 1), (True, -1)):
        pictures, sine = columns("test", mirrored=mirrored)
        assert sign * np.corrcoef(regression.predict(pictures), sine)[0, 1] > 0.4
