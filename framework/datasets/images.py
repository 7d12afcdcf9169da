"""Functions that read image files, cut squares out of them, make data sets of squares, and augment and blur images."""

import math
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from numpy.typing import NDArray
from PIL import Image, ImageFile, ImageOps, UnidentifiedImageError
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.storage import reading
from framework.storage.limits import AT_ONCE, LONGEST_SIDE, MOST_PADDED, MOST_PIXELS, MOST_PIXELS_OF
from framework.storage.progress import tracked

READERS = min(8, os.cpu_count() or 1)
"""Number of threads that decode images at the same time."""
FORMATS = ("AVIF", "BMP", "GIF", "ICO", "JPEG", "JPEG2000", "PCX", "PNG", "PPM", "SGI", "TGA", "TIFF", "WEBP")
"""Formats of Pillow that only decode pixels; EPS, for example, would start another program."""
SUFFIXES = (".avif", ".bmp", ".gif", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
"""Usual suffixes of image files; a file with another suffix is an image if it can be decoded."""
ORIENTATION = 0x0112
"""Number of the EXIF entry that says how an image is rotated."""
BITS_PER_SAMPLE, PHOTOMETRIC = 258, 262
"""Numbers of the TIFF entries for the bits of a value, and for the meaning of 0: entry 0 is white, entry 1 is black."""
MODES = {1: "L", 3: "RGB", 4: "RGBA"}
"""Pillow's names of decoded images, by number of channels."""
STRIP = 256
"""Number of rows that are converted at a time."""
IN_MEMORY = 2 * 2**30
"""Size of a data set of crops, in bytes, up to which the crops are kept in memory."""

Box = tuple[float, float, float, float]
"""Left, top, right and bottom in pixels, measured from the outer corner: (0, 0, width, height) is the whole image."""


@dataclass(frozen=True)
class Crop:
    """A square that is cut out of an image file.

    Attributes:
        file: path of the image.
        box: part of the image in the middle of the square; None: the whole image.
        margin: border added on each side, as a share of the box's longer side.
        side: side of the resulting square, pixels.
        channels: 3 for colour, 1 for grey.
        upright: rotate the image as its EXIF entry says, as photo viewers do.
        blur: standard deviation of the Gaussian that blurs the result, pixels of the result; 0: no blur.
    """

    file: Path
    box: Box | None
    margin: float
    side: int
    channels: int = 3
    upright: bool = False
    blur: float = 0.0

    def read(self) -> UInt8[Tensor, "channels side side"]:
        """Read the file and return the square cut out of it.

        Raises:
            DataError: the file is missing, is no image or is truncated, or the box lies outside the image.
        """
        with opened(self.file) as raw, DECODED.taking(raw.width * raw.height):
            image = plain(raw, self.channels, upright=self.upright)
            whole = (0.0, 0.0, float(image.width), float(image.height))
            pixels = square(image, self.box or whole, self.margin, self.side)
        if pixels is None:
            raise self._outside(image.size)
        return blurred(torch.from_numpy(pixels), self.blur)

    def check(self) -> None:
        """Check the header of the file only.

        Raises:
            DataError: the file is missing, is no image, or the box lies outside the image.
        """
        with opened(self.file) as image:
            if self.box is not None and clipped(self.box, image.size) is None:
                raise self._outside(image.size)

    def _outside(self, size: tuple[int, int]) -> DataError:
        return DataError(
            f"{self.file}: the box {self.box} lies outside the image of {size[0]} x {size[1]} pixels; "
            "wanted left < right and top < bottom within it. Mend the annotation."
        )


@contextmanager
def opened(file: Path) -> Iterator[Image.Image]:
    """Open an image file for the time of decoding it.

    Raises:
        DataError: the file is missing, is no image, or is truncated; the message names it.
    """
    with (
        reading.guarded(file, "an image", f"{reading.RESTORE} Scale the image down if it is too large."),
        reading.opened(file) as stream,
        of_stream(stream) as image,
    ):
        yield image


@contextmanager
def of_stream(stream: BinaryIO | BytesIO) -> Iterator[Image.Image]:
    """Open the content of an image file for the time of decoding it, whatever the file's suffix.

    If the file holds several images (frames, pages), it is the first one.

    Raises:
        ValueError: the image has more pixels than `MOST_PIXELS_OF` and `LONGEST_SIDE` allow.
        Exception: the content is no image, or damaged.
    """
    try:
        found = Image.open(stream, formats=FORMATS)
    except UnidentifiedImageError:
        raise ValueError(f"its content is none of {', '.join(FORMATS)}") from None
    with found as image:
        most = MOST_PIXELS_OF.get(image.format or "", MOST_PIXELS)
        if image.width * image.height > most or max(image.size) > LONGEST_SIDE:
            raise ValueError(
                f"{image.width} x {image.height} pixels; at most {most}, and {LONGEST_SIDE} along a side"
            )
        yield image


class AtOnce:
    """Limit on the pixels that all threads hold together, because decoded images take much memory.

    A single thread may hold any number of pixels while no other thread holds any.

    Args:
        most: largest number of pixels.
    """

    def __init__(self, most: int) -> None:
        self.most, self.taken, self.changed = most, 0, threading.Condition()
        os.register_at_fork(after_in_child=self._forget)

    @contextmanager
    def taking(self, pixels: int) -> Iterator[None]:
        """Wait until there is room for this many pixels, and reserve it inside the block."""
        with self.changed:
            self.changed.wait_for(lambda: not self.taken or self.taken + pixels <= self.most)
            self.taken += pixels
        try:
            yield
        finally:
            with self.changed:
                self.taken -= pixels
                self.changed.notify_all()

    def _forget(self) -> None:
        """Reset the count in a forked process, which has none of the threads that hold pixels."""
        self.taken, self.changed = 0, threading.Condition()


DECODED = AtOnce(AT_ONCE)
"""Limit on the decoded images of this process."""


def plain(image: Image.Image, channels: int, *, upright: bool) -> Image.Image:
    """Decode an image to eight bits, however it is stored. Every reader of images uses this decoder.

    Args:
        image: an opened image.
        channels: 1 for grey, 3 for RGB, 4 for RGB with alpha. Without alpha, transparent pixels become white.
        upright: rotate it as its EXIF entry says.

    Raises:
        DataError: the range of its values is unknown.
    """
    stored = _stored(image)
    # exif_transpose would copy the image in any case
    turned = upright and image.getexif().get(ORIENTATION, 1) != 1
    whole = ImageOps.exif_transpose(image) if turned else image
    whole.load()
    mode = MODES[channels]
    if whole.mode == mode and "transparency" not in whole.info:
        return whole
    found = Image.new(mode, whole.size)
    # In strips, because whole intermediate images beside the source and the result would take four times the memory.
    for top, strip in _strips(whole, stored, channels, opaque=False):
        found.paste(strip, (0, top))
    return found


def colors(image: Image.Image) -> Iterator[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
    """Decode an image to RGB as `plain` does, but ignore its alpha: transparent pixels keep their colours.

    Yields:
        The first row of a strip, and its pixels.

    Raises:
        DataError: as in `plain`.
    """
    for top, strip in _strips(image, _stored(image), 3, opaque=True):
        yield top, np.asarray(strip)


def _strips(
    image: Image.Image, stored: "_Stored", channels: int, *, opaque: bool
) -> Iterator[tuple[int, Image.Image]]:
    for top in range(0, image.height, STRIP):
        strip = image.crop((0, top, image.width, min(top + STRIP, image.height)))
        if stored.key is not None:
            strip.info["transparency"] = stored.key
        strip = _eight_bit(strip, stored)
        if channels != 4 and not opaque and has_alpha(strip):
            strip = Image.alpha_composite(Image.new("RGBA", strip.size, "white"), strip.convert("RGBA"))
        yield top, strip.convert(MODES[channels])


def has_alpha(image: Image.Image) -> bool:
    """Return whether an image has an alpha channel or a transparent colour."""
    return image.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in image.info


class _Stored(NamedTuple):
    """Meaning of the values in a file; a loaded image no longer tells it.

    Attributes:
        black: value of black, if a value has more than eight bits.
        white: value of white, if a value has more than eight bits.
        key: colour that is transparent, in the values of decoded pixels; None if no colour is.
    """

    black: int
    white: int
    key: Any


def _stored(image: Image.Image) -> _Stored:
    """Read the meaning of an image's values from its header.

    Raises:
        DataError: the range of its values is unknown; or a 16-bit colour is transparent, of which only 8 bits are
            decoded.
    """
    tags = getattr(image, "tag_v2", {})  # entries of a TIFF file
    long = image.mode.startswith("I")
    if image.mode == "F" or (image.mode == "I" and tags):
        kind = "floating-point numbers" if image.mode == "F" else "integers of 32 bits, or with a sign,"
        raise DataError(
            f"its pixels are {kind} of unknown range; wanted 8 or 16 bits. Scale them to 16 bits, and save it anew."
        )
    key = image.info.get("transparency")
    if image.mode == "RGB" and isinstance(key, tuple) and max(key) > 255:
        raise DataError(
            "one of its 16-bit colours stands for transparent pixels; wanted an alpha channel. Save it with one."
        )
    if image.mode == "L" and isinstance(key, int) and isinstance(image, ImageFile.ImageFile) and image.tile:
        # Pillow gives the key in the bits of the PNG file.
        key *= {"L;2": 85, "L;4": 17}.get(str(image.tile[0].args), 1)
    most = 2 ** tags.get(BITS_PER_SAMPLE, (16,))[0] - 1 if long else 255
    return _Stored(most, 0, key) if long and tags.get(PHOTOMETRIC) == 0 else _Stored(0, most, key)


def _eight_bit(strip: Image.Image, stored: _Stored) -> Image.Image:
    """Return a strip in one of the modes that Pillow converts to grey, RGB and RGBA."""
    if strip.mode.startswith("I"):
        numbers, most = np.asarray(strip).astype(np.int64), max(stored.black, stored.white)
        if numbers.size and not (numbers.min() >= 0 and numbers.max() <= most):
            raise DataError(
                f"its pixels go from {numbers.min()} to {numbers.max()}; wanted 0 to {most}. Scale them, and save it "
                "anew."
            )
        grey = Image.fromarray(((255 * abs(numbers - stored.black) + most // 2) // most).astype(np.uint8))
        if stored.key is not None:
            grey.putalpha(Image.fromarray((255 * (numbers != stored.key)).astype(np.uint8)))
        return grey
    if strip.mode in ("La", "RGBa"):  # colours that were multiplied with alpha
        return strip.convert("LA" if strip.mode == "La" else "RGBA")
    if has_alpha(strip):
        return strip.convert("RGBA")
    return strip.convert("RGB") if strip.mode == "LAB" else strip


def square(image: Image.Image, box: Box, margin: float, side: int) -> NDArray[np.uint8] | None:
    """Return the square around a box, (channels, side, side), low-pass filtered; None if the box is empty.

    The box is first clipped to the image. Where the square reaches beyond the image, border pixels are repeated.
    """
    inner = clipped(box, image.size)
    if inner is None:
        return None
    left, top, right, bottom = inner
    half = (0.5 + margin) * max(right - left, bottom - top)
    x, y = (left + right) / 2, (top + bottom) / 2
    # First the whole pixels around the square, then those inside the image, then the square within the cut part.
    first_x, first_y = math.floor(x - half), math.floor(y - half)
    last_x, last_y = math.ceil(x + half), math.ceil(y + half)
    inside = (max(0, first_x), max(0, first_y), min(image.width, last_x), min(image.height, last_y))
    padded = inside != (first_x, first_y, last_x, last_y)
    if padded and (last_x - first_x) * (last_y - first_y) > MOST_PADDED:  # a long strip, for example
        step = math.ceil(max(last_x - first_x, last_y - first_y) / math.isqrt(MOST_PADDED))
        small = (left / step, top / step, right / step, bottom / step)
        return square(image.reduce(step), small, margin, side)
    cut = image if inside == (0, 0, *image.size) else image.crop(inside)
    if padded:
        cut = _padded(cut, inside[0] - first_x, inside[1] - first_y, (last_x - first_x, last_y - first_y))
    start_x, start_y = max(0.0, x - half - first_x), max(0.0, y - half - first_y)
    window = (start_x, start_y, min(cut.width, start_x + 2 * half), min(cut.height, start_y + 2 * half))
    result = np.asarray(cut.resize((side, side), Image.Resampling.BILINEAR, box=window))
    return np.array(np.atleast_3d(result).transpose(2, 0, 1), order="C")


def _padded(image: Image.Image, left: int, top: int, size: tuple[int, int]) -> Image.Image:
    """Return an image of `size` with this image at (left, top); its border pixels are repeated around it."""
    width, height = size
    right, bottom = left + image.width, top + image.height
    found = Image.new(image.mode, size)
    found.paste(image, (left, top))
    for edge, first, last in ((left, 0, left), (right - 1, right, width)):
        column = found.crop((edge, top, edge + 1, bottom))
        if last > first:
            found.paste(column.resize((last - first, image.height), Image.Resampling.NEAREST), (first, top))
    for edge, first, last in ((top, 0, top), (bottom - 1, bottom, height)):
        if last > first:
            row = found.crop((0, edge, width, edge + 1))
            found.paste(row.resize((width, last - first), Image.Resampling.NEAREST), (0, first))
    return found


def clipped(box: Box, size: tuple[int, int]) -> Box | None:
    """Return a box clipped to an image of (width, height); None if nothing is left or the box is not finite."""
    if not all(map(math.isfinite, box)):
        return None
    width, height = map(float, size)
    left, top, right, bottom = max(0.0, box[0]), max(0.0, box[1]), min(width, box[2]), min(height, box[3])
    return (left, top, right, bottom) if left < right and top < bottom else None


class Crops(Dataset[dict[str, Tensor]]):
    """Data set that reads each crop from its file when it is requested; the other fields are in memory.

    Items raise a DataError if a file cannot be read.
    """

    def __init__(self, crops: Sequence[Crop], **fields: Tensor) -> None:
        self.crops = crops
        self.fields = Fields(**fields)

    def __len__(self) -> int:
        return len(self.crops)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        return {"input": self.crops[index].read(), **self.fields[index]}


def load(
    crops: Sequence[Crop], fields: Mapping[str, Tensor], what: str, *, in_memory: bool
) -> tuple[Fields | Crops, list[DataError]]:
    """Return a data set of the crops that can be read ("input", their `fields`, "index"), and the errors of the others.

    With `in_memory` every crop is decoded now. Otherwise only the headers of the files are read, and damage after the
    header is found when a crop is used.
    """
    faults: dict[int, DataError] = {}
    shape = (len(crops), crops[0].channels, crops[0].side, crops[0].side) if crops and in_memory else (0,)
    pixels = torch.empty(shape, dtype=torch.uint8)

    def visit(index: int) -> None:
        try:
            if in_memory:
                pixels[index] = crops[index].read()
            else:
                crops[index].check()
        except DataError as error:
            faults[index] = error

    with ThreadPoolExecutor(READERS) as readers:
        for _ in tracked(readers.map(visit, range(len(crops))), f"reading {what}", len(crops), "images"):
            pass
    good = [index for index in range(len(crops)) if index not in faults]
    kept = {name: field[good] if faults else field for name, field in fields.items()}
    kept["index"] = torch.arange(len(good))
    reasons = [faults[index] for index in sorted(faults)]
    if in_memory and good:
        return Fields(input=pixels[good] if faults else pixels, **kept), reasons
    return Crops([crops[index] for index in good], **kept), reasons


def load_splits(
    crops: Mapping[str, Sequence[Crop]],
    fields: Mapping[str, Mapping[str, Tensor]],
    faults: Sequence[DataError] = (),
    *,
    skip_unreadable: bool,
    generated_in: Path | None = None,
) -> tuple[dict[str, Fields | Crops], int]:
    """Return a data set of the readable crops of each split, and the number of samples that cannot be read.

    Args:
        crops: crops by the split's name.
        fields: fields by the split's name.
        faults: errors of samples whose labels could not be read.
        skip_unreadable: leave out samples that cannot be read.
        generated_in: the cache folder of generated images; None: the images are the user's.

    Raises:
        DataError: samples cannot be read and must not be skipped; the message names the first ten.
    """
    every = [crop for chosen in crops.values() for crop in chosen]
    total = len(faults) + len(every)
    in_memory = not every or fit_in_memory(total, every[0].side, every[0].channels)
    loaded = {
        split: load(chosen, fields[split], f"the {split} images", in_memory=in_memory)
        for split, chosen in crops.items()
    }
    faults = [*faults, *(fault for _, bad in loaded.values() for fault in bad)]
    if faults and not skip_unreadable:
        remedy = "Restore them, or set data.skip_unreadable=true to leave them out."
        if generated_in is not None:
            remedy = f"Delete {generated_in}: the data are generated anew."
        raise DataError(fault_message(faults, total, remedy))
    return {split: table for split, (table, _) in loaded.items()}, len(faults)


def angle_fields(angles: Sequence[Sequence[float]], names: Sequence[str]) -> dict[str, Tensor]:
    """Return "target" (radians in [-π, π), one column per name) and "group" (0) of samples with these angles."""
    turned = [[(angle + math.pi) % (2 * math.pi) - math.pi for angle in row] for row in angles]
    return {
        "target": torch.tensor(turned, dtype=torch.float32).reshape(len(angles), len(names)),
        "group": torch.zeros(len(angles), dtype=torch.int64),
    }


def unlabelled(crops: Sequence[Crop]) -> Fields | Crops:
    """Return a data set, "input" and "index", of a user's own images in their order.

    Raises:
        DataError: there is no image, or some cannot be read; the message names the first ten.
    """
    if not crops:
        raise DataError("No image file was given; wanted at least one.")
    in_memory = fit_in_memory(len(crops), crops[0].side, crops[0].channels)
    table, faults = load(crops, {}, "images", in_memory=in_memory)
    if faults:
        raise DataError(fault_message(faults, len(crops), "Leave them out, or restore them."))
    return table


def fit_in_memory(crops: int, side: int, channels: int) -> bool:
    """Return whether this many crops take at most IN_MEMORY bytes."""
    return crops * channels * side**2 <= IN_MEMORY


def fault_message(faults: Sequence[DataError], total: int, remedy: str) -> str:
    """Return a message with the number of unreadable samples, at most ten of the reasons, and the remedy."""
    return f"{len(faults)} of {total} samples cannot be read:{listed(faults)}\n{remedy}"


def listed(items: Sequence[object]) -> str:
    """Return at most ten of the items, each on its own line, and the number of the others."""
    lines = [str(item) for item in items[:10]]
    if len(items) > 10:
        lines.append(f"and {len(items) - 10} more")
    return "".join(f"\n  {line}" for line in lines)


def varied(batch: Batch, signs: Sequence[float], jitter: float) -> Batch:
    """Vary the images of a training batch as `augmented` does and, if there are `signs`, mirror half of them.

    The angles of a mirrored image are multiplied by `signs`, 1 or -1 for each angle.
    """
    if not signs and not jitter:
        return batch
    target = batch["target"]
    mirrored = (torch.rand(len(target)) < 0.5) & bool(signs)
    turned = target * torch.tensor(signs or 1.0).to(target)
    return {
        **batch,
        "input": augmented(batch["input"], mirrored, jitter),
        "target": torch.where(mirrored.to(target.device)[:, None], turned, target),
    }


def augmented(
    images: Shaped[Tensor, "batch channels height width"], mirrored: Bool[Tensor, "batch"], jitter: float
) -> Float[Tensor, "batch channels height width"]:
    """Vary images at random; the values are 0…1, on the images' device.

    Images that `mirrored` marks are reflected left to right. Every image is shifted and scaled by up to `jitter` of its
    side (linear interpolation, border pixels repeated). Its brightness changes by up to `jitter`, and its contrast by
    up to twice that. Random numbers come from torch's global CPU generator.
    """
    batch, _, height, width = images.shape
    # float32, because the default type may be float64 while a float64 model trains.
    amount = (2 * torch.rand(5, batch, dtype=torch.float32) - 1) * jitter
    scale = amount[0].exp()
    sign = 1 - 2 * mirrored.to("cpu", torch.float32)
    rows = _positions(height, scale, amount[1] * height).to(images.device)
    columns = _positions(width, sign * scale, amount[2] * width).to(images.device)
    # Whole lines are copied fastest, so columns are interpolated as rows of the transposed image. kornia's warp_affine
    # agrees to 0.01 grey levels and takes twice to five times as long (batches of 48 to 75 pixels, one thread).
    image = _interpolated(images.transpose(2, 3), columns)
    image = _interpolated(image.transpose(2, 3), rows)

    full = 1.0 if images.is_floating_point() else 255.0
    contrast, brightness = (2 * amount[3]).exp(), amount[4]
    gain, offset = contrast / full, 0.5 - 0.5 * contrast + brightness
    return image.mul_(gain.view(-1, 1, 1, 1).to(image)).add_(offset.view(-1, 1, 1, 1).to(image)).clamp_(0, 1)


def _positions(length: int, scale: Tensor, shift: Tensor) -> Float[Tensor, "batch length"]:
    """Return the source position of each of `length` pixels, scaled about the middle and kept within the image."""
    middle = (length - 1) / 2
    offset = torch.arange(length, dtype=torch.float32) - middle
    return (middle + shift[:, None] + scale[:, None] * offset).clamp(0, length - 1)


def _interpolated(images: Tensor, rows: Float[Tensor, "batch height"]) -> Tensor:
    """Interpolate the lines of each image at fractional `rows`, as float32."""
    batch, channels, height, width = images.shape
    lines = images.reshape(-1, width)
    plane = height * torch.arange(batch * channels, device=images.device).view(batch, channels, 1)
    first = rows.long()
    second = (first + 1).clamp(max=height - 1)
    above, below = (
        lines.index_select(0, (plane + row[:, None]).view(-1)).view(images.shape).float()
        for row in (first, second)
    )
    return above.lerp_(below, (rows - first)[:, None, :, None])


def blurred(
    images: Shaped[Tensor, "*batch height width"], deviation: float
) -> Shaped[Tensor, "*batch height width"]:
    """Convolve images with a Gaussian of standard deviation `deviation` pixels; 0 returns the images themselves.

    The kernel ends at four deviations and sums to 1. Beyond the border the image is mirrored about its edge (d c b a |
    a b c d | d c b a). The result has the images' type; integers are rounded.
    """
    if deviation == 0:
        return images
    exact = images if images.is_floating_point() else images.float()
    height, width = images.shape[-2:]
    down = _smoothing(height, deviation).to(exact)
    across = _smoothing(width, deviation).to(exact)
    # Separable: G(x, y) = g(x) g(y). Two products of matrices cost the same whatever the deviation; kornia's
    # gaussian_blur2d takes 2 to 70 times as long, lacks this border, and refuses kernels larger than the image.
    smooth = down @ exact @ across.mT
    return smooth if images.is_floating_point() else smooth.round_().to(images.dtype)


def _smoothing(length: int, deviation: float) -> Float[Tensor, "length length"]:
    """Return the Gaussian filter of a line of `length` pixels as a matrix, float64."""
    reach = int(4 * deviation + 0.5)
    offsets = torch.arange(-reach, reach + 1)
    weights = (-0.5 * (offsets.double() / deviation).square()).exp()
    # A line that is mirrored repeatedly about its edges has a period of twice its length.
    source = (torch.arange(length)[:, None] + offsets) % (2 * length)
    source = torch.minimum(source, 2 * length - 1 - source)
    matrix = torch.zeros(length, length, dtype=torch.float64)
    return matrix.scatter_add_(1, source, (weights / weights.sum()).expand(length, -1))


def picture(image: Tensor) -> NDArray[np.uint8]:
    """Return one image (channels, height, width), uint8 or float in 0…1, as (height, width, 3) uint8."""
    pixels = image.detach().cpu()
    if pixels.is_floating_point():
        pixels = (255 * pixels.clamp(0, 1)).round().to(torch.uint8)
    return pixels.expand(3, -1, -1).permute(1, 2, 0).contiguous().numpy()
