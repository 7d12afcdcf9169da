"""Tests of the folders of TownCentre heads: reading, splits by people, refusals, and synthetic heads."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from framework.data import Splits
from framework.errors import DataError
from framework.testing.data_samples import fields_of
from plugins.data.head_pose import synthetic_heads
from plugins.data.head_pose.roots import PEOPLE, pixels, prepare_data, write_towncentre
from plugins.data.head_pose.towncentre import IMAGES_PER_PERSON, random_pose
from plugins.data.head_pose.towncentre_labels import Head, find_heads, read_label, split_by_person

SPLITS = Splits._fields


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_towncentre(tmp_path / "TownCentreHeadImages")


def test_people_are_split_as_the_authors_code_does(root: Path) -> None:
    data = prepare_data("towncentre", root)
    np.random.seed(13)  # noqa: NPY002  (their code seeds the global generator)
    uniform = np.random.rand(PEOPLE)  # noqa: NPY002
    people = {
        "train": np.flatnonzero(uniform < 0.8).tolist(),
        "validation": np.flatnonzero((uniform >= 0.8) & (uniform < 0.9)).tolist(),
        "test": np.flatnonzero(uniform > 0.9).tolist(),
    }
    for split in SPLITS:
        fields = fields_of(data, split)
        expected = {
            pixels(2 * person + second).tobytes(): 10.0 * person + 5 * second
            for person in people[split]
            for second in range(2)
        }
        assert len(fields["input"]) == len(expected) > 0
        for image, target in zip(fields["input"], fields["target"], strict=True):
            pan = math.radians(expected.pop(image.permute(1, 2, 0).contiguous().numpy().tobytes()))
            assert math.cos(float(target) - pan) == pytest.approx(1)
            assert abs(float(target)) < math.pi + 1e-6
    assert data.target.names == ("pan",)
    assert data.input_shape == (3, 50, 50)
    assert data.groups == ("towncentre",)
    assert data.invalid == 0
    assert data.fingerprint()["version"] == "TownCentreHeadImages"


def test_split_does_not_depend_on_the_order_of_folders_and_keeps_the_shares() -> None:
    heads = [Head(Path(f"{person}.jpg"), person, 0.0) for person in range(10_000)]
    splits = split_by_person(heads)
    shares = [len(splits[split]) / len(heads) for split in SPLITS]
    assert shares == pytest.approx([0.8, 0.1, 0.1], abs=0.01)
    reversed_order = split_by_person(heads[::-1])
    for split in SPLITS:
        assert set(reversed_order[split]) == set(splits[split])


def test_heads_that_are_not_valid_are_left_out_and_counted(root: Path) -> None:
    (root / "person3" / "image_3_0.txt").write_text("pan = +1.00\nvalid = 0\n", encoding="utf-8")
    data = prepare_data("towncentre", root)
    assert data.invalid == 1
    assert data.skipped == 0
    assert sum(len(fields_of(data, split)["input"]) for split in SPLITS) == 2 * PEOPLE - 1


def test_a_label_whose_stem_begins_another_stem_gets_its_own_image(root: Path) -> None:
    folder = root / "person3"
    Image.fromarray(pixels(99)).save(folder / "image_3_10_17_0.png")
    (folder / "image_3_10.txt").write_text("pan = -90.00\nvalid = 1\n", encoding="utf-8")
    heads = {head.image.name: head for head in find_heads(root).heads}
    assert heads["image_3_1_17_1.png"].pan == pytest.approx(math.radians(10 * 3 + 5 - 720))
    assert heads["image_3_10_17_0.png"].pan == pytest.approx(math.radians(-90))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("pan = +123.45\nvalid = 1\n", (123.45, True)),
        ("pan = -0.50\r\nvalid = 0\r\n", (-0.5, False)),
        ("valid=1\npan=370", (370.0, True)),
    ],
)
def test_a_label_file_gives_its_angle_and_validity(
    tmp_path: Path, text: str, expected: tuple[float, bool]
) -> None:
    (tmp_path / "label.txt").write_bytes(text.encode())
    assert read_label(tmp_path / "label.txt") == expected


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"pan = \nvalid = 1\n",
        b"pan = 3\n",
        b"pan = 3\nvalid = 2\n",
        b"tilt = 3\nvalid = 1",
        b"pan = 1\xff",
    ],
)
def test_the_message_names_a_file_that_holds_no_label(root: Path, content: bytes) -> None:
    file = root / "person3" / "image_3_0.txt"
    file.write_bytes(content)
    with pytest.raises(DataError) as caught:
        prepare_data("towncentre", root)
    assert f"1 of {2 * PEOPLE} samples cannot be read:\n  {file}: " in str(caught.value)
    assert prepare_data("towncentre", root, skip_unreadable=True).skipped == 1


def test_missing_damaged_and_doubtful_images_are_named_at_once_or_skipped(root: Path) -> None:
    (root / "person3" / "image_3_0_17_0.png").unlink()
    Image.fromarray(pixels(1)).save(root / "person4" / "image_4_0_99.png")
    broken = root / "person5" / "image_5_1_17_1.png"
    broken.write_bytes(broken.read_bytes()[:200])
    (root / "person6" / "image_6_0.txt").rename(root / "person6" / "other.txt")
    (root / "person6" / "image_6_0_17_0.png").rename(root / "person6" / "other.png")
    with pytest.raises(DataError) as caught:
        prepare_data("towncentre", root)
    message = str(caught.value)
    assert message.startswith(f"4 of {2 * PEOPLE} samples cannot be read")
    for part in (
        "image_3_0.txt: 0 images have names that start with 'image_3_0'; expected exactly one",
        "image_4_0.txt: 2 images have names that start with 'image_4_0': image_4_0_17_0.png, image_4_0_99.png",
        "image_5_1_17_1.png: cannot be read as an image",
        "other.png: The name does not hold the number of the person",
        "data.skip_unreadable=true",
    ):
        assert part in message
    data = prepare_data("towncentre", root, skip_unreadable=True)
    assert data.skipped == 4
    assert sum(len(fields_of(data, split)["input"]) for split in SPLITS) == 2 * PEOPLE - 4


def test_pan_that_is_not_finite_is_refused(root: Path) -> None:
    """Check also that `skip_unreadable` leaves the label out, like any unusable label."""
    (root / "person3" / "image_3_0.txt").write_text("pan = nan\nvalid = 1\n", encoding="utf-8")
    with pytest.raises(
        DataError, match=r"image_3_0\.txt: .*Two lines are expected, `pan = ` with finite degrees"
    ):
        prepare_data("towncentre", root)
    prepare_data("towncentre", root, skip_unreadable=True)


def test_the_message_about_a_wrong_layout_names_the_fault_and_the_remedy(root: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere does not exist .* Set data\.root to the unpacked Town"):
        prepare_data("towncentre", tmp_path / "nowhere")
    with pytest.raises(
        DataError, match=r"does not have the layout of .* Did you mean .*TownCentreHeadImages\?"
    ):
        prepare_data("towncentre", tmp_path)
    with pytest.raises(
        DataError, match=r"none of its folders holds a label file .* Unpack the whole archive"
    ):
        prepare_data("towncentre", root / "person3")


def test_an_empty_split_is_refused_with_the_number_of_invalid_images(root: Path) -> None:
    for folder in sorted(root.glob("person*"))[2:]:
        for file in folder.glob("*.txt"):
            file.write_text("pan = 1\nvalid = 0\n", encoding="utf-8")
    with pytest.raises(
        DataError, match=r"split is empty \(4 images in all, 0 unreadable, 76 marked as not valid"
    ):
        prepare_data("towncentre", root)


def test_augment_mirrors_with_the_sign_of_pan(root: Path) -> None:
    data = prepare_data("towncentre", root, jitter=0.0)
    batch = dict(fields_of(data, "train"))
    torch.manual_seed(0)
    varied = data.augment(batch)
    flipped = (255 * varied["input"] - batch["input"].flip(-1)).abs().amax((1, 2, 3)) < 0.01
    assert 10 < int(flipped.sum()) < len(flipped) - 10
    expected = torch.where(flipped[:, None], -batch["target"], batch["target"])
    assert torch.equal(varied["target"], expected)
    off = prepare_data("towncentre", root, jitter=0.0, mirror=False)
    assert off.augment(batch) is batch


def test_labels_of_the_generated_set_are_the_random_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path))
    data = prepare_data("towncentre", None, images=600)
    counts = [len(fields_of(data, split)["input"]) for split in SPLITS]
    assert sum(counts) == 600 - data.invalid
    assert 3 < data.invalid < 40
    assert counts[0] > 400
    pans = []
    for number in range(600):
        person_random = np.random.default_rng([0, 1, number // IMAGES_PER_PERSON])
        synthetic_heads.random_person(person_random)
        random = np.random.default_rng([0, 0, number])
        pan = random_pose(person_random.uniform(0, 360), random).pan
        if random.random() >= 0.03:
            pans.append((pan + 180) % 360 - 180)
    read = torch.cat([fields_of(data, split)["target"] for split in SPLITS]).rad2deg().flatten()
    np.testing.assert_allclose(np.sort(read.numpy()), np.sort(pans), atol=0.006)
