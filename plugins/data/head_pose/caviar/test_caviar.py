"""The folder of CAVIAR crops and its MATLAB file: what is read, what is refused, and what is drawn."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import torch
from PIL import Image
from sklearn.kernel_ridge import KernelRidge

from framework.configuration import schema
from framework.datasets.fields import Fields
from framework.errors import ConfigError, DataError
from framework.storage import generated
from plugins.data.head_pose.caviar import generator
from plugins.data.head_pose.caviar.data import Caviar
from plugins.data.head_pose.caviar.labels import LABELS, Label, read_labels, write_labels

SPLITS = ("train", "validation", "test")
NAMES = ("gaze", "x", "y", "size", "name")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def struct_array(rows: Sequence[Sequence[Any]], names: Sequence[str] = NAMES) -> np.ndarray:
    """A MATLAB struct array, one element a row."""
    array = np.empty((1, len(rows)), dtype=[(name, object) for name in names])
    for index, row in enumerate(rows):
        array[0, index] = tuple(row)
    return array


def row(number: int) -> list[Any]:
    """Gaze of 10° × number - 180°, whole numbers as MATLAB's uint8 would be, and a name with a number in it."""
    return [10.0 * number - 180, np.uint8(25), 25.5, 50.0, f"head_{number}_x"]


def save(root: Path, train: np.ndarray, test: np.ndarray) -> None:
    scipy.io.savemat(root / LABELS, {"or_label_train": train, "or_label_test": test, "other": 3})


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Twenty images to train with and eleven to test with, whose red is their number times eight."""
    place = tmp_path / "CAVIARShoppingCenterFullOccl"
    for split, numbers in (("train", range(20)), ("test", range(20, 31))):
        (place / split).mkdir(parents=True)
        for number in numbers:
            color = (8 * number, 100, 200)
            Image.new("RGB", (50, 50), color).save(place / split / f"head_{number}_x.jpg", quality=100)
    save(place, struct_array([row(n) for n in range(20)]), struct_array([row(n) for n in range(20, 31)]))
    return place


def prepared(root: Path | None, **config: Any) -> Caviar:
    config = {"name": "caviar", "root": root and str(root), **config}
    data = schema.build("data", schema.resolve("data", config))
    data.prepare()
    return data


def table(data: Caviar, split: str) -> Mapping[str, torch.Tensor]:
    dataset = {"train": data.train, "validation": data.validation, "test": data.test}[split]()
    assert isinstance(dataset, Fields)
    return dataset.fields


# ---- the published layout --------------------------------------------------------------------------------


def numbers_in(fields: Mapping[str, torch.Tensor]) -> list[int]:
    return [round(float(red) / 8) for red in fields["input"][:, 0].float().mean((1, 2))]


def test_images_labels_and_splits(root: Path) -> None:
    data = prepared(root)
    assert numbers_in(table(data, "train")) == list(range(20))
    np.random.seed(13)  # noqa: NPY002  (the thesis authors' code seeds the global generator)
    order = (20 + np.random.choice(11, 11, replace=False)).tolist()  # noqa: NPY002
    assert numbers_in(table(data, "validation")) == order[:5]
    assert numbers_in(table(data, "test")) == order[5:]
    for split in SPLITS:
        fields = table(data, split)
        for number, target in zip(numbers_in(fields), fields["target"], strict=True):
            gaze = math.radians(10 * number - 180)
            assert math.cos(float(target) - gaze) == pytest.approx(1)
            assert abs(float(target)) < math.pi + 1e-6
    assert data.target.names == ("gaze",)
    assert data.input_shape == (3, 50, 50)
    assert data.groups == ("caviar",)
    assert not data.synthetic
    assert data.fingerprint()["version"] == "CAVIARShoppingCenterFullOccl"
    assert prepared(root).fingerprint() == data.fingerprint()


def test_fields_are_read_by_their_order(root: Path) -> None:
    """What the published file calls them is not known."""
    names = ("or", "xc", "yc", "s", "im")
    save(root, struct_array([row(0)], names), struct_array([row(n) for n in (20, 21, 22)], names))
    labels = read_labels(root / LABELS)
    assert labels["train"] == [Label("head_0_x", -180.0)]  # one alone comes without the array
    assert [label.name for label in labels["test"]] == ["head_20_x", "head_21_x", "head_22_x"]


@pytest.mark.parametrize(
    "bad",
    [
        [[], 1, 1, 1, "a"],
        ["left", 1, 1, 1, "a"],
        [[1.0, 2.0], 1, 1, 1, "a"],
        [1j, 1, 1, 1, "a"],
        [1.0, 1, 1, 1, ""],
        [1.0, 1, 1, 1, 7],
    ],
    ids=["empty", "text", "two", "complex", "no name", "number for a name"],
)
def test_element_that_is_no_label_is_named(root: Path, bad: list[Any]) -> None:
    save(root, struct_array([row(0), bad]), struct_array([row(20)]))
    with pytest.raises(
        DataError, match=r"or_label\.mat: (or_label_train\(2\) holds|cannot be read as a MATLAB)"
    ):
        prepared(root)


def test_other_contents_are_refused(root: Path) -> None:
    save(root, struct_array([row(0)[:4]], NAMES[:4]), struct_array([row(20)]))
    with pytest.raises(
        DataError, match=r"or_label_train\(1\) holds .* wanted a struct of gaze, x, y, size, name"
    ):
        prepared(root)
    scipy.io.savemat(root / LABELS, {"or_label_train": np.eye(2), "or_label_test": struct_array([row(20)])})
    with pytest.raises(DataError, match=r"or_label_train\(1\) holds"):
        prepared(root)
    scipy.io.savemat(root / LABELS, {"or_label_train": struct_array([row(0)])})
    with pytest.raises(DataError, match=r"holds no or_label_test\. Restore"):
        prepared(root)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "cannot be read as a MATLAB file"),
        (b"no matrix at all" * 20, "cannot be read as a MATLAB file"),
        (b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400), r"a MATLAB 7\.3 file; .* '-v7'"),
    ],
)
def test_label_file_that_cannot_be_read(root: Path, content: bytes, message: str) -> None:
    (root / LABELS).write_bytes(content)
    with pytest.raises(DataError, match=rf"or_label\.mat: {message}"):
        prepared(root)


def test_label_file_that_is_cut_short_is_named(root: Path) -> None:
    whole = (root / LABELS).read_bytes()
    for length in range(0, len(whole), 499):
        (root / LABELS).write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"or_label\.mat: "):
            prepared(root)


def test_wrong_layouts_say_what_is_missing(root: Path, tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"data\.root = .*nowhere: no such folder; wanted the unpacked CAVIAR"
    ):
        prepared(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"no train/, no test/, no or_label\.mat\. Did you mean .*FullOccl\?"):
        prepared(tmp_path)
    (root / LABELS).unlink()
    with pytest.raises(DataError, match=r"no or_label\.mat\. Unpack the whole archive there"):
        prepared(root)


def test_unreadable_images_are_named_or_skipped(root: Path) -> None:
    (root / "train" / "head_3_x.jpg").unlink()
    (root / "test" / "head_21_x.jpg").write_bytes(b"\xff\xd8")
    with pytest.raises(DataError) as caught:
        prepared(root)
    message = str(caught.value)
    assert message.startswith("2 of 31 samples cannot be read")
    for part in ("head_3_x.jpg: no such file", "head_21_x.jpg: cannot be read", "data.skip_unreadable=true"):
        assert part in message
    data = prepared(root, skip_unreadable=True)
    assert data.skipped == 2
    assert numbers_in(table(data, "train")) == [0, 1, 2, *range(4, 20)]


@pytest.mark.parametrize("gaze", [math.nan, -math.inf])
def test_gaze_that_is_not_finite_is_never_skipped(root: Path, gaze: float) -> None:
    rows = [row(n) for n in range(20, 31)]
    rows[3][0] = gaze
    save(root, struct_array([row(0)]), struct_array(rows))
    with pytest.raises(DataError, match=rf"1 images have an angle .*\n.*head_23_x\.jpg: {gaze}"):
        prepared(root, skip_unreadable=True)


def test_empty_split(root: Path) -> None:
    save(root, struct_array([row(0)]), struct_array([row(20)]))
    with pytest.raises(DataError, match=r"The validation split is empty \(2 images in all, 0 unreadable\)"):
        prepared(root)
    save(root, struct_array([]), struct_array([row(n) for n in range(20, 31)]))
    with pytest.raises(DataError, match=r"The train split is empty"):
        prepared(root)


@pytest.mark.parametrize(
    ("key", "value"), [("image_size", 4), ("test_blur", math.inf), ("images", 3), ("mirror", True)]
)
def test_config_out_of_range(key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"data\.{key}"):
        schema.resolve("data", {"name": "caviar", key: value})


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
            pixels = np.random.default_rng(0).integers(0, 256, (50, 50, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(file)
    sharp, smooth = prepared(root), prepared(root, test_blur=2.0)
    for split in ("train", "validation"):
        assert torch.equal(table(sharp, split)["input"], table(smooth, split)["input"])
    changes = [table(data, "test")["input"].float().diff(dim=3).abs().mean() for data in (smooth, sharp)]
    assert changes[0] < 0.2 * changes[1]


def test_read_takes_a_users_own_files(root: Path) -> None:
    data = Caviar()
    samples = data.read([root / "train" / "head_9_x.jpg"])
    assert isinstance(samples, Fields)
    assert samples.fields.keys() == {"input", "index"}
    assert data.picture(samples[0]["input"]).shape == (50, 50, 3)


# ---- the synthetic set -----------------------------------------------------------------------------------


def files_of(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_labels_are_written_as_they_are_read(tmp_path: Path) -> None:
    labels = {"train": [Label("a_1", 12.25), Label("b", -370.5)], "test": [Label("c", 0.0)]}
    write_labels(tmp_path / LABELS, labels, 50)
    assert read_labels(tmp_path / LABELS) == labels


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
    assert first.keys() == other.keys()
    assert not any(first[name] == other[name] for name in first if name.endswith(".jpg"))
    mark = json.loads(first["synthetic.json"])
    assert (mark["seed"], mark["images"]) == (5, 40)


def test_generated_set_is_read_by_the_same_loader() -> None:
    data = prepared(None, images=60)
    assert data.synthetic
    assert data.fingerprint()["root"] == "synthetic, seed 0"
    assert [len(table(data, split)["input"]) for split in SPLITS] == [36, 12, 12]
    whole = prepared(generator.generate(60, 0))
    assert whole.synthetic
    assert whole.fingerprint()["sha256"] == data.fingerprint()["sha256"]


def test_generated_data_that_are_damaged_are_to_be_deleted(cache: Path) -> None:
    prepared(None, images=20)
    next(cache.rglob("*.jpg")).write_bytes(b"")
    with pytest.raises(DataError, match=rf"Delete {cache}/caviar: the data are generated anew"):
        prepared(None, images=20)


def test_pictures_agree_with_their_labels() -> None:
    """A kernel regression of sin(gaze) on coarse grey pictures: on mirror images its sign is turned."""
    data = prepared(None, images=1200, image_size=16)

    def columns(split: str, *, mirrored: bool) -> tuple[np.ndarray, np.ndarray]:
        fields = table(data, split)
        grey = fields["input"].flip(-1) if mirrored else fields["input"]
        grey = grey.float().mean(1).flatten(1)
        grey = (grey - grey.mean(1, keepdim=True)) / (grey.std(1, keepdim=True) + 1)
        return grey.numpy(), fields["target"][:, 0].sin().numpy()

    regression = KernelRidge(kernel="rbf", gamma=2e-3, alpha=0.3).fit(*columns("train", mirrored=False))
    for mirrored, sign in ((False, 1), (True, -1)):
        pictures, sine = columns("test", mirrored=mirrored)
        assert sign * np.corrcoef(regression.predict(pictures), sine)[0, 1] > 0.25
