"""What the loaders of whole, labelled images share (plugins.data.head_pose.labelled_images)."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from framework.datasets import images
from framework.datasets.images import Crops, blurred
from framework.errors import DataError
from plugins.data.head_pose.labelled_images import SPLITS, Labelled, Splits, halves, own, read_splits, varied


def samples(place: Path, count: int = 12) -> dict[str, list[Labelled]]:
    """Images whose red is their number times ten, at angles (number, -number) radians."""
    made = []
    for number in range(count):
        pixels = np.random.default_rng(number).integers(0, 256, (8, 8, 3), dtype=np.uint8)
        pixels[..., 0] = 10 * number
        Image.fromarray(pixels).save(place / f"{number}.png")
        made.append(Labelled(place / f"{number}.png", (float(number), float(-number))))
    return {"train": made[:6], "validation": made[6:9], "test": made[9:]}


def read(chosen: dict[str, list[Labelled]], faults: Sequence[DataError] = (), **more: Any) -> Splits:
    config = {"side": 8, "test_blur": 0.0, "skip_unreadable": False, "remedy": "Mend it."}
    return read_splits(chosen, faults, **{**config, **more})


def test_published_test_set_is_halved_as_the_authors_code_does() -> None:
    made = [Labelled(Path(str(number)), ()) for number in range(23_991)]
    validation, test = halves(made)
    np.random.seed(13)  # noqa: NPY002  (their code seeds the global generator)
    order = np.random.choice(23_991, 23_991, replace=False)  # noqa: NPY002
    assert [int(sample.file.name) for sample in (*validation, *test)] == order.tolist()
    assert (len(validation), len(test)) == (11_995, 11_996)  # thesis §3.6.1
    assert tuple(map(len, halves(made[:10_889]))) == (5_444, 5_445)
    assert halves([]) == ([], [])


def test_fields(tmp_path: Path) -> None:
    chosen = samples(tmp_path)
    splits = read(chosen)
    assert splits.skipped == 0
    assert splits.sizes() == {"train": "6", "validation": "3", "test": "3"}
    for split in SPLITS:
        table = splits.tables[split]
        for index, sample in enumerate(chosen[split]):
            item = table[index]
            with Image.open(sample.file) as image:
                pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1)
            assert torch.equal(item["input"], pixels)  # of the size asked for: unchanged
            expected = [(angle + math.pi) % (2 * math.pi) - math.pi for angle in sample.angles]
            torch.testing.assert_close(item["target"], torch.tensor(expected))
            assert (int(item["index"]), int(item["group"])) == (index, 0)
    moved = {**chosen, "test": chosen["test"][::-1]}
    assert read(chosen).digest == splits.digest != read(moved).digest


@pytest.mark.parametrize("in_memory", [True, False])
def test_only_the_test_split_is_blurred(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_memory: bool
) -> None:
    if not in_memory:
        monkeypatch.setattr(images, "IN_MEMORY", 0)
    sharp, smooth = read(samples(tmp_path)), read(samples(tmp_path), test_blur=1.2)
    assert isinstance(smooth.tables["test"], Crops) != in_memory
    assert smooth.digest == sharp.digest
    for split in SPLITS:
        for index in range(len(sharp.tables[split])):
            expected = blurred(sharp.tables[split][index]["input"], 1.2 if split == "test" else 0.0)
            assert torch.equal(smooth.tables[split][index]["input"], expected)


def test_unreadable_images_are_named_or_skipped(tmp_path: Path) -> None:
    chosen = samples(tmp_path)
    chosen["test"][1].file.unlink()
    chosen["train"][0].file.write_bytes(b"\x89PNG")
    label = DataError("a label that cannot be read")
    with pytest.raises(DataError) as caught:
        read(chosen, [label])
    message = str(caught.value)
    assert message.startswith("3 of 13 samples cannot be read")
    assert message.endswith("Mend it.")
    for part in ("a label that cannot be read", "0.png: cannot be read as an image", "10.png: no such file"):
        assert part in message
    splits = read(chosen, [label], skip_unreadable=True)
    assert splits.skipped == 3
    assert splits.sizes() == {"train": "5", "validation": "3", "test": "2"}
    assert int(splits.tables["train"][0]["input"][0, 0, 0]) == 10
    torch.testing.assert_close(splits.tables["train"][0]["target"], torch.tensor([1.0, -1.0]))


@pytest.mark.parametrize("angle", [math.nan, math.inf])
def test_angle_that_is_not_finite_is_never_skipped(tmp_path: Path, angle: float) -> None:
    chosen = samples(tmp_path)
    chosen["test"][1] = Labelled(chosen["test"][1].file, (0.5, angle))
    with pytest.raises(DataError, match=rf"1 images have an angle .*\n.*10\.png: 0\.5, {angle}\nMend"):
        read(chosen, skip_unreadable=True)


@pytest.mark.parametrize("split", SPLITS)
def test_empty_split(tmp_path: Path, split: str) -> None:
    chosen = samples(tmp_path)
    chosen[split] = []
    with pytest.raises(
        DataError, match=rf"The {split} split is empty \(\d+ images in all, 0 unreadable, so\)"
    ):
        read(chosen, left_out=", so")


def test_augmentation_mirrors_half_of_a_batch_with_the_named_angles() -> None:
    torch.manual_seed(0)
    pixels = torch.randint(0, 256, (200, 3, 8, 8), dtype=torch.uint8)
    batch = {"input": pixels, "target": torch.rand(200, 2) + 0.1, "index": torch.arange(200)}
    result = varied(batch, ("pan", "tilt"), ("pan",), 0.0)
    flipped = (255 * result["input"] - pixels.flip(-1)).abs().amax((1, 2, 3)) < 0.01
    same = (255 * result["input"] - pixels).abs().amax((1, 2, 3)) < 0.01
    assert torch.all(same ^ flipped)
    assert 70 < int(flipped.sum()) < 130
    expected = torch.where(flipped[:, None], batch["target"] * torch.tensor([-1.0, 1.0]), batch["target"])
    assert torch.equal(result["target"], expected)
    assert result["index"] is batch["index"]
    assert varied(batch, ("pan", "tilt"), (), 0.0) is batch
    shaken = varied(batch, ("pan", "tilt"), (), 0.1)
    assert torch.equal(shaken["target"], batch["target"])
    assert not torch.equal(255 * shaken["input"], pixels.float())


def test_own_files_are_turned_as_viewers_do(tmp_path: Path) -> None:
    image = Image.new("RGB", (10, 10))
    image.paste((255, 255, 255), (0, 0, 5, 10))
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by 90° to be seen upright
    image.save(tmp_path / "one.png", exif=exif)
    pixels = own(tmp_path / "one.png", 10).read()
    assert pixels[0, 0].min() == 255
    assert pixels[0, -1].max() == 0
