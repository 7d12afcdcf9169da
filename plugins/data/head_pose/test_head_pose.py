"""Tests of what IDIAP, TownCentre and CAVIAR have in common: folders, augmentation, and synthetic heads."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from sklearn.kernel_ridge import KernelRidge

from framework.configuration import schema
from framework.data import Splits
from framework.errors import ConfigError, DataError
from framework.storage import generated
from framework.testing.data_samples import fields_of
from plugins.data.head_pose.archive import Archive, Source
from plugins.data.head_pose.caviar import ARCHIVE as CAVIAR
from plugins.data.head_pose.idiap import ARCHIVE as IDIAP
from plugins.data.head_pose.roots import (
    caviar_row,
    idiap_row,
    prepare_data,
    publish_caviar,
    publish_idiap,
    write_caviar,
    write_idiap,
)
from plugins.data.head_pose.towncentre import ARCHIVE as TOWNCENTRE

SPLITS = Splits._fields


class Published(NamedTuple):
    """Data set, with functions that write its published layout, and the numbers that a test expects.

    Attributes:
        archive: The archive.
        write: Function that fills a folder with images and labels.
        publish: Function that writes the labels of images with given numbers.
        angles: Function from the number of an image to its angles, radians.
        names: Names of the angles.
        side: Side of the images, pixels.
        labels: Name of the label file.
    """

    archive: Archive
    write: Callable[[Path], Path]
    publish: Callable[..., None]
    angles: Callable[[int], tuple[float, ...]]
    names: tuple[str, ...]
    side: int
    labels: str


IN_TWO_FOLDERS = (
    Published(
        IDIAP,
        write_idiap,
        publish_idiap,
        lambda number: idiap_row(number)[1:],
        ("pan", "tilt", "roll"),
        75,
        "or_label_full.mat",
    ),
    Published(
        CAVIAR,
        write_caviar,
        publish_caviar,
        lambda number: (math.radians(caviar_row(number)[0]),),
        ("gaze",),
        50,
        "or_label.mat",
    ),
)


def archive_name(published: Published) -> str:
    return published.archive.name


in_two_folders = pytest.mark.parametrize("published", IN_TWO_FOLDERS, ids=archive_name)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def root(published: Published, tmp_path: Path) -> Path:
    return published.write(tmp_path / published.archive.folder)


def numbers_in(fields: Any) -> list[int]:
    """Return the numbers of the images of a split, from their red values."""
    return [round(float(red) / 8) for red in fields["input"][:, 0].float().mean((1, 2))]


# ---- the published layout --------------------------------------------------------------------------------


@in_two_folders
def test_images_labels_and_splits(published: Published, root: Path) -> None:
    name = published.archive.name
    data = prepare_data(name, root)
    assert numbers_in(fields_of(data, "train")) == list(range(20))
    np.random.seed(13)  # noqa: NPY002  (the thesis authors' code seeds the global generator)
    order = (20 + np.random.choice(11, 11, replace=False)).tolist()  # noqa: NPY002
    assert numbers_in(fields_of(data, "validation")) == order[:5]
    assert numbers_in(fields_of(data, "test")) == order[5:]
    for split in SPLITS:
        fields = fields_of(data, split)
        expected = torch.tensor([published.angles(number) for number in numbers_in(fields)])
        torch.testing.assert_close(fields["target"], expected)
        assert torch.all(abs(fields["target"]) < math.pi + 1e-6)
    assert data.target.names == published.names
    assert data.input_shape == (3, published.side, published.side)
    assert data.groups == (name,)
    assert data.fingerprint()["version"] == published.archive.folder


@in_two_folders
def test_wrong_layouts_say_what_is_missing(published: Published, root: Path, tmp_path: Path) -> None:
    name, folder = published.archive.name, published.archive.folder
    with pytest.raises(
        DataError,
        match=rf"data\.root = .*nowhere does not exist .* Set data\.root to the unpacked {folder}, or to null",
    ):
        prepare_data(name, tmp_path / "nowhere")
    labels = published.labels.replace(".", r"\.")
    with pytest.raises(
        DataError, match=rf"it holds no train/, no test/, no {labels}\. Did you mean .*{folder}\?"
    ):
        prepare_data(name, tmp_path)
    (root / published.labels).unlink()
    with pytest.raises(DataError, match=rf"it holds no {labels}\. Unpack the whole archive into"):
        prepare_data(name, root)


@in_two_folders
def test_an_empty_split_is_named(published: Published, root: Path) -> None:
    published.publish(root, train=[0], test=[20])
    with pytest.raises(DataError, match=r"The validation split is empty \(2 images in all, 0 unreadable\)"):
        prepare_data(published.archive.name, root)
    published.publish(root, train=[])
    with pytest.raises(DataError, match=r"The train split is empty"):
        prepare_data(published.archive.name, root)


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("idiap", "image_size", 4),
        ("idiap", "test_blur", math.nan),
        ("idiap", "images", 3),
        ("idiap", "mirror", True),
        ("idiap", "angles_in", "turns"),
        ("idiap", "angles", ["yaw"]),
        ("towncentre", "image_size", 4),
        ("towncentre", "test_blur", -1),
        ("towncentre", "images", 3),
        ("towncentre", "jitter", math.nan),
        ("towncentre", "rot", "x"),
        ("caviar", "image_size", 4),
        ("caviar", "test_blur", math.inf),
        ("caviar", "images", 3),
        ("caviar", "mirror", True),
    ],
)
def test_a_config_out_of_range_is_refused(name: str, key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"data\.{key}"):
        schema.resolve("data", {"name": name, key: value})


# ---- the rest of the contract ----------------------------------------------------------------------------


@in_two_folders
def test_augment_changes_no_label(published: Published, root: Path) -> None:
    data = prepare_data(published.archive.name, root)
    batch = dict(fields_of(data, "train"))
    torch.manual_seed(0)
    varied = data.augment(batch)
    assert torch.equal(varied["target"], batch["target"])
    assert not torch.equal(255 * varied["input"], batch["input"].float())
    assert prepare_data(published.archive.name, root, jitter=0.0).augment(batch) is batch


# ---- the synthetic sets ----------------------------------------------------------------------------------


def files_of(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("archive", "images", "files"),
    [(IDIAP, 40, 42), (TOWNCENTRE, 48, 97), (CAVIAR, 40, 42)],
    ids=lambda x: getattr(x, "name", None),
)
def test_generation_is_the_same_to_the_byte_for_any_number_of_threads(
    cache: Path, monkeypatch: pytest.MonkeyPatch, archive: Archive, images: int, files: int
) -> None:
    contents = []
    for painters in (1, 3):
        monkeypatch.setattr(generated, "PAINTERS", painters)
        monkeypatch.setenv("FRAMEWORK_CACHE", str(cache / str(painters)))
        contents.append(files_of(Source(archive, None, images, 5).folder()))
    first, second = contents
    assert len(first) == files
    assert first == second
    other = files_of(Source(archive, None, images, 6).folder())
    assert len(other) == files
    if archive is not IDIAP:  # the names of IDIAP images hold the number of a random person
        assert first.keys() == other.keys()
    assert not any(content == other.get(name) for name, content in first.items())
    mark = json.loads(first["synthetic.json"])
    assert (mark["seed"], mark["images"]) == (5, images)


@pytest.mark.parametrize(("name", "sizes"), [("idiap", [38, 11, 11]), ("caviar", [36, 12, 12])])
def test_generated_sets_have_the_published_shares(name: str, sizes: list[int]) -> None:
    data = prepare_data(name, None, images=60)
    assert data.fingerprint()["root"] == "synthetic, seed 0"
    assert [len(fields_of(data, split)["input"]) for split in SPLITS] == sizes


@pytest.mark.parametrize("name", ["idiap", "caviar"])
def test_the_message_about_damaged_generated_data_says_to_delete_them(cache: Path, name: str) -> None:
    prepare_data(name, None, images=20)
    next(cache.rglob("*.jpg")).write_bytes(b"")
    with pytest.raises(DataError, match=rf"Delete {cache}/{name}; the next run generates the data again"):
        prepare_data(name, None, images=20)


@pytest.mark.parametrize(
    ("name", "images", "correlation"),
    [
        ("caviar", 1200, 0.25),
        pytest.param("idiap", 600, 0.4, marks=pytest.mark.slow),
        pytest.param("towncentre", 1200, 0.4, marks=pytest.mark.slow),
    ],
)
def test_images_agree_with_their_labels(name: str, images: int, correlation: float) -> None:
    """Check that a kernel regression predicts the sine of the first angle from coarse grey images.

    On mirror images the sign of the correlation changes.
    """
    data = prepare_data(name, None, images=images, image_size=16)

    def columns(split: str, *, mirrored: bool) -> tuple[np.ndarray, np.ndarray]:
        fields = fields_of(data, split)
        grey = fields["input"].flip(-1) if mirrored else fields["input"]
        grey = grey.float().mean(1).flatten(1)
        grey = (grey - grey.mean(1, keepdim=True)) / (grey.std(1, keepdim=True) + 1)
        return grey.numpy(), fields["target"][:, 0].sin().numpy()

    regression = KernelRidge(kernel="rbf", gamma=2e-3, alpha=0.3).fit(*columns("train", mirrored=False))
    for mirrored, sign in ((False, 1), (True, -1)):
        pixels, sine = columns("test", mirrored=mirrored)
        assert sign * np.corrcoef(regression.predict(pixels), sine)[0, 1] > correlation
