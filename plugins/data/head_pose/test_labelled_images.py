"""Tests of the shared loader of whole, labelled images (plugins.data.head_pose.labelled_images)."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from framework.datasets import images
from framework.datasets.images import Crops, blur
from framework.errors import DataError
from plugins.data.head_pose.labelled_images import SPLITS, Labelled, Loaded, Reading, halves, load


def write_samples(folder: Path, count: int = 12) -> dict[str, list[Labelled]]:
    """Write images whose red value is ten times their number, and return them by split.

    Their angles are (number, -number) radians.
    """
    images = []
    for number in range(count):
        pixels = np.random.default_rng(number).integers(0, 256, (8, 8, 3), dtype=np.uint8)
        pixels[..., 0] = 10 * number
        Image.fromarray(pixels).save(folder / f"{number}.png")
        images.append(Labelled(folder / f"{number}.png", (float(number), float(-number))))
    return {"train": images[:6], "validation": images[6:9], "test": images[9:]}


def read(
    chosen: dict[str, list[Labelled]],
    faults: Sequence[DataError] = (),
    generated_in: Path | None = None,
    left_out: str = "",
    **config: Any,
) -> Loaded:
    reading = Reading(image_size=8, **config)
    return load(chosen, ("pan", "roll"), reading, faults, generated_in=generated_in, left_out=left_out)


def sizes(loaded: Loaded) -> list[str]:
    return [loaded.fingerprint[split] for split in SPLITS]


def test_published_test_set_is_halved_as_the_authors_code_does() -> None:
    images = [Labelled(Path(str(number)), ()) for number in range(23_991)]
    validation, test = halves(images)
    np.random.seed(13)  # noqa: NPY002  (their code seeds the global generator)
    order = np.random.choice(23_991, 23_991, replace=False)  # noqa: NPY002
    assert [int(sample.file.name) for sample in (*validation, *test)] == order.tolist()
    assert (len(validation), len(test)) == (11_995, 11_996)  # thesis §3.6.1
    assert tuple(map(len, halves(images[:10_889]))) == (5_444, 5_445)
    assert halves([]) == ([], [])


def test_fields_are_the_images_and_angles_of_the_samples(tmp_path: Path) -> None:
    chosen = write_samples(tmp_path)
    splits = read(chosen)
    assert splits.skipped == 0
    assert sizes(splits) == ["6", "3", "3"]
    for split in SPLITS:
        table = splits.tables[split]
        for index, sample in enumerate(chosen[split]):
            item = table[index]
            with Image.open(sample.file) as image:
                pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1)
            assert torch.equal(item["input"], pixels)  # the image has the requested size already
            expected = [(angle + math.pi) % (2 * math.pi) - math.pi for angle in sample.angles]
            torch.testing.assert_close(item["target"], torch.tensor(expected))
            assert (int(item["index"]), int(item["group"])) == (index, 0)
    reordered = {**chosen, "test": chosen["test"][::-1]}
    digest = splits.fingerprint["sha256"]
    assert read(chosen).fingerprint["sha256"] == digest != read(reordered).fingerprint["sha256"]


@pytest.mark.parametrize("in_memory", [True, False])
def test_only_the_test_split_is_blurred(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_memory: bool
) -> None:
    if not in_memory:
        monkeypatch.setattr(images, "IN_MEMORY", 0)
    sharp, smooth = read(write_samples(tmp_path)), read(write_samples(tmp_path), test_blur=1.2)
    assert isinstance(smooth.tables["test"], Crops) != in_memory
    assert smooth.fingerprint["sha256"] == sharp.fingerprint["sha256"]
    for split in SPLITS:
        for index in range(len(sharp.tables[split])):
            expected = blur(sharp.tables[split][index]["input"], 1.2 if split == "test" else 0.0)
            assert torch.equal(smooth.tables[split][index]["input"], expected)


def test_unreadable_images_are_named_or_skipped(tmp_path: Path) -> None:
    chosen = write_samples(tmp_path)
    chosen["test"][1].file.unlink()
    chosen["train"][0].file.write_bytes(b"\x89PNG")
    label = DataError("a label that cannot be read")
    with pytest.raises(DataError) as caught:
        read(chosen, [label])
    message = str(caught.value)
    assert message.startswith("3 of 13 samples cannot be read")
    assert message.endswith("data.skip_unreadable=true to leave them out.")
    for part in ("a label that cannot be read", "0.png: cannot be read as an image", "10.png: no such file"):
        assert part in message
    with pytest.raises(DataError, match=r"\nDelete /the/cache; the next run generates the data again\.$"):
        read(chosen, [label], generated_in=Path("/the/cache"))
    splits = read(chosen, [label], skip_unreadable=True)
    assert splits.skipped == 3
    assert sizes(splits) == ["5", "3", "2"]
    assert int(splits.tables["train"][0]["input"][0, 0, 0]) == 10
    torch.testing.assert_close(splits.tables["train"][0]["target"], torch.tensor([1.0, -1.0]))


@pytest.mark.parametrize("angle", [math.nan, math.inf])
def test_angle_that_is_not_finite_is_never_skipped(tmp_path: Path, angle: float) -> None:
    chosen = write_samples(tmp_path)
    chosen["test"][1] = Labelled(chosen["test"][1].file, (0.5, angle))
    with pytest.raises(DataError, match=rf"1 images have an angle .*\n.*10\.png: 0\.5, {angle}\nCorrect"):
        read(chosen, skip_unreadable=True)


@pytest.mark.parametrize("split", SPLITS)
def test_an_empty_split_is_named(tmp_path: Path, split: str) -> None:
    chosen = write_samples(tmp_path)
    chosen[split] = []
    with pytest.raises(
        DataError, match=rf"The {split} split is empty \(\d+ images in all, 0 unreadable, so\)"
    ):
        read(chosen, left_out=", so")


def test_own_files_are_rotated_as_their_exif_entries_say(tmp_path: Path) -> None:
    image = Image.new("RGB", (10, 10))
    image.paste((255, 255, 255), (0, 0, 5, 10))
    exif = Image.Exif()
    exif[0x0112] = 6  # the image is upright after a rotation by 90°
    image.save(tmp_path / "rotated.png", exif=exif)
    pixels = Reading(image_size=10).read_unlabelled([tmp_path / "rotated.png"])[0]["input"]
    assert pixels[0, 0].min() == 255
    assert pixels[0, -1].max() == 0
