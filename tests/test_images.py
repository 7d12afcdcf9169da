"""Image code that data plugins share (framework.datasets.images), compared with independent references."""

import io
import math
import os
import re
from pathlib import Path

import numpy as np
import pytest
import scipy.ndimage
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from framework.datasets import images
from framework.datasets.images import Crop, augment, cut_square, to_rgb8, vary
from framework.errors import DataError
from tests.exhausting import scanned, tiled


def ramp(width: int, height: int) -> Image.Image:
    """Return an image in which red grows by 2 per column and green by 3 per row; a filter without bias keeps it
    exactly."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return Image.fromarray(np.stack([2 * x, 3 * y, 0 * x], axis=2).astype(np.uint8))


@pytest.mark.parametrize(
    "box", [(20.0, 10.0, 60.0, 50.0), (20.5, 10.25, 60.0, 41.0), (30.0, 20.0, 38.0, 28.0)]
)
@pytest.mark.parametrize("margin", [0.0, 0.1, 0.25])
@pytest.mark.parametrize("side", [8, 17, 64])
def test_square_lies_where_it_should_to_a_part_of_a_pixel(
    box: tuple[float, float, float, float], margin: float, side: int
) -> None:
    """The crop of a linear ramp equals the ramp at the sample centres of the crop; pixel i covers [i, i + 1]."""
    left, top, right, bottom = box
    half = (0.5 + margin) * max(right - left, bottom - top)
    pixels = cut_square(ramp(100, 80), box, margin, side)
    assert pixels is not None
    centers = 2 * half * (np.arange(side) + 0.5) / side - half
    x, y = (left + right) / 2 + centers - 0.5, (top + bottom) / 2 + centers - 0.5
    x, y = x.clip(0, 99), y.clip(0, 79)  # the border is repeated
    inner = slice(2, -2)  # at the edge of what was cut the filter is one-sided
    np.testing.assert_allclose(pixels[0, side // 2, inner], 2 * x[inner], atol=0.8)
    np.testing.assert_allclose(pixels[1, inner, side // 2], 3 * y[inner], atol=0.8)


def test_shrinking_averages_instead_of_skipping() -> None:
    checks = Image.fromarray((255 * (np.indices((64, 64)).sum(0) % 2)).astype(np.uint8))
    pixels = cut_square(checks, (0.0, 0.0, 64.0, 64.0), 0.0, 8)
    assert pixels is not None
    assert pixels.shape == (1, 8, 8)
    assert abs(pixels[:, 1:-1, 1:-1].astype(int) - 127).max() <= 2


def test_beyond_the_border_the_border_is_repeated() -> None:
    pixels = cut_square(ramp(20, 40), (0.0, 0.0, 20.0, 40.0), 0.0, 40)  # 10 columns are missing on each side
    assert pixels is not None
    np.testing.assert_array_equal(pixels[0, 5, :10], 0)
    np.testing.assert_array_equal(pixels[0, 5, 10:30], 2 * np.arange(20))
    np.testing.assert_array_equal(pixels[0, 5, 30:], 38)


coordinate = st.floats(-1e6, 1e6) | st.sampled_from([math.nan, math.inf, -math.inf, 0.0, 7.0, 1e-9])


@given(
    st.tuples(coordinate, coordinate, coordinate, coordinate),
    st.floats(0, 2),
    st.tuples(st.integers(1, 12), st.integers(1, 12)),
    st.sampled_from([1, 2, 9]),
)
@settings(deadline=None, max_examples=150)
def test_any_box_gives_a_square_or_nothing(
    box: tuple[float, float, float, float], margin: float, size: tuple[int, int], side: int
) -> None:
    pixels = cut_square(ramp(*size), box, margin, side)
    left, top, right, bottom = box
    overlaps = max(left, 0) < min(right, size[0]) and max(top, 0) < min(bottom, size[1])
    if not (overlaps and all(map(math.isfinite, box))):
        assert pixels is None
    else:
        assert pixels is not None
        assert pixels.shape == (3, side, side)
        assert pixels[0].max() <= 2 * (size[0] - 1)  # no colour that the image does not hold
        assert pixels[2].max() == 0


def save(folder: Path, pixels: np.ndarray, mode: str | None = None, name: str = "one.png") -> Path:
    image = Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(folder / name)
    return folder / name


def test_every_kind_of_pixel_becomes_colour_or_grey(tmp_path: Path) -> None:
    colors = np.zeros((4, 4, 3), np.uint8) + np.array([204, 102, 51], np.uint8)
    grey = round(0.299 * 204 + 0.587 * 102 + 0.114 * 51)  # ITU-R 601 luma
    for mode in ("RGB", "P", "RGBA"):
        file = save(tmp_path, colors, mode)
        np.testing.assert_allclose(Crop(file, None, 0.0, 4).read()[:, 0, 0], [204, 102, 51], atol=1)
        np.testing.assert_allclose(Crop(file, None, 0.0, 4, channels=1).read(), grey, atol=1)
    for mode in ("L", "LA", "1"):
        file = save(tmp_path, colors, mode)
        red, green, blue = Crop(file, None, 0.0, 1).read().flatten().tolist()
        assert red == green == blue
    sixteen = save(tmp_path, np.full((4, 4), 40000, np.uint16))
    assert torch.all(Crop(sixteen, None, 0.0, 4).read() == round(40000 / 257))


def test_transparent_pixels_become_white(tmp_path: Path) -> None:
    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[:, 2:] = (10, 20, 30, 255)
    crop = Crop(save(tmp_path, pixels), None, 0.0, 4).read()
    assert torch.all(crop[:, :, :2] == 255)
    assert crop[:, 0, 3].tolist() == [10, 20, 30]


def test_exif_turns_only_where_it_is_asked_for(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 3  # upside down
    half = np.zeros((8, 8, 3), np.uint8)
    half[:4] = 255
    Image.fromarray(half).save(tmp_path / "one.png", exif=exif)
    assert Crop(tmp_path / "one.png", None, 0.0, 8).read()[0, 0, 0] == 255
    assert Crop(tmp_path / "one.png", None, 0.0, 8, upright=True).read()[0, 0, 0] == 0


@pytest.mark.filterwarnings("ignore")  # Pillow warns of some damage beside
@pytest.mark.parametrize("suffix", ["jpg", "png", "bmp", "gif", "tiff", "webp"])
def test_damaged_files_are_named(tmp_path: Path, suffix: str) -> None:
    buffer = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 256, (24, 24, 3), dtype=np.uint8)
    Image.fromarray(noise).save(buffer, {"jpg": "JPEG"}.get(suffix, suffix.upper()))
    whole = buffer.getvalue()
    file = tmp_path / f"one.{suffix}"
    random = np.random.default_rng(1)
    for _ in range(60):
        damaged = bytearray(whole[: int(random.integers(len(whole)))])
        for place in random.integers(0, max(1, len(damaged)), 4):
            if damaged:
                damaged[place] ^= int(random.integers(1, 256))
        file.write_bytes(bytes(damaged))
        try:
            pixels = Crop(file, None, 0.0, 8).read()
        except DataError as error:
            assert str(error).startswith(str(file))
        else:
            assert pixels.shape == (3, 8, 8)  # the damage did not reach the pixels
    with pytest.raises(DataError, match="no such file; expected an image"):
        Crop(tmp_path / "none.png", None, 0.0, 8).read()
    with pytest.raises(DataError, match="cannot be read as an image"):
        Crop(tmp_path, None, 0.0, 8).read()


def test_floating_point_images_are_refused(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 4), np.float32)).save(tmp_path / "one.tiff")
    with pytest.raises(DataError, match="floating-point numbers of unknown range, but 8 or 16 bits"):
        Crop(tmp_path / "one.tiff", None, 0.0, 4).read()


def test_huge_images_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = save(tmp_path, np.zeros((30, 30, 3), np.uint8))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    with pytest.raises(DataError, match=r"one\.png: .*Scale the image down"):
        Crop(file, None, 0.0, 4).read()


def test_load_leaves_out_what_cannot_be_read_with_its_fields(tmp_path: Path) -> None:
    files = [save(tmp_path, np.full((4, 4, 3), value, np.uint8), name=f"{value}.png") for value in range(4)]
    files[2].write_bytes(b"")
    crops = [Crop(file, None, 0.0, 2) for file in files]
    for in_memory in (True, False):
        table, faults = images.load(crops, {"target": torch.arange(4)}, "images", in_memory=in_memory)
        assert [str(fault).split(":")[0] for fault in faults] == [str(files[2])]
        items = [table[index] for index in range(len(table))]
        assert [int(item["target"]) for item in items] == [0, 1, 3]
        assert [int(item["index"]) for item in items] == [0, 1, 2]
        assert [int(item["input"][0, 0, 0]) for item in items] == [0, 1, 3]
    table, faults = images.load([], {"target": torch.empty(0)}, "images", in_memory=True)
    assert (len(table), faults) == (0, [])


@pytest.mark.parametrize(
    "name, advice",
    [
        ("a/0", "Did you mean 0.png?"),
        ("0.png", "Did you mean a/0.png?"),
        ("a\\0.png", "Write / instead of \\ in the path."),
        ("a/1.png", "Correct the path."),
        ("b/0.png", "Correct the path."),
    ],
)
def test_the_message_about_a_missing_image_names_a_similar_path(
    tmp_path: Path, name: str, advice: str
) -> None:
    (tmp_path / "a").mkdir()
    save(tmp_path / "a", np.zeros((4, 4, 3), np.uint8), name="0.png")
    with pytest.raises(DataError, match=re.escape(f"{name}: no such file; expected an image. {advice}")):
        Crop(tmp_path / name, None, 0.0, 2).read()


def test_files_are_left_out_only_if_others_remain() -> None:
    faults = [DataError("a"), DataError("b")]
    assert "or set data.unreadable=skip to leave" in images.advise_unreadable(
        faults, 3, "data.unreadable=skip"
    )
    assert "data.unreadable" not in images.advise_unreadable(faults, 2, "data.unreadable=skip")


def test_long_lists_of_faults_are_cut() -> None:
    message = images.fault_message([DataError(f"fault {number}") for number in range(13)], 40, "Mend them.")
    assert message.splitlines() == [
        "13 of 40 samples cannot be read:",
        *[f"  fault {number}" for number in range(10)],
        "  and 3 more",
        "Mend them.",
    ]


def test_augmented_without_jitter_is_the_image_or_its_mirror_image() -> None:
    pixels = torch.randint(0, 256, (6, 3, 5, 8), dtype=torch.uint8)
    mirrored = torch.tensor([True, False, True, False, False, True])
    result = augment(pixels, mirrored, 0.0)
    expected = torch.where(mirrored[:, None, None, None], pixels.flip(-1), pixels) / 255
    torch.testing.assert_close(result, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(augment(pixels / 255, mirrored, 0.0), expected, rtol=0, atol=1e-6)


def test_augmented_against_scipy() -> None:
    """Shift, scale, mirror, contrast and brightness of each image, drawn again and applied by SciPy."""
    batch, height, width, jitter = 8, 12, 15, 0.15
    pixels = torch.randint(0, 256, (batch, 3, height, width), dtype=torch.uint8)
    mirrored = torch.arange(batch) % 2 == 0
    torch.manual_seed(3)
    result = augment(pixels, mirrored, jitter).numpy()
    torch.manual_seed(3)
    amount = ((2 * torch.rand(5, batch) - 1) * jitter).double().numpy()
    for index in range(batch):
        log_scale, down, right, log_contrast, brightness = amount[:, index]
        scale, contrast = math.exp(log_scale), math.exp(2 * log_contrast)
        rows = (height - 1) / 2 + down * height + scale * (np.arange(height) - (height - 1) / 2)
        sign = -1 if mirrored[index] else 1
        columns = (width - 1) / 2 + right * width + sign * scale * (np.arange(width) - (width - 1) / 2)
        places = np.meshgrid(rows, columns, indexing="ij")
        for channel in range(3):
            source = pixels[index, channel].double().numpy() / 255
            moved = scipy.ndimage.map_coordinates(source, places, order=1, mode="nearest")
            expected = np.clip((moved - 0.5) * contrast + 0.5 + brightness, 0, 1)
            np.testing.assert_allclose(result[index, channel], expected, atol=2e-6)


def test_augmented_is_the_same_while_a_model_of_float64_trains() -> None:
    pixels = torch.randint(0, 256, (4, 3, 9, 9), dtype=torch.uint8)
    found = []
    try:
        for kind in (torch.float32, torch.float64):
            torch.set_default_dtype(kind)
            torch.manual_seed(0)
            found.append(augment(pixels, torch.tensor([True, False, True, False]), 0.1))
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(*found)


def test_augmented_takes_an_empty_batch() -> None:
    none = torch.empty((0, 3, 8, 8), dtype=torch.uint8)
    assert augment(none, torch.empty(0, dtype=torch.bool), 0.1).shape == (0, 3, 8, 8)


def test_augmentation_mirrors_half_of_a_batch_and_signs_its_angles() -> None:
    torch.manual_seed(0)
    pixels = torch.randint(0, 256, (200, 3, 8, 8), dtype=torch.uint8)
    batch = {"input": pixels, "target": torch.rand(200, 2) + 0.1, "index": torch.arange(200)}
    result = vary(batch, (-1.0, 1.0), 0.0)
    flipped = (255 * result["input"] - pixels.flip(-1)).abs().amax((1, 2, 3)) < 0.01
    same = (255 * result["input"] - pixels).abs().amax((1, 2, 3)) < 0.01
    assert torch.all(same ^ flipped)
    assert 70 < int(flipped.sum()) < 130
    expected = torch.where(flipped[:, None], batch["target"] * torch.tensor([-1.0, 1.0]), batch["target"])
    assert torch.equal(result["target"], expected)
    assert result["index"] is batch["index"]
    assert vary(batch, (), 0.0) is batch
    shaken = vary(batch, (), 0.1)
    assert torch.equal(shaken["target"], batch["target"])
    assert not torch.equal(255 * shaken["input"], pixels.float())


def test_picture_of_grey_and_of_floating_point_images() -> None:
    grey = torch.tensor([[[0.0, 1.0], [0.5, 2.0]]])
    expected = np.array([[0, 255], [128, 255]], np.uint8)[..., None].repeat(3, axis=2)
    np.testing.assert_array_equal(to_rgb8(grey), expected)
    np.testing.assert_array_equal(to_rgb8(torch.from_numpy(expected).permute(2, 0, 1)), expected)


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_real_views_look_most_like_their_neighbours(tmp_path: Path) -> None:
    """COIL-20, object 1, one view every 5°: read from files, each view's nearest one is at most 10° away."""
    views = scipy.io.loadmat(Path(os.environ["REAL_DATA_ROOT"]) / "orientation" / "COIL20.mat")["X"][:72]
    pixels = views.reshape(-1, 32, 32).transpose(0, 2, 1)
    files = [save(tmp_path, view, name=f"{index}.png") for index, view in enumerate(pixels.astype(np.uint8))]
    crops = torch.stack([Crop(file, None, 0.0, 16, channels=1).read() for file in files]).flatten(1).float()
    distance = torch.cdist(crops, crops).fill_diagonal_(math.inf)
    apart = (distance.argmin(1) - torch.arange(72)).abs()
    assert torch.minimum(apart, 72 - apart).max() <= 2


def test_small_files_that_take_much_memory_or_time_to_decode_are_refused(tmp_path: Path) -> None:
    """Tiles that are larger than the image, and scans that pass over every pixel."""
    for name, content, message in (
        ("tiles.tif", tiled(7200), r"tiles of 7200 x 7200 pixels; at most 50331648 are allowed"),
        ("scans.jpg", scanned(200, 64, 48), r"more than 100 scans, which is not allowed"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=rf"{name}: cannot be read as an image \(the image has {message}"):
            Crop(tmp_path / name, None, 0.0, 8).read()


def test_a_photograph_with_a_thumbnail_and_a_film_behind_it_is_read(tmp_path: Path) -> None:
    """Only the scans of the image count, and not what looks like scans in the data around it."""
    stream = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    like_scans = b"\xff\xda" * 200
    Image.fromarray(noise).save(stream, "JPEG", progressive=True, comment=like_scans, restart_marker_blocks=1)
    (tmp_path / "one.jpg").write_bytes(stream.getvalue() + like_scans)
    pixels = Crop(tmp_path / "one.jpg", None, 0.0, 64).read().numpy()
    with Image.open(stream) as wanted:
        np.testing.assert_array_equal(pixels, np.asarray(wanted).transpose(2, 0, 1))
